//! Derived roadblocks for maps that have none, so that datasets with lanes only can be used in the
//! closed loop.

use std::collections::BTreeMap;
use std::sync::Arc;

use gump_geometry::{DVec2, Polygon, Polyline, angle_difference};
use gump_scene::{
    Area, AreaKind, Lane, LaneId, MapGraph, MapParts, Roadblock, RoadblockId, Route, Scenario,
};

/// Distance by which a route is extended past its end, metres: no planner looks farther ahead.
const BEYOND: f64 = 200.0;
/// Distance into a lane over which its turn is determined, metres: branches of a junction point
/// different ways by then. Chosen by hand.
const TURN_SEEN: f64 = 10.0;
/// Distance that a derived surface goes on past a linked end of its lane, metres: closes the wedge
/// between lanes of 3.7 m that meet at up to 30 degrees.
const OVERLAP: f64 = 0.5;
/// Ids of derived areas start here, above those of the formats.
const FIRST_AREA: i64 = 1 << 40;

/// Completes a scenario whose map has lanes but no roadblocks; other scenarios are not changed.
///
/// Adjacent lanes share a roadblock, named after its lowest lane. Outlines are the lanes' surfaces;
/// where they follow from centre line and width, those of linked lanes overlap a little.
/// Lanes through intersections become the area of the intersection. The route gets the roadblocks
/// of its lanes and is extended straight on by 200 m.
pub fn derive_roadblocks(scenario: &mut Scenario) {
    if !scenario.map.roadblocks().is_empty() {
        return;
    }
    let old = Arc::clone(&scenario.map);
    let block_of = group(&old);
    let mut parts = MapParts {
        lanes: old.lanes().to_vec(),
        roadblocks: roadblocks(&old, &block_of),
        road_lines: old.road_lines().to_vec(),
        road_edges: old.road_edges().to_vec(),
        areas: old.areas().to_vec(),
        stop_signs: old.stop_signs().to_vec(),
        drivable: old.drivable().to_vec(),
        unstated: old.unstated(),
    };
    for lane in &mut parts.lanes {
        lane.outline = lane.outline.take().or_else(|| joined_ribbon(lane));
        lane.roadblock = block_of.get(&lane.id).copied();
    }
    let inside = parts.lanes.iter().filter(|lane| lane.in_intersection);
    let outlines = inside.filter_map(|lane| lane.outline.clone());
    let intersections: Vec<Area> = outlines
        .enumerate()
        .map(|(i, outline)| Area::new(FIRST_AREA + i as i64, AreaKind::Intersection, outline))
        .collect();
    parts.areas.extend(intersections);
    // A map that was valid stays valid: nothing was renamed and every number comes from it.
    let map = Arc::new(MapGraph::new(parts).expect("parts of a valid map"));
    if let Some(route) = &scenario.route {
        scenario.route = Some(Arc::new(with_roadblocks(&map, route)));
    }
    scenario.map = map;
}

/// Whether the outlines of a map's lanes are those of [`derive_roadblocks`]: as wide as the lanes are said
/// or estimated to be, so that the shoulder, and what lies between two lanes of a junction, are on none.
///
/// Formats state the outlines of all lanes or of none, so that the first one tells.
pub fn has_derived_outlines(map: &MapGraph) -> bool {
    let mut lanes = map.lanes().iter();
    let first = lanes.find(|lane| lane.outline.is_some());
    // No stated outline is the same to the last bit.
    first.is_some_and(|lane| lane.outline == joined_ribbon(lane))
}

/// The surface of a lane without a stated outline. It reaches into the lanes linked to it: ribbons
/// of lanes that meet at an angle leave a wedge uncovered, and a corner of the vehicle over it would
/// count as off the road.
fn joined_ribbon(lane: &Lane) -> Option<Polygon> {
    let line = &lane.centerline;
    let beyond = |s: f64, by: f64| {
        let end = line.pose_at(s);
        end.position + end.direction() * by
    };
    let before = (!lane.predecessors.is_empty()).then(|| beyond(0.0, -OVERLAP));
    let after = (!lane.successors.is_empty()).then(|| beyond(line.length(), OVERLAP));
    let points = before.into_iter().chain(line.points().iter().copied());
    Polyline::new(points.chain(after).collect())?.ribbon(lane.width)
}

/// The roadblock of every lane that has a surface.
fn group(map: &MapGraph) -> BTreeMap<LaneId, RoadblockId> {
    let mut block_of = BTreeMap::new();
    let usable = |lane: &&Lane| lane.surface().is_some();
    let mut ids: Vec<LaneId> = map
        .lanes()
        .iter()
        .filter(usable)
        .map(|lane| lane.id)
        .collect();
    ids.sort_unstable();
    for &first in &ids {
        let mut open = vec![first];
        while let Some(id) = open.pop() {
            let Some(lane) = map
                .lane(id)
                .filter(|lane| ids.binary_search(&lane.id).is_ok())
            else {
                continue;
            };
            if block_of.contains_key(&id) {
                continue;
            }
            block_of.insert(id, RoadblockId(first.0));
            let beside = lane.left_neighbors.iter().chain(&lane.right_neighbors);
            open.extend(beside.filter(|&&other| {
                map.lane(other)
                    .is_some_and(|other| other.in_intersection == lane.in_intersection)
            }));
        }
    }
    block_of
}

fn roadblocks(map: &MapGraph, block_of: &BTreeMap<LaneId, RoadblockId>) -> Vec<Roadblock> {
    let mut lanes: BTreeMap<RoadblockId, Vec<&Lane>> = BTreeMap::new();
    for lane in map.lanes() {
        if let Some(&block) = block_of.get(&lane.id) {
            lanes.entry(block).or_default().push(lane);
        }
    }
    let linked = |block: RoadblockId, lanes: &[LaneId]| -> Vec<RoadblockId> {
        let blocks = lanes.iter().filter_map(|id| block_of.get(id).copied());
        blocks.filter(|&other| other != block).collect()
    };
    let blocks = lanes.into_iter().filter_map(|(id, lanes)| {
        let surfaces = lanes.iter().filter_map(|lane| lane.surface());
        let corners = surfaces
            .flat_map(|surface| surface.ring().to_vec())
            .collect();
        let all = |links: fn(&Lane) -> &Vec<LaneId>| {
            let mut blocks: Vec<RoadblockId> = Vec::new();
            for block in lanes.iter().flat_map(|lane| linked(id, links(lane))) {
                if !blocks.contains(&block) {
                    blocks.push(block);
                }
            }
            blocks
        };
        Some(Roadblock {
            id,
            outline: Polygon::new(convex_hull(corners))?,
            // Formats without roadblocks cut ways through intersections into lanes that overlap;
            // called connectors, they would look like a route that comes back to a place.
            in_intersection: false,
            predecessors: all(|lane| &lane.predecessors),
            successors: all(|lane| &lane.successors),
        })
    });
    blocks.collect()
}

/// The route with the roadblocks of its lanes, extended along the straightest lanes.
fn with_roadblocks(map: &MapGraph, route: &Route) -> Route {
    let mut lanes = route.lanes.clone();
    let mut beyond = 0.0;
    while let Some(&last) = lanes.last().filter(|_| beyond < BEYOND) {
        let ahead = map.lane(last).map(|lane| {
            let line = &lane.centerline;
            line.pose_at(line.length()).heading
        });
        let next = map
            .successors(last)
            .filter(|lane| !lanes.contains(&lane.id))
            .min_by(|a, b| {
                let turn = |lane: &Lane| turn_into(lane, ahead.unwrap_or_default());
                turn(a).total_cmp(&turn(b))
            });
        let Some(next) = next else { break };
        beyond += next.centerline.length();
        lanes.push(next.id);
    }
    let blocks = lanes.iter().filter_map(|&id| map.lane(id)?.roadblock);
    let mut roadblocks: Vec<RoadblockId> = blocks.collect();
    roadblocks.dedup();
    Route {
        roadblocks,
        ..route.clone()
    }
}

/// Angle by which a lane turns away from `heading` in its first metres, radians.
fn turn_into(lane: &Lane, heading: f64) -> f64 {
    let line = &lane.centerline;
    let begun = line.pose_at(TURN_SEEN.min(line.length())).heading;
    angle_difference(begun, heading).abs()
}

/// The convex hull of some points, counter-clockwise.
fn convex_hull(mut points: Vec<DVec2>) -> Vec<DVec2> {
    points.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
    points.dedup();
    let chain = |points: &mut dyn Iterator<Item = DVec2>| {
        let mut chain: Vec<DVec2> = Vec::new();
        for point in points {
            while let [.., a, b] = chain[..] {
                if (b - a).perp_dot(point - b) > 0.0 {
                    break;
                }
                chain.pop();
            }
            chain.push(point);
        }
        chain.pop();
        chain
    };
    let mut hull = chain(&mut points.iter().copied());
    hull.extend(chain(&mut points.iter().rev().copied()));
    hull
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_geometry::dvec2;
    use gump_scene::fixture;

    #[test]
    fn surfaces_of_lanes_that_meet_at_an_angle_leave_no_gap() {
        let mut scenario = fixture::scenario(
            "lane 1: 0,0 50,0 next 2
             lane 2: 50,0 100,5
             ego vehicle 0: 10,0 velocity 5,0",
        )
        .unwrap();
        // On the outer side of the bend.
        let seam = dvec2(50.05, -1.7);
        let is_covered = |scenario: &Scenario| {
            let mut lanes = scenario.map.lanes().iter();
            lanes.any(|lane| lane.surface().is_some_and(|polygon| polygon.contains(seam)))
        };
        assert!(!is_covered(&scenario));
        derive_roadblocks(&mut scenario);
        assert!(is_covered(&scenario));
        // The far end of the second lane leads nowhere.
        let end = scenario.map.lane(LaneId(2)).unwrap();
        assert!(!end.surface().unwrap().contains(dvec2(100.2, 5.02)));
    }

    #[test]
    fn neighbours_share_a_roadblock_and_the_route_goes_on() {
        let mut scenario = fixture::scenario(
            "lane 1: 0,0 50,0 next 3 left 2
             lane 2: 0,3.5 50,3.5 right 1
             lane 3: 50,0 90,0 next 4,5
             lane 4: 90,0 130,40
             lane 5: 90,0 150,0
             route 1
             ego vehicle 0: 10,0 velocity 5,0",
        )
        .unwrap();
        derive_roadblocks(&mut scenario);
        let map = &scenario.map;
        let block = |id: i64| map.lane(LaneId(id)).unwrap().roadblock.unwrap().0;
        assert_eq!([1, 2, 3, 4, 5].map(block), [1, 1, 3, 4, 5]);
        let first = map.roadblock(RoadblockId(1)).unwrap();
        assert_eq!(first.successors, [RoadblockId(3)]);
        assert!(first.outline.contains(dvec2(25.0, 4.0)));
        let route = scenario.route.as_ref().unwrap();
        assert_eq!(route.roadblocks, [1, 3, 5].map(RoadblockId));
        let before = Arc::clone(map);
        derive_roadblocks(&mut scenario);
        assert!(Arc::ptr_eq(&before, &scenario.map));
    }

    #[test]
    fn derived_outlines_are_told_from_stated_ones() {
        let mut scenario = fixture::scenario(
            "lane 1: 0,0 50,0 next 2
             lane 2: 50,0 90,0
             ego vehicle 0: 10,0",
        )
        .unwrap();
        assert!(!has_derived_outlines(&scenario.map));
        let mut parts = scenario.map.parts().clone();
        derive_roadblocks(&mut scenario);
        assert!(has_derived_outlines(&scenario.map));
        for lane in &mut parts.lanes {
            lane.outline = lane.surface().map(std::borrow::Cow::into_owned);
        }
        assert!(!has_derived_outlines(&MapGraph::new(parts).unwrap()));
    }
}
