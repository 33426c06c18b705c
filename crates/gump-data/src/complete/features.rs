//! Map features from plain points: lanes, lines, edges and areas, valid or dropped.
//!
//! Every reader whose format lists points builds its map here, so that damage is handled and
//! counted in the same way. Nothing is inferred.

use gump_geometry::{DVec2, DVec3, Polygon, Polyline};
use gump_scene::{
    Area, AreaKind, Lane, LaneId, LaneKind, MapParts, RoadEdge, RoadEdgeKind, RoadLine,
    RoadLineKind,
};

use super::infer;
use crate::ReadReport;
use crate::error::MAX_COORDINATE;

/// Points of a line in the plane and their heights; invalid points are dropped and listed.
///
/// `None` and a count if no point remains.
pub(crate) fn line(
    id: i64,
    points: &[DVec3],
    report: &mut ReadReport,
) -> Option<(Polyline, Vec<f64>)> {
    let points = sound_points(id, points, report);
    let line = Polyline::new(points.iter().map(|p| p.truncate()).collect());
    if line.is_none() {
        report.drop("map feature without points", 1);
    }
    Some((line?, points.iter().map(|p| p.z).collect()))
}

/// A lane with the default width of its kind and without links.
pub(crate) fn lane(
    id: i64,
    kind: LaneKind,
    points: &[DVec3],
    report: &mut ReadReport,
) -> Option<Lane> {
    let (centerline, elevation) = line(id, points, report)?;
    Some(Lane {
        kind,
        width: infer::default_width(kind),
        ..Lane::new(LaneId(id), centerline, elevation)
    })
}

/// Adds a painted line.
pub(crate) fn add_road_line(
    parts: &mut MapParts,
    id: i64,
    kind: RoadLineKind,
    points: &[DVec3],
    report: &mut ReadReport,
) {
    let shape = line(id, points, report);
    parts
        .road_lines
        .extend(shape.map(|(line, elevation)| RoadLine {
            id,
            kind,
            line,
            elevation,
        }));
}

/// Adds a border of the road.
pub(crate) fn add_road_edge(
    parts: &mut MapParts,
    id: i64,
    kind: RoadEdgeKind,
    points: &[DVec3],
    report: &mut ReadReport,
) {
    let shape = line(id, points, report);
    parts
        .road_edges
        .extend(shape.map(|(line, elevation)| RoadEdge {
            id,
            kind,
            line,
            elevation,
        }));
}

/// Adds an area. Outlines that cross themselves are kept, because the even-odd rule still defines
/// their inside, and counted.
pub(crate) fn add_area(
    parts: &mut MapParts,
    id: i64,
    kind: AreaKind,
    points: &[DVec3],
    report: &mut ReadReport,
) {
    let points = sound_points(id, points, report);
    let Some(polygon) = polygon(id, &points, report) else {
        return;
    };
    // The polygon may have dropped a closing point.
    let elevation = points
        .iter()
        .take(polygon.ring().len())
        .map(|p| p.z)
        .collect();
    parts.areas.push(Area {
        elevation,
        ..Area::new(id, kind, polygon)
    });
}

/// An outline without height; `None` and a count for fewer than three corners.
pub(crate) fn polygon(id: i64, points: &[DVec3], report: &mut ReadReport) -> Option<Polygon> {
    let ring: Vec<DVec2> = points.iter().map(|p| p.truncate()).collect();
    let polygon = Polygon::new(ring);
    match &polygon {
        None => report.drop("outline of fewer than 3 points", 1),
        Some(polygon) if crosses_itself(polygon) => {
            report.drop_damaged("simple shape of an outline that crosses itself", || {
                format!("map feature {id}")
            });
        }
        Some(_) => {}
    }
    polygon
}

/// The valid points; an invalid height is replaced by that of the previous point.
pub(crate) fn sound_points(id: i64, points: &[DVec3], report: &mut ReadReport) -> Vec<DVec3> {
    let sound = |v: f64| v.abs() <= MAX_COORDINATE;
    let mut kept: Vec<DVec3> = Vec::with_capacity(points.len());
    for (i, &point) in points.iter().enumerate() {
        if sound(point.x) && sound(point.y) {
            let z = if sound(point.z) {
                point.z
            } else {
                kept.last().map_or(0.0, |p| p.z)
            };
            kept.push(DVec3 { z, ..point });
        } else {
            report.drop_damaged("map point that is no place on Earth", || {
                format!("map feature {id}, point {i}: {}, {}", point.x, point.y)
            });
        }
    }
    kept
}

/// Rings with more corners are not checked: the check looks at all pairs.
const MAX_CHECKED: usize = 400;

fn crosses_itself(polygon: &Polygon) -> bool {
    let ring = polygon.ring();
    let n = ring.len();
    if n > MAX_CHECKED {
        return false;
    }
    let edge = |i: usize| (ring[i], ring[(i + 1) % n]);
    (0..n).any(|i| (i + 2..n).any(|j| !(i == 0 && j == n - 1) && properly_cross(edge(i), edge(j))))
}

fn properly_cross((a, b): (DVec2, DVec2), (c, d): (DVec2, DVec2)) -> bool {
    let side = |p: DVec2, q: DVec2, r: DVec2| (q - p).perp_dot(r - p);
    side(a, b, c) * side(a, b, d) < 0.0 && side(c, d, a) * side(c, d, b) < 0.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_geometry::dvec3;

    #[test]
    fn unsound_points_are_left_out_and_named() {
        let mut report = ReadReport::default();
        let points = [
            dvec3(0.0, 0.0, 1.0),
            dvec3(f64::NAN, 0.0, 1.0),
            dvec3(5.0, 0.0, f64::NAN),
        ];
        let (line, z) = line(7, &points, &mut report).unwrap();
        assert_eq!((line.length(), z), (5.0, vec![1.0, 1.0]));
        assert_eq!(report.notes[0].detail, "map feature 7, point 1: NaN, 0");
        assert!(super::line(8, &points[1..2], &mut report).is_none());
        assert_eq!(report.dropped["map feature without points"], 1);
    }

    #[test]
    fn outlines_that_cross_themselves_are_told() {
        let check = |ring: &[(f64, f64)], crosses: bool| {
            let points: Vec<_> = ring.iter().map(|&(x, y)| dvec3(x, y, 0.0)).collect();
            let mut report = ReadReport::default();
            assert!(polygon(1, &points, &mut report).is_some());
            assert_eq!(!report.notes.is_empty(), crosses);
        };
        check(&[(0.0, 0.0), (4.0, 0.0), (4.0, 3.0), (0.0, 3.0)], false);
        check(&[(0.0, 0.0), (4.0, 3.0), (4.0, 0.0), (0.0, 3.0)], true);
    }
}
