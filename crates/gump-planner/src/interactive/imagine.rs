//! What becomes of every candidate: policies and world take turns, half a second each.

use std::time::Duration;

use gump_geometry::Pose;
use gump_nuplan::closed_loop::Moment;
use gump_rollout::{BoxError, RolloutError, Session, Start, WorldModel};
use gump_scene::{AgentId, AgentState, EgoState, Frame, Rollout, SceneState};
use rayon::prelude::*;

use super::choice::{judge, summarize};
use super::{Decision, InteractiveDriverConfig, Phases, steps};
use crate::pdm::comfort::ComfortFilters;
use crate::pdm::forecast::{Forecast, MOMENT_DT};
use crate::pdm::mission::State;
use crate::pdm::propose::{Corridor, DT, Proposal, Proposer};
use crate::pdm::score::Judge;
use crate::pdm::track::Tracker;
use crate::{PlanError, ProposalKind};

/// Steps of a tenth of a second that a policy drives before the world answers ...
pub(super) const DECISION: usize = 5;
/// ... and the same in seconds.
pub(super) const DECISION_S: f64 = 0.5;
/// Steps that a policy looks ahead each time: what it drives and the second that the tracker sees.
const LOOK: usize = DECISION + 10;
/// Seconds of history that a world is shown: the learned one's three frames.
const HISTORY_S: f64 = 1.0;

/// What imagining takes.
pub(super) struct Imagination<'a> {
    pub(super) world: &'a dyn WorldModel,
    pub(super) config: &'a InteractiveDriverConfig,
    /// Prepared for the moment.
    pub(super) state: &'a State,
    pub(super) speeds: &'a [f64],
    pub(super) moment: &'a Moment<'a>,
    pub(super) clock: &'a dyn Fn() -> Duration,
    /// For whole horizons.
    pub(super) comfort: &'a ComfortFilters,
}

/// One future of one candidate.
pub(super) struct Row {
    /// Index of the candidate.
    pub(super) candidate: usize,
    /// Others as imagined so far.
    pub(super) forecast: Forecast,
    /// The policy's own line so far; imitation has none.
    policy: Proposal,
    /// How the car follows it, from now on.
    pub(super) drive: Vec<EgoState>,
    /// What the world said, once per decision; shorter where it was lost and let go.
    pub(super) frames: Vec<Frame>,
    /// True once nothing can make it worth anything: it drives no more.
    lost: bool,
}

impl Imagination<'_> {
    /// Imagines all candidates and judges them; nobody is chosen yet.
    pub(super) fn imagine(&self) -> Result<Decision, PlanError> {
        let began = (self.clock)();
        let mut phases = Phases::default();
        let history = self.surroundings();
        let scene = SceneState {
            history: &history,
            ..self.moment.scene
        };
        let proposer = self.state.proposer(&self.config.proposals.law, self.speeds);
        let mut rows = self.rows(&proposer);
        let lines = self.config.proposals.lateral_offsets.len();
        let n_ruled = lines * self.speeds.len() * self.config.n_futures;
        let (mut ruled, mut own) = self.open(scene, n_ruled)?;
        let per = frames_per_decision(&*ruled).map_err(|error| self.failed(error.into()))?;
        phases.open = (self.clock)() - began;

        let corridors: Vec<Corridor> = (0..lines)
            .map(|line| {
                let first = &rows[line * self.speeds.len() * self.config.n_futures];
                proposer.corridor(line, first.policy.drives[0].progress)
            })
            .collect();
        let n_decisions = steps(&self.config.budget) / DECISION;
        let mut asked: Vec<usize> = (0..n_ruled).collect();
        let mut imagined = 0;
        for decision in 1..=n_decisions {
            let time = (self.clock)();
            let spent = time - began;
            if decision > 1 && self.config.budget.wall.is_some_and(|wall| spent > wall) {
                break;
            }
            self.drive(&proposer, &corridors, &mut rows[..n_ruled]);
            let open: Vec<usize> = (0..asked.len()).filter(|&i| !rows[asked[i]].lost).collect();
            if open.len() < asked.len() && !open.is_empty() && ruled.keep(&open) {
                asked = open.into_iter().map(|i| asked[i]).collect();
            }
            let driven = (self.clock)();
            phases.policies += driven - time;
            let (ruled_rows, own_rows) = rows.split_at_mut(n_ruled);
            self.answer(&mut *ruled, ruled_rows, &asked, per, true)?;
            if let Some(own) = &mut own {
                let all: Vec<usize> = (0..own_rows.len()).collect();
                self.answer(&mut **own, own_rows, &all, per, false)?;
            }
            let answered = (self.clock)();
            phases.frames += answered - driven;
            let present = scene.now();
            rows.par_iter_mut()
                .filter(|row| row.frames.len() == decision)
                .for_each(|row| row.remember(present));
            phases.policies += (self.clock)() - answered;
            imagined = decision;
        }
        let time = (self.clock)();
        self.imitate(&mut rows[n_ruled..], imagined);
        let scores = judge(&rows, &self.judge_of(), self.comfort, self.config, imagined);
        let prospects = summarize(
            rows,
            &scores,
            self.config,
            |candidate| self.kind(candidate),
            |frames| film(scene, frames),
        );
        phases.score = (self.clock)() - time;
        Ok(Decision {
            chosen: 0,
            brakes: false,
            prospects,
            horizon: imagined as f64 * DECISION_S,
            phases,
        })
    }

    /// The last second of the ego and of those nearest to it.
    fn surroundings(&self) -> Vec<Frame> {
        let scene = self.moment.scene;
        let place = scene.ego_now().state.pose.position;
        let moving = scene.now().agents().iter();
        let mut near: Vec<(f64, AgentId)> = moving
            .filter(|agent| agent.id != scene.ego && agent.kind.is_moving())
            .map(|agent| (agent.state.pose.position.distance(place), agent.id))
            .collect();
        near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        near.truncate(self.config.budget.nearest);
        let kept = |id: AgentId| id == scene.ego || near.iter().any(|(_, near)| *near == id);
        let n = (HISTORY_S / scene.dt).round() as usize + 1;
        let first = scene.history.len().saturating_sub(n);
        let frames = scene.history[first..].iter().map(|frame| {
            let agents = frame.agents().iter().filter(|agent| kept(agent.id));
            Frame::new(agents.copied().collect(), frame.lights().to_vec())
        });
        frames.collect()
    }

    /// All rows: futures of one candidate after another, imitation last.
    fn rows(&self, proposer: &Proposer<'_>) -> Vec<Row> {
        let ego = self.moment.ego;
        let lines = self.config.proposals.lateral_offsets.len();
        let mut rows = Vec::new();
        let mut add = |candidate: usize, policy: &Proposal| {
            rows.extend((0..self.config.n_futures).map(|_| Row {
                candidate,
                forecast: self.state.forecast.clone(),
                policy: policy.clone(),
                drive: vec![*ego],
                frames: Vec::new(),
                lost: false,
            }));
        };
        for line in 0..lines {
            let mut policy = proposer.begin(line, ego.rear_axle, ego.velocity.x);
            for (i, &speed) in self.speeds.iter().enumerate() {
                policy.desired_speed = speed;
                add(line * self.speeds.len() + i, &policy);
            }
        }
        if self.config.imitation {
            add(lines * self.speeds.len(), &Proposal::default());
        }
        rows
    }

    /// One session in which policies drive and one in which the world does.
    #[expect(clippy::type_complexity, reason = "two sessions, used once")]
    fn open(
        &self,
        scene: SceneState<'_>,
        n_rows: usize,
    ) -> Result<(Box<dyn Session + '_>, Option<Box<dyn Session + '_>>), PlanError> {
        let n_futures = self.config.n_futures;
        let start = Start {
            scene,
            n_futures,
            seed: self.config.seed.fork(self.moment.iteration as u64),
        };
        let open = |starts: &[Start<'_>]| {
            let opened = self.world.open(starts);
            opened.map_err(|error| self.failed(error))
        };
        let ruled = open(&vec![start; n_rows / n_futures])?;
        let own = self.config.imitation.then(|| open(&[start])).transpose()?;
        Ok((ruled, own))
    }

    /// Lets every policy drive for half a second among the others as they are known.
    fn drive(&self, proposer: &Proposer<'_>, corridors: &[Corridor], rows: &mut [Row]) {
        let wheel_base = self.state.vehicle.wheel_base;
        let judge = self.judge_of();
        let room = || (Tracker::new(LOOK), Vec::new());
        rows.par_iter_mut()
            .for_each_init(room, |(tracker, states), row| {
                let k = row.drive.len() - 1;
                if row.lost {
                    coast(&mut row.drive);
                    return;
                }
                let proposer = Proposer {
                    forecast: &row.forecast,
                    ..*proposer
                };
                let corridor = &corridors[row.policy.line];
                let policy = std::slice::from_mut(&mut row.policy);
                proposer.drive_within(corridor, policy, k + 1..=k + LOOK);
                let reference = &row.policy.poses[k..];
                tracker.drive(&row.drive[k], reference, wheel_base, states);
                row.drive.extend_from_slice(&states[1..=DECISION]);
                row.policy.truncate(k + DECISION);
                let judge = Judge {
                    forecast: &row.forecast,
                    ..judge
                };
                row.lost = judge.is_lost(&row.drive);
            });
    }

    /// Asks the world for the half second that was just driven, in those rows that it has.
    fn answer(
        &self,
        session: &mut (dyn Session + '_),
        rows: &mut [Row],
        asked: &[usize],
        per: usize,
        driven: bool,
    ) -> Result<(), PlanError> {
        let vehicle = &self.state.vehicle;
        let mut frames = Vec::new();
        for i in 1..=per {
            // The half second ends with the last state.
            let behind = DECISION - i * DECISION / per;
            let ego = |&i: &usize| {
                let drive = &rows[i].drive;
                drive[drive.len() - 1 - behind].agent_state(vehicle)
            };
            let egos: Option<Vec<AgentState>> = driven.then(|| asked.iter().map(ego).collect());
            let answered = session.step(egos.as_deref());
            frames = answered.map_err(|error| self.failed(error))?;
        }
        let who = "the world";
        let (expected, found) = (asked.len(), frames.len());
        if expected != found {
            let wrong = RolloutError::Count {
                who,
                expected,
                found,
            };
            return Err(self.failed(wrong.into()));
        }
        let agents = frames.iter().flat_map(Frame::agents);
        if !agents.map(|agent| agent.state).all(|s| s.is_finite()) {
            return Err(self.failed(RolloutError::NotFinite { who }.into()));
        }
        for (future, (&i, frame)) in asked.iter().zip(frames).enumerate() {
            let row = &mut rows[i];
            let ego = self.moment.scene.ego;
            if !driven && frame.agent(ego).is_none() {
                let step = row.frames.len();
                let gone = RolloutError::EgoVanished { ego, future, step };
                return Err(self.failed(gone.into()));
            }
            row.frames.push(frame);
        }
        Ok(())
    }

    /// Lets the car follow what the world had the ego do.
    fn imitate(&self, rows: &mut [Row], n_decisions: usize) {
        let (scene, vehicle) = (self.moment.scene, &self.state.vehicle);
        let now = scene.ego_now().state;
        let mut tracker = Tracker::new(n_decisions * DECISION);
        for row in rows {
            let places: Vec<Pose> = std::iter::once(now.pose)
                .chain(row.frames.iter().filter_map(|frame| {
                    let ego = frame.agent(scene.ego)?;
                    Some(ego.state.pose)
                }))
                .collect();
            let kind = ProposalKind::Imitation;
            let reference = crate::Proposal::through(kind, &places, DECISION_S);
            let states = reference.resampled(&now, DT);
            let poses: Vec<Pose> = std::iter::once(now.pose)
                .chain(states.iter().map(|state| state.pose))
                .map(|center| vehicle.rear_axle_of(center))
                .collect();
            let ego = self.moment.ego;
            tracker.drive(ego, &poses, vehicle.wheel_base, &mut row.drive);
        }
    }

    fn judge_of(&self) -> Judge<'_> {
        Judge {
            vehicle: &self.state.vehicle,
            forecast: &self.state.forecast,
            ground: &self.state.ground,
            centerline: self.state.centerline(),
        }
    }

    fn kind(&self, candidate: usize) -> ProposalKind {
        let proposals = &self.config.proposals;
        let n = self.speeds.len();
        match proposals.lateral_offsets.get(candidate / n) {
            Some(&lateral_offset) => ProposalKind::Idm {
                speed_fraction: proposals.speed_fractions[candidate % n],
                lateral_offset,
            },
            None => ProposalKind::Imitation,
        }
    }

    fn failed(&self, source: BoxError) -> PlanError {
        PlanError::World {
            world: self.world.name().to_owned(),
            source,
        }
    }
}

impl Row {
    /// Notes where the last frame has the others: straight between frames, and after it on at the
    /// velocity of the last second, since places come in quanta.
    fn remember(&mut self, present: &Frame) {
        let n = self.frames.len();
        let frame = |i: usize| i.checked_sub(1).map_or(present, |i| &self.frames[i]);
        let first = ((n - 1) as f64 * DECISION_S / MOMENT_DT + 1e-9).floor() as usize + 1;
        let last = (n as f64 * DECISION_S / MOMENT_DT + 1e-9).floor() as usize;
        for object in &mut self.forecast.objects {
            let pose = |i: usize| frame(i).agent(object.agent.id).map(|a| a.state.pose);
            let (Some(from), Some(to)) = (pose(n - 1), pose(n)) else {
                continue;
            };
            let before = n.saturating_sub(2);
            let Some(earlier) = pose(before) else {
                continue;
            };
            let elapsed = (n - before) as f64 * DECISION_S;
            let drift = (to.position - earlier.position) / elapsed;
            let moments = (first..=last).map(|moment| {
                let t = moment as f64 * MOMENT_DT / DECISION_S - (n - 1) as f64;
                from.interpolate(to, t)
            });
            object.imagine(moments, drift);
        }
    }
}

/// Half a second straight on at constant speed.
fn coast(drive: &mut Vec<EgoState>) {
    for _ in 0..DECISION {
        let mut next = drive[drive.len() - 1];
        next.rear_axle.position += next.rear_axle.direction() * (next.velocity.x * DT);
        next.time_us += (DT * 1e6) as i64;
        drive.push(next);
    }
}

/// Frames of a session in half a second.
fn frames_per_decision(session: &(dyn Session + '_)) -> Result<usize, RolloutError> {
    let ratio = DECISION_S / session.dt();
    let per = ratio.round();
    let divides = per >= 1.0 && DECISION.is_multiple_of(per as usize);
    if divides && (ratio - per).abs() < 1e-6 {
        Ok(per as usize)
    } else {
        Err(RolloutError::TimeStep {
            session: session.dt(),
            scene: DECISION_S,
        })
    }
}

/// What was imagined as a rollout of its own, from the present on.
fn film(scene: SceneState<'_>, frames: Vec<Frame>) -> Rollout {
    let last = scene.history.len() - 1;
    let mut rollout = Rollout::begin(SceneState {
        history: &scene.history[last..],
        dt: DECISION_S,
        ..scene
    });
    for frame in frames {
        rollout.push(frame);
    }
    rollout
}
