//! Whether a vehicle that stands in traffic has a reason to: a light, a sign, a junction or another
//! agent ahead.
//!
//! A network that draws one object after another places standing vehicles in the middle of open
//! lanes. Rollouts leave them there, like double-parked vehicles, and half a minute later all
//! traffic stands behind them.
//!
//! `behaviour/free_road.rs` of `gump-metrics` and `relative/waiting.rs` of `gump-engine` ask similar
//! questions of standing vehicles, with other reasons. Here a draw is judged while its scene is half
//! drawn, and judged again and again, so the test is short and knows less:
//!
//! * The others are boxes without velocities, since those drawn later are not there yet. A junction
//!   ahead is therefore a reason by itself; the metric, and starts after nine seconds, look for
//!   traffic that approaches it. In a junction only another agent ahead is one: who stands there is in
//!   the way of all others for as long as it waits.
//! * A way ahead is the rest of the lane joined with one following lane, and everything is measured
//!   along the joined line. The other two measure on each lane by itself (`gump_scene::LaneAhead`)
//!   and follow lanes as far as they look; near the seam of two lanes the results differ, and with
//!   them the scenes that a seed gives.
//! * Another agent is a reason if its centre is within 1.8 m of the path and its rear within 12 m
//!   ahead, whatever its kind; the other two look at its corners and keep farther from people.

use gump_geometry::{DVec2, OrientedBox, Polyline, Pose, angle_difference};
use gump_scene::{Lane, Light, LightState, MapGraph, stop_line};

// Chosen by hand: result 23 has the effect of the rule, not of its numbers.

/// A slower vehicle stands, metres per second: two bins of a token.
const STANDS: f64 = 0.5;
/// A vehicle this near to a lane's centre, and this well aligned with it, stands in traffic;
/// otherwise it is parked. Metres and radians, as in the relative network's world.
const IN_LANE_M: f64 = 1.0;
const ALONG: f64 = 0.35;
/// One that is in no lane, but this near to a lane of a junction and to no other, is in the junction,
/// metres.
const INSIDE_M: f64 = 4.0;
/// Maximum distance of a reason ahead of the front bumper, metres: a light or sign (it waits a few
/// cars behind the line), a junction, another agent (a gap of two cars).
const LINE_M: f64 = 25.0;
const JUNCTION_M: f64 = 10.0;
const NEXT_M: f64 = 12.0;
/// Maximum distance beside the path of another agent that blocks it, metres: about the width of a
/// car.
const BESIDE_M: f64 = 1.8;

/// Vehicles are at least as long as this, metres: people and bicycles get past.
const SHORTEST_M: f64 = 2.5;
/// Vehicles in a junction meet if they are nearer than this, metres, at more than this angle, radians.
const MEETING_M: f64 = 25.0;
const CROSSES: f64 = 0.6;

/// True if a box, world frame, stands in a lane without a reason.
pub(crate) fn stands_without(
    own: &OrientedBox,
    speed: f64,
    map: &MapGraph,
    lights: &[Light],
    others: &[OrientedBox],
) -> bool {
    if speed >= STANDS {
        return false;
    }
    let Some(lane) = lane_of(own.pose, map) else {
        // Nobody parks in a junction.
        let mut near = map.lanes_near(own.pose.position, INSIDE_M);
        return near.next().is_some_and(|(lane, _)| lane.in_intersection);
    };
    let from = lane.centerline.project(own.pose.position).arc_length;
    let front = own.length / 2.0;
    // Every path ahead must be free: a vehicle that waits to turn has one that is not.
    !ways(map, lane, from).iter().any(|(lanes, way)| {
        let is_held_by_line = lanes.iter().any(|lane| {
            let ahead = |at: DVec2| {
                let gap = way.project(at).arc_length - front;
                // Up to 3 m past the line it may still wait; signs stand beside the road.
                (-3.0..LINE_M).contains(&gap) && way.project(at).distance < 5.0
            };
            let binds = |light: &&Light| light.lane == lane.id && light.state != LightState::Green;
            let mut lines = lights.iter().filter(binds);
            let mut signs = map.stop_signs_of(lane.id);
            lines.any(|light| ahead(stop_line(lane, light).position))
                || signs.any(|sign| ahead(DVec2::new(sign.position.x, sign.position.y)))
        });
        let enters = |lane: &&&Lane| {
            let start = way.project(lane.centerline.points()[0]).arc_length;
            lane.in_intersection && start - front < JUNCTION_M
        };
        let is_blocked = others.iter().any(|other| {
            let foot = way.project(other.pose.position);
            let gap = foot.arc_length - front - other.length / 2.0;
            foot.arc_length > 0.0 && gap < NEXT_M && foot.distance < BESIDE_M
        });
        let is_held = is_held_by_line || lanes.iter().any(|lane| enters(&lane));
        // Who is in a junction already has passed its line.
        (is_held && !lane.in_intersection) || is_blocked
    })
}

/// True if a vehicle is in a junction across the way of another one in it. Drawn one after another,
/// both may be fast, and they meet within a second.
pub(crate) fn meets_in_junction(own: &OrientedBox, map: &MapGraph, others: &[OrientedBox]) -> bool {
    let is_inside = |one: &OrientedBox| {
        let mut near = map.lanes_near(one.pose.position, IN_LANE_M);
        near.next().is_some_and(|(lane, _)| lane.in_intersection)
    };
    let is_near = |other: &&OrientedBox| {
        let turned = angle_difference(own.pose.heading, other.pose.heading).abs();
        other.length >= SHORTEST_M
            && own.pose.position.distance(other.pose.position) < MEETING_M
            && (CROSSES..std::f64::consts::PI - CROSSES).contains(&turned)
    };
    own.length >= SHORTEST_M && is_inside(own) && others.iter().filter(is_near).any(is_inside)
}

/// The lane in whose middle an agent is, if there is one.
pub(crate) fn lane_of(pose: Pose, map: &MapGraph) -> Option<&Lane> {
    let near = map.lanes_near(pose.position, IN_LANE_M);
    let along = near.filter(|(lane, _)| lane.foot(pose).turned < ALONG);
    let nearest = along.min_by(|a, b| a.1.total_cmp(&b.1).then(a.0.id.cmp(&b.0.id)));
    nearest.map(|(lane, _)| lane)
}

/// The paths ahead of a position on a lane, each with its lanes.
pub(crate) fn ways<'m>(
    map: &'m MapGraph,
    lane: &'m Lane,
    from: f64,
) -> Vec<(Vec<&'m Lane>, Polyline)> {
    let rest = lane.centerline.slice(from, lane.centerline.length());
    let mut next: Vec<&Lane> = map.successors(lane.id).collect();
    next.sort_by_key(|lane| lane.id);
    if next.is_empty() || rest.length() > LINE_M + 10.0 {
        return vec![(vec![lane], rest)];
    }
    let longer = |next: &'m Lane| {
        let points = rest.points().iter().chain(next.centerline.points());
        let way = Polyline::new(points.copied().collect()).unwrap_or_else(|| rest.clone());
        (vec![lane, next], way)
    };
    next.into_iter().map(longer).collect()
}

#[cfg(test)]
mod tests {
    use gump_geometry::dvec2;
    use gump_scene::fixture;

    use super::*;

    #[test]
    fn reasons_are_lights_junctions_and_others() {
        let check = |light: &str, at: (f64, f64), other: Option<(f64, f64)>, expected: bool| {
            let scenario = fixture::scenario(&format!(
                "lane 1: 0,0 60,0 120,0\n{light}\nego vehicle 0: 0,0"
            ))
            .unwrap();
            let boxed = |(x, y): (f64, f64)| OrientedBox {
                pose: Pose {
                    position: dvec2(x, y),
                    heading: 0.0,
                },
                length: 4.6,
                width: 1.9,
            };
            let others: Vec<OrientedBox> = other.into_iter().map(boxed).collect();
            let lights = scenario.present().now().lights();
            let found = stands_without(&boxed(at), 0.0, &scenario.map, lights, &others);
            assert_eq!(found, expected, "{light} {at:?} {other:?}");
        };
        check("", (30.0, 0.2), None, true);
        check("light 1 green:", (110.0, 0.2), None, true);
        check("light 1 red:", (110.0, 0.2), None, false);
        check("light 1 red:", (30.0, 0.2), None, true);
        // Parked beside the lane, behind another, in front of another, next to another.
        check("", (30.0, 2.4), None, false);
        check("", (30.0, 0.2), Some((38.0, 0.0)), false);
        check("", (30.0, 0.2), Some((22.0, 0.0)), true);
        check("", (30.0, 0.2), Some((31.0, 3.0)), true);
        let open = fixture::scenario("lane 1: 0,0 60,0\nego vehicle 0: 30,0").unwrap();
        let ego = open.present().ego_now().oriented_box();
        assert!(!stands_without(&ego, 3.0, &open.map, &[], &[]));
        let crossing = |x: f64, heading: f64, other: Option<f64>| {
            let scenario = fixture::scenario(
                "lane 1: 0,0 60,0 next 2\nlane 2: 60,0 80,0 next 3\nlane 3: 80,0 120,0\nego vehicle 0: 0,0",
            )
            .unwrap();
            let mut parts = scenario.map.parts().clone();
            parts.lanes[1].in_intersection = true;
            let map = MapGraph::new(parts).unwrap();
            let boxed = |x: f64, heading: f64| OrientedBox {
                pose: Pose::new(x, 0.2, heading),
                length: 4.6,
                width: 1.9,
            };
            let meets =
                |x: f64, turn: f64| meets_in_junction(&boxed(70.0, 0.0), &map, &[boxed(x, turn)]);
            // Across its way in the junction, along it, and before the junction.
            assert!(meets(77.0, 1.2) && !meets(77.0, 0.2) && !meets(77.0, 3.0));
            assert!(!meets(50.0, 1.2));
            let others: Vec<OrientedBox> = other.map(|x| boxed(x, 0.0)).into_iter().collect();
            stands_without(&boxed(x, heading), 0.0, &map, &[], &others)
        };
        assert!(!crossing(56.0, 0.0, None) && !crossing(70.0, 0.0, Some(79.0)));
        // In the junction for nothing, along the lane or across it.
        assert!(crossing(70.0, 0.0, None) && crossing(70.0, 0.9, None));
        assert!(stands_without(&ego, 0.0, &open.map, &[], &[]));
    }
}
