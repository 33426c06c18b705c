//! Search for a route through the graph of roadblocks and lanes.
//!
//! A stated route may have gaps, repeats or loops, or begin elsewhere than at the ego;
//! [`correct_route`] repairs it. [`lanes_of_route`], [`shortest_lanes`] and [`first_lanes`] choose
//! lanes within it.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::f64::consts::FRAC_PI_4;

use gump_geometry::{DVec2, Polygon, Pose, angle_difference, dvec2};
use gump_nuplan::path::baseline;
use gump_scene::{Lane, LaneId, MapGraph, Roadblock, RoadblockId};

// tuPlan Garage's values, up to `SHARED_AREA`.

/// Half the side of the square around the rear axle in which its roadblock is searched, metres.
const HERE: f64 = 1.0;
/// A roadblock fits if one of its lanes passes this near, metres, ...
const NEAR: f64 = 3.0;
/// ... in this direction, radians.
const ALIGNED: f64 = FRAC_PI_4;
/// Number of roadblocks back from the start of the route that are searched for the ego.
const DEPTH_BACK: usize = 15;
/// Number of roadblocks ahead of the ego that are searched for the route.
const DEPTH_AHEAD: usize = 30;
/// Connectors that overlap by more than this are the same place, square metres.
const SHARED_AREA: f64 = 1.0;
/// Side of the squares by which shared areas are counted, metres: fine enough to compare with 1 m²
/// (decision 27).
const AREA_CELL: f64 = 0.2;

/// The route from the ego's roadblock on, without gaps and without returning to a place.
///
/// Source: the route correction of tuPlan Garage's PDM planners.
pub fn correct_route(map: &MapGraph, route: &[RoadblockId], rear_axle: Pose) -> Vec<RoadblockId> {
    let (here, candidates) = roadblock_of_ego(map, route, rear_axle);
    let mut route = route.to_vec();
    if let (Some(here), Some(&first)) = (here, route.first())
        && !route.contains(&here)
    {
        join(map, &mut route, here, first, &candidates);
    }
    let route = without_loop(map, &fill_gaps(map, &route));
    let mut seen = BTreeSet::new();
    route.into_iter().filter(|id| seen.insert(*id)).collect()
}

/// Connects the ego's roadblock to the route: backwards from its start, else forwards to one of its
/// first three roadblocks.
fn join(
    map: &MapGraph,
    route: &mut Vec<RoadblockId>,
    here: RoadblockId,
    first: RoadblockId,
    candidates: &[RoadblockId],
) {
    let back = search(map, first, DEPTH_BACK, Direction::Back, |id| {
        candidates.contains(&id)
    });
    if let Some(mut chain) = back {
        chain.reverse();
        chain.pop();
        route.splice(0..0, chain);
        return;
    }
    let targets = &route[..route.len().min(3)];
    let ahead = search(map, here, DEPTH_AHEAD, Direction::Ahead, |id| {
        targets.contains(&id)
    });
    if let Some(chain) = ahead {
        let met = chain.last().copied();
        let skip = route.iter().position(|&id| Some(id) == met).unwrap_or(0);
        route.splice(0..=skip, chain);
    }
}

/// The roadblock of the ego, if there is one near, and all that fit.
fn roadblock_of_ego(
    map: &MapGraph,
    route: &[RoadblockId],
    rear_axle: Pose,
) -> (Option<RoadblockId>, Vec<RoadblockId>) {
    let mut near: Vec<&Roadblock> = map.roadblocks_in_square(rear_axle.position, HERE).collect();
    if near.is_empty() {
        for in_intersection in [false, true] {
            let layer = map
                .roadblocks()
                .iter()
                .filter(|b| b.in_intersection == in_intersection);
            let distance = |b: &Roadblock| b.outline.signed_distance(rear_axle.position);
            near.extend(layer.min_by(|a, b| distance(a).total_cmp(&distance(b))));
        }
    }
    let rated: Vec<(RoadblockId, f64)> = near
        .iter()
        .filter_map(|block| Some((block.id, displacement(map, block.id, rear_axle)?)))
        .collect();
    let best = |on_route: bool| {
        rated
            .iter()
            .filter(|(id, _)| !on_route || route.contains(id))
            .min_by(|a, b| a.1.total_cmp(&b.1))
            .map(|&(id, _)| id)
    };
    let here = best(true)
        .or_else(|| best(false))
        .or(near.first().map(|block| block.id));
    let mut candidates: Vec<_> = rated.into_iter().map(|(id, _)| id).collect();
    candidates.extend(here.filter(|id| !candidates.contains(id)));
    (here, candidates)
}

/// Metres to the nearest point of a lane of the block that runs in the ego's direction, if near.
fn displacement(map: &MapGraph, block: RoadblockId, rear_axle: Pose) -> Option<f64> {
    map.roadblock_lanes(block)
        .flat_map(baseline)
        .filter(|pose| angle_difference(pose.heading, rear_axle.heading).abs() < ALIGNED)
        .map(|pose| pose.position.distance(rear_axle.position))
        .filter(|&distance| distance < NEAR)
        .min_by(f64::total_cmp)
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Direction {
    Ahead,
    Back,
}

/// The shortest chain of roadblocks from `start` to one that `is_target`, both included, of at most
/// `depth` roadblocks.
fn search(
    map: &MapGraph,
    start: RoadblockId,
    depth: usize,
    direction: Direction,
    is_target: impl Fn(RoadblockId) -> bool,
) -> Option<Vec<RoadblockId>> {
    let mut before: BTreeMap<RoadblockId, RoadblockId> = BTreeMap::new();
    let mut queue = VecDeque::from([(start, 1)]);
    let mut seen = BTreeSet::from([start]);
    while let Some((id, n)) = queue.pop_front() {
        if is_target(id) {
            let mut chain = vec![id];
            while let Some(&previous) = chain.last().and_then(|id| before.get(id)) {
                chain.push(previous);
            }
            chain.reverse();
            return Some(chain);
        }
        let Some(block) = map.roadblock(id).filter(|_| n < depth) else {
            continue;
        };
        let next = match direction {
            Direction::Ahead => &block.successors,
            Direction::Back => &block.predecessors,
        };
        for &id_next in next {
            if seen.insert(id_next) {
                before.insert(id_next, id);
                queue.push_back((id_next, n + 1));
            }
        }
    }
    None
}

fn fill_gaps(map: &MapGraph, route: &[RoadblockId]) -> Vec<RoadblockId> {
    let mut filled: Vec<RoadblockId> = route.first().copied().into_iter().collect();
    for pair in route.windows(2) {
        let is_next = |block: &Roadblock| block.successors.contains(&pair[1]);
        if !map.roadblock(pair[0]).is_some_and(is_next) {
            let chain = search(map, pair[0], DEPTH_AHEAD, Direction::Ahead, |id| {
                id == pair[1]
            });
            if let Some(chain) = chain.filter(|chain| chain.len() >= 3) {
                filled.extend(&chain[1..chain.len() - 1]);
            }
        }
        filled.push(pair[1]);
    }
    filled
}

/// Cuts the route before the first connector that lies over an earlier one.
fn without_loop(map: &MapGraph, route: &[RoadblockId]) -> Vec<RoadblockId> {
    let mut passed: Vec<&Polygon> = Vec::new();
    for (i, &id) in route.iter().enumerate() {
        let Some(block) = map.roadblock(id).filter(|block| block.in_intersection) else {
            continue;
        };
        if passed
            .iter()
            .any(|other| shared_area(other, &block.outline) > SHARED_AREA)
        {
            return route[..i].to_vec();
        }
        passed.push(&block.outline);
    }
    route.to_vec()
}

/// Area that two polygons share, square metres, counted in small squares.
fn shared_area(a: &Polygon, b: &Polygon) -> f64 {
    let (low, high) = (
        a.bounds().0.max(b.bounds().0),
        a.bounds().1.min(b.bounds().1),
    );
    if low.cmpge(high).any() {
        return 0.0;
    }
    let n = ((high - low) / AREA_CELL).ceil();
    let inside = |i: usize| {
        let (column, row) = (i % n.x as usize, i / n.x as usize);
        let point = low + dvec2(column as f64 + 0.5, row as f64 + 0.5) * AREA_CELL;
        a.contains(point) && b.contains(point)
    };
    let count = (0..n.x as usize * n.y as usize)
        .filter(|&i| inside(i))
        .count();
    count as f64 * AREA_CELL * AREA_CELL
}

/// All lanes of the roadblocks, roadblock by roadblock.
pub fn lanes_of_route<'m>(map: &'m MapGraph, route: &[RoadblockId]) -> Vec<&'m Lane> {
    let lanes = route.iter().flat_map(|&id| map.roadblock_lanes(id));
    let mut seen = BTreeSet::new();
    lanes.filter(|lane| seen.insert(lane.id)).collect()
}

/// The shortest chain of lanes within the route from `start` to its last roadblock; where that
/// cannot be reached, to the deepest lane that can.
///
/// Source: Dijkstra's algorithm with the length of the lane entered as cost, as in PDM.
pub fn shortest_lanes(map: &MapGraph, start: LaneId, route: &[RoadblockId]) -> Vec<LaneId> {
    let allowed: BTreeSet<LaneId> = lanes_of_route(map, route).iter().map(|l| l.id).collect();
    let targets: BTreeSet<LaneId> = route
        .last()
        .map(|&id| map.roadblock_lanes(id).map(|lane| lane.id).collect())
        .unwrap_or_default();
    // Distance, depth and predecessor of every lane met.
    let mut met: BTreeMap<LaneId, (f64, usize, Option<LaneId>)> = BTreeMap::new();
    let mut open = BTreeSet::from([start]);
    let mut done: BTreeSet<LaneId> = BTreeSet::new();
    met.insert(start, (1.0, 1, None));
    let mut end = start;
    loop {
        let nearest = open
            .iter()
            .min_by(|a, b| met[a].0.total_cmp(&met[b].0))
            .copied();
        let Some(id) = nearest else {
            // The deepest lane reached, of several the nearest.
            let rank = |id: &&LaneId| {
                let (distance, depth, _) = met[id];
                (depth, -distance)
            };
            let deepest = done.iter().max_by(|a, b| {
                let ((da, na), (db, nb)) = (rank(a), rank(b));
                da.cmp(&db).then(na.total_cmp(&nb))
            });
            end = deepest.copied().unwrap_or(end);
            break;
        };
        open.remove(&id);
        done.insert(id);
        if targets.contains(&id) {
            end = id;
            break;
        }
        let (distance, depth, _) = met[&id];
        for next in map.successors(id).filter(|lane| allowed.contains(&lane.id)) {
            let through = distance + next.centerline.length();
            if met.get(&next.id).is_none_or(|&(known, ..)| through < known) {
                met.insert(next.id, (through, depth + 1, Some(id)));
                open.insert(next.id);
            }
        }
    }
    let mut chain = vec![end];
    while let Some((_, _, Some(before))) = chain.last().map(|id| met[id]) {
        chain.push(before);
    }
    chain.reverse();
    chain
}

/// The first chain of lanes that a breadth-first search within the route finds from `start` to the
/// route's last roadblock at exactly `depth` lanes; otherwise the chain examined last.
///
/// Source: the route search of nuPlan's IDM planner.
pub fn first_lanes(
    map: &MapGraph,
    start: LaneId,
    route: &[RoadblockId],
    depth: usize,
) -> (Vec<LaneId>, bool) {
    let allowed: BTreeSet<LaneId> = lanes_of_route(map, route).iter().map(|l| l.id).collect();
    let targets: BTreeSet<LaneId> = route
        .last()
        .map(|&id| map.roadblock_lanes(id).map(|lane| lane.id).collect())
        .unwrap_or_default();
    let mut before: BTreeMap<LaneId, LaneId> = BTreeMap::new();
    let mut seen = BTreeSet::from([start]);
    let mut queue = VecDeque::from([(start, 1)]);
    let (mut end, mut found) = (start, false);
    while let Some((id, n)) = queue.pop_front() {
        end = id;
        if n == depth && targets.contains(&id) {
            found = true;
            break;
        }
        for next in map.successors(id).filter(|lane| allowed.contains(&lane.id)) {
            if n < depth && seen.insert(next.id) {
                before.insert(next.id, id);
                queue.push_back((next.id, n + 1));
            }
        }
    }
    let mut chain = vec![end];
    while let Some(&previous) = chain.last().and_then(|id| before.get(id)) {
        chain.push(previous);
    }
    chain.reverse();
    (chain, found)
}

/// The point of a lane's centre line nearest to `point`, with its direction.
pub fn nearest_vertex(lane: &Lane, point: DVec2) -> Pose {
    let squared = |pose: &Pose| pose.position.distance_squared(point);
    let poses = baseline(lane).into_iter();
    poses
        .min_by(|a, b| squared(a).total_cmp(&squared(b)))
        .expect("a centre line has a point")
}
