//! Surfaces of the road around the ego, and queries for the surfaces under points.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use gump_geometry::{DVec2, PolygonIndex};
use gump_metrics::Border;
use gump_nuplan::closed_loop::has_derived_outlines;
use gump_scene::{AreaKind, LaneId, MapGraph};

/// Surfaces within this square around the ego are considered, half its side in metres. Source:
/// tuPlan Garage.
pub(crate) const RADIUS: f64 = 50.0;
/// Within this square around the ego's first position the border is quick to ask, half its side in metres.
/// Chosen by hand.
const DRIVEN: f64 = 256.0;

/// Surfaces near the ego, prepared once per lane and kept for the drive.
#[derive(Debug, Default)]
pub(crate) struct Ground {
    lanes: BTreeMap<LaneId, Arc<PolygonIndex>>,
    areas: BTreeMap<(i64, bool), Arc<PolygonIndex>>,
    near: Vec<Surface>,
    intersections: Vec<Arc<PolygonIndex>>,
    /// Whether the map's border decides if a corner on no surface is off the road.
    has_border: bool,
    /// The border, once the ego has been seen.
    border: Option<Border>,
    /// Height of the road at the ego, metres.
    z: f64,
}

#[derive(Debug)]
struct Surface {
    lane: Option<LaneId>,
    polygon: Arc<PolygonIndex>,
    on_route: bool,
}

/// The surfaces under a vehicle.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Footing {
    /// Its corners are on several surfaces, none of which contains all.
    pub(crate) multiple_lanes: bool,
    /// Some corner is on no surface, and beyond the border where that counts.
    pub(crate) off_road: bool,
    /// Its centre is on no surface of the route.
    pub(crate) oncoming: bool,
}

impl Ground {
    /// No surface yet. Where outlines of lanes are derived from their widths, corners off all lanes and car
    /// parks are off the road only beyond the map's border: vehicles on the shoulder, or between two lanes
    /// of a junction, are not.
    pub(crate) fn new(map: &MapGraph) -> Self {
        let is_stated = !map.road_edges().is_empty() || !map.drivable().is_empty();
        Self {
            has_border: is_stated && has_derived_outlines(map),
            ..Self::default()
        }
    }

    /// Updates the surfaces around `center`.
    pub(crate) fn look(&mut self, map: &Arc<MapGraph>, route: &BTreeSet<LaneId>, center: DVec2) {
        if self.has_border {
            self.z = map.elevation_at(center).unwrap_or_default();
            let border = || Border::new(map, center, self.z, DRIVEN);
            self.border.get_or_insert_with(border);
        }
        self.near.clear();
        for block in map.roadblocks_in_square(center, RADIUS) {
            for lane in map.roadblock_lanes(block.id) {
                let known = self.lanes.get(&lane.id).cloned();
                let polygon = known.or_else(|| {
                    let index = Arc::new(PolygonIndex::new(&*lane.surface()?));
                    self.lanes.insert(lane.id, Arc::clone(&index));
                    Some(index)
                });
                self.near.extend(polygon.map(|polygon| Surface {
                    lane: Some(lane.id),
                    polygon,
                    on_route: route.contains(&lane.id),
                }));
            }
        }
        let carparks: Vec<_> = self.areas_near(map, center, AreaKind::Carpark);
        self.near
            .extend(carparks.into_iter().map(|polygon| Surface {
                lane: None,
                polygon,
                on_route: false,
            }));
        self.intersections = self.areas_near(map, center, AreaKind::Intersection);
    }

    fn areas_near(
        &mut self,
        map: &MapGraph,
        center: DVec2,
        kind: AreaKind,
    ) -> Vec<Arc<PolygonIndex>> {
        let known = &mut self.areas;
        let areas = map.areas_in_square(center, RADIUS, kind);
        areas
            .map(|area| {
                // Ids are unique within a layer of a map at least.
                let prepared = known.entry((area.id, kind == AreaKind::Carpark));
                Arc::clone(prepared.or_insert_with(|| Arc::new(PolygonIndex::new(&area.polygon))))
            })
            .collect()
    }

    /// The lanes near the ego.
    #[cfg(test)]
    pub(crate) fn lanes(&self) -> impl Iterator<Item = LaneId> + '_ {
        self.near.iter().filter_map(|surface| surface.lane)
    }

    /// Lanes of the route that contain a point.
    pub(crate) fn route_lanes_at(&self, point: DVec2) -> impl Iterator<Item = LaneId> + '_ {
        self.near
            .iter()
            .filter(move |surface| surface.on_route && surface.polygon.contains(point))
            .filter_map(|surface| surface.lane)
    }

    /// True if a point is in an intersection.
    pub(crate) fn is_in_intersection(&self, point: DVec2) -> bool {
        self.intersections
            .iter()
            .any(|polygon| polygon.contains(point))
    }

    /// The surfaces that share a point with a box, as indices for [`Ground::footing`].
    pub(crate) fn within(&self, min: DVec2, max: DVec2, found: &mut Vec<usize>) {
        found.clear();
        found.extend((0..self.near.len()).filter(|&i| {
            let (low, high) = self.near[i].polygon.bounds();
            low.cmple(max).all() && min.cmple(high).all()
        }));
    }

    /// The surfaces under a vehicle with these corners; only `surfaces` are considered.
    pub(crate) fn footing(
        &self,
        corners: &[DVec2; 4],
        center: DVec2,
        surfaces: &[usize],
    ) -> Footing {
        let min = corners.iter().fold(center, |min, &c| min.min(c));
        let max = corners.iter().fold(center, |max, &c| max.max(c));
        let (mut n_touched, mut held, mut on_route) = (0, false, false);
        let mut covered = [false; 4];
        for surface in surfaces.iter().map(|&i| &self.near[i]) {
            let (low, high) = surface.polygon.bounds();
            if low.cmpgt(max).any() || high.cmplt(min).any() {
                continue;
            }
            let inside = corners.map(|corner| surface.polygon.contains(corner));
            n_touched += usize::from(inside.contains(&true));
            held |= inside == [true; 4];
            for (covered, inside) in covered.iter_mut().zip(inside) {
                *covered |= inside;
            }
            on_route |= surface.on_route && surface.polygon.contains(center);
        }
        let is_off = |border: &Border| {
            // Roads above one another are told apart by the height at the ego. nuPlan's metric takes that at
            // the centre of each box, which costs more time.
            let mut bare = corners.iter().zip(covered).filter(|(_, covered)| !covered);
            bare.any(|(corner, _)| {
                let off = border.metres_off_road(*corner, self.z);
                off.is_some_and(|off| off > 0.0)
            })
        };
        let is_bare = covered.contains(&false);
        Footing {
            multiple_lanes: n_touched > 1 && !held,
            off_road: is_bare && self.border.as_ref().is_none_or(is_off),
            oncoming: !on_route,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::borrow::Cow;

    use gump_geometry::dvec2;
    use gump_nuplan::closed_loop::derive_roadblocks;
    use gump_scene::{Lane, fixture};

    use super::*;

    #[test]
    fn the_shoulder_of_a_derived_lane_is_road_up_to_the_border() {
        // A lane of 3.5 m, and a metre and a half of shoulder on its right.
        let text = "lane 1: 0,0 50,0 next 2\nlane 2: 50,0 90,0\n{edge}\nego vehicle 0: 10,0";
        let is_off = |edge: &str, are_stated: bool, right_m: f64| {
            let mut scenario = fixture::scenario(&text.replace("{edge}", edge)).unwrap();
            if are_stated {
                let mut parts = scenario.map.parts().clone();
                let outline = |lane: &Lane| lane.surface().map(Cow::into_owned);
                parts
                    .lanes
                    .iter_mut()
                    .for_each(|lane| lane.outline = outline(lane));
                scenario.map = Arc::new(MapGraph::new(parts).unwrap());
            }
            derive_roadblocks(&mut scenario);
            let mut ground = Ground::new(&scenario.map);
            let center = dvec2(20.0, -right_m);
            ground.look(&scenario.map, &BTreeSet::from([LaneId(1)]), center);
            let corners = [(2.0, 1.0), (2.0, -1.0), (-2.0, -1.0), (-2.0, 1.0)];
            let corners = corners.map(|(x, y)| center + dvec2(x, y));
            let mut surfaces = Vec::new();
            ground.within(corners[2], corners[0], &mut surfaces);
            ground.footing(&corners, center, &surfaces).off_road
        };
        for edge in [
            "edge: 0,-3.25 90,-3.25",
            "drivable: 0,-3.25 90,-3.25 90,4 0,4",
        ] {
            assert!(!is_off(edge, false, 0.5), "{edge}");
            assert!(!is_off(edge, false, 2.0), "{edge}");
            assert!(is_off(edge, false, 3.0), "{edge}");
            // nuPlan's maps state outlines.
            assert!(!is_off(edge, true, 0.5), "{edge}");
            assert!(is_off(edge, true, 2.0), "{edge}");
        }
    }
}
