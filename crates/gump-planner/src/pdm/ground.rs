//! Surfaces of the road around the ego, and queries for the surfaces under points.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use gump_geometry::{DVec2, PolygonIndex};
use gump_scene::{AreaKind, LaneId, MapGraph};

/// Surfaces within this square around the ego are considered, half its side in metres. Source:
/// tuPlan Garage.
pub(crate) const RADIUS: f64 = 50.0;

/// Surfaces near the ego, prepared once per lane and kept for the drive.
#[derive(Debug, Default)]
pub(crate) struct Ground {
    lanes: BTreeMap<LaneId, Arc<PolygonIndex>>,
    areas: BTreeMap<(i64, bool), Arc<PolygonIndex>>,
    near: Vec<Surface>,
    intersections: Vec<Arc<PolygonIndex>>,
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
    /// Some corner is on no surface.
    pub(crate) off_road: bool,
    /// Its centre is on no surface of the route.
    pub(crate) oncoming: bool,
}

impl Ground {
    /// Updates the surfaces around `center`.
    pub(crate) fn look(&mut self, map: &MapGraph, route: &BTreeSet<LaneId>, center: DVec2) {
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
        Footing {
            multiple_lanes: n_touched > 1 && !held,
            off_road: covered.contains(&false),
            oncoming: !on_route,
        }
    }
}
