//! Modes: drives of the world's own ego that are candidates as they are, whatever the others do.
//!
//! Imitation draws its ego anew in every future, together with the others, so its value is that of
//! several drives of which one is followed. A mode is one drive, drawn before the futures that it is
//! judged in. Start with [`Imagination::modes`].

use std::sync::Arc;
use std::time::Duration;

use gump_nuplan::tracking::Trajectory;
use gump_rollout::{Session, Start};
use gump_scene::{EgoState, SceneState};

use super::imagine::{Begun, CandidateFuture, DECISION, Imagination, ROUND, frames_per_decision};
use super::{CandidateEvaluation, Phases};
use crate::pdm::TRAJECTORY_STEPS;
use crate::pdm::propose::DT;
use crate::pdm::state::trajectory;
use crate::pdm::track::Tracker;
use crate::{PlanError, ProposalKind};

/// Draws for each mode that is wanted. Chosen by hand: a draw costs as much as a candidate's first
/// future, and with fewer the rarer modes are missed.
const DRAWS_PER_MODE: usize = 2;
/// Drives that are nearer to each other are one mode: root mean square of the distances every half
/// second, metres. Chosen by hand, twice the step of positions of the networks' older form.
const SAME_DRIVE: f64 = 0.5;
/// Rounds of the clustering; a dozen draws settle within two or three.
const ROUNDS: usize = 8;

/// A mode.
pub(super) struct Mode {
    /// From 1.
    index: usize,
    /// The vehicle's states every tenth of a second, now first.
    pub(super) drive: Arc<[EgoState]>,
}

impl Mode {
    pub(super) fn kind(&self) -> ProposalKind {
        ProposalKind::NetworkMode { index: self.index }
    }
}

/// A drive of the world's ego that is followed.
#[derive(Clone, Debug)]
pub(super) struct Following {
    /// The drive, and straight on after it.
    pub(super) way: Trajectory,
    /// The number of the mode; `None` for imitation, which is drawn anew in each decision.
    mode: Option<usize>,
    /// Where the drawn part ends, microseconds.
    drawn_to_us: i64,
}

impl Following {
    /// The drive of a candidate that was just chosen, if it is one of the world's ego.
    pub(super) fn begin(
        chosen: &CandidateEvaluation,
        ego: &EgoState,
        horizon: f64,
    ) -> Result<Option<Self>, PlanError> {
        let mode = match chosen.kind {
            ProposalKind::NetworkMode { index } => Some(index),
            ProposalKind::Imitation => None,
            _ => return Ok(None),
        };
        Ok(Some(Self {
            way: imitated(chosen, ego)?,
            mode,
            drawn_to_us: ego.time_us + (horizon * 1e6).round() as i64,
        }))
    }

    /// The number of the mode, as long as at least half of a horizon of its drawn part lies ahead:
    /// so long it stays a candidate.
    pub(super) fn mode_under_way(&self, now_us: i64, horizon: f64) -> Option<usize> {
        let rest = (horizon / 2.0 * 1e6).round() as i64;
        self.mode.filter(|_| self.drawn_to_us - now_us >= rest)
    }
}

impl<'a> Imagination<'a> {
    /// The modes of this decision: the one that is followed, and representatives of new draws,
    /// the likeliest first. None if time is up before they are drawn.
    pub(super) fn modes(
        &self,
        scene: SceneState<'_>,
        began: Duration,
        n_decisions: usize,
        opened: &mut Vec<Box<dyn Session + 'a>>,
        phases: &mut Phases,
    ) -> Result<Vec<Mode>, PlanError> {
        let n = self.config.network_modes;
        if n < 2 {
            return Ok(Vec::new());
        }
        let mut modes = Vec::from_iter(self.mode_under_way(n_decisions)?);
        let draws = self.draws(scene, began, n_decisions, opened, phases)?;
        let time = (self.clock)();
        let taken = modes.first().map(|mode| mode.index);
        let followed = modes.first().map(|mode| mode.drive.clone());
        let mut free = (1..=n).filter(|&index| taken != Some(index));
        for i in representatives(&draws, n) {
            let known = |drive: &Arc<[EgoState]>| apart(drive, &draws[i]) < SAME_DRIVE;
            if followed.as_ref().is_some_and(known) {
                continue;
            }
            let Some(index) = free.next() else {
                break;
            };
            modes.push(Mode {
                index,
                drive: draws[i].as_slice().into(),
            });
        }
        modes.sort_by_key(|mode| mode.index);
        phases.policies += (self.clock)() - time;
        Ok(modes)
    }

    /// The rest of the mode that is followed, from where the ego is.
    fn mode_under_way(&self, n_decisions: usize) -> Result<Option<Mode>, PlanError> {
        let ego = self.input.ego;
        let horizon = self.config.budget.horizon;
        let index = |f: &Following| f.mode_under_way(ego.time_us, horizon);
        let Some((following, index)) = self.following.and_then(|f| Some((f, index(f)?))) else {
            return Ok(None);
        };
        let n = n_decisions * DECISION;
        let mut poses = Vec::with_capacity(n + 1);
        for i in 0..=n as i64 {
            let time_us = ego.time_us + i * (DT * 1e6) as i64;
            let pose = following.way.pose_at(time_us);
            poses.push(pose.map_err(|error| self.failed(error.into()))?);
        }
        let mut drive = Vec::new();
        let wheel_base = self.state.vehicle.wheel_base;
        Tracker::new(n).drive(ego, &poses, wheel_base, &mut drive);
        Ok(Some(Mode {
            index,
            drive: drive.into(),
        }))
    }

    /// Draws of the world's ego, as the vehicle drives them; none if time is up.
    fn draws(
        &self,
        scene: SceneState<'_>,
        began: Duration,
        n_decisions: usize,
        opened: &mut Vec<Box<dyn Session + 'a>>,
        phases: &mut Phases,
    ) -> Result<Vec<Vec<EgoState>>, PlanError> {
        let n_futures = DRAWS_PER_MODE * self.config.network_modes;
        let time = (self.clock)();
        let start = Start {
            scene,
            n_futures,
            // No round has this number.
            seed: self.seed(0).fork(2 * ROUND),
        };
        let session = self.world.open(&[start]);
        let mut session = session.map_err(|error| self.failed(error))?;
        let per = frames_per_decision(&*session).map_err(|error| self.failed(error.into()))?;
        let mut futures: Vec<CandidateFuture> = (0..n_futures)
            .map(|_| self.future(Begun::default()))
            .collect();
        let all: Vec<usize> = (0..n_futures).collect();
        let begun = (self.clock)();
        phases.open += begun - time;
        let mut is_late = false;
        for _ in 0..n_decisions {
            let spent = (self.clock)() - began;
            is_late = self.config.budget.wall.is_some_and(|wall| spent > wall);
            if is_late {
                break;
            }
            self.answer(&mut *session, &mut futures, &all, per, false)?;
        }
        phases.frames += (self.clock)() - begun;
        opened.push(session);
        if is_late {
            return Ok(Vec::new());
        }
        self.imitate(&mut futures, n_decisions);
        Ok(futures.into_iter().map(|future| future.drive).collect())
    }
}

/// Root mean square of the distances of two drives every half second, metres.
fn apart(a: &[EgoState], b: &[EgoState]) -> f64 {
    let moments = a.iter().zip(b).step_by(DECISION).skip(1);
    let (sum, n) = moments.fold((0.0, 0), |(sum, n), (a, b)| {
        let (a, b) = (a.rear_axle.position, b.rear_axle.position);
        (sum + a.distance_squared(b), n + 1)
    });
    (sum / f64::from(n.max(1))).sqrt()
}

/// Up to `n` drives that stand for all: medoids of clusters, that of the largest cluster first. They
/// are draws themselves, since a mean of two ways round an obstacle leads into it.
fn representatives(drives: &[Vec<EgoState>], n: usize) -> Vec<usize> {
    let all = 0..drives.len();
    let distance: Vec<Vec<f64>> = drives
        .iter()
        .map(|a| drives.iter().map(|b| apart(a, b)).collect())
        .collect();
    // The member nearest to all others, the first of several.
    let middle = |members: &[usize]| {
        let sum = |&i: &usize| members.iter().map(|&j| distance[i][j]).sum::<f64>();
        let of = |members: &[usize]| {
            members
                .iter()
                .copied()
                .min_by(|a, b| sum(a).total_cmp(&sum(b)))
        };
        of(members)
    };
    let every: Vec<usize> = all.clone().collect();
    let mut medoids = Vec::from_iter(middle(&every));
    // Then always the one farthest from those chosen.
    while medoids.len() < n {
        let nearest = |i: usize| {
            let to_chosen = medoids.iter().map(|&m| distance[i][m]);
            to_chosen.fold(f64::INFINITY, f64::min)
        };
        let next = all
            .clone()
            .rev()
            .max_by(|&a, &b| nearest(a).total_cmp(&nearest(b)));
        match next {
            Some(next) if nearest(next) >= SAME_DRIVE => medoids.push(next),
            _ => break,
        }
    }
    let mut clusters = Vec::new();
    for _ in 0..ROUNDS {
        clusters = vec![Vec::new(); medoids.len()];
        for i in all.clone() {
            let order = |&a: &usize, &b: &usize| {
                distance[i][medoids[a]].total_cmp(&distance[i][medoids[b]])
            };
            if let Some(own) = (0..medoids.len()).min_by(order) {
                clusters[own].push(i);
            }
        }
        let moved: Vec<usize> = clusters.iter().filter_map(|c| middle(c)).collect();
        if moved == medoids {
            break;
        }
        medoids = moved;
    }
    let mut order: Vec<usize> = (0..medoids.len()).collect();
    order.sort_by_key(|&i| std::cmp::Reverse(clusters.get(i).map_or(0, Vec::len)));
    order.into_iter().map(|i| medoids[i]).collect()
}

/// The ego's motion in the future that ends nearest to the mean end of all, and straight on after
/// it.
fn imitated(evaluation: &CandidateEvaluation, ego: &EgoState) -> Result<Trajectory, PlanError> {
    let end = |drive: &Vec<EgoState>| drive[drive.len() - 1].rear_axle.position;
    let n = evaluation.drives.len() as f64;
    let middle = evaluation
        .drives
        .iter()
        .map(end)
        .sum::<gump_geometry::DVec2>()
        / n;
    let off = |drive: &Vec<EgoState>| end(drive).distance_squared(middle);
    let nearest = evaluation
        .drives
        .iter()
        .min_by(|a, b| off(a).total_cmp(&off(b)));
    let drive = nearest.expect("there is at least one future");
    let mut poses: Vec<_> = drive.iter().map(|state| state.rear_axle).collect();
    let last = drive[drive.len() - 1];
    let step = last.rear_axle.direction() * (last.velocity.x.max(0.0) * DT);
    for i in 1..=TRAJECTORY_STEPS - (poses.len() - 1) {
        let mut pose = last.rear_axle;
        pose.position += step * i as f64;
        poses.push(pose);
    }
    Ok(trajectory(ego.time_us, &poses)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_geometry::Pose;

    /// Straight on at some speed, with an offset to the side that grows.
    fn drive(speed: f64, aside: f64) -> Vec<EgoState> {
        let state = |i: usize| {
            let t = i as f64 * DT;
            EgoState {
                rear_axle: Pose::new(speed * t, aside * t / 4.0, 0.0),
                ..EgoState::default()
            }
        };
        (0..=40).map(state).collect()
    }

    #[test]
    fn a_mode_is_a_draw_in_the_middle_of_its_cluster() {
        let drives = [
            drive(8.0, 0.0),
            drive(2.0, 0.0),
            drive(8.2, 0.0),
            drive(8.4, 0.0),
            drive(1.8, 0.0),
            drive(8.2, 6.0),
        ];
        assert_eq!(representatives(&drives, 3), [2, 1, 5]);
        // Two have to do for three; the slow ones are farther from the rest than the one aside.
        assert_eq!(representatives(&drives, 2), [2, 1]);
        assert_eq!(representatives(&drives, 1).len(), 1);
        assert!(representatives(&[], 3).is_empty());
    }

    #[test]
    fn draws_that_are_alike_are_one_mode() {
        let drives = [drive(8.0, 0.0), drive(8.0, 0.0), drive(8.1, 0.1)];
        assert_eq!(representatives(&drives, 3).len(), 1);
    }
}
