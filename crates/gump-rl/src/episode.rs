//! The rules of one episode as pure functions: no randomness, no buffers, no hidden state.
//!
//! A state is cheap to clone, so callers can look ahead from it; the same state and action give the
//! same successor. The caller chooses the traffic: [`Rules::step`] reads the other agents from the
//! log, [`Rules::advance`] takes a frame of any world.

use gump_geometry::{OrientedBox, Pose, angle_difference, dvec2};
use gump_metrics::encounter::classify;
use gump_metrics::{ComfortBounds, ComfortMeasurements};
use gump_scene::{Agent, AgentKind, AgentState, Frame, VehicleParameters};
use serde::{Deserialize, Serialize};

use crate::{Dynamics, PreparedScenario, RlError};

/// Seconds between the moments of a step at which collisions are tested: a vehicle at 15 m/s moves
/// a third of its length.
const MOMENT: f64 = 0.1;

/// Metres between two tests of road edges, about: less than half of a car's length. These tests
/// take most of a step's time. Not tuned.
const ROAD_TEST_SPACING: f64 = 2.0;

/// Metres per second that no agent exceeds (216 km/h): an agent farther away than this allows is
/// not looked up in the frame before. Saves time only.
const FASTEST: f64 = 60.0;

/// Dynamics, rewards and horizon of an episode.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Rules {
    /// The meaning of actions.
    pub dynamics: Dynamics,
    /// The reward.
    pub reward: RewardWeights,
    /// Seconds until an episode is truncated, > 0; rounded to whole steps.
    pub horizon: f64,
}

impl Default for Rules {
    /// 8 s, the future of a Waymo scenario: 16 steps of half a second, a frame of the world model.
    fn default() -> Self {
        Self {
            dynamics: Dynamics::default(),
            reward: RewardWeights::default(),
            horizon: 8.0,
        }
    }
}

/// The reward of a step: the sum of these weights times the measurements of the step.
///
/// The measurements are those of [`gump_metrics::Progress`], [`gump_metrics::Collision`],
/// [`gump_metrics::OffRoad`] and [`gump_metrics::Discomfort`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RewardWeights {
    /// Per metre of progress along the route.
    pub progress: f64,
    /// For a collision at the ego's fault.
    pub collision: f64,
    /// For a collision in which the ego stands or is hit from behind; as `collision` if `None`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub blameless_collision: Option<f64>,
    /// For leaving the road.
    pub off_road: f64,
    /// For exceeding a comfort bound.
    pub discomfort: f64,
}

impl Default for RewardWeights {
    /// The weights of [`gump_metrics::Reward::driving_step`].
    fn default() -> Self {
        Self {
            progress: 0.1,
            collision: -5.0,
            blameless_collision: None,
            off_road: -5.0,
            discomfort: -0.05,
        }
    }
}

/// The end of an episode.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    /// By failure: the value after it is 0.
    Terminated(Failure),
    /// Cut off at the horizon, at the end of a replayed log or at the end of the route: the value
    /// after it must be bootstrapped.
    Truncated,
}

/// The kind of failure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Failure {
    /// The ego's box overlapped another.
    Collision,
    /// A corner of the ego's box left the road.
    OffRoad,
}

/// The state of an episode after some steps.
#[derive(Clone, Debug, PartialEq)]
pub struct EpisodeState {
    /// Number of steps.
    pub steps: usize,
    /// The ego now.
    pub ego: Agent,
    /// The ego one and two steps ago, as far as known; used for comfort.
    before: [Option<AgentState>; 2],
    /// Metres along the route.
    pub(crate) along: f64,
    /// Reward of the last step.
    pub reward: f64,
    /// Totals of all steps.
    pub totals: Totals,
    /// The end of the episode; `None` while it goes on.
    pub end: Option<End>,
}

/// Totals of an episode so far.
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub struct Totals {
    /// Sum of the rewards.
    pub reward: f64,
    /// Metres along the route.
    pub progress: f64,
    /// True if the ego's box overlapped another.
    pub collided: bool,
    /// True if it did so other than standing or hit from behind.
    pub at_fault: bool,
    /// True if a corner of the ego's box left the road.
    pub off_road: bool,
    /// True if a comfort bound was exceeded.
    pub uncomfortable: bool,
}

impl EpisodeState {
    /// The ego's acceleration over the last step, metres per second squared along its heading, and
    /// its yaw rate, radians per second; zeros where the log begins.
    pub(crate) fn motion(&self, dt: f64) -> (f64, f64) {
        self.before[0].map_or((0.0, 0.0), |before| {
            let now = &self.ego.state;
            let acceleration = (now.velocity - before.velocity) / dt;
            (
                acceleration.dot(now.pose.direction()),
                turn_rate(&before, now, dt),
            )
        })
    }
}

impl Rules {
    /// The initial state of every episode of a scenario: its present.
    pub fn reset(&self, prepared: &PreparedScenario) -> EpisodeState {
        let ego = *prepared.scenario().present().ego_now();
        EpisodeState {
            steps: 0,
            ego,
            before: [prepared.ego_before(1), prepared.ego_before(2)],
            along: prepared.along_route(ego.state.pose.position),
            reward: 0.0,
            totals: Totals::default(),
            end: None,
        }
    }

    /// One step with the other agents replaying the log.
    ///
    /// Shape: `action` is `[action_len]` of the dynamics, in [-1, 1].
    ///
    /// # Errors
    /// [`RlError::Finished`] if the episode has ended; [`RlError::Count`], [`RlError::NotFinite`]
    /// and [`RlError::OutOfRange`] for invalid actions.
    pub fn step(
        &self,
        prepared: &PreparedScenario,
        state: &EpisodeState,
        action: &[f32],
    ) -> Result<EpisodeState, RlError> {
        if state.end.is_some() {
            return Err(RlError::Finished { row: 0 });
        }
        self.check_actions(action, 1)?;
        Ok(self.step_in_log(prepared, state, action))
    }

    /// One step with `action_len` checked numbers, the other agents replaying the log.
    pub(crate) fn step_in_log(
        &self,
        prepared: &PreparedScenario,
        state: &EpisodeState,
        action: &[f32],
    ) -> EpisodeState {
        let others = [state.steps, state.steps + 1].map(|step| prepared.logged(step));
        let mut next = self.advance(prepared, state, action, others);
        if next.end.is_none() && next.steps >= prepared.logged_steps() {
            next.end = Some(End::Truncated);
        }
        next
    }

    /// The state after one step in which `action` drives the ego and all other agents move from
    /// their places in `before` to those in `after`.
    ///
    /// A collision or leaving the road terminates, in this order. Collisions are tested every tenth
    /// of a second, road edges at the end and about every two metres before it; an episode that
    /// starts in a collision ends with its first step. The horizon and the end of the route
    /// truncate. Between the two frames others move in straight lines; those that `before` lacks
    /// come from where their velocity in `after` says.
    ///
    /// Shape: `action` is `[action_len]` of the dynamics, in [-1, 1].
    pub fn advance(
        &self,
        prepared: &PreparedScenario,
        state: &EpisodeState,
        action: &[f32],
        [before, after]: [&Frame; 2],
    ) -> EpisodeState {
        let (dt, now) = (prepared.dt(), state.ego.state);
        let seen = after.agent(state.ego.id).unwrap_or(&state.ego);
        let n = (dt / MOMENT).round().max(1.0) as usize;
        let at = |k: usize| {
            let elapsed = dt * k as f64 / n as f64;
            seen.with_state(self.dynamics.advance(&now, action, dt, elapsed))
        };
        let way: Vec<Agent> = (1..=n).map(at).collect();
        let ego = way[n - 1].state;
        let mut next = EpisodeState {
            steps: state.steps + 1,
            ego: way[n - 1],
            before: [Some(now), state.before[0]],
            along: prepared.along_route(ego.pose.position),
            ..state.clone()
        };
        let moved = ego.pose.position.distance(now.pose.position);
        let progress = (next.along - state.along).clamp(-moved, moved);
        let contact = contact(&way, before, after, dt);
        let (collided, at_fault) = (contact.is_some(), contact == Some(Fault::Ego));
        let stride = n.div_ceil((moved / ROAD_TEST_SPACING).ceil().clamp(1.0, n as f64) as usize);
        let off_road = way
            .iter()
            .rev()
            .step_by(stride)
            .any(|ego| is_off_road(prepared, ego));
        let uncomfortable = next.is_uncomfortable(dt);

        let weights = &self.reward;
        let blameless = weights.blameless_collision.unwrap_or(weights.collision);
        let happened = |weight: f64, it: bool| if it { weight } else { 0.0 };
        next.reward = weights.progress * progress
            + happened(weights.collision, at_fault)
            + happened(blameless, collided && !at_fault)
            + happened(weights.off_road, off_road)
            + happened(weights.discomfort, uncomfortable);
        next.totals.reward += next.reward;
        next.totals.progress += progress;
        next.totals.collided |= collided;
        next.totals.at_fault |= at_fault;
        next.totals.off_road |= off_road;
        next.totals.uncomfortable |= uncomfortable;
        let horizon = (self.horizon / prepared.dt()).round().max(1.0) as usize;
        let at_end_of_route = prepared.route().is_some_and(|r| next.along >= r.length());
        next.end = if collided {
            Some(End::Terminated(Failure::Collision))
        } else if off_road {
            Some(End::Terminated(Failure::OffRoad))
        } else if next.steps >= horizon || at_end_of_route {
            Some(End::Truncated)
        } else {
            None
        };
        next
    }

    /// The action that comes nearest to the log's next state; keeps the velocity where the log has
    /// none.
    ///
    /// Shape: `action` is `[action_len]`.
    pub fn expert_action(
        &self,
        prepared: &PreparedScenario,
        state: &EpisodeState,
        action: &mut [f32],
    ) {
        let ahead = self.dynamics.action_len().div_ceil(3);
        let logged = (1..=ahead).map_while(|k| prepared.logged_ego(state.steps + k));
        let targets: Vec<AgentState> = logged.collect();
        let now = &state.ego.state;
        self.dynamics.towards(now, &targets, prepared.dt(), action);
    }

    /// Checks that this is a valid batch of `n` actions.
    pub(crate) fn check_actions(&self, actions: &[f32], n: usize) -> Result<(), RlError> {
        let len = self.dynamics.action_len();
        if actions.len() != n * len {
            return Err(RlError::Count {
                who: "the policy",
                expected: n * len,
                found: actions.len(),
            });
        }
        // Rounding may carry a number that was scaled into the box just beyond it.
        let fits = |v: &f32| v.abs() <= 1.0 + 1e-5;
        let Some(i) = actions.iter().position(|v| !fits(v)) else {
            return Ok(());
        };
        let row = i / len;
        Err(if actions[i].is_finite() {
            RlError::OutOfRange {
                row,
                dimension: i % len,
                value: actions[i],
            }
        } else {
            RlError::NotFinite { row }
        })
    }
}

impl EpisodeState {
    /// [`gump_metrics::Discomfort`] of the last step.
    fn is_uncomfortable(&self, dt: f64) -> bool {
        let [Some(before), earlier] = self.before else {
            return false;
        };
        let now = &self.ego.state;
        let forward = now.pose.direction();
        let acceleration = (now.velocity - before.velocity) / dt;
        let yaw_rate = turn_rate(&before, now, dt);
        let jerk = earlier.map(|earlier| {
            let acceleration_before = (before.velocity - earlier.velocity) / dt;
            let jerk = (acceleration - acceleration_before) / dt;
            let change = (acceleration.length() - acceleration_before.length()) / dt;
            let yaw_acceleration = (yaw_rate - turn_rate(&earlier, &before, dt)) / dt;
            (jerk.dot(forward), change, yaw_acceleration)
        });
        let felt = ComfortMeasurements {
            longitudinal_acceleration: acceleration.dot(forward),
            lateral_acceleration: acceleration.dot(forward.perp()),
            yaw_rate: Some(yaw_rate),
            yaw_acceleration: jerk.map(|(_, _, yaw)| yaw),
            longitudinal_jerk: jerk.map(|(along, _, _)| along),
            jerk: jerk.map(|(_, change, _)| change),
        };
        !ComfortBounds::NUPLAN.allow(&felt)
    }
}

fn turn_rate(from: &AgentState, to: &AgentState, dt: f64) -> f64 {
    angle_difference(to.pose.heading, from.pose.heading) / dt
}

/// Who is to blame for a collision, by nuPlan's kinds of contact. Contacts from the side are the
/// ego's fault here, since scenes need not say where lanes end.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Fault {
    /// Another, who ran into the ego from behind or while it stood.
    Other,
    /// The ego.
    Ego,
}

/// [`gump_metrics::Collision`] of the ego at any moment of a step, and whose fault: the ego's if it
/// is to blame for one of several. `way` has the ego at evenly spaced moments, the last of them the
/// step's end; the step takes `dt` seconds.
fn contact(way: &[Agent], before: &Frame, after: &Frame, dt: f64) -> Option<Fault> {
    let own = way[way.len() - 1].oriented_box();
    let from_end = |ego: &Agent| ego.state.pose.position.distance(own.pose.position);
    let own_way = way.iter().map(from_end).fold(0.0, f64::max);
    let with = |other: &Agent| {
        let end = other.state.pose;
        // Half the sum of length and width is no less than half the diagonal.
        let size = (own.length + own.width + other.length + other.width) / 2.0;
        let distance = own.pose.position.distance_squared(end.position);
        let far = |reach: f64| distance >= reach * reach;
        if other.id == way[0].id || far(size + own_way + FASTEST * dt) {
            return None;
        }
        let appeared = Pose {
            position: end.position - other.state.velocity * dt,
            ..end
        };
        let start = before
            .agent(other.id)
            .map_or(appeared, |then| then.state.pose);
        // Of the whole step, as is the way between the two poses.
        let velocity = (end.position - start.position) / dt;
        if far(size + own_way + start.position.distance(end.position)) {
            return None;
        }
        way.iter().enumerate().find_map(|(k, ego)| {
            let share = (k + 1) as f64 / way.len() as f64;
            let there = OrientedBox {
                pose: if share < 1.0 {
                    start.interpolate(end, share)
                } else {
                    end
                },
                ..other.oriented_box()
            };
            let own = ego.oriented_box();
            let touches = own.pose.position.distance_squared(there.pose.position) < size * size
                && own.overlaps(&there);
            touches.then(|| {
                let other = other.with_state(AgentState {
                    pose: there.pose,
                    velocity,
                });
                fault(ego, &other)
            })
        })
    };
    after.agents().iter().filter_map(with).max()
}

/// Whose fault it is that the ego touches an agent.
fn fault(ego: &Agent, other: &Agent) -> Fault {
    // nuPlan's vehicle has its rear axle at this share of its length behind its centre.
    let vehicle = VehicleParameters::PACIFICA;
    let behind = vehicle.rear_axle_to_center() / vehicle.length() * ego.length;
    let rear_axle = Pose {
        position: ego.state.pose * dvec2(-behind, 0.0),
        ..ego.state.pose
    };
    let kind = classify(&ego.oriented_box(), rear_axle, ego.state.speed(), other);
    if kind.is_at_fault(false) {
        Fault::Ego
    } else {
        Fault::Other
    }
}

/// [`gump_metrics::OffRoad`] of the ego.
fn is_off_road(prepared: &PreparedScenario, ego: &Agent) -> bool {
    if ego.kind != AgentKind::Vehicle {
        return false;
    }
    let z = ego.elevation - ego.height / 2.0;
    let is_off = |corner| {
        let metres = prepared.border.metres_off_road(corner, z);
        metres.is_some_and(|metres| metres > 0.0)
    };
    OrientedBox::corners(&ego.oriented_box())
        .into_iter()
        .any(is_off)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

    use gump_scene::{AgentId, fixture};

    use super::*;

    const DT: f64 = 0.5;

    /// The contact of an ego that drives from 0 to 5 with what stands at its end as `after` says.
    fn found(before: &str, after: &str) -> Option<Fault> {
        let frame = |others: &str| {
            let text = format!("ego vehicle 0: 5,0 velocity 10,0\n{others}");
            fixture::scenario(&text).unwrap().present().now().clone()
        };
        let [before, after] = [before, after].map(frame);
        let ego = *after.agent(AgentId(0)).unwrap();
        let at = |k: usize| {
            let mut state = ego.state;
            state.pose.position.x = k as f64;
            ego.with_state(state)
        };
        let way: Vec<Agent> = (1..=5).map(at).collect();
        contact(&way, &before, &after, DT)
    }

    #[test]
    fn who_appears_within_a_step_has_come_from_somewhere() {
        // Its box crosses the ego's way after a quarter of a second, and is beyond it at the end.
        let passes = "agent vehicle 1: 4,7 heading 1.5708 velocity 0,20";
        assert_eq!(found("", passes), Some(Fault::Ego));
        assert_eq!(found("", "agent vehicle 1: 4,7 heading 1.5708"), None);
    }

    #[test]
    fn who_drives_into_the_ego_and_stops_there_is_to_blame() {
        let before = "agent vehicle 1: -11,0 heading 0 velocity 20,0";
        assert_eq!(found(before, "agent vehicle 1: 1,0"), Some(Fault::Other));
        let stands = "agent vehicle 1: 8,0";
        assert_eq!(found(stands, stands), Some(Fault::Ego));
    }

    #[test]
    fn all_collisions_cost_the_same_unless_stated() {
        let of = |text: &str| toml::from_str::<RewardWeights>(text).unwrap();
        assert_eq!(of("collision = -15.0").blameless_collision, None);
        let stated = of("blameless_collision = -3.0");
        assert_eq!(stated.blameless_collision, Some(-3.0));
        // A car from behind touches the ego, which drives at 10 m/s.
        let text = "lane 1: 0,0 400,0\nroute 1\nego vehicle 0: 20,0 velocity 10,0
            agent vehicle 1: 12,0 velocity 20,0";
        let prepared = PreparedScenario::new(fixture::scenario(text).unwrap(), DT).unwrap();
        let reward = |reward: RewardWeights| {
            let rules = Rules {
                reward,
                ..Rules::default()
            };
            let next = rules.step(&prepared, &rules.reset(&prepared), &[0.0, 0.0]);
            let next = next.unwrap();
            assert!(next.totals.collided && !next.totals.at_fault);
            next.reward
        };
        let weights = RewardWeights {
            collision: -15.0,
            ..RewardWeights::default()
        };
        assert!((reward(weights) - (0.5 - 15.0)).abs() < 1e-6);
        let forgiving = RewardWeights {
            blameless_collision: Some(-1.0),
            ..weights
        };
        assert!((reward(forgiving) - (0.5 - 1.0)).abs() < 1e-6);
    }

    /// Drives within the given route are as long as without the lanes beyond.
    #[test]
    fn what_lies_beyond_the_route_does_not_change_progress_along_it() {
        let of = |next: &str| {
            let text = format!(
                "lane 1: 0,0 60,0 60,40 {next}\nlane 2: 60,40 60,300\nroute 1
                 ego vehicle 0: 10,1 velocity 6,0"
            );
            PreparedScenario::new(fixture::scenario(&text).unwrap(), DT).unwrap()
        };
        let [alone, extended] = ["", "next 2"].map(of);
        let rules = Rules::default();
        let drive = |prepared: &PreparedScenario| {
            let mut state = rules.reset(prepared);
            while state.end.is_none() {
                let steer = if state.steps < 13 { 0.0 } else { 0.4 };
                state = rules.step(prepared, &state, &[0.0, steer]).unwrap();
            }
            state.totals.progress
        };
        let lengths = [&alone, &extended].map(|prepared| prepared.route().unwrap().length());
        assert_eq!(lengths, [100.0, 360.0]);
        assert_eq!(drive(&alone), drive(&extended));
        assert!(drive(&alone) > 30.0);
    }
}
