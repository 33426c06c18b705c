//! Positions of agents relative to lanes, crosswalks and each other; and properties of the road.

use gump_geometry::{DVec2, angle_difference};
use gump_scene::{Agent, AgentKind, AreaKind, MapGraph, Scenario};

use super::observe::STANDING;
use super::{Statistic as M, StatisticClass, Statistics};
use crate::signed_distance_to_road_edge;

// Definitions of the measures, chosen by hand: see `observe.rs`.
/// An agent farther than this from the centre of any lane is off the lanes, metres.
const OFF_LANE: f64 = 2.0;
/// Distance from a lane centre within which a moving agent is on the lane, metres.
const ON_LANE: f64 = 3.0;
/// Directions that differ by less are the same, radians.
const ALIGNED: f64 = std::f64::consts::FRAC_PI_4;
/// Search radius for lanes, metres.
const FARTHEST_LANE: f64 = 20.0;
/// Maximum distance of a leader, front to rear, metres.
const FARTHEST_LEADER: f64 = 50.0;
/// Maximum lateral offset of a leader's centre, metres.
const LEADER_ASIDE: f64 = 1.5;
/// Slower agents wait rather than follow, m/s; slower pedestrians stand.
const FOLLOWS: f64 = 5.0;
const WALKS: f64 = 0.5;
/// Metres around an agent in which others are neighbours.
const NEIGHBOURHOOD: f64 = 10.0;
/// Maximum distance of a lane of an intersection to another of the same, metres.
const JUNCTION_REACH: f64 = 25.0;

/// Records the position of an agent relative to the road.
pub(super) fn note_place(scenario: &Scenario, agent: &Agent, parked: bool, to: &mut Statistics) {
    let (map, class): (_, StatisticClass) = (&scenario.map, Some(agent.kind));
    let position = agent.state.pose.position;
    if map.lanes().is_empty() {
        return;
    }
    let nearest = map.lanes_near(position, FARTHEST_LANE).next();
    let distance = nearest.map_or(FARTHEST_LANE, |(_, distance)| distance);
    if parked {
        to.note(M::ParkedLaneDistance, class, distance);
        to.note_if(M::ParkedOffLane, class, distance > OFF_LANE);
    } else if agent.state.speed() >= STANDING {
        let offset = lane_offset(map, agent);
        to.note_if(M::OnLane, class, offset.is_some());
        if let Some(offset) = offset {
            to.note(M::LateralOffset, class, offset);
        }
    }
    if agent.kind != AgentKind::Vehicle {
        let crossing = map.areas_containing(position, AreaKind::Crosswalk).next();
        let (crossing, on_lane) = (crossing.is_some(), distance < OFF_LANE);
        to.note_if(M::OnCrosswalk, class, crossing);
        to.note_if(M::OnRoad, class, on_lane && !crossing);
        to.note_if(M::Beside, class, !on_lane && !crossing);
    }
    let z = agent.elevation - agent.height / 2.0;
    if let Some(distance) = signed_distance_to_road_edge(map, position, z) {
        to.note(M::EdgeDistance, class, distance);
    }
}

/// Distance to the centre of the nearest lane in the agent's direction, metres; `None` if there is
/// none within reach.
fn lane_offset(map: &MapGraph, agent: &Agent) -> Option<f64> {
    let pose = agent.state.pose;
    let aligned = |at: DVec2, line: &gump_geometry::Polyline| {
        let along = line.pose_at(line.project(at).arc_length);
        angle_difference(along.heading, pose.heading).abs() < ALIGNED
    };
    map.lanes_near(pose.position, ON_LANE)
        .find(|(lane, _)| aligned(pose.position, &lane.centerline))
        .map(|(_, distance)| distance)
}

/// Records gaps between agents in a frame: neighbours and leaders.
pub(super) fn note_room(scenario: &Scenario, step: usize, to: &mut Statistics) {
    let agents = scenario.log[step].agents();
    let agents: Vec<&Agent> = agents
        .iter()
        .filter(|agent| agent.kind.is_moving())
        .collect();
    let has_lanes = !scenario.map.lanes().is_empty();
    for (i, agent) in agents.iter().enumerate() {
        let class: StatisticClass = Some(agent.kind);
        let here = agent.state.pose.position;
        let others = || agents.iter().enumerate().filter(move |(j, _)| *j != i);
        let others = || others().map(|(_, other)| *other);
        let near = others().filter(|o| o.state.pose.position.distance(here) < NEIGHBOURHOOD);
        to.note(M::Neighbours, class, near.count() as f64);
        let shape = agent.oriented_box();
        let nearest = others()
            .filter(|o| o.state.pose.position.distance(here) < 20.0 + o.length + agent.length)
            .map(|other| shape.signed_distance(&other.oriented_box()))
            .reduce(f64::min);
        if let Some(nearest) = nearest {
            to.note(M::Nearest, class, nearest);
        }
        let drives = agent.kind != AgentKind::Pedestrian && has_lanes;
        if drives
            && let Some((gap, leader)) = leader(agent, others())
            && lane_offset(&scenario.map, agent).is_some_and(|off| off < OFF_LANE)
        {
            to.note(M::Gap, class, gap);
            let speed = agent.state.speed();
            if speed > FOLLOWS && leader.state.speed() > speed / 2.0 {
                to.note(M::Headway, class, gap / speed);
            }
        }
        let walks = agent.kind == AgentKind::Pedestrian && agent.state.speed() > WALKS;
        if walks {
            let people = others().filter(|other| other.kind == AgentKind::Pedestrian);
            let apart = people.map(|other| other.state.pose.position.distance(here));
            to.note(M::Company, class, apart.fold(NEIGHBOURHOOD, f64::min));
        }
    }
}

/// Gap to the agent ahead with the same heading, metres, and that agent.
fn leader<'a>(agent: &Agent, others: impl Iterator<Item = &'a Agent>) -> Option<(f64, &'a Agent)> {
    let pose = agent.state.pose;
    let ahead = others.filter_map(|other| {
        let local = pose.inverse() * other.state.pose.position;
        let turn = angle_difference(other.state.pose.heading, pose.heading).abs();
        let gap = local.x - (agent.length + other.length) / 2.0;
        let leads = other.kind != AgentKind::Pedestrian
            && local.x > 0.0
            && local.y.abs() < LEADER_ASIDE
            && turn < ALIGNED
            && gap < FARTHEST_LEADER;
        leads.then_some((gap.max(0.0), other))
    });
    ahead.min_by(|a, b| a.0.total_cmp(&b.0))
}

/// Records properties of the road.
pub(super) fn note_road(scenario: &Scenario, to: &mut Statistics) {
    let map = &scenario.map;
    let lanes = map.lanes();
    to.note(M::Lanes, None, lanes.len() as f64);
    let metres: f64 = lanes.iter().map(|lane| lane.centerline.length()).sum();
    to.note(M::LaneKilometres, None, metres / 1000.0);
    for lane in lanes {
        to.note_if(M::LanesWithLimit, None, lane.speed_limit.is_some());
    }
    to.note(M::Junctions, None, junctions(map) as f64);
    let lights = scenario.present().now().lights().len();
    to.note(M::Lights, None, lights as f64);
    to.note(M::StopSigns, None, map.stop_signs().len() as f64);
    let areas = |kind| map.areas().iter().filter(|area| area.kind == kind).count() as f64;
    to.note(M::Crosswalks, None, areas(AreaKind::Crosswalk));
    to.note(M::Driveways, None, areas(AreaKind::Driveway));
}

/// Groups of lanes in intersections with centres near each other.
fn junctions(map: &MapGraph) -> usize {
    let inside = map.lanes().iter().filter(|lane| lane.in_intersection);
    let middles: Vec<DVec2> = inside
        .map(|lane| {
            lane.centerline
                .pose_at(lane.centerline.length() / 2.0)
                .position
        })
        .collect();
    let mut seen = vec![false; middles.len()];
    let mut groups = 0;
    for start in 0..middles.len() {
        if seen[start] {
            continue;
        }
        groups += 1;
        seen[start] = true;
        let mut open = vec![start];
        while let Some(i) = open.pop() {
            for j in 0..middles.len() {
                if !seen[j] && middles[i].distance(middles[j]) < JUNCTION_REACH {
                    seen[j] = true;
                    open.push(j);
                }
            }
        }
    }
    groups
}
