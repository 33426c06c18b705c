//! Signed distance to the road edge.

use gump_geometry::{DVec2, cross, project_on_segment};
use gump_scene::{Agent, MapGraph, RoadEdge, SceneState};

use crate::{Metric, Reduce};

/// Factor of height differences when the nearest edge is chosen, so that a road above or below is
/// not mistaken for this one.
///
/// Source: the Waymo Sim Agents Challenge since 2024.
const Z_STRETCH: f64 = 3.0;
/// An edge whose ends are closer than this is closed, metres.
///
/// Source: the Waymo Sim Agents Challenge.
const CLOSED: f64 = 1.0;

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
/// The nearest segment is chosen in space, the distance is measured in the plane. Beside a joint of
/// two segments the sign depends on whether the joint is convex, so that it is correct on both
/// sides of a corner. Past an open end the last segment is extended. A point exactly on an edge has
/// distance 0.
///
/// Source: the rule of the Waymo Sim Agents Challenge (2024), in f64 and with every edge whose
/// ends nearly meet closed by the segment between them.
pub fn signed_distance_to_road_edge(map: &MapGraph, point: DVec2, z: f64) -> Option<f64> {
    let (distance, edge, segment) = nearest(map, point, z)?;
    Some(distance * side(&Spot::new(map, edge, segment, point)))
}

/// Distance of `point` to the right of the nearest edge, off the road, metres, else 0. 0 past the
/// open end of an edge, where the border is unknown. `None` on a map without road edges.
pub(crate) fn metres_beyond_road_edge(map: &MapGraph, point: DVec2, z: f64) -> Option<f64> {
    let (distance, edge, segment) = nearest(map, point, z)?;
    let beyond = is_beyond(map, edge, segment, point);
    Some(if beyond { distance } else { 0.0 })
}

/// True if `point`, nearest to this segment, is off the road.
pub(crate) fn is_beyond(map: &MapGraph, edge: usize, segment: usize, point: DVec2) -> bool {
    let spot = Spot::new(map, edge, segment, point);
    side(&spot) > 0.0 && !spot.is_past_open_end()
}

/// The segment nearest in space as (distance in the plane, edge, segment).
pub(crate) fn nearest(map: &MapGraph, point: DVec2, z: f64) -> Option<(f64, usize, usize)> {
    let mut best: Option<(f64, f64, usize, usize)> = None;
    for (edge, segment, distance) in map.nearest_road_edges(point) {
        // Segments come by distance in the plane, which the distance in space only exceeds.
        if best.is_some_and(|(least, ..)| distance > least) {
            break;
        }
        let Some(in_space) = distance_in_space(map, edge, segment, point, z, distance) else {
            continue;
        };
        if best.is_none_or(|(least, ..)| in_space < least) {
            best = Some((in_space, distance, edge, segment));
        }
    }
    best.map(|(_, distance, edge, segment)| (distance, edge, segment))
}

/// The distance by which the nearest segment is chosen, metres, of a segment that is `distance`
/// away in the plane; `None` for repeated points, which have no sides.
pub(crate) fn distance_in_space(
    map: &MapGraph,
    edge: usize,
    segment: usize,
    point: DVec2,
    z: f64,
    distance: f64,
) -> Option<f64> {
    let edge = &map.road_edges()[edge];
    let points = edge.line.points();
    if points[segment] == points[segment + 1] {
        return None;
    }
    Some(distance.hypot(Z_STRETCH * rise(edge, segment, point, z)))
}

/// Height of `z` over the foot of `point` on a segment.
fn rise(edge: &RoadEdge, segment: usize, point: DVec2, z: f64) -> f64 {
    let points = edge.line.points();
    let t = project_on_segment(point, points[segment], points[segment + 1]);
    let (from, to) = (edge.elevation[segment], edge.elevation[segment + 1]);
    z - (from + t * (to - from))
}

/// A point beside one segment of an edge.
struct Spot {
    point: DVec2,
    /// Fraction along the segment, below 0 or above 1 beside its ends.
    t: f64,
    segment: Line,
    before: Option<Line>,
    after: Option<Line>,
}

/// A start and a direction.
#[derive(Clone, Copy)]
struct Line {
    start: DVec2,
    direction: DVec2,
}

impl Line {
    /// False for repeated points, which have no sides.
    fn has_length(&self) -> bool {
        self.direction != DVec2::ZERO
    }
}

impl Spot {
    fn new(map: &MapGraph, edge: usize, segment: usize, point: DVec2) -> Self {
        let points = map.road_edges()[edge].line.points();
        let n = points.len() - 1;
        let between = |a: DVec2, b: DVec2| Line {
            start: a,
            direction: b - a,
        };
        let line = |i: usize| between(points[i], points[i + 1]);
        // Ends that nearly meet close the edge, by a chord if they do not coincide: without it
        // the end of a narrow island would be a joint that turns back on itself.
        let gap = points[n].distance(points[0]);
        let chord = (gap < CLOSED && gap > 1e-6).then(|| between(points[n], points[0]));
        let wrap = |i: usize| if gap <= 1e-6 { Some(line(i)) } else { chord };
        let own = line(segment);
        Self {
            point,
            t: (point - own.start).dot(own.direction) / own.direction.length_squared(),
            segment: own,
            before: (0..segment)
                .rev()
                .map(line)
                .find(Line::has_length)
                .or_else(|| wrap(n - 1)),
            after: (segment + 1..n)
                .map(line)
                .find(Line::has_length)
                .or_else(|| wrap(0)),
        }
    }

    fn is_past_open_end(&self) -> bool {
        (self.t < 0.0 && self.before.is_none()) || (self.t > 1.0 && self.after.is_none())
    }

    /// +1 right of the line, -1 left of it, 0 on it.
    fn right_of(&self, line: Line) -> f64 {
        -sign(cross(line.direction, self.point - line.start))
    }

    /// Beside the joint of two segments. At a left turn a point is off the road if it is to the
    /// right of either, at a right turn only if it is to the right of both.
    fn at_joint(&self, a: Line, b: Line) -> f64 {
        if cross(a.direction, b.direction) > 0.0 {
            self.right_of(a).max(self.right_of(b))
        } else {
            self.right_of(a).min(self.right_of(b))
        }
    }
}

/// -1 on the road, +1 off it, 0 on the edge itself.
fn side(spot: &Spot) -> f64 {
    match (spot.before, spot.after) {
        (Some(before), _) if spot.t < 0.0 => spot.at_joint(before, spot.segment),
        (_, Some(after)) if spot.t > 1.0 => spot.at_joint(spot.segment, after),
        _ => spot.right_of(spot.segment),
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
    fn a_narrow_island_ends_where_it_ends() {
        // Its ends are 0.8 m apart; the road is all around.
        let island = "edge: 0,0.8 10,0.8 10,0 0,0";
        check(island, dvec2(-3.0, 4.8), Some(-5.0));
        check(island, dvec2(-4.0, -3.0), Some(-5.0));
        check(island, dvec2(5.0, 0.5), Some(0.3));
    }

    #[test]
    fn repeated_points_change_nothing() {
        let left = "edge: 0,0 10,0 10,0 10,10 10,10";
        check(left, dvec2(11.0, -1.0), Some(2f64.sqrt()));
        check(left, dvec2(9.0, 11.0), Some(-(2f64.sqrt())));
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
