//! Lanes and a path from the roadblocks that a log states.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;

use gump_geometry::{Polyline, Pose, angle_difference};
use gump_scene::{Lane, LaneId, MapGraph, RoadblockId, Route, Scenario};

use super::log::unexpected;
use crate::complete::infer;
use crate::{Problem, ReadOptions, ReadReport};

// Chosen by hand: the ego may stand beside the road, or across, as when it leaves a parking place.
/// A lane of the route further away than this is not where the ego starts, metres.
const MAX_DISTANCE: f64 = 8.0;
/// Nor is one that points elsewhere, radians.
const MAX_TURN: f64 = 1.2;
/// One radian beside the lane's direction counts as so many metres beside its centre.
const TURN_COST: f64 = 4.0;

/// Gives the scenario its route: along the stated roadblocks from the ego's present position, else,
/// if `options` allow, along its log.
///
/// Error: [`Problem::Unexpected`] if roadblocks are stated and none of them is in the map.
pub(super) fn fill(
    scenario: &mut Scenario,
    stated: &[RoadblockId],
    options: ReadOptions,
    report: &mut ReadReport,
) -> Result<(), Problem> {
    let known = |id: &&RoadblockId| scenario.map.roadblock(**id).is_some();
    let n_known = stated.iter().filter(known).count();
    if n_known == 0 && !stated.is_empty() {
        let ids: Vec<String> = stated.iter().map(ToString::to_string).collect();
        return Err(unexpected(
            "a route of roadblocks that are in the map",
            format!("none of {}", ids.join(" ")),
            "its scene".into(),
        ));
    }
    report.drop(
        "roadblock of the route that is not in the map",
        stated.len() - n_known,
    );
    let ego = scenario.present().ego_now().state.pose;
    match along(&scenario.map, stated, ego) {
        Some(route) => scenario.route = Some(Arc::new(route)),
        None => {
            infer::route(scenario, options, report);
            if let Some(route) = &mut scenario.route {
                Arc::make_mut(route).roadblocks = stated.to_vec();
            }
        }
    }
    Ok(())
}

/// Lanes of the stated roadblocks, each a successor of the one before, from where the ego is as far
/// along the list as they lead; `None` if the ego is on none of them.
fn along(map: &MapGraph, stated: &[RoadblockId], ego: Pose) -> Option<Route> {
    let place: BTreeMap<RoadblockId, usize> = stated
        .iter()
        .enumerate()
        .rev()
        .map(|(i, &id)| (id, i))
        .collect();
    let blocks: BTreeSet<RoadblockId> = stated.iter().copied().collect();
    let lanes = blocks.iter().flat_map(|&id| map.roadblock_lanes(id));
    let mut starts: Vec<(f64, &Lane)> = lanes
        .filter_map(|lane| Some((distance(lane, ego)?, lane)))
        .collect();
    starts.sort_by(|a, b| a.0.total_cmp(&b.0));
    // Lanes of one roadblock lead to different ends; of those the ego may be on, the one that
    // leads furthest counts, of equals the nearest.
    let mut best: Option<(usize, Vec<LaneId>)> = None;
    for (_, start) in starts.iter().take(4) {
        let (end, chain) = furthest(map, &place, start);
        if best.as_ref().is_none_or(|(most, _)| end > *most) {
            best = Some((end, chain));
        }
    }
    let (_, lanes) = best?;
    let points = lanes.iter().filter_map(|&id| map.lane(id));
    let points = points.flat_map(|lane| lane.centerline.points().iter().copied());
    Some(Route {
        path: Polyline::new(points.collect())?,
        lanes,
        roadblocks: stated.to_vec(),
    })
}

/// Cost of the ego in a lane: its distance from the centre line, metres, plus a penalty for its
/// heading error; `None` if it is not on the lane.
fn distance(lane: &Lane, ego: Pose) -> Option<f64> {
    let foot = lane.centerline.project(ego.position);
    let turn = angle_difference(
        lane.centerline.pose_at(foot.arc_length).heading,
        ego.heading,
    );
    let on = foot.distance <= MAX_DISTANCE && turn.abs() <= MAX_TURN;
    on.then(|| foot.distance + TURN_COST * turn.abs())
}

/// The chain of lanes on the route that reaches its furthest place, and that place.
fn furthest(
    map: &MapGraph,
    place: &BTreeMap<RoadblockId, usize>,
    start: &Lane,
) -> (usize, Vec<LaneId>) {
    let place_of = |lane: &Lane| lane.roadblock.and_then(|id| place.get(&id).copied());
    let mut from: BTreeMap<LaneId, LaneId> = BTreeMap::new();
    let mut queue = VecDeque::from([start]);
    let mut best = (place_of(start).unwrap_or(0), start.id);
    while let Some(lane) = queue.pop_front() {
        for next in map.successors(lane.id) {
            let Some(at) = place_of(next) else { continue };
            if next.id == start.id || from.contains_key(&next.id) {
                continue;
            }
            from.insert(next.id, lane.id);
            if at > best.0 {
                best = (at, next.id);
            }
            queue.push_back(next);
        }
    }
    let mut lanes: Vec<LaneId> =
        std::iter::successors(Some(best.1), |id| from.get(id).copied()).collect();
    lanes.reverse();
    (best.0, lanes)
}
