//! Road edges with sides, and the distance by which a box reaches off the road.
//!
//! An edge is directed, with the road on its left (`gump_scene::RoadEdge`), as in Waymo's maps and
//! in the metric `gump_metrics::DistanceToRoadEdge`. Here it is cut into stretches of at most a
//! metre and a half, so that few are near a box.

use gump_geometry::{DVec2, OrientedBox, Polyline, Pose, project_on_segment, segments_intersect};

/// Length of a stretch of a road edge, metres: kerbs bend, and few stretches are near a box. Chosen
/// by hand.
pub(super) const EDGE_STEP_M: f64 = 1.5;
/// An edge whose ends are closer than this is closed, metres. Source: the Waymo Sim Agents Challenge.
const CLOSED_M: f64 = 1.0;

/// A straight stretch of a road edge, scene frame; the road is on its left.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Edge {
    /// Start of the edge, metres.
    pub from: DVec2,
    pub(crate) to: DVec2,
    /// True if the border is unknown before its start, after its end.
    open: [bool; 2],
}

impl Edge {
    /// The stretches of an edge.
    pub fn of(line: &Polyline, scene_from_world: Pose) -> Vec<Self> {
        let points = line.resample(EDGE_STEP_M);
        let points: Vec<DVec2> = points
            .points()
            .iter()
            .map(|&p| scene_from_world * p)
            .collect();
        let (Some(first), Some(last)) = (points.first(), points.last()) else {
            return Vec::new();
        };
        let is_open = first.distance(*last) > CLOSED_M;
        let n = points.len();
        let stretch = |i: usize| Self {
            from: points[i],
            to: points[i + 1],
            open: [is_open && i == 0, is_open && i + 2 == n],
        };
        (0..n - 1).map(stretch).collect()
    }

    /// Whether a straight way crosses it.
    pub(crate) fn crosses(&self, from: DVec2, to: DVec2) -> bool {
        segments_intersect(self.from, self.to, from, to)
    }

    /// Signed distance of a point to the right of the line through the stretch, metres; negative on
    /// the left.
    fn metres_right(&self, point: DVec2) -> f64 {
        let along = (self.to - self.from).normalize_or_zero();
        -along.perp_dot(point - self.from)
    }

    /// True if the foot of a point lies beyond an end where the edge stops.
    fn is_past_open_end(&self, point: DVec2) -> bool {
        let t = project_on_segment(point, self.from, self.to);
        (t <= 0.0 && self.open[0]) || (t >= 1.0 && self.open[1])
    }

    fn distance(&self, point: DVec2) -> f64 {
        let t = project_on_segment(point, self.from, self.to);
        self.from.lerp(self.to, t).distance(point)
    }

    /// The farthest corner of a box on the right of the line through the stretch, metres.
    fn depth(&self, body: &OrientedBox) -> f64 {
        let right = body.corners().map(|corner| self.metres_right(corner));
        right.into_iter().fold(f64::MIN, f64::max)
    }
}

/// Returns the distance by which a box reaches over the edges that it crosses, metres; 0 if it
/// crosses none, whichever side of them it is on. `reach` is half its diagonal.
pub fn metres_across(body: &OrientedBox, reach: f64, edges: &[Edge]) -> f64 {
    let centre = body.pose.position;
    let near = (reach + EDGE_STEP_M).powi(2);
    edges
        .iter()
        .filter(|edge| edge.from.distance_squared(centre) <= near)
        .filter(|edge| body.intersects_segment(edge.from, edge.to))
        .map(|edge| edge.depth(body))
        .fold(0.0, f64::max)
}

/// Returns the distance by which a box reaches off the road, metres, whether it crosses an edge or
/// is beyond it; 0 on the road, and where the nearest edge has no known side there.
pub fn metres_off(body: &OrientedBox, reach: f64, edges: &[Edge]) -> f64 {
    let centre = body.pose.position;
    // Two stretches are equally near beside their joint: the one with the larger lateral distance
    // determines the side.
    let key = |edge: &&Edge| (edge.distance(centre), edge.metres_right(centre).abs());
    let nearest = edges.iter().min_by(|a, b| {
        let ((a, beside_a), (b, beside_b)) = (key(a), key(b));
        match (a - b).abs() < 1e-9 {
            true => beside_b.total_cmp(&beside_a),
            false => a.total_cmp(&b),
        }
    });
    let beyond = nearest
        .filter(|edge| edge.metres_right(centre) > 0.0 && !edge.is_past_open_end(centre))
        .map_or(0.0, |edge| edge.depth(body));
    beyond.max(metres_across(body, reach, edges))
}

#[cfg(test)]
mod tests {
    use gump_geometry::dvec2;

    use super::*;

    fn car(x: f64, y: f64, heading: f64) -> OrientedBox {
        OrientedBox {
            pose: Pose::new(x, y, heading),
            length: 4.0,
            width: 2.0,
        }
    }

    fn off(edges: &[Edge], x: f64, y: f64) -> f64 {
        metres_off(&car(x, y, 0.0), 2.24, edges)
    }

    fn edges(points: &[(f64, f64)]) -> Vec<Edge> {
        let points = points.iter().map(|&(x, y)| dvec2(x, y)).collect();
        Edge::of(&Polyline::new(points).expect("two points"), Pose::default())
    }

    #[test]
    fn the_right_side_of_an_edge_is_off_the_road() {
        let edges = edges(&[(-20.0, 0.0), (20.0, 0.0)]);
        assert_eq!(off(&edges, 0.0, 3.0), 0.0);
        assert_eq!(off(&edges, 0.0, 1.1), 0.0);
        assert!((off(&edges, 0.0, 0.7) - 0.3).abs() < 1e-9);
        assert!((off(&edges, 0.0, -5.0) - 6.0).abs() < 1e-9);
        // The same line the other way round borders the other side.
        let back = self::edges(&[(20.0, 0.0), (-20.0, 0.0)]);
        assert!(off(&back, 0.0, 3.0) > 3.9 && off(&back, 0.0, -5.0) == 0.0);
        // Nothing is known beyond where it ends.
        assert_eq!(off(&edges, 40.0, -5.0), 0.0);
    }

    #[test]
    fn corners_have_one_side_each() {
        // A block of houses, the road around it.
        let block = edges(&[
            (-10.0, -10.0),
            (-10.0, 10.0),
            (10.0, 10.0),
            (10.0, -10.0),
            (-10.0, -10.0),
        ]);
        for (x, y) in [(14.0, 14.0), (-14.0, 13.0), (15.0, -12.5), (0.0, 12.0)] {
            assert_eq!(off(&block, x, y), 0.0, "{x} {y}");
        }
        for (x, y) in [(0.0, 0.0), (7.0, 8.0), (-7.0, -8.0)] {
            assert!(off(&block, x, y) > 1.0, "{x} {y}");
        }
    }
}
