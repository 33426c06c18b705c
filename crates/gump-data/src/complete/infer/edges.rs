//! Road edges along the border of the drivable surface, where a format states none.
//!
//! A piece of a surface's outline is a road edge if just outside of it there is no other surface
//! and no lane leads across it: surfaces overlap and join, and at the border of the map roads are
//! cut off rather than bounded.

use gump_geometry::{DVec2, Polygon, Polyline, SegmentIndex, simplify};
use gump_scene::{MapParts, RoadEdge, RoadEdgeKind};

use crate::ReadReport;

/// Distance outside a surface at which other surfaces are looked up, metres: gaps are narrower,
/// medians wider.
const OUTSIDE: f64 = 0.4;
/// Pieces are at most this long, metres: the resolution of a border, finer than a lane is wide.
const PIECE: f64 = 2.0;
/// At most so many pieces of one side: a damaged file may claim surfaces around the world.
const MAX_PIECES: f64 = 500.0;
/// A lane this near that runs across (sine of 45 degrees) leads over the border, metres: as far as
/// half a piece reaches. Chosen by hand.
const ACROSS: f64 = 1.0;
const MIN_SINE: f64 = 0.7;
/// Inferred features are numbered from here, far beyond the ids of any known format.
const FIRST_ID: i64 = 1 << 60;

/// Adds edges to a map that has surfaces but no edges; the road is on their left.
pub(super) fn infer(parts: &mut MapParts, report: &mut ReadReport) {
    if !parts.road_edges.is_empty() || parts.drivable.is_empty() {
        return;
    }
    let lanes = parts
        .lanes
        .iter()
        .flat_map(|lane| lane.centerline.segments());
    let lanes = SegmentIndex::new(lanes.map(|(a, b)| (a, b, (a, b))).collect::<Vec<_>>());
    let surfaces = Surfaces::new(&parts.drivable);
    let mut lines = Vec::new();
    for (i, surface) in parts.drivable.iter().enumerate() {
        border(i, surface, &surfaces, &lanes, &mut lines);
    }
    let heights = heights(parts);
    report.infer("road edge along the drivable surface", lines.len());
    for (k, line) in lines.into_iter().enumerate() {
        let elevation = line.points().iter().map(|&p| heights.at(p)).collect();
        parts.road_edges.push(RoadEdge {
            id: FIRST_ID + k as i64,
            kind: RoadEdgeKind::Boundary,
            line,
            elevation,
        });
    }
}

/// All surfaces, found by the boxes around them.
struct Surfaces<'a> {
    /// Sorted by the left end of the box.
    sorted: Vec<(DVec2, DVec2, usize, &'a Polygon)>,
}

impl<'a> Surfaces<'a> {
    fn new(surfaces: &'a [Polygon]) -> Self {
        let boxed = surfaces.iter().enumerate().map(|(i, surface)| {
            let (low, high) = surface.bounds();
            (low, high, i, surface)
        });
        let mut sorted: Vec<_> = boxed.collect();
        sorted.sort_by(|a, b| a.0.x.total_cmp(&b.0.x));
        Self { sorted }
    }

    fn covers(&self, point: DVec2, but: usize) -> bool {
        let end = self.sorted.partition_point(|(low, ..)| low.x <= point.x);
        self.sorted[..end].iter().any(|(low, high, i, surface)| {
            *i != but
                && point.cmpge(*low).all()
                && point.cmple(*high).all()
                && surface.contains(point)
        })
    }
}

/// The stretches of one outline that are road edges.
fn border(
    index: usize,
    surface: &Polygon,
    surfaces: &Surfaces<'_>,
    lanes: &SegmentIndex<(DVec2, DVec2)>,
    lines: &mut Vec<Polyline>,
) {
    let outward = surface.signed_area().signum();
    let mut ring = surface.ring().to_vec();
    if outward < 0.0 {
        // Counter-clockwise: the surface is on the left.
        ring.reverse();
    }
    let mut run: Vec<DVec2> = Vec::new();
    for (k, &a) in ring.iter().enumerate() {
        let b = ring[(k + 1) % ring.len()];
        let direction = (b - a).normalize_or_zero();
        let n = (a.distance(b) / PIECE).ceil().clamp(1.0, MAX_PIECES) as usize;
        for i in 0..n {
            let [from, to] = [i, i + 1].map(|i| a.lerp(b, i as f64 / n as f64));
            let middle = from.midpoint(to);
            let outside = middle - direction.perp() * OUTSIDE;
            let crossed = lanes.within(middle, ACROSS).any(|((p, q), _)| {
                (q - p).normalize_or_zero().perp_dot(direction).abs() > MIN_SINE
            });
            if surfaces.covers(outside, index) || crossed {
                finish(&mut run, lines);
            } else {
                if run.is_empty() {
                    run.push(from);
                }
                run.push(to);
            }
        }
    }
    finish(&mut run, lines);
}

fn finish(run: &mut Vec<DVec2>, lines: &mut Vec<Polyline>) {
    let points = std::mem::take(run);
    if points.len() > 1 {
        let kept = simplify(&points, 0.01);
        lines.extend(Polyline::new(kept.into_iter().map(|i| points[i]).collect()));
    }
}

/// Heights of the map: those of the nearest point of a centre line.
struct Heights {
    index: gump_geometry::PointIndex,
    heights: Vec<f64>,
}

fn heights(parts: &MapParts) -> Heights {
    let points = parts.lanes.iter().flat_map(|lane| lane.centerline.points());
    Heights {
        index: gump_geometry::PointIndex::new(points.copied()),
        heights: parts
            .lanes
            .iter()
            .flat_map(|lane| lane.elevation.iter().copied())
            .collect(),
    }
}

impl Heights {
    fn at(&self, point: DVec2) -> f64 {
        let nearest = self.index.nearest(point, 1).next();
        nearest.map_or(0.0, |(i, _)| self.heights[i])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_geometry::dvec2;

    fn rectangle(x: [f64; 2], y: [f64; 2]) -> Polygon {
        let corners = [(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])];
        Polygon::new(corners.map(|(x, y)| dvec2(x, y)).to_vec()).unwrap()
    }

    #[test]
    fn the_outer_border_is_an_edge_but_not_joints_and_ends() {
        let scenario = gump_scene::fixture::scenario(
            "lane 1: 0,0 50,0\nlane 2: 50,0 100,0\nlane 3: 0,4 50,4\nego vehicle 0: 9,0 velocity 5,0",
        )
        .unwrap();
        let mut parts = MapParts {
            lanes: scenario.map.lanes().to_vec(),
            drivable: vec![
                rectangle([0.0, 50.0], [-2.0, 2.0]),
                rectangle([50.0, 100.0], [-2.0, 2.0]),
                rectangle([0.0, 50.0], [2.0, 6.0]),
            ],
            ..MapParts::default()
        };
        let mut report = ReadReport::default();
        infer(&mut parts, &mut report);
        let near = |x: f64, y: f64| {
            let lines = parts.road_edges.iter();
            lines
                .map(|edge| edge.line.project(dvec2(x, y)).distance)
                .fold(f64::MAX, f64::min)
        };
        for (x, y) in [(25.0, -2.0), (75.0, -2.0), (75.0, 2.0), (25.0, 6.0)] {
            assert!(near(x, y) < 0.01, "no edge at {x}, {y}");
        }
        // Joints between surfaces and the cut ends of the road.
        for (x, y) in [(25.0, 2.0), (50.0, 0.0), (0.0, 0.0), (100.0, 0.0)] {
            assert!(near(x, y) > 0.5, "an edge at {x}, {y}");
        }
        // The road is on the left.
        let south = parts
            .road_edges
            .iter()
            .find(|e| e.line.project(dvec2(25.0, -2.0)).distance < 0.01);
        assert!(south.unwrap().line.project(dvec2(25.0, 0.0)).lateral > 0.0);
        assert_eq!(
            report.inferred["road edge along the drivable surface"],
            parts.road_edges.len()
        );
    }
}
