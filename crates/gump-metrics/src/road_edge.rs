//! Signed distance to the border of the road.

use gump_geometry::{DVec2, cross, project_on_segment};
use gump_scene::{Agent, MapGraph, RoadEdge, SceneState};

use crate::{Metric, Reduce};

/// Vertical metres count this often when the nearest edge is chosen, so that a road above or below
/// is not taken for this one.
///
/// Source: the Waymo Sim Agents Challenge since 2024.
const Z_STRETCH: f64 = 3.0;

/// Signed distance from the agent's box to the nearest road edge, metres: negative on the road,
/// positive off it; the corner that is farthest out counts. `None` on a map without road edges.
#[derive(Clone, Copy, Debug)]
pub struct DistanceToRoadEdge;

impl Metric for DistanceToRoadEdge {
    fn name(&self) -> &'static str {
        "distance_to_road_edge_m"
    }

    fn at(&self, scene: &SceneState<'_>, agent: &Agent) -> Option<f64> {
        let z = agent.elevation - agent.height / 2.0;
        let corners = agent.oriented_box().corners();
        let distances = corners.map(|corner| signed_distance_to_road_edge(scene.map, corner, z));
        distances.into_iter().flatten().reduce(f64::max)
    }

    fn reduce(&self) -> Reduce {
        Reduce::Max
    }
}

/// Signed distance from `point` at height `z` to the nearest road edge, metres: negative on the
/// left of the edge's direction, where the road is. `None` on a map without road edges.
///
/// The nearest segment is chosen in space, the distance is measured in the plane. Beside a joint
/// of two segments the sign follows whether the joint is convex, so that it is right on both sides
/// of a corner. A point exactly on an edge has distance 0.
///
/// Source: the rule of the Waymo Sim Agents Challenge (2024), in f64 and with closed edges always
/// treated as closed.
pub fn signed_distance_to_road_edge(map: &MapGraph, point: DVec2, z: f64) -> Option<f64> {
    let mut best: Option<(f64, f64, usize, usize)> = None;
    for (edge, segment, distance) in map.nearest_road_edges(point) {
        // Segments come by distance in the plane, which the distance in space only exceeds.
        if best.is_some_and(|(least, ..)| distance > least) {
            break;
        }
        let in_space = distance.hypot(Z_STRETCH * rise(&map.road_edges()[edge], segment, point, z));
        if best.is_none_or(|(least, ..)| in_space < least) {
            best = Some((in_space, distance, edge, segment));
        }
    }
    best.map(|(_, distance, edge, segment)| {
        distance * side(map.road_edges()[edge].line.points(), segment, point)
    })
}

/// Height of `z` over the foot of `point` on a segment.
fn rise(edge: &RoadEdge, segment: usize, point: DVec2, z: f64) -> f64 {
    let points = edge.line.points();
    let t = project_on_segment(point, points[segment], points[segment + 1]);
    let (from, to) = (edge.elevation[segment], edge.elevation[segment + 1]);
    z - (from + t * (to - from))
}

/// -1 on the left, +1 on the right, 0 on the line itself.
fn side(points: &[DVec2], segment: usize, point: DVec2) -> f64 {
    let n = points.len() - 1;
    let closed = points[0].distance_squared(points[n]) < 1.0;
    let direction = |i: usize| points[i + 1] - points[i];
    let right = |i: usize| -sign(cross(direction(i), point - points[i]));
    let before = match segment {
        0 => closed.then(|| n - 1),
        i => Some(i - 1),
    };
    let after = match segment + 1 {
        i if i == n => closed.then_some(0),
        i => Some(i),
    };
    let (start, along) = (points[segment], direction(segment));
    let t = (point - start).dot(along) / along.length_squared();
    // A left turn is convex seen from the right: beside it a point is off the road if it is to the
    // right of either segment, at a right turn only if it is to the right of both.
    let at_joint = |a: usize, b: usize| {
        if cross(direction(a), direction(b)) > 0.0 {
            right(a).max(right(b))
        } else {
            right(a).min(right(b))
        }
    };
    match (before, after) {
        (Some(before), _) if t < 0.0 => at_joint(before, segment),
        (_, Some(after)) if t > 1.0 => at_joint(segment, after),
        _ => right(segment),
    }
}

fn sign(value: f64) -> f64 {
    if value == 0.0 { 0.0 } else { value.signum() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;
    use gump_geometry::dvec2;
    use gump_scene::fixture;

    fn check(edges: &str, point: DVec2, expected: Option<f64>) {
        let scenario = fixture::scenario(&format!("{edges}\nego vehicle 0: 0,0")).unwrap();
        let found = signed_distance_to_road_edge(&scenario.map, point, 0.0);
        match (found, expected) {
            (Some(found), Some(expected)) => assert_abs_diff_eq!(found, expected, epsilon = 1e-9),
            _ => assert_eq!(found, expected),
        }
    }

    #[test]
    fn the_road_is_on_the_left() {
        let edge = "edge: 0,-2 100,-2";
        check(edge, dvec2(50.0, 1.0), Some(-3.0));
        check(edge, dvec2(50.0, -4.0), Some(2.0));
        check(edge, dvec2(50.0, -2.0), Some(0.0));
        check("edge: 100,-2 0,-2", dvec2(50.0, 1.0), Some(3.0));
        check("", dvec2(0.0, 0.0), None);
    }

    #[test]
    fn the_nearest_edge_counts() {
        let edges = "edge: 0,-2 100,-2\nedge: 100,8 0,8";
        check(edges, dvec2(50.0, 7.0), Some(-1.0));
        check(edges, dvec2(50.0, 9.0), Some(1.0));
    }

    #[test]
    fn beside_a_corner_the_sign_follows_its_turn() {
        // The road turns left: beyond the outer corner one is off it, whichever segment is nearest.
        let left = "edge: 0,0 10,0 10,10";
        check(left, dvec2(11.0, -1.0), Some(2f64.sqrt()));
        check(left, dvec2(11.0, 0.0), Some(1.0));
        check(left, dvec2(9.0, 1.0), Some(-1.0));
        // It turns right: beyond the corner one is on it.
        let right = "edge: 0,0 10,0 10,-10";
        check(right, dvec2(11.0, 1.0), Some(-(2f64.sqrt())));
        check(right, dvec2(9.0, -1.0), Some(1.0));
        // A sharp left turn: right of one segment is enough, left of the other does not help.
        let sharp = "edge: 0,0 10,0 0,3";
        check(sharp, dvec2(12.0, -0.1), Some(2.0f64.hypot(0.1)));
        check(sharp, dvec2(12.0, 0.1), Some(2.0f64.hypot(0.1)));
    }

    #[test]
    fn closed_edges_have_no_open_end() {
        // An island: the road is outside, on the left of a clockwise ring.
        let island = "edge: 0,0 0,4 4,4 4,0 0,0";
        check(island, dvec2(-1.0, -1.0), Some(-(2f64.sqrt())));
        check(island, dvec2(2.0, 1.0), Some(1.0));
    }

    #[test]
    fn a_road_on_another_level_is_not_this_one() {
        let text = "edge: 0,-2 100,-2\nedge: 100,1 0,1\nego vehicle 0: 50,0";
        let scenario = fixture::scenario(text).unwrap();
        let mut parts = gump_scene::MapParts {
            road_edges: scenario.map.road_edges().to_vec(),
            ..Default::default()
        };
        parts.road_edges[1].elevation = vec![6.0; 2];
        let map = MapGraph::new(parts).unwrap();
        let at = |z| signed_distance_to_road_edge(&map, dvec2(50.0, 0.2), z).unwrap();
        assert_abs_diff_eq!(at(0.0), -2.2, epsilon = 1e-9);
        assert_abs_diff_eq!(at(6.0), -0.8, epsilon = 1e-9);
    }

    #[test]
    fn the_corner_farthest_out_counts() {
        let text = "edge: 0,-2 100,-2\nego vehicle 0: 50,-0.5 size 4,2";
        let scenario = fixture::scenario(text).unwrap();
        let scene = scenario.present();
        let found = DistanceToRoadEdge.at(&scene, scene.ego_now()).unwrap();
        assert_abs_diff_eq!(found, -0.5, epsilon = 1e-9);
    }
}
