//! How agents that are off their log come back to it: the targets of those that are led away from it.
//!
//! `steered` is the next pose of a vehicle that drives back. Which agents are led away, and where to, is
//! in `sample` and in the drives of `gump-train`.

use gump_geometry::{DVec2, Pose};
use gump_scene::AgentKind;
use serde::{Deserialize, Serialize};

use crate::relative::graph::Shown;
use crate::relative::grid::STILL_M;
use crate::relative::sample::{ALONG_SLACK, BRAKING};
use crate::steps::TOKEN_DT;

/// How agents that are off their log come back to it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum Returns {
    /// A share of the offset is gone with the next move, of its position and of its heading apart: quick,
    /// but no vehicle moves so.
    #[default]
    Slide,
    /// Vehicles and bicycles steer towards their log's way, and gain or lose speed; people as with `slide`.
    Steer,
}

// The time was chosen with the decision to steer; the others were chosen by hand, and none was varied.

/// Who steers back aims at a point on its log's way that it reaches after this time, seconds, ...
const AIM_S: f64 = 1.2;
/// ... and not nearer than this, metres: about a vehicle's length.
const AIM_M: f64 = 4.0;
/// It gains and loses this at most in a step, metres, or what its log does, and swerves no harder: 4 m/s².
const HARDEST_M: f64 = 4.0 * TOKEN_DT * TOKEN_DT;
/// Frames of the log before and after the present one in which its way is looked at: it is seldom
/// farther behind or ahead than 4 s.
const AROUND: usize = 8;

/// What wheels allow.
#[derive(Clone, Copy)]
struct Wheels {
    /// The rear axle is this far behind the centre of the box, metres.
    axle_m: f64,
    /// Greatest turn, radians per metre.
    curvature: f64,
}

impl Wheels {
    /// As the limits of rollouts (`gump_engine::kinematic_limits`); none of who walks.
    fn of(kind: AgentKind) -> Option<Self> {
        match kind {
            AgentKind::Vehicle => Some(Self {
                axle_m: 1.4,
                curvature: 0.22,
            }),
            AgentKind::Bicycle => Some(Self {
                axle_m: 0.6,
                curvature: 0.65,
            }),
            _ => None,
        }
    }
}

/// The next pose of an agent that is off its log in frame `t`, and steers back to it. It aims `aside`
/// metres to the left of its log's way. `None` for who does not steer, and where the log ends.
///
/// With an offset of zero it is the log's own move: the turn that leads back is added to it.
pub(super) fn steered(own: &Shown, log: &[Option<Pose>], t: usize, aside: f64) -> Option<Pose> {
    let wheels = Wheels::of(own.body.kind)?;
    let way = Way::around(log, t, wheels)?;
    if way.reverses {
        // It goes on as its log does beside it.
        return Some(own.pose * way.step);
    }
    let rear = own.pose * Pose::new(-wheels.axle_m, 0.0, 0.0);
    let at = way.project(rear.position);
    let foot = way.at(at);
    let (last_m, ahead) = (
        own.velocity().dot(own.pose.direction()) * TOKEN_DT,
        at - way.now,
    );
    let wanted = match way.stops {
        // Behind the log it drives on to where the log stops, if that is on its way.
        true => (-ahead).clamp(0.0, BRAKING * last_m.max(0.0)),
        false => way.step_m - (1.0 - ALONG_SLACK) * ahead,
    };
    let hardest = HARDEST_M.max(way.change_m);
    let metres = wanted.clamp(last_m - hardest, last_m + hardest).max(0.0);
    if metres < STILL_M {
        return Some(own.pose);
    }
    // Beyond the log's end its way goes straight on, which it may not have done.
    let known = (way.length() - at).max(AIM_M);
    let aim = (AIM_S / TOKEN_DT * metres).clamp(AIM_M, known);
    let off = foot.inverse() * rear;
    let target = Pose::new(0.0, off.position.y, off.heading).inverse() * DVec2::new(aim, aside);
    let swerve = HARDEST_M / metres;
    let back = (2.0 * target.y / target.length_squared() * metres).clamp(-swerve, swerve);
    let logged = foot.inverse() * way.at(at + metres);
    let most = (wheels.curvature * metres).max(logged.heading.abs());
    let turn = (logged.heading + back).clamp(-most, most);
    let step = Pose {
        position: logged.position + DVec2::new(0.0, 0.5 * metres * (turn - logged.heading)),
        heading: turn,
    };
    Some(rear * step * Pose::new(wheels.axle_m, 0.0, 0.0))
}

/// The way of a log's rear axle around a frame.
struct Way {
    /// Poses, and their distances from the first, metres.
    poses: Vec<(f64, Pose)>,
    /// Where the log is, metres.
    now: f64,
    /// Its next move, how far that is, metres, and whether it goes backwards or nowhere.
    step: Pose,
    step_m: f64,
    reverses: bool,
    stops: bool,
    /// By how much that is longer or shorter than the move before, metres.
    change_m: f64,
}

impl Way {
    fn around(log: &[Option<Pose>], t: usize, wheels: Wheels) -> Option<Self> {
        let step_of = |k: usize| {
            let (from, to) = (log.get(k).copied()??, log.get(k + 1).copied()??);
            Some(from.inverse() * to)
        };
        let goes_on = |k: usize| step_of(k).is_some_and(|step| step.position.x > -STILL_M);
        let step = step_of(t)?;
        let mut first = t;
        while first > 0 && t - first < AROUND && goes_on(first - 1) {
            first -= 1;
        }
        let mut last = t;
        while last - t < AROUND && goes_on(last) {
            last += 1;
        }
        let (mut poses, mut now) = (Vec::<(f64, Pose)>::new(), 0.0);
        for (k, logged) in log.iter().enumerate().take(last + 1).skip(first) {
            let rear = (*logged)? * Pose::new(-wheels.axle_m, 0.0, 0.0);
            let at = match poses.last() {
                None => Some(0.0),
                // Jitter is no way.
                Some((at, before)) => {
                    let metres = before.position.distance(rear.position);
                    (metres >= STILL_M).then_some(at + metres)
                }
            };
            if let Some(at) = at {
                poses.push((at, rear));
            }
            if k == t {
                now = poses.last()?.0;
            }
        }
        let back = Pose::new(-wheels.axle_m, 0.0, 0.0);
        let axle = back.inverse() * step * back;
        let before = t.checked_sub(1).and_then(step_of);
        let longer = |before: Pose| (step.position.length() - before.position.length()).abs();
        Some(Self {
            poses,
            now,
            step,
            step_m: axle.position.length(),
            reverses: step.position.x <= -STILL_M,
            stops: step.position.length() < STILL_M,
            change_m: before.map_or(0.0, longer),
        })
    }

    fn length(&self) -> f64 {
        self.poses.last().map_or(0.0, |last| last.0)
    }

    /// The pose at a distance from the start, metres. Between two poses it is on an arc; before the first and
    /// beyond the last it is straight.
    fn at(&self, metres: f64) -> Pose {
        let i = self.poses.partition_point(|(at, _)| *at <= metres);
        let straight = |(at, pose): (f64, Pose)| pose * Pose::new(metres - at, 0.0, 0.0);
        if i == 0 || i == self.poses.len() {
            return straight(self.poses[i.saturating_sub(1)]);
        }
        let ((from, a), (to, b)) = (self.poses[i - 1], self.poses[i]);
        let share = (metres - from) / (to - from);
        let chord = b.position - a.position;
        // How far the arc is beside its chord, to the right of it in a turn to the left.
        let bulge = 0.5 * (a.inverse() * b).heading * share * (1.0 - share);
        let pose = a.interpolate(b, share);
        Pose {
            position: pose.position - chord.perp() * bulge,
            ..pose
        }
    }

    /// The distance from the start of the nearest place, metres; below 0 before it.
    fn project(&self, point: DVec2) -> f64 {
        let ends = [self.poses.first(), self.poses.last()];
        let [before, beyond] =
            ends.map(|end| end.map_or((0.0, 0.0), |(at, pose)| (*at, (pose.inverse() * point).x)));
        let mut nearest = (f64::INFINITY, before.0);
        for pair in self.poses.windows(2) {
            let ((from, a), (to, b)) = (pair[0], pair[1]);
            let chord = b.position - a.position;
            let share = (point - a.position).dot(chord) / chord.length_squared();
            let share = share.clamp(0.0, 1.0);
            let away = point.distance_squared(a.position + chord * share);
            if away < nearest.0 {
                nearest = (away, from + share * (to - from));
            }
        }
        match nearest.1 {
            at if at <= before.0 && before.1 < 0.0 => before.0 + before.1,
            at if at >= beyond.0 && beyond.1 > 0.0 => beyond.0 + beyond.1,
            at => at,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::relative::graph::Body;

    fn body(kind: AgentKind) -> Body {
        Body {
            kind,
            length: 4.5,
            width: 1.9,
            sized: true,
        }
    }

    fn car(pose: Pose, speed: f64) -> Shown {
        Shown::first(body(AgentKind::Vehicle), pose, pose.direction() * speed)
    }

    /// A log that moves so many metres in each step, and turns so much.
    fn log(steps: impl Iterator<Item = (f64, f64)>) -> Vec<Option<Pose>> {
        let mut rear = Pose::new(-1.4, 0.0, 0.0);
        let mut all = vec![Some(Pose::IDENTITY)];
        for (metres, turn) in steps {
            let chord = match turn == 0.0 {
                true => DVec2::new(metres, 0.0),
                false => DVec2::new(turn.sin(), 1.0 - turn.cos()) * (metres / turn),
            };
            rear = rear
                * Pose {
                    position: chord,
                    heading: turn,
                };
            all.push(Some(rear * Pose::new(1.4, 0.0, 0.0)));
        }
        all
    }

    fn next(own: &Shown, log: &[Option<Pose>], t: usize) -> Pose {
        steered(own, log, t, 0.0).unwrap()
    }

    /// How far a move slides: what its rear axle moves across the mean of its headings, metres.
    fn slides(from: Pose, to: Pose) -> f64 {
        let back = Pose::new(-1.4, 0.0, 0.0);
        let step = (from * back).inverse() * (to * back);
        (step.position.y - 0.5 * step.position.x * step.heading).abs()
    }

    #[test]
    fn who_is_off_its_log_drives_back_without_sliding() {
        // Straight on at 15 m/s, and in a bend with a radius of 12 m at 6 m/s.
        for (metres, turn) in [(7.5, 0.0), (3.0, 0.25)] {
            let log = log(std::iter::repeat_n((metres, turn), 17));
            for (aside, turned) in [(0.5, 0.0), (0.0, 0.035), (-0.8, 0.1), (0.4, -0.05)] {
                let from = log[2].unwrap() * Pose::new(0.0, aside, turned);
                let mut now = car(from, 2.0 * metres);
                let mut worst = 0.0_f64;
                for t in 2..16 {
                    let to = next(&now, &log, t);
                    let step = now.pose.inverse() * to;
                    assert!(
                        slides(now.pose, to) < 0.03,
                        "{aside} {turned} at {t}: {step:?}"
                    );
                    assert!(step.position.x > 0.0);
                    now = now.then(to);
                    let left = log[t + 1].unwrap().inverse() * to;
                    worst = worst.max(left.position.y.abs());
                }
                let left = log[16].unwrap().inverse() * now.pose;
                assert!(
                    left.position.y.abs() < 0.12 && left.heading.abs() < 0.04,
                    "{aside} {turned}: {left:?}"
                );
                assert!(worst < 1.1, "{aside} {turned}: {worst}");
            }
        }
    }

    #[test]
    fn who_is_on_its_log_moves_as_it() {
        // Into a bend and out of it, at 8 m/s; it brakes at the end.
        let bend = |i: usize| if (5..9).contains(&i) { 0.3 } else { 0.0 };
        let steps = (0..17).map(|i| {
            (
                if i > 12 {
                    4.0 - 0.7 * (i - 12) as f64
                } else {
                    4.0
                },
                bend(i),
            )
        });
        let log = log(steps);
        for t in 1..17 {
            let now = car(log[t - 1].unwrap(), 8.0).then(log[t].unwrap());
            let (found, logged) = (next(&now, &log, t), log[t + 1].unwrap());
            let apart = found.position.distance(logged.position);
            assert!(apart < 0.05, "{apart} at {t}");
            assert!((found.heading - logged.heading).abs() < 0.02, "{t}");
        }
    }

    #[test]
    fn speeds_change_as_brakes_and_engines_allow_and_nobody_is_asked_back() {
        let creeps = log(std::iter::repeat_n((0.2, 0.0), 17));
        // A metre ahead of a log that creeps at 0.4 m/s, standing and at 5 m/s.
        let ahead = Pose::new(1.4, 0.3, 0.0);
        assert_eq!(next(&car(ahead, 0.0), &creeps, 2), ahead);
        let far = next(&car(ahead, 5.0), &creeps, 2);
        assert!((far.position.x - 1.4 - 1.5).abs() < 0.01, "{far:?}");
        // Standing ten metres behind a log at 10 m/s.
        let drives = log(std::iter::repeat_n((5.0, 0.0), 17));
        let behind = next(&car(Pose::new(5.0, 0.0, 0.0), 0.0), &drives, 3);
        assert!((behind.position.x - 6.0).abs() < 1e-3, "{behind:?}");
        // The log brakes harder than that.
        let brakes = log([(5.0, 0.0), (5.0, 0.0), (2.0, 0.0), (1.0, 0.0)].into_iter());
        let stops = next(&car(Pose::new(10.0, 0.2, 0.0), 10.0), &brakes, 2);
        assert!((stops.position.x - 12.0).abs() < 1e-2, "{stops:?}");
    }

    #[test]
    fn who_reverses_goes_on_beside_its_log_and_who_walks_does_not_steer() {
        let back = log(std::iter::repeat_n((-1.0, 0.0), 6));
        let from = back[2].unwrap() * Pose::new(0.1, 0.3, 0.0);
        let to = next(&car(from, 0.0), &back, 2);
        assert!(
            (from.inverse() * to)
                .position
                .distance(DVec2::new(-1.0, 0.0))
                < 1e-9
        );
        let person = Shown::first(body(AgentKind::Pedestrian), from, DVec2::ZERO);
        assert!(steered(&person, &back, 2, 0.0).is_none());
        // Where the log ends there is nowhere to go.
        assert!(steered(&car(from, 0.0), &back, 6, 0.0).is_none());
    }
}
