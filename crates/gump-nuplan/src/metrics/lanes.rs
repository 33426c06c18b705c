//! The lanes that a drive follows, and whether the ego stays within one.
//!
//! Lanes inside intersections (nuPlan's lane connectors) overlap, so a point may be on several;
//! elsewhere it is on at most one. All results come from one map query per point.

use gump_geometry::DVec2;
use gump_scene::{AreaKind, Lane, LaneId, LaneKind, MapGraph};

/// A lane inside an intersection that was left by less than this may still be followed, metres.
///
/// Source: nuplan-devkit.
const STILL_NEAR: f64 = 5.0;

/// The lanes at one instant; the first is the followed one.
pub type Lanes<'a> = Vec<&'a Lane>;

/// The lanes that a sequence of points follows, one list per point, empty off the lanes.
///
/// A lane is followed until the point leaves it, then its successors are tried before the map.
/// Where lanes overlap all are kept; at the end those that are inconsistent with later lanes are
/// dropped.
///
/// Source: nuPlan's route of a drive (`route_extractor`).
pub fn followed_lanes<'a>(map: &'a MapGraph, points: &[DVec2]) -> Vec<Lanes<'a>> {
    let mut route: Vec<Lanes<'a>> = Vec::with_capacity(points.len());
    for (i, &point) in points.iter().enumerate() {
        let here = lanes_at(map, point);
        let candidates = route.last().map_or(&[][..], Vec::as_slice);
        let mut lanes = continued(map, candidates, &here);
        if lanes.is_empty() {
            lanes = looked_up(&here, point);
            let inside = match lanes.first() {
                Some(lane) => lane.in_intersection,
                None => is_in_intersection(map, point),
            };
            if i > 1 && inside && candidates.first().is_some_and(|l| l.in_intersection) {
                let near = candidates.iter().copied();
                let near: Lanes<'_> = near
                    .filter(|lane| distance(lane, point) < STILL_NEAR)
                    .collect();
                if !near.is_empty() {
                    lanes = near;
                }
            }
        }
        route.push(lanes);
    }
    drop_side_branches(&mut route);
    route
}

/// Drops lanes that are inconsistent with later ones, at points with several lanes.
fn drop_side_branches(route: &mut [Lanes<'_>]) {
    for i in (0..route.len().saturating_sub(1)).rev() {
        let (before, after) = route.split_at_mut(i + 1);
        let (lanes, later) = (&mut before[i], &after[0]);
        if lanes.len() <= 1 {
            continue;
        }
        let all = lanes.clone();
        if all.len() > later.len() && later.iter().all(|lane| has(&all, lane.id)) {
            lanes.clone_from(later);
        }
        if let Some(next) = later.first().filter(|lane| !lane.in_intersection) {
            let leading = all.iter().copied();
            let leading: Lanes<'_> = leading
                .filter(|lane| next.predecessors.contains(&lane.id))
                .collect();
            if !leading.is_empty() {
                *lanes = leading;
            }
        }
    }
}

/// The lanes under the four corners of the ego, from front left counter-clockwise.
pub type CornerLanes<'a> = [Lanes<'a>; 4];

/// The lanes under the corners of each box.
///
/// Source: nuPlan's lanes of the ego's corners; as there, lanes found in the second sample are
/// immediately candidates for the following corners.
pub fn corner_lanes<'a>(map: &'a MapGraph, boxes: &[[DVec2; 4]]) -> Vec<CornerLanes<'a>> {
    let mut candidates: Lanes<'a> = Vec::new();
    let mut found = Vec::with_capacity(boxes.len());
    for (i, corners) in boxes.iter().enumerate() {
        let lanes: CornerLanes<'a> = corners.map(|corner| {
            let here = lanes_at(map, corner);
            let mut lanes = continued(map, &candidates, &here);
            if lanes.is_empty() {
                lanes = looked_up(&here, corner);
                if i == 1 {
                    extend_unique(&mut candidates, &lanes);
                }
            }
            lanes
        });
        candidates.clear();
        for lanes in &lanes {
            extend_unique(&mut candidates, lanes);
        }
        found.push(lanes);
    }
    found
}

/// The relation of the corners' lanes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Keeping {
    /// All corners are on these lanes or on lanes that lead from one to the other.
    Within(Vec<LaneId>),
    /// The corners are on lanes that do not lead from one to another, or some are on none.
    Across,
    /// No corner is on a lane.
    Outside,
}

impl Keeping {
    /// True within a lane or connected ones.
    pub fn is_within(&self) -> bool {
        matches!(self, Self::Within(_))
    }
}

/// Evaluates the lanes under the corners of a box.
///
/// Source: nuPlan's test for common or connected lanes, which pairs rear and front corners
/// crosswise.
pub fn keeping(corners: &CornerLanes<'_>) -> Keeping {
    let ids = corners
        .each_ref()
        .map(|lanes| lanes.iter().map(|lane| lane.id).collect::<Vec<_>>());
    if ids.iter().all(Vec::is_empty) {
        return Keeping::Outside;
    }
    if ids.iter().any(Vec::is_empty) {
        return Keeping::Across;
    }
    let [front_left, rear_left, rear_right, front_right] = &ids;
    let on_all = common(
        &common(front_left, rear_left),
        &common(rear_right, front_right),
    );
    if !on_all.is_empty() {
        return Keeping::Within(on_all);
    }
    let outgoing = |i: usize| with_links(&corners[i], |lane| &lane.successors);
    let incoming = |i: usize| with_links(&corners[i], |lane| &lane.predecessors);
    let rear_meets =
        !common(rear_left, &outgoing(2)).is_empty() || !common(rear_right, &outgoing(1)).is_empty();
    if !rear_meets {
        return Keeping::Across;
    }
    let left_front = common(&incoming(0), &outgoing(2));
    let right_front = common(&incoming(3), &outgoing(1));
    let both = common(&left_front, &right_front);
    if both.is_empty() {
        Keeping::Across
    } else {
        Keeping::Within(both)
    }
}

/// A lane change of the ego.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LaneChange {
    /// The first sample across lanes.
    pub start: usize,
    /// The first sample that is not across any more; the last sample if there is none.
    pub end: usize,
    /// False if it ended off the lanes, on the lane it came from or a following one, or not at all.
    pub success: bool,
}

/// Finds the lane changes of a drive.
///
/// Source: nuPlan's `ego_lane_change`, a statistic without score.
pub fn lane_changes(map: &MapGraph, keeping: &[Keeping]) -> Vec<LaneChange> {
    let mut changes = Vec::new();
    let mut open: Option<(usize, &[LaneId])> = None;
    let mut from: &[LaneId] = &[];
    for (i, now) in keeping.iter().enumerate() {
        match (now, open) {
            (Keeping::Across, None) if !from.is_empty() => open = Some((i, from)),
            (Keeping::Across, _) | (_, None) => {}
            (ended, Some((start, initial))) => {
                let success = match ended {
                    Keeping::Within(lanes) => !lanes.iter().any(|id| {
                        let follows = |first: &LaneId| {
                            let mut next = map.successors(*first);
                            next.any(|lane| lane.id == *id)
                        };
                        initial.contains(id) || initial.iter().any(follows)
                    }),
                    Keeping::Across | Keeping::Outside => false,
                };
                changes.push(LaneChange {
                    start,
                    end: i,
                    success,
                });
                open = None;
            }
        }
        from = match now {
            Keeping::Within(lanes) => lanes,
            Keeping::Across | Keeping::Outside => &[],
        };
    }
    if let Some((start, _)) = open {
        changes.push(LaneChange {
            start,
            end: keeping.len() - 1,
            success: false,
        });
    }
    changes
}

/// True if `point` is in an intersection: by the map's areas if it states any intersections, else
/// by its lanes.
pub fn is_in_intersection(map: &MapGraph, point: DVec2) -> bool {
    let kind = AreaKind::Intersection;
    if map.areas_containing(point, kind).next().is_some() {
        return true;
    }
    let states_none = || !map.areas().iter().any(|area| area.kind == kind);
    states_none() && map.lanes_containing(point).any(|lane| lane.in_intersection)
}

/// Metres from `point` to the surface of a lane, 0 on it; infinite for a lane without surface.
pub(crate) fn distance(lane: &Lane, point: DVec2) -> f64 {
    let surface = lane.surface();
    surface.map_or(f64::INFINITY, |s| s.signed_distance(point).max(0.0))
}

fn lanes_at(map: &MapGraph, point: DVec2) -> Lanes<'_> {
    let lanes = map.lanes_containing(point);
    lanes.filter(|l| l.kind != LaneKind::BikeLane).collect()
}

/// The candidates that still contain the point; if none does and there was only one, those of its
/// successors.
fn continued<'a>(map: &'a MapGraph, candidates: &[&'a Lane], here: &[&'a Lane]) -> Lanes<'a> {
    let present = |lane: &&Lane| has(here, lane.id);
    let kept: Lanes<'_> = candidates.iter().copied().filter(present).collect();
    match candidates {
        [only] if kept.is_empty() => map.successors(only.id).filter(present).collect(),
        _ => kept,
    }
}

/// The lanes by the map alone, without a history: the lane, else all lanes inside the intersection.
///
/// Lanes outside of intersections do not overlap on nuPlan's maps; where they do, as merging lanes
/// of derived surfaces, the nearest centre line decides.
fn looked_up<'a>(here: &[&'a Lane], point: DVec2) -> Lanes<'a> {
    let off_centre = |lane: &Lane| lane.centerline.project(point).distance;
    let lane = here
        .iter()
        .copied()
        .filter(|lane| !lane.in_intersection)
        .min_by(|a, b| off_centre(a).total_cmp(&off_centre(b)));
    lane.map_or_else(|| here.to_vec(), |lane| vec![lane])
}

fn has(lanes: &[&Lane], id: LaneId) -> bool {
    lanes.iter().any(|lane| lane.id == id)
}

fn extend_unique<'a>(lanes: &mut Lanes<'a>, more: &[&'a Lane]) {
    for &lane in more {
        if !has(lanes, lane.id) {
            lanes.push(lane);
        }
    }
}

fn common(a: &[LaneId], b: &[LaneId]) -> Vec<LaneId> {
    a.iter().copied().filter(|id| b.contains(id)).collect()
}

/// The lanes and their neighbours in the graph.
fn with_links(lanes: &[&Lane], links: impl Fn(&Lane) -> &Vec<LaneId>) -> Vec<LaneId> {
    let own = lanes.iter().map(|lane| lane.id);
    let linked = lanes.iter().flat_map(|lane| links(lane).iter().copied());
    own.chain(linked).collect()
}
