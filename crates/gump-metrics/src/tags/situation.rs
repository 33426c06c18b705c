//! The facts that tags depend on, computed once per scenario: the ego, the agents around it, the
//! areas it is on and the road ahead.

use std::sync::Arc;

use gump_geometry::{DVec2, Polygon, angle_difference};
use gump_scene::{
    Agent, AgentId, AgentKind, AreaKind, Frame, Lane, LightState, MapGraph, Route, Scenario,
    SceneState,
};

use super::maneuver::{Turn, lane_change, turn};
use crate::kinematics;

// Chosen by hand, where nuPlan publishes no numbers.
/// Maximum lateral offset of an agent in the ego's path, metres.
const CORRIDOR: f64 = 1.5;
/// Search distance for a leader ahead, metres.
const LEAD_RANGE: f64 = 30.0;
/// Search distance for lights, stop signs and crosswalks ahead, metres.
const ROAD_RANGE: f64 = 30.0;
/// Time before and after the present over which acceleration is measured, seconds: shorter ones are
/// dominated by tracker noise.
const MOTION_S: f64 = 0.3;
/// Maximum difference in direction between the ego's lane and the ego, radians.
const SAME_WAY: f64 = 0.8;
/// Sampling distance along the road ahead, metres.
const LOOK: f64 = 0.5;

/// An agent in the ego's frame.
#[derive(Clone, Copy, Debug)]
pub(super) struct Other<'a> {
    pub(super) agent: &'a Agent,
    /// Metres between the boxes.
    pub(super) distance: f64,
    /// Centre in the ego's frame: x ahead, y left, metres.
    pub(super) place: DVec2,
    /// Metres from the ego's front to the other's nearest end, along the ego's heading.
    pub(super) gap: f64,
}

/// A light, stop sign or area ahead of the ego or under it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Ahead<T> {
    /// Metres from the ego's front; negative if the front is past it.
    pub(super) distance: f64,
    pub(super) what: T,
}

/// A scenario as seen from some agent at some time.
#[derive(Clone, Copy)]
pub(super) struct View<'a> {
    pub(super) map: &'a Arc<MapGraph>,
    route: Option<&'a Arc<Route>>,
    pub(super) log: &'a [Frame],
    pub(super) dt: f64,
    pub(super) now: usize,
    pub(super) ego: AgentId,
}

impl<'a> View<'a> {
    /// The view of the ego at the present.
    pub(super) fn of(scenario: &'a Scenario) -> Self {
        Self {
            map: &scenario.map,
            route: scenario.route.as_ref(),
            log: &scenario.log,
            dt: scenario.dt,
            now: scenario.now,
            ego: scenario.ego,
        }
    }

    /// The view of another agent or time, without the ego's route.
    pub(super) fn around(scenario: &'a Scenario, agent: AgentId, now: usize) -> Self {
        Self {
            route: None,
            now,
            ego: agent,
            ..Self::of(scenario)
        }
    }

    pub(super) fn at(&self, index: usize) -> SceneState<'a> {
        SceneState {
            map: self.map,
            route: self.route,
            history: &self.log[..=index],
            ego: self.ego,
            dt: self.dt,
        }
    }
}

/// The facts.
pub(super) struct Situation<'a> {
    pub(super) scenario: View<'a>,
    pub(super) ego: &'a Agent,
    pub(super) speed: f64,
    /// Along the heading, metres per second squared.
    pub(super) acceleration: f64,
    /// To the left, metres per second squared.
    pub(super) lateral_acceleration: f64,
    /// Magnitude, metres per second cubed.
    pub(super) jerk: f64,
    pub(super) others: Vec<Other<'a>>,
    pub(super) lane: Option<&'a Lane>,
    pub(super) on_intersection: bool,
    /// The light that controls the ego's lane inside the intersection it is on.
    pub(super) lit_here: bool,
    pub(super) light: Option<Ahead<LightState>>,
    pub(super) stop_sign: Option<Ahead<()>>,
    pub(super) crosswalk: Option<Ahead<()>>,
    pub(super) on_crosswalk: bool,
    pub(super) turn: Option<Turn>,
    /// Offset to the left of a beginning lane change, metres; its sign is the side.
    pub(super) lane_change: Option<f64>,
}

impl<'a> Situation<'a> {
    pub(super) fn of(scenario: View<'a>) -> Self {
        let scene = scenario.at(scenario.now);
        let ego = scene.ego_now();
        let map: &MapGraph = scenario.map;
        let frame = scene.now();
        let lane = lane_of(map, ego);
        let on_intersection = is_on_intersection(map, ego);
        let ways = ways_ahead(scenario, ego, lane);
        let (along, across) = acceleration(scenario, &scene);
        let lit = |lane: &Lane| frame.light(lane.id).is_some();
        Self {
            scenario,
            ego,
            speed: ego.state.speed(),
            acceleration: along,
            lateral_acceleration: across,
            jerk: jerk(scenario),
            others: others(frame, ego),
            lane,
            on_intersection,
            lit_here: on_intersection && lane.is_some_and(lit),
            light: light_ahead(frame, ego, &ways),
            stop_sign: stop_sign_ahead(map, ego, &ways),
            crosswalk: crosswalk_ahead(map, ego),
            on_crosswalk: touches(map, ego, AreaKind::Crosswalk),
            turn: turn(scenario),
            lane_change: lane_change(scenario, lane),
        }
    }

    pub(super) fn of_kind(&self, kind: AgentKind) -> impl Iterator<Item = &Other<'a>> {
        self.others
            .iter()
            .filter(move |other| other.agent.kind == kind)
    }

    /// Agents of a kind in the ego's path, nearest first.
    pub(super) fn in_the_way(&self, kind: AgentKind) -> Option<&Other<'a>> {
        self.of_kind(kind)
            .filter(|other| other.place.y.abs() < CORRIDOR && other.place.x > 0.0)
            .filter(|other| other.gap < LEAD_RANGE && self.same_way(other))
            .min_by(|a, b| a.gap.total_cmp(&b.gap))
    }

    /// The vehicle ahead in the ego's lane.
    pub(super) fn lead(&self) -> Option<&Other<'a>> {
        self.in_the_way(AgentKind::Vehicle)
    }

    /// A vehicle ahead so near that it relates to the ego's stopping or starting.
    pub(super) fn has_close_lead(&self) -> bool {
        self.lead().is_some_and(|lead| lead.gap < 6.0)
    }

    /// The ego stops within the next seconds, and has begun to brake.
    pub(super) fn is_stopping(&self) -> bool {
        self.speed > 0.3 && self.acceleration < -0.6 && self.slowest_within(3.0) < 0.3
    }

    /// The ego has begun to drive off from near standstill.
    pub(super) fn is_starting(&self) -> bool {
        self.speed < 3.0 && self.acceleration > 0.6
    }

    pub(super) fn is_stationary(&self) -> bool {
        self.speed < 0.1
    }

    /// The ego neither accelerates nor brakes much.
    pub(super) fn is_steady(&self) -> bool {
        self.acceleration.abs() < 1.0
    }

    pub(super) fn is_lane_ruled_by_stop(&self, within: f64) -> bool {
        self.stop_sign
            .is_some_and(|sign| (-2.0..within).contains(&sign.distance))
    }

    pub(super) fn is_light_within(&self, within: f64) -> bool {
        self.light
            .is_some_and(|light| (-2.0..within).contains(&light.distance))
    }

    /// A light that requires to stop.
    pub(super) fn is_stop_light_within(&self, within: f64) -> bool {
        let stops = |state| matches!(state, LightState::Red | LightState::Yellow);
        self.is_light_within(within) && self.light.is_some_and(|light| stops(light.what))
    }

    pub(super) fn is_crosswalk_within(&self, within: f64) -> bool {
        self.crosswalk
            .is_some_and(|crosswalk| crosswalk.distance < within)
    }

    /// Position of an agent after some seconds, in the ego's present frame, if it is logged.
    pub(super) fn place_after(&self, other: &Other<'_>, seconds: f64) -> Option<DVec2> {
        let step = self.scenario.now + (seconds / self.scenario.dt).round() as usize;
        let then = self.scenario.log.get(step)?.agent(other.agent.id)?;
        Some(self.ego.state.pose.inverse() * then.state.pose.position)
    }

    fn slowest_within(&self, seconds: f64) -> f64 {
        let n = (seconds / self.scenario.dt).round() as usize;
        let future = &self.scenario.log[self.scenario.now + 1..];
        let states = future.iter().take(n);
        let speeds = states.filter_map(|frame| frame.agent(self.ego.id));
        speeds
            .map(|ego| ego.state.speed())
            .fold(self.speed, f64::min)
    }

    fn same_way(&self, other: &Other<'_>) -> bool {
        let (own, theirs) = (self.ego.state.pose.heading, other.agent.state.pose.heading);
        angle_difference(theirs, own).abs() < SAME_WAY
    }
}

/// The lane of an agent: the one around its centre whose direction fits best.
pub(super) fn lane_of<'a>(map: &'a MapGraph, agent: &Agent) -> Option<&'a Lane> {
    let pose = agent.state.pose;
    let off = |lane: &Lane| {
        let projection = lane.centerline.project(pose.position);
        let heading = lane.centerline.pose_at(projection.arc_length).heading;
        (
            angle_difference(pose.heading, heading).abs(),
            projection.distance,
        )
    };
    map.lanes_near(pose.position, 4.0)
        .filter(|(lane, distance)| *distance <= lane.width / 2.0 + 0.3)
        .map(|(lane, _)| (lane, off(lane)))
        .filter(|(_, (turn, _))| *turn < SAME_WAY)
        .min_by(|(_, a), (_, b)| (a.0 * 2.0 + a.1).total_cmp(&(b.0 * 2.0 + b.1)))
        .map(|(lane, _)| lane)
}

/// True if the agent's centre is on the area of an intersection or a lane through one.
pub(super) fn is_on_intersection(map: &MapGraph, agent: &Agent) -> bool {
    let centre = agent.state.pose.position;
    let on_area = map
        .areas_containing(centre, AreaKind::Intersection)
        .next()
        .is_some();
    on_area || lane_of(map, agent).is_some_and(|lane| lane.in_intersection)
}

/// True if the agent's box overlaps an area of this kind.
pub(super) fn touches(map: &MapGraph, agent: &Agent, kind: AreaKind) -> bool {
    let own = footprint(agent);
    let mut areas = map.areas().iter().filter(|area| area.kind == kind);
    areas.any(|area| area.polygon.intersects(&own))
}

/// The agent's box as a polygon.
pub(super) fn footprint(agent: &Agent) -> Polygon {
    Polygon::new(agent.oriented_box().corners().to_vec()).expect("a box has four corners")
}

fn others<'a>(frame: &'a Frame, ego: &Agent) -> Vec<Other<'a>> {
    let ego_from_world = ego.state.pose.inverse();
    let own = ego.oriented_box();
    let others = frame.agents().iter().filter(|agent| agent.id != ego.id);
    others
        .map(|agent| {
            let place = ego_from_world * agent.state.pose.position;
            let turn = agent.state.pose.heading - ego.state.pose.heading;
            let half = (agent.length * turn.cos().abs() + agent.width * turn.sin().abs()) / 2.0;
            Other {
                agent,
                distance: own.signed_distance(&agent.oriented_box()).max(0.0),
                place,
                gap: place.x - half - ego.length / 2.0,
            }
        })
        .collect()
}

/// Along and across the ego's heading, over [`MOTION_S`] before and after the present.
fn acceleration(scenario: View<'_>, scene: &SceneState<'_>) -> (f64, f64) {
    let n = (MOTION_S / scenario.dt).round().max(1.0) as usize;
    let velocity = |step: usize| {
        let ego = scenario.log.get(step)?.agent(scenario.ego)?;
        Some((step, ego.state.velocity))
    };
    let before = (0..=n)
        .rev()
        .find_map(|k| velocity(scenario.now.checked_sub(k)?));
    let after = (0..=n).rev().find_map(|k| velocity(scenario.now + k));
    let acceleration = match (before, after) {
        (Some((i, a)), Some((j, b))) if j > i => (b - a) / ((j - i) as f64 * scenario.dt),
        _ => DVec2::ZERO,
    };
    let ahead = scene.ego_now().state.pose.direction();
    (acceleration.dot(ahead), acceleration.dot(ahead.perp()))
}

fn jerk(scenario: View<'_>) -> f64 {
    let n = (MOTION_S / scenario.dt).round().max(1.0) as usize;
    let at = |step: usize| {
        let scene = (step < scenario.log.len()).then(|| scenario.at(step))?;
        kinematics::acceleration(&scene, scenario.ego)
    };
    match (
        scenario.now.checked_sub(n).and_then(at),
        at(scenario.now + n),
    ) {
        (Some(before), Some(after)) => (after - before).length() / (2.0 * n as f64 * scenario.dt),
        _ => 0.0,
    }
}

/// The lanes the ego drives next, with the distances from its front to their starts.
fn ways_ahead<'a>(scenario: View<'a>, ego: &Agent, lane: Option<&'a Lane>) -> Vec<(&'a Lane, f64)> {
    let map: &MapGraph = scenario.map;
    let Some(lane) = lane else {
        return Vec::new();
    };
    let on_route = |lane: &Lane| {
        let route = scenario.route;
        route.is_some_and(|route| route.lanes.contains(&lane.id))
    };
    let driven = lane.centerline.project(ego.state.pose.position).arc_length;
    let mut ways = vec![(lane, -driven - ego.length / 2.0)];
    loop {
        let (last, start) = ways[ways.len() - 1];
        let start = start + last.centerline.length();
        let next = map.successors(last.id).find(|lane| on_route(lane));
        let next = next.or_else(|| map.successors(last.id).next());
        match next {
            Some(next) if start < ROAD_RANGE && ways.len() < 16 => ways.push((next, start)),
            _ => return ways,
        }
    }
}

fn light_ahead(frame: &Frame, ego: &Agent, ways: &[(&Lane, f64)]) -> Option<Ahead<LightState>> {
    // Once on its way through, the light behind does not count.
    let mut ahead = ways.iter().filter(|(_, start)| *start > -2.0 - ego.length);
    ahead.find_map(|(lane, start)| {
        let light = frame.light(lane.id)?;
        let stop = light
            .stop_point
            .map(|stop| (ego.state.pose.inverse() * stop).x);
        let to_stop = stop
            .map(|x| x - ego.length / 2.0)
            .filter(|d| (d - start).abs() < 8.0);
        Some(Ahead {
            distance: to_stop.unwrap_or(*start),
            what: light.state,
        })
    })
}

fn stop_sign_ahead(map: &MapGraph, ego: &Agent, ways: &[(&Lane, f64)]) -> Option<Ahead<()>> {
    let ruled = |lane: &Lane| map.stop_signs_of(lane.id).next().is_some();
    let found = ways.iter().find(|(lane, _)| ruled(lane))?;
    // The sign of a lane through the intersection stands at its start, that of others at the end.
    let length = found.0.centerline.length();
    let at = found.1 + if found.0.in_intersection { 0.0 } else { length };
    (at > -2.0 - ego.length).then_some(Ahead {
        distance: at,
        what: (),
    })
}

/// The first crosswalk straight ahead of the front.
fn crosswalk_ahead(map: &MapGraph, ego: &Agent) -> Option<Ahead<()>> {
    let n = (ROAD_RANGE / LOOK) as usize;
    let front = ego.state.pose.position + ego.state.pose.direction() * (ego.length / 2.0);
    let distances = (0..=n).map(|i| i as f64 * LOOK);
    let mut hits = distances.filter(|distance| {
        let point = front + ego.state.pose.direction() * *distance;
        map.areas_containing(point, AreaKind::Crosswalk)
            .next()
            .is_some()
    });
    hits.next().map(|distance| Ahead { distance, what: () })
}
