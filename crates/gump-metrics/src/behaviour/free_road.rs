//! Stops without a reason.
//!
//! Each of these is a reason to stop: the vehicle is not on a lane (over 1 m beside the centre line
//! or 30 degrees off it, as when parking); an agent is ahead within 15 m of the front bumper and
//! half a metre of its path, pedestrians and bicycles within 3 m; within 25 m ahead is a light that
//! is not green, a stop line, a stop sign or the end of the road; an intersection is within 15 m
//! and within 50 m an agent on another path approaches. A stop is free if there is no reason at its
//! start, at its end or in between; a vehicle that stands for long is looked at every second.
//!
//! `relative/waiting.rs` of `gump-engine` and `reason.rs` of `gump-generate` ask similar questions of
//! standing vehicles. A metric must not count stops that a driver might make, so the reasons here
//! are the most, and reach farthest:
//!
//! * Stop lines and stop signs without lanes are reasons nowhere else.
//! * Agents are reasons up to 15 m ahead (12 m for draws, 15 or 5 m for starts) and people up to 3 m
//!   beside the path, because one may stop for somebody who only might step onto it.
//! * A junction is a reason only while somebody approaches it. For draws it always is, because
//!   nothing is known of the motion of what is not drawn yet; for starts it always is at first and
//!   later never by itself.
//! * Only vehicles are judged, and not on bicycle lanes.

use std::f64::consts::FRAC_PI_6;

use gump_geometry::{Pose, angle_difference};
use gump_scene::{Agent, AgentKind, Frame, LaneAhead, LightState, MapGraph, lanes_ahead};

use super::reach::nearest;
use super::track::Track;
use super::{Counter, MOVES, STANDS};

// Bounds are chosen by hand and generous: what may be a reason counts as one. The logs of
// recorded/tune and recorded/test have no free stop with them.
/// A vehicle farther than this beside the centre line is not on the lane, metres.
pub(super) const ON_LANE_M: f64 = 1.0;
/// Distance ahead of the front bumper within which agents are considered, and lights, signs and the
/// end of the road, metres.
const OTHERS_M: f64 = 15.0;
const ROAD_M: f64 = 25.0;
/// Distance beside the path within which agents are considered, from the side of the vehicle,
/// metres.
const BESIDE_M: f64 = 0.5;
const PEOPLE_BESIDE_M: f64 = 3.0;
/// Distance to an intersection within which vehicles give way, and distance of the agents they give
/// way to, metres.
const JUNCTION_M: f64 = 15.0;
const CROSSING_M: f64 = 50.0;
/// Tolerance behind the front bumper that still counts as ahead, metres: boxes are not exact.
const BEHIND_M: f64 = 1.0;
/// Stop signs without lanes apply within this distance of the path, metres.
const SIGN_M: f64 = 10.0;

impl Counter<'_> {
    /// Whether a vehicle that stands from one frame to another has no reason to.
    pub(super) fn is_free(&self, track: &Track, from: usize, until: usize) -> bool {
        let moments = [from, (from + until) / 2, until];
        moments.into_iter().all(|k| self.is_free_at(track, k))
    }

    /// Whether a vehicle that stands at frame `k` has no reason to.
    pub(super) fn is_free_at(&self, track: &Track, k: usize) -> bool {
        let frame = self.take.frames[k];
        track.pose(k).is_some_and(|pose| {
            let other = |agent: &&Agent| agent.id != track.id;
            let others: Vec<&Agent> = frame.agents().iter().filter(other).collect();
            has_no_reason(self.map, frame, &others, track, pose)
        })
    }
}

fn has_no_reason(
    map: &MapGraph,
    frame: &Frame,
    others: &[&Agent],
    track: &Track,
    pose: Pose,
) -> bool {
    let Some((lane, place)) = nearest(map, pose, ON_LANE_M, FRAC_PI_6) else {
        return false;
    };
    let front_m = place.arc_length + track.length / 2.0;
    let (way, goes_on) = lanes_ahead(map, lane, front_m, ROAD_M);
    let blocks = |part: &LaneAhead<'_>| {
        is_ruled(map, frame, part)
            || others
                .iter()
                .any(|other| is_in_way(part, other, track.width))
    };
    goes_on && !way.iter().any(blocks) && !gives_way(&way, others, pose)
}

/// A light that is not green, a stop line or a stop sign.
fn is_ruled(map: &MapGraph, frame: &Frame, part: &LaneAhead<'_>) -> bool {
    let is_ahead = |metres: f64| (-BEHIND_M..=ROAD_M).contains(&metres);
    let light = frame.light(part.lane.id).is_some_and(|light| {
        light.state != LightState::Green && is_ahead(part.metres_to_stop_line(light))
    });
    let stop = map.stop_lines(part.lane.id).next().is_some();
    light
        || stop
        || map.stop_signs().iter().any(|sign| {
            let place = part.locate(sign.position.truncate());
            let rules = if sign.lanes.is_empty() {
                place.beside_m <= SIGN_M
            } else {
                sign.lanes.contains(&part.lane.id)
            };
            rules && is_ahead(place.ahead_m)
        })
}

fn is_in_way(part: &LaneAhead<'_>, other: &Agent, width: f64) -> bool {
    let is_soft = matches!(other.kind, AgentKind::Pedestrian | AgentKind::Bicycle);
    let beside = if is_soft { PEOPLE_BESIDE_M } else { BESIDE_M };
    let within = width / 2.0 + beside;
    let own = other.oriented_box();
    let corners = own.corners().into_iter();
    // Far boxes need no corners.
    let centre = part.locate(other.state.pose.position);
    if centre.beside_m > within + other.length.hypot(other.width) / 2.0 {
        return false;
    }
    corners.chain([other.state.pose.position]).any(|point| {
        let place = part.locate(point);
        place.beside_m <= within && (-BEHIND_M..=OTHERS_M).contains(&place.ahead_m)
    })
}

/// True if, at an intersection, an agent on another path approaches.
fn gives_way(way: &[LaneAhead<'_>], others: &[&Agent], pose: Pose) -> bool {
    let junction = |part: &LaneAhead<'_>| part.lane.in_intersection && part.base_m <= JUNCTION_M;
    let crosses = |other: &&Agent| {
        let state = other.state;
        let speed = if other.kind == AgentKind::Vehicle {
            MOVES
        } else {
            STANDS
        };
        let towards = pose.position - state.pose.position;
        state.speed() > speed
            && towards.length() <= CROSSING_M
            && towards.dot(state.velocity) > 0.0
            && angle_difference(state.velocity.to_angle(), pose.heading).abs() > FRAC_PI_6
    };
    way.iter().any(junction) && others.iter().any(crosses)
}
