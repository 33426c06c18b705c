//! Manoeuvres with which the ego leaves its log.

use std::f64::consts::FRAC_PI_6;

use gump_geometry::{DVec2, OrientedBox, Polyline, Pose};
use gump_scene::{Agent, AgentState, Lane, LightState, MapGraph, stop_line};

use super::path::{Path, chain, smooth};
use super::{Reactions, Reason};
use crate::behaviour::reach;
use crate::red_light::passes;

/// An ego slower than this cannot perform a change of speed, m/s: it would stand within a second.
/// Chosen by hand.
const DRIVES: f64 = 3.0;
/// A comfortable to firm braking and an emergency, m/s². Chosen by hand.
const BRAKES: f64 = 3.0;
const STOPS: f64 = 6.0;
/// A brisk acceleration, m/s², and the increase in speed, m/s. Chosen by hand.
const GAINS: f64 = 2.0;
const FASTER: f64 = 5.0;
/// The minimum final speed of an ego that runs a light, m/s: a usual one in towns. Chosen by hand.
const RUNS: f64 = 8.0;
/// A log whose speed falls below this has stopped, m/s: above the jitter of trackers.
const HAS_STOPPED: f64 = 0.5;
/// A slower ego would have to turn by more than 24 degrees to change lane in time, m/s. First 3,
/// raised after a look at cases (docs/results/0024-reactions.md).
const CHANGES: f64 = 5.0;
/// Duration of a lane change, seconds: a quick one, which presses who is behind. Chosen by hand.
const CHANGE_S: f64 = 3.0;
/// Distance of adjacent lanes, metres: from narrow ones to wide ones with a strip between.
const BESIDE_M: std::ops::RangeInclusive<f64> = 2.0..=6.0;
/// Maximum distance of the ego from its lane's centre line at the start of a change, metres:
/// somewhere on a wide lane.
const ON_LANE_M: f64 = 2.5;
/// Free space that a lane change needs before and behind the ego, metres, and additional space
/// behind it per difference in speed, seconds: it must be free until the change is complete. First
/// one second, raised with the speed above.
const ROOM_M: f64 = 2.0;
const ROOM_S: f64 = CHANGE_S;
/// A motion shorter than this between two frames has no direction, metres: a tenth of a
/// metre per second at 10 Hz, measured over two frames.
const STILL_M: f64 = 0.02;

/// A manoeuvre of the ego.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[non_exhaustive]
pub enum Manoeuvre {
    /// Follows its log.
    Log,
    /// Brakes to a stop.
    Brake,
    /// Brakes to a stop as in an emergency.
    Stop,
    /// Drives faster.
    SpeedUp,
    /// Changes to an adjacent lane.
    ChangeLane,
    /// Drives past a red light at which its log stopped.
    RunLight,
}

impl Manoeuvre {
    /// All, with the control first.
    pub const ALL: [Self; 6] = [
        Self::Log,
        Self::Brake,
        Self::Stop,
        Self::SpeedUp,
        Self::ChangeLane,
        Self::RunLight,
    ];

    /// The name in tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::Log => "log",
            Self::Brake => "brake",
            Self::Stop => "stop",
            Self::SpeedUp => "speed-up",
            Self::ChangeLane => "change-lane",
            Self::RunLight => "run-light",
        }
    }

    /// The manoeuvre with this name.
    pub fn of_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|one| one.name() == name)
    }
}

/// A speed that changes linearly up to a bound.
#[derive(Clone, Copy, Debug)]
pub(super) struct Profile {
    /// At the start, m/s.
    pub(super) from: f64,
    /// At the end, m/s.
    pub(super) to: f64,
    /// Rate of change, m/s², > 0.
    pub(super) rate: f64,
}

impl Profile {
    /// Distance driven after this many seconds, metres.
    pub(super) fn metres_after(self, seconds: f64) -> f64 {
        let changing = ((self.to - self.from).abs() / self.rate).min(seconds);
        let rate = self.rate.copysign(self.to - self.from);
        let changed = self.from * changing + rate * changing * changing / 2.0;
        changed + self.to * (seconds - changing)
    }
}

impl Reactions<'_> {
    /// The states of the ego from the present to the horizon.
    pub(super) fn plan(&self, manoeuvre: Manoeuvre) -> Result<Vec<AgentState>, Reason> {
        let speed = self.speed();
        let is_of_drivers = !matches!(manoeuvre, Manoeuvre::Log | Manoeuvre::RunLight);
        if is_of_drivers && speed <= DRIVES {
            return Err(Reason::TooSlow);
        }
        let along = |to: f64, rate: f64| {
            self.along(Profile {
                from: speed,
                to,
                rate,
            })
        };
        match manoeuvre {
            Manoeuvre::Log => Ok(self.logged.clone()),
            Manoeuvre::Brake => along(0.0, BRAKES),
            Manoeuvre::Stop => along(0.0, STOPS),
            Manoeuvre::SpeedUp => along(speed + FASTER, GAINS),
            Manoeuvre::ChangeLane => self.change_lane(),
            Manoeuvre::RunLight => {
                let plan = along(speed.max(RUNS), GAINS)?;
                match self.runs_light(&plan) {
                    true => Ok(plan),
                    false => Err(Reason::NoLight),
                }
            }
        }
    }

    /// Forward speed of the ego in the present, m/s.
    fn speed(&self) -> f64 {
        let now = self.logged[0];
        now.velocity.dot(now.pose.direction()).max(0.0)
    }

    /// Seconds of frame `k` after the present.
    fn at_s(&self, k: usize) -> f64 {
        k as f64 * self.scenario.dt
    }

    /// Along the path of the log at another speed.
    fn along(&self, profile: Profile) -> Result<Vec<AgentState>, Reason> {
        let metres = |k: usize| profile.metres_after(self.at_s(k));
        // The horizon and a little: past the last point a way goes straight on.
        let path = Path::of_log(&self.logged, &self.scenario.map, metres(self.n) + 1.0);
        let path = path.ok_or(Reason::LikeLog)?;
        let poses: Vec<Pose> = (0..=self.n).map(|k| path.pose_at(metres(k))).collect();
        Ok(self.moving(&poses))
    }

    /// States of these poses, with the velocities of their positions; the first is the present.
    fn moving(&self, poses: &[Pose]) -> Vec<AgentState> {
        let last = poses.len() - 1;
        let velocity = |k: usize| {
            let (from, to) = (k.saturating_sub(1), (k + 1).min(last));
            let seconds = (to - from).max(1) as f64 * self.scenario.dt;
            (poses[to].position - poses[from].position) / seconds
        };
        let states = (0..=last).map(|k| match k {
            0 => self.logged[0],
            _ => AgentState {
                pose: poses[k],
                velocity: velocity(k),
            },
        });
        states.collect()
    }

    /// True if the ego passes a line that is red at that time, and its log stops before it.
    fn runs_light(&self, plan: &[AgentState]) -> bool {
        let ahead = &self.scenario.log[self.scenario.now..];
        let crossed = |states: &[AgentState], line: Pose, width: f64| {
            let mut steps = states.windows(2);
            steps.position(|pair| passes(line, width, pair[0].pose.position, pair[1].pose))
        };
        let slowest = self.logged.iter().map(AgentState::speed);
        let has_stopped = slowest.fold(f64::INFINITY, f64::min) < HAS_STOPPED;
        let is_red = |light: &&gump_scene::Light| light.state == LightState::Red;
        let mut reds = ahead[0].lights().iter().filter(is_red);
        has_stopped
            && reds.any(|light| {
                let Some(lane) = self.scenario.map.lane(light.lane) else {
                    return false;
                };
                let line = stop_line(lane, light);
                let then = crossed(plan, line, lane.width).map(|k| &ahead[k + 1]);
                let still = then.and_then(|frame| frame.light(light.lane));
                still.as_ref().is_some_and(is_red)
                    && crossed(&self.logged, line, lane.width).is_none()
            })
    }

    /// To the adjacent lane, left before right, at the speed of the log.
    fn change_lane(&self) -> Result<Vec<AgentState>, Reason> {
        let (map, start) = (&self.scenario.map, self.logged[0].pose);
        let driven: f64 = self.driven_until(self.steps(CHANGE_S).min(self.n));
        if self.speed() <= CHANGES || driven < CHANGES * CHANGE_S {
            return Err(Reason::TooSlow);
        }
        let here = reach::nearest(map, start, ON_LANE_M, FRAC_PI_6);
        let lane = here.map(|(lane, _)| lane).ok_or(Reason::NoLane)?;
        let mut why = Reason::NoLane;
        for beside in [&lane.left_neighbors, &lane.right_neighbors] {
            let there = beside.first().and_then(|&id| map.lane(id));
            let Some(there) = there.filter(|there| !lane.in_intersection && !there.in_intersection)
            else {
                continue;
            };
            if let Some(poses) = self.over_to(map, there) {
                if self.has_room(there) {
                    return Ok(self.moving(&poses));
                }
                why = Reason::NoRoom;
            }
        }
        Err(why)
    }

    fn steps(&self, seconds: f64) -> usize {
        (seconds / self.scenario.dt).round() as usize
    }

    /// Distance that the log drives until frame `k`, metres.
    fn driven_until(&self, k: usize) -> f64 {
        let pairs = self.logged[..=k].windows(2);
        pairs
            .map(|pair| pair[0].pose.position.distance(pair[1].pose.position))
            .sum()
    }

    /// To a lane within [`CHANGE_S`] and along it; `None` if it does not run beside the path of the
    /// log for that long.
    fn over_to(&self, map: &MapGraph, there: &Lane) -> Option<Vec<Pose>> {
        let start = there.centerline.project(self.logged[0].pose.position);
        let metres = start.arc_length + self.driven_until(self.n) + 1.0;
        let line = chain(map, there, metres)?;
        let n_change = self.steps(CHANGE_S).min(self.n);
        let mut positions = Vec::with_capacity(self.n + 1);
        for (k, state) in self.logged[..=n_change].iter().enumerate() {
            let own = state.pose.position;
            let beside = line.project(own);
            if !BESIDE_M.contains(&beside.distance) {
                return None;
            }
            let target = line.pose_at(beside.arc_length).position;
            positions.push(own.lerp(target, smooth(self.at_s(k) / CHANGE_S)));
        }
        let mut along = line.project(*positions.last()?).arc_length;
        for k in n_change + 1..=self.n {
            let (a, b) = (self.logged[k - 1].pose, self.logged[k].pose);
            along += a.position.distance(b.position);
            positions.push(line.pose_at(along).position);
        }
        Some(headed(&positions, self.logged[0].pose.heading))
    }

    /// True if the target positions on the adjacent lane are free.
    fn has_room(&self, there: &Lane) -> bool {
        let present = &self.scenario.log[self.scenario.now];
        let Some(ego) = present.agent(self.scenario.ego) else {
            return false;
        };
        let mut others = present.agents().iter().filter(|agent| agent.id != ego.id);
        others.all(|other| !is_in_gap(&there.centerline, ego, other))
    }
}

/// True if another agent is beside the ego on a line, or approaches from behind within [`ROOM_S`].
fn is_in_gap(line: &Polyline, ego: &Agent, other: &Agent) -> bool {
    let foot = line.pose_at(line.project(ego.state.pose.position).arc_length);
    let closing = other.state.velocity.dot(foot.direction()) - ego.state.speed();
    let behind = ROOM_M + ROOM_S * closing.max(0.0);
    let shift = (ROOM_M - behind) / 2.0;
    let gap = OrientedBox {
        pose: foot * Pose::new(shift, 0.0, 0.0),
        length: ego.length + ROOM_M + behind,
        width: ego.width,
    };
    gap.overlaps(&other.oriented_box())
}

/// Poses at these positions that point in the direction of motion, with the given heading at the
/// start.
fn headed(positions: &[DVec2], start: f64) -> Vec<Pose> {
    let mut heading = start;
    let last = positions.len() - 1;
    let poses = positions.iter().enumerate().map(|(k, &position)| {
        let step = positions[(k + 1).min(last)] - positions[k.saturating_sub(1)];
        if k > 0 && step.length() >= STILL_M {
            heading = step.to_angle();
        }
        Pose { position, heading }
    });
    poses.collect()
}
