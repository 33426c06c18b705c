//! Widths of lanes.
//!
//! The rules, in order: the distance to the bound of the lane on the left plus that on the right,
//! where bounds are painted lines, road edges, and the middle between two centre lines of
//! neighbours; inside an intersection, or without bounds, the mean of the lanes before and after,
//! repeatedly; else the default. Lanes with an outline have its width.

use std::collections::BTreeMap;

use gump_geometry::{BoxIndex, DVec2, Pose, simplify};
use gump_scene::{Lane, LaneId, LaneKind, MapParts};

use crate::ReadReport;

/// Maximum distance of a bound from the centre, metres; beyond it the lane has none on that side:
/// half of the widest lane, and a metre.
const MAX_REACH: f64 = 4.0;
/// Metres between two measurements along a lane; their median counts, so more change little.
const SPACING: f64 = 5.0;
/// At most so many measurements per lane: a damaged file may claim lanes around the world.
const MAX_MEASUREMENTS: f64 = 200.0;
/// Tolerance of simplified bounds, metres, for speed; far less than lines are wide.
const TOLERANCE: f64 = 0.02;
/// A bound must lie this much across rather than along the lane (cosine of 45 degrees).
const MIN_ACROSS: f64 = 0.7;

/// Sets the width of every lane without an outline that can be measured; the others keep theirs.
pub(super) fn infer(parts: &mut MapParts, report: &mut ReadReport) {
    let lanes = &parts.lanes;
    let by_id: BTreeMap<LaneId, &Lane> = lanes.iter().map(|lane| (lane.id, lane)).collect();
    let outlined = lanes.iter().filter(|lane| lane.outline.is_some());
    let mut measured: BTreeMap<LaneId, f64> = outlined.map(|lane| (lane.id, lane.width)).collect();
    let n_outlined = measured.len();
    if n_outlined == lanes.len() {
        return;
    }
    let bounds = bounds(parts);
    let unknown = |lane: &&Lane| lane.outline.is_none() && !lane.in_intersection;
    for lane in lanes.iter().filter(unknown) {
        let neighbors = |ids: &[LaneId]| -> Vec<&Lane> {
            ids.iter().filter_map(|id| by_id.get(id).copied()).collect()
        };
        let beside = [
            neighbors(&lane.left_neighbors),
            neighbors(&lane.right_neighbors),
        ];
        measured.extend(width(lane, &beside, &bounds).map(|width| (lane.id, width)));
    }
    report.infer(
        "lane width from lines, edges and neighbours",
        measured.len() - n_outlined,
    );
    let n_measured = measured.len();
    while spread(lanes, &mut measured) {}
    let linked = measured.len() - n_measured;
    report.infer("lane width from the lanes before and after", linked);
    report.infer("lane width by default", lanes.len() - measured.len());
    for lane in &mut parts.lanes {
        lane.width = measured.get(&lane.id).copied().unwrap_or(lane.width);
    }
}

/// Gives lanes without a width the mean of those they are linked to; true if any was given.
fn spread(lanes: &[Lane], known: &mut BTreeMap<LaneId, f64>) -> bool {
    let mut found = Vec::new();
    for lane in lanes.iter().filter(|lane| !known.contains_key(&lane.id)) {
        let ends = lane.predecessors.iter().chain(&lane.successors);
        let widths: Vec<f64> = ends.filter_map(|id| known.get(id).copied()).collect();
        if !widths.is_empty() {
            found.push((lane.id, widths.iter().sum::<f64>() / widths.len() as f64));
        }
    }
    let any = !found.is_empty();
    known.extend(found);
    any
}

type Bounds = BoxIndex<(DVec2, DVec2)>;

fn bounds(parts: &MapParts) -> Bounds {
    let lines = parts.road_lines.iter().map(|line| &line.line);
    let edges = parts.road_edges.iter().map(|edge| &edge.line);
    let segments = lines.chain(edges).flat_map(|line| {
        let points = line.points();
        let kept = simplify(points, TOLERANCE);
        let segment = |i: &[usize]| (points[i[0]], points[i[1]]);
        kept.windows(2).map(segment).collect::<Vec<_>>()
    });
    BoxIndex::new(segments.map(|(a, b)| (a.min(b), a.max(b), (a, b))))
}

/// The median width over the places where both sides are bounded.
fn width(lane: &Lane, neighbors: &[Vec<&Lane>; 2], bounds: &Bounds) -> Option<f64> {
    let length = lane.centerline.length();
    let n = (length / SPACING).ceil().clamp(1.0, MAX_MEASUREMENTS) as usize;
    let mut widths: Vec<f64> = (0..n)
        .map(|i| {
            lane.centerline
                .pose_at((i as f64 + 0.5) * length / n as f64)
        })
        .filter_map(|pose| {
            let [left, right] = to_lines(pose, bounds);
            let left = left.min(to_neighbors(pose, &neighbors[0]));
            let right = right.min(to_neighbors(pose, &neighbors[1]));
            Some(left + right).filter(|&width| plausible(lane.kind, width))
        })
        .collect();
    widths.sort_by(f64::total_cmp);
    (!widths.is_empty()).then(|| widths[widths.len() / 2])
}

/// Wider or narrower than any lane means that something else was measured. Bounds by hand.
fn plausible(kind: LaneKind, width: f64) -> bool {
    let least = if kind == LaneKind::BikeLane { 1.0 } else { 2.2 };
    (least..=6.0).contains(&width)
}

/// Metres to the nearest line or edge on the left and on the right, infinite if there is none.
fn to_lines(pose: Pose, bounds: &Bounds) -> [f64; 2] {
    let mut sides = [f64::INFINITY; 2];
    let (low, high) = (pose.position - MAX_REACH, pose.position + MAX_REACH);
    for (a, b) in bounds.intersecting(low, high) {
        let foot = a.lerp(b, gump_geometry::project_on_segment(pose.position, a, b));
        let distance = foot.distance(pose.position);
        let across = pose.direction().perp_dot(foot - pose.position);
        let is_near = 0.0 < distance && distance <= MAX_REACH;
        if is_near && across.abs() >= MIN_ACROSS * distance {
            let side = &mut sides[usize::from(across < 0.0)];
            *side = side.min(distance);
        }
    }
    sides
}

/// Metres to the middle between this lane and the nearest of its neighbours on one side.
fn to_neighbors(pose: Pose, neighbors: &[&Lane]) -> f64 {
    let reach = |lane: &&Lane| {
        let projection = lane.centerline.project(pose.position);
        let ends = [0.0, lane.centerline.length()];
        // Past its ends a neighbour is not beside.
        (!ends.contains(&projection.arc_length)).then_some(projection.distance / 2.0)
    };
    let nearest = neighbors.iter().filter_map(reach);
    nearest
        .filter(|&half| half <= MAX_REACH)
        .fold(f64::INFINITY, f64::min)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(text: &str, expected: &[f64]) -> ReadReport {
        let text = format!("{text}\nego vehicle 0: 10,0 velocity 5,0");
        let scenario = gump_scene::fixture::scenario(&text).unwrap();
        let map = &scenario.map;
        let mut parts = MapParts {
            lanes: map.lanes().to_vec(),
            road_lines: map.road_lines().to_vec(),
            road_edges: map.road_edges().to_vec(),
            ..MapParts::default()
        };
        let mut report = ReadReport::default();
        infer(&mut parts, &mut report);
        for (lane, expected) in parts.lanes.iter().zip(expected) {
            assert!((lane.width - expected).abs() < 1e-9, "{}", lane.width);
        }
        report
    }

    #[test]
    fn lines_and_edges_bound_a_lane() {
        let report = check(
            "lane 1: 0,0 50,0\nline: 0,1.6 50,1.6\nedge: 0,-1.4 50,-1.4",
            &[3.0],
        );
        assert_eq!(
            report.inferred["lane width from lines, edges and neighbours"],
            1
        );
    }

    #[test]
    fn an_outline_says_how_wide_its_lane_is() {
        let text = "lane 1: 0,0 50,0 width 2.75 next 2\nlane 2: 50,0 99,0\n\
                    line: 0,2 99,2\nline: 0,-2 99,-2\nego vehicle 0: 10,0 velocity 5,0";
        let scenario = gump_scene::fixture::scenario(text).unwrap();
        let mut parts = MapParts {
            lanes: scenario.map.lanes().to_vec(),
            road_lines: scenario.map.road_lines().to_vec(),
            ..MapParts::default()
        };
        parts.lanes[0].outline = parts.lanes[0].centerline.ribbon(2.75);
        let mut report = ReadReport::default();
        infer(&mut parts, &mut report);
        assert_eq!([parts.lanes[0].width, parts.lanes[1].width], [2.75, 4.0]);
        assert_eq!(report.inferred.values().sum::<usize>(), 1);
    }

    #[test]
    fn neighbours_share_the_space_between_them() {
        check(
            "lane 1: 0,0 50,0 left 2\nlane 2: 0,3.2 50,3.2 right 1\n\
             line: 0,-1.5 50,-1.5\nline: 0,4.9 50,4.9",
            &[3.1, 3.3],
        );
    }

    #[test]
    fn a_lane_without_bounds_takes_the_width_of_its_links_or_the_default() {
        let report = check(
            "lane 1: 0,0 50,0 next 2\nlane 2: 50,0 99,0\nlane 3: 0,90 50,90\n\
             line: 0,2 50,2\nline: 0,-2 50,-2",
            &[4.0, 4.0, 3.5],
        );
        assert_eq!(report.inferred["lane width by default"], 1);
        assert_eq!(
            report.inferred["lane width from the lanes before and after"],
            1
        );
    }

    #[test]
    fn a_kerb_far_away_is_no_bound() {
        check(
            "lane 1: 0,0 50,0\nline: 0,3.9 50,3.9\nedge: 0,-3.9 50,-3.9",
            &[3.5],
        );
    }
}
