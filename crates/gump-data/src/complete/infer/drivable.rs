//! Drivable surfaces, where a format states none.
//!
//! One polygon per lane: from its centre half its width to both sides, but never beyond a road
//! edge, and out to the road edge where only a shoulder lies between. Driveways are added
//! unchanged.

use gump_geometry::{BoxIndex, DVec2, Polygon, simplify};
use gump_scene::{AreaKind, Lane, MapParts};

use crate::ReadReport;

/// Maximum deviation of a lane's outline from its offset centre line, metres: less than
/// [`OVERLAP`], for fewer corners.
const TOLERANCE: f64 = 0.05;
/// Metres between two cross sections at most: road edges bend where lanes are straight.
const SPACING: f64 = 4.0;
/// Maximum number of cross sections between two corners of a lane: a damaged file may have lanes
/// around the world.
const MAX_SECTIONS: f64 = 1000.0;
/// A strip up to this wide between a lane and the road edge is shoulder or parking bay: a parked
/// car (2 m) and room for its door.
const MAX_SHOULDER: f64 = 3.0;
/// Overlap of neighbouring surfaces, metres, so that errors of estimated widths leave no gaps.
const OVERLAP: f64 = 0.1;
/// Edges further above or below the lane than this belong to another level, metres: a vehicle must
/// fit between two.
const MAX_STEP: f64 = 2.5;

/// Adds a surface for every lane that has length, and for every driveway.
pub(super) fn infer(parts: &mut MapParts, report: &mut ReadReport) {
    let edges = EdgeIndex::new(parts);
    let lanes = parts.lanes.iter().filter_map(|lane| surface(lane, &edges));
    let mut surfaces: Vec<Polygon> = lanes.collect();
    report.infer("drivable surface of a lane", surfaces.len());
    let driveways = parts.areas.iter().filter(|a| a.kind == AreaKind::Driveway);
    let n_lanes = surfaces.len();
    surfaces.extend(driveways.map(|area| area.polygon.clone()));
    report.infer("drivable surface of a driveway", surfaces.len() - n_lanes);
    parts.drivable = surfaces;
}

/// Road-edge segments with the height of their start.
struct EdgeIndex(BoxIndex<(DVec2, DVec2, f64)>);

impl EdgeIndex {
    fn new(parts: &MapParts) -> Self {
        let segments = parts.road_edges.iter().flat_map(|edge| {
            let points = edge.line.points();
            let kept = simplify(points, TOLERANCE);
            let segment = |i: &[usize]| (points[i[0]], points[i[1]], edge.elevation[i[0]]);
            kept.windows(2).map(segment).collect::<Vec<_>>()
        });
        let boxes = segments.map(|(a, b, z)| (a.min(b), a.max(b), (a, b, z)));
        Self(BoxIndex::new(boxes))
    }

    /// Metres from `origin` along the unit vector `direction` to the first edge at this height,
    /// if it is within `reach`.
    fn first_hit(&self, origin: DVec2, z: f64, direction: DVec2, reach: f64) -> Option<f64> {
        let end = origin + direction * reach;
        let near = self.0.intersecting(origin.min(end), origin.max(end));
        near.filter(|(_, _, height)| (height - z).abs() < MAX_STEP)
            .filter_map(|(a, b, _)| hit(origin, direction, a, b))
            .filter(|&distance| distance <= reach)
            .min_by(f64::total_cmp)
    }
}

/// Metres along a ray to the segment `a`-`b`.
fn hit(origin: DVec2, direction: DVec2, a: DVec2, b: DVec2) -> Option<f64> {
    let along = b - a;
    let determinant = direction.perp_dot(along);
    let distance = (a - origin).perp_dot(along) / determinant;
    let t = (a - origin).perp_dot(direction) / determinant;
    (determinant != 0.0 && distance >= 0.0 && (0.0..=1.0).contains(&t)).then_some(distance)
}

fn surface(lane: &Lane, edges: &EdgeIndex) -> Option<Polygon> {
    let sections = cross_sections(lane);
    let mut left = Vec::with_capacity(sections.len());
    let mut right = Vec::with_capacity(sections.len());
    for section in &sections {
        let reach = |side: DVec2| {
            let half = lane.width / 2.0;
            let edge = edges.first_hit(section.center, section.z, side, half + MAX_SHOULDER);
            section.center + side * edge.unwrap_or(half + OVERLAP)
        };
        left.push(reach(section.left));
        right.push(reach(-section.left));
    }
    left.extend(right.into_iter().rev());
    (sections.len() > 1).then(|| Polygon::new(left)).flatten()
}

struct Section {
    center: DVec2,
    left: DVec2,
    z: f64,
}

/// Places along a lane with the direction to its left; none for a lane without length.
fn cross_sections(lane: &Lane) -> Vec<Section> {
    let points = lane.centerline.points();
    let corners = simplify(points, TOLERANCE);
    let mut places: Vec<(DVec2, f64)> = Vec::new();
    for pair in corners.windows(2) {
        let (from, to) = (pair[0], pair[1]);
        let n = (points[from].distance(points[to]) / SPACING).ceil();
        let n = n.clamp(1.0, MAX_SECTIONS) as usize;
        places.extend((0..n).map(|i| {
            let t = i as f64 / n as f64;
            let z = lane.elevation[from] + t * (lane.elevation[to] - lane.elevation[from]);
            (points[from].lerp(points[to], t), z)
        }));
    }
    places.extend(corners.last().map(|&i| (points[i], lane.elevation[i])));
    places.dedup_by(|b, a| a.0 == b.0);
    let n = places.len();
    let direction = |i: usize| {
        let (before, after) = (places[i.saturating_sub(1)].0, places[(i + 1).min(n - 1)].0);
        (after - before).normalize_or_zero()
    };
    let section = |(i, &(center, z)): (usize, &(DVec2, f64))| Section {
        center,
        left: direction(i).perp(),
        z,
    };
    places.iter().enumerate().map(section).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_geometry::dvec2;

    /// Whether each point is drivable in a scene with these lanes and edges.
    fn check(text: &str, points: &[(f64, f64, bool)]) {
        let text = format!("{text}\nego vehicle 0: 10,0 velocity 5,0");
        let scenario = gump_scene::fixture::scenario(&text).unwrap();
        let mut parts = MapParts {
            lanes: scenario.map.lanes().to_vec(),
            road_edges: scenario.map.road_edges().to_vec(),
            areas: scenario.map.areas().to_vec(),
            ..MapParts::default()
        };
        infer(&mut parts, &mut ReadReport::default());
        for &(x, y, expected) in points {
            let found = parts.drivable.iter().any(|s| s.contains(dvec2(x, y)));
            assert_eq!(found, expected, "at {x}, {y}");
        }
    }

    #[test]
    fn a_lane_is_drivable_to_half_its_width() {
        check(
            "lane 1: 0,0 50,0 width 3",
            &[
                (25.0, 1.4, true),
                (25.0, -1.4, true),
                (25.0, 1.7, false),
                (51.0, 0.0, false),
            ],
        );
    }

    #[test]
    fn a_road_edge_cuts_the_surface() {
        check(
            "lane 1: 0,0 50,0 width 3\nedge: 0,-1 50,-1",
            &[(25.0, -0.9, true), (25.0, -1.1, false), (25.0, 1.4, true)],
        );
    }

    #[test]
    fn the_shoulder_is_drivable_but_what_lies_beyond_is_not() {
        check(
            "lane 1: 0,0 50,0 width 3\nedge: 0,-4 50,-4\nedge: 50,6 0,6",
            &[(25.0, -3.9, true), (25.0, -4.1, false), (25.0, 3.0, false)],
        );
    }

    #[test]
    fn bends_are_followed() {
        check(
            "lane 1: 0,0 30,0 30,30 width 4",
            &[(29.0, 1.0, true), (31.0, 20.0, true), (20.0, 10.0, false)],
        );
    }

    #[test]
    fn a_lane_without_length_has_no_surface() {
        check("lane 1: 5,5 5,5", &[(5.0, 5.0, false)]);
    }
}
