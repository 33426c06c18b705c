//! Links and neighbours of lanes, and speed limits along links.
//!
//! For formats that state no links at all. A lane leads to lanes that start at its end and continue
//! in about its direction; two lanes are neighbours where they run side by side, a lane's width
//! apart, in the same direction.

use std::collections::BTreeMap;

use gump_geometry::{PointIndex, SegmentIndex, angle_difference};
use gump_scene::{Lane, LaneId, LaneKind, MapParts};

use crate::ReadReport;

/// A lane starts where another ends if they are this close, metres. In Waymo's maps linked ends
/// are the same point; thinning moves none.
const MAX_GAP: f64 = 0.5;
/// And in height, metres: roads cross over each other, with more than this between them.
const MAX_STEP: f64 = 1.5;
/// At most so many lanes are looked at around an end: more seldom start at one point.
/// Chosen by hand.
const MAX_ENDS: usize = 24;
/// A lane does not bend more than this where it leads to another, radians (60 degrees): lines may
/// be coarse. Chosen by hand.
const MAX_BEND: f64 = 1.05;
/// Metres between two places where neighbours are looked for: several within [`MIN_LENGTH`].
const SPACING: f64 = 4.0;
/// At most so many places per lane: a damaged file may claim lanes around the world.
const MAX_PLACES: f64 = 200.0;
/// Centre lines of neighbours are so far apart, metres: half a narrow and half a wide lane.
const BESIDE: std::ops::Range<f64> = 2.0..5.2;
/// Neighbours run in one direction to within this angle, radians (17 degrees): more than bends and
/// lanes that widen make of it. Chosen by hand.
const MAX_SKEW: f64 = 0.3;
/// Neighbours are side by side over at least this length, metres, or half of a shorter lane: forks
/// are for less. Chosen by hand.
const MIN_LENGTH: f64 = 10.0;

/// Adds links and neighbours to lanes that have none of either.
pub(super) fn infer(parts: &mut MapParts, report: &mut ReadReport) {
    let lanes = &mut parts.lanes;
    if lanes
        .iter()
        .all(|l| l.successors.is_empty() && l.predecessors.is_empty())
    {
        let links = links(lanes);
        report.infer("link between lanes", links.len());
        for (from, to) in links {
            let (from_id, to_id) = (lanes[from].id, lanes[to].id);
            lanes[from].successors.push(to_id);
            lanes[to].predecessors.push(from_id);
        }
    }
    if lanes
        .iter()
        .all(|l| l.left_neighbors.is_empty() && l.right_neighbors.is_empty())
    {
        add_neighbors(lanes, report);
    }
}

/// Pairs of indices of lanes that follow each other.
fn links(lanes: &[Lane]) -> Vec<(usize, usize)> {
    let starts = PointIndex::new(lanes.iter().map(|lane| lane.centerline.points()[0]));
    let mut links = Vec::new();
    for (i, lane) in lanes
        .iter()
        .enumerate()
        .filter(|(_, l)| l.centerline.length() > 0.0)
    {
        let end = lane.centerline.pose_at(lane.centerline.length());
        let height = lane.elevation.last().copied().unwrap_or_default();
        let near = starts.nearest(end.position, MAX_ENDS);
        for (j, _) in near.take_while(|(_, gap)| *gap <= MAX_GAP) {
            let next = &lanes[j];
            let level = (next.elevation[0] - height).abs() <= MAX_STEP;
            let bend = angle_difference(next.centerline.pose_at(0.0).heading, end.heading);
            let has_length = next.centerline.length() > 0.0;
            if i != j && level && has_length && bend.abs() <= MAX_BEND {
                links.push((i, j));
            }
        }
    }
    links.sort_unstable();
    links
}

fn add_neighbors(lanes: &mut [Lane], report: &mut ReadReport) {
    let segments = lanes.iter().enumerate().flat_map(|(i, lane)| {
        lane.centerline
            .segments()
            .map(move |(a, b)| (a, b, (i, a, b)))
    });
    let index = SegmentIndex::new(segments.collect::<Vec<_>>());
    let mut found: Vec<[Vec<LaneId>; 2]> = Vec::with_capacity(lanes.len());
    for (i, lane) in lanes.iter().enumerate() {
        let mut beside: BTreeMap<usize, Beside> = BTreeMap::new();
        let length = lane.centerline.length();
        let n = (length / SPACING).ceil().clamp(1.0, MAX_PLACES);
        let spacing = length / n;
        for k in 0..n as usize {
            let here = lane.centerline.pose_at((k as f64 + 0.5) * spacing);
            let mut seen = Vec::new();
            for ((j, a, b), distance) in index.within(here.position, BESIDE.end) {
                // The nearest segment of each lane counts; segments come nearest first.
                if j == i || seen.contains(&j) || !alike(lane.kind, lanes[j].kind) {
                    continue;
                }
                seen.push(j);
                let skew = angle_difference((b - a).to_angle(), here.heading).abs();
                let across = here.direction().perp_dot(a.midpoint(b) - here.position);
                if BESIDE.contains(&distance) && skew <= MAX_SKEW {
                    let entry = beside.entry(j).or_default();
                    entry.length += spacing;
                    entry.offset += distance.copysign(across) * spacing;
                }
            }
        }
        let enough = |(j, beside): &(usize, Beside)| {
            let shorter = length.min(lanes[*j].centerline.length());
            beside.length >= MIN_LENGTH.min(shorter / 2.0)
        };
        let mut beside: Vec<_> = beside.into_iter().filter(enough).collect();
        beside.sort_by(|a, b| a.1.distance().total_cmp(&b.1.distance()));
        let side = |left: bool| {
            let on_side = beside.iter().filter(move |(_, b)| (b.offset > 0.0) == left);
            on_side.map(|(j, _)| lanes[*j].id).collect::<Vec<_>>()
        };
        found.push([side(true), side(false)]);
    }
    for (lane, [left, right]) in lanes.iter_mut().zip(found) {
        report.infer("neighbour of a lane", left.len() + right.len());
        (lane.left_neighbors, lane.right_neighbors) = (left, right);
    }
}

/// Length that a lane runs beside another and its offset to the left times that length, both summed
/// over sample points.
#[derive(Default)]
struct Beside {
    length: f64,
    offset: f64,
}

impl Beside {
    fn distance(&self) -> f64 {
        (self.offset / self.length).abs()
    }
}

/// Bicycle lanes and car lanes are not neighbours.
fn alike(a: LaneKind, b: LaneKind) -> bool {
    (a == LaneKind::BikeLane) == (b == LaneKind::BikeLane)
}

/// Gives lanes without a speed limit the mean of the lanes before, after and beside, repeatedly.
pub(super) fn speed_limits(parts: &mut MapParts, report: &mut ReadReport) {
    let stated = parts
        .lanes
        .iter()
        .filter_map(|lane| Some((lane.id, lane.speed_limit?)));
    let mut known: BTreeMap<LaneId, f64> = stated.collect();
    let n_stated = known.len();
    loop {
        let mut found = Vec::new();
        for lane in parts
            .lanes
            .iter()
            .filter(|lane| !known.contains_key(&lane.id))
        {
            let links = lane.predecessors.iter().chain(&lane.successors);
            let beside = lane.left_neighbors.iter().chain(&lane.right_neighbors);
            let near: Vec<f64> = links
                .chain(beside)
                .filter_map(|id| known.get(id).copied())
                .collect();
            if !near.is_empty() {
                found.push((lane.id, near.iter().sum::<f64>() / near.len() as f64));
            }
        }
        if found.is_empty() {
            break;
        }
        known.extend(found);
    }
    report.infer("speed limit from linked lanes", known.len() - n_stated);
    for lane in &mut parts.lanes {
        lane.speed_limit = known.get(&lane.id).copied();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Id, successors, neighbours on the left and on the right.
    type Links<'a> = (i64, &'a [i64], &'a [i64], &'a [i64]);

    /// Infers links of the lanes of `text` and lists successors and neighbours.
    fn check(text: &str, expected: &[Links<'_>]) {
        let text = format!("{text}\nego vehicle 0: 10,0 velocity 5,0");
        let scenario = gump_scene::fixture::scenario(&text).unwrap();
        let mut parts = MapParts {
            lanes: scenario.map.lanes().to_vec(),
            ..MapParts::default()
        };
        infer(&mut parts, &mut ReadReport::default());
        for (lane, (id, next, left, right)) in parts.lanes.iter().zip(expected) {
            let ids = |ids: &[i64]| ids.iter().copied().map(LaneId).collect::<Vec<_>>();
            assert_eq!(lane.id, LaneId(*id));
            assert_eq!(lane.successors, ids(next), "after lane {id}");
            assert_eq!(lane.left_neighbors, ids(left), "left of lane {id}");
            assert_eq!(lane.right_neighbors, ids(right), "right of lane {id}");
        }
    }

    #[test]
    fn ends_meet_starts_and_neighbours_run_side_by_side() {
        check(
            "lane 1: 0,0 50,0
             lane 2: 50,0 100,0
             lane 3: 50,0 80,-10
             lane 4: 0,3.5 50,3.5
             lane 5: 100,3.5 0,3.5
             lane 6: 50,0 50,50
             lane 7: 0,7 50,7",
            &[
                (1, &[2, 3], &[4], &[]),
                (2, &[], &[], &[]),
                (3, &[], &[], &[]),
                (4, &[], &[7], &[1]),
                (5, &[], &[], &[]),
                (6, &[], &[], &[]),
                (7, &[], &[], &[4]),
            ],
        );
    }

    #[test]
    fn stated_links_are_not_added_to() {
        check(
            "lane 1: 0,0 50,0 next 9\nlane 2: 50,0 100,0\nlane 9: 50,0 80,20",
            &[(1, &[9], &[], &[]), (2, &[], &[], &[])],
        );
    }

    #[test]
    fn speed_limits_spread_along_links() {
        let scenario = gump_scene::fixture::scenario(
            "lane 1: 0,0 50,0 next 2 speed 10
             lane 2: 50,0 100,0 next 3
             lane 3: 100,0 150,0
             lane 4: 0,90 9,90
             ego vehicle 0: 10,0 velocity 5,0",
        )
        .unwrap();
        let mut parts = MapParts {
            lanes: scenario.map.lanes().to_vec(),
            ..MapParts::default()
        };
        for (lane, before) in [(1, 1), (2, 2)] {
            parts.lanes[lane].predecessors = vec![LaneId(before)];
        }
        let mut report = ReadReport::default();
        speed_limits(&mut parts, &mut report);
        let limits: Vec<_> = parts.lanes.iter().map(|lane| lane.speed_limit).collect();
        assert_eq!(limits, [Some(10.0), Some(10.0), Some(10.0), None]);
        assert_eq!(report.inferred["speed limit from linked lanes"], 2);
    }
}
