//! Places at which a vehicle may be, and the properties of each: the inputs of the placement network.
//!
//! A place is a pose: every metre along the centre lines of lanes, and every cell of 2 m
//! beside them, along the nearest lane and across it, where vehicles park: at the curb, in car parks,
//! on driveways. [`Places`] holds them
//! with what the map, the lights and the ego say of each; [`Traffic`] adds the vehicles that are
//! already placed.

mod beside;
mod features;
mod traffic;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use gump_geometry::{DVec2, Pose, angle_difference};
use gump_scene::{
    LaneAhead, LaneId, LaneKind, Light, LightState, MapGraph, lanes_ahead, stop_line,
};

pub use self::beside::CELL;
pub use self::features::N_FEATURES;
use self::features::{FIXED, N_OWN, N_TRAFFIC};
pub use self::traffic::{PlacedVehicle, Traffic};
use crate::placement::spawn_map::{SLOW, is_near};

/// Half the side of the square with places on lanes, metres: that of the positions' grid.
const REACH: f64 = 100.0;
/// Places on a lane are this far apart, metres.
const STEP: f64 = 1.0;
/// Distance along lanes within which other vehicles, lights and junctions are seen, metres.
const LOOK: f64 = 60.0;
/// Lanes before this one that are searched for a junction. Not tuned.
const LANES_BEHIND: usize = 4;
/// Largest difference between the directions of a moving vehicle and its place, radians. Loose, as
/// a velocity of a few bins is rounded.
const SAME_WAY: f64 = 0.3;

/// The kind of a place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PlaceKind {
    /// On the centre line of a lane.
    OnLane,
    /// Beside a lane, parallel to it.
    Along,
    /// Beside a lane, perpendicular to it.
    Across,
}

/// A place at which a vehicle may be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Place {
    /// Centre and direction, scene frame. Vehicles beside lanes may also head the opposite way.
    pub pose: Pose,
    /// Its kind.
    pub kind: PlaceKind,
    /// Index of its lane, the nearest one where it is beside lanes.
    lane: u32,
    /// Metres along that lane.
    along: f32,
    /// Metres inside the nearest road edge, below 0 beyond it, up to 5 m.
    edge: f32,
    /// Whether no road edge lies between it and the lane.
    is_open: bool,
}

impl Place {
    /// True on the road: inside its edges.
    pub fn is_on_road(&self) -> bool {
        self.is_open
    }
}

/// A vehicle that is to be placed.
#[derive(Clone, Copy, Debug)]
pub struct NewVehicle {
    /// Scene frame, metres per second.
    pub velocity: DVec2,
    /// Metres.
    pub length: f64,
}

impl NewVehicle {
    /// A car of usual length that stands.
    pub const STANDING_CAR: Self = Self {
        velocity: DVec2::ZERO,
        length: 4.8,
    };

    /// True if it has no direction of motion.
    pub fn stands(&self) -> bool {
        self.velocity.length() < SLOW
    }

    /// True if its velocity agrees with a place: it moves along it, or stands. Only vehicles that
    /// stand are beside lanes.
    pub fn suits(&self, place: &Place) -> bool {
        let turn = || angle_difference(self.velocity.to_angle(), place.pose.heading).abs();
        self.stands() || place.kind == PlaceKind::OnLane && turn() <= SAME_WAY
    }
}

/// What lies ahead on a lane.
#[derive(Clone, Debug)]
struct Chain {
    id: LaneId,
    /// This lane and those that can be reached, and where they begin, metres from the start of
    /// this one.
    ahead: Vec<(u32, f64)>,
    /// Lights: metres from the start of this lane to their stop lines.
    lights: Vec<(f64, LightState)>,
    /// Metres from the start to the first junction after it, and to the first stop sign.
    junction: f64,
    stop: f64,
    /// Metres from the last junction to the start.
    behind: f64,
}

/// The places of one scene.
#[derive(Clone, Debug)]
pub struct Places {
    map: Arc<MapGraph>,
    world_from_scene: Pose,
    places: Vec<Place>,
    /// `[places, FIXED]`
    fixed: Vec<f32>,
    chains: Vec<Chain>,
    index: BTreeMap<LaneId, u32>,
}

impl Places {
    /// The places around an ego, whose pose is the scene's frame, under these lights.
    pub fn new(map: &Arc<MapGraph>, world_from_scene: Pose, lights: &[Light]) -> Self {
        let lanes = map.lanes().iter();
        let lanes = lanes.filter(|lane| {
            lane.kind != LaneKind::BikeLane && is_near(lane, world_from_scene.position)
        });
        let lanes: Vec<_> = lanes.collect();
        let index: BTreeMap<LaneId, u32> = lanes.iter().map(|lane| lane.id).zip(0..).collect();
        let stops: BTreeSet<LaneId> = map
            .stop_signs()
            .iter()
            .flat_map(|sign| sign.lanes.iter().copied())
            .collect();
        let lit: BTreeMap<LaneId, &Light> =
            lights.iter().map(|light| (light.lane, light)).collect();
        let chains = lanes.iter().map(|lane| {
            let length = lane.centerline.length();
            let (reached, _) = lanes_ahead(map, lane, 0.0, length + LOOK);
            let ahead = reached
                .iter()
                .filter_map(|part| Some((*index.get(&part.lane.id)?, part.base_m)));
            let lights = reached.iter().filter_map(|part| {
                let light = lit.get(&part.lane.id)?;
                let line = stop_line(part.lane, light).position;
                let at = part.lane.centerline.project(line).arc_length;
                Some((part.base_m + at, light.state))
            });
            let first = |at: &dyn Fn(&LaneAhead<'_>) -> Option<f64>| {
                reached.iter().filter_map(at).fold(f64::INFINITY, f64::min)
            };
            Chain {
                id: lane.id,
                ahead: ahead.collect(),
                lights: lights.collect(),
                junction: first(&|part| {
                    let is_later = part.lane.in_intersection && part.lane.id != lane.id;
                    is_later.then_some(part.base_m)
                }),
                stop: first(&|part| {
                    let end = part.base_m + part.lane.centerline.length();
                    stops.contains(&part.lane.id).then_some(end)
                }),
                behind: since_junction(map, lane.id, LANES_BEHIND),
            }
        });
        let mut places = Self {
            map: Arc::clone(map),
            world_from_scene,
            places: Vec::new(),
            fixed: Vec::new(),
            chains: chains.collect(),
            index,
        };
        let scene_from_world = world_from_scene.inverse();
        for (lane, i) in lanes.iter().zip(0..) {
            let line = &lane.centerline;
            let n = (line.length() / STEP).round().max(1.0) as usize;
            for k in 0..n {
                let along = (k as f64 + 0.5) * line.length() / n as f64;
                let pose = scene_from_world * line.pose_at(along);
                if pose.position.abs().max_element() < REACH {
                    places.places.push(Place {
                        pose,
                        kind: PlaceKind::OnLane,
                        lane: i,
                        along: along as f32,
                        edge: beside::EDGE_REACH as f32,
                        is_open: true,
                    });
                }
            }
        }
        places
            .places
            .extend(beside::places(map, world_from_scene, &lanes));
        places.fixed = features::fixed(&places);
        places
    }

    /// All of them.
    pub fn all(&self) -> &[Place] {
        &self.places
    }

    /// The lane whose centre line a place is on, if it is on one.
    pub fn lane(&self, place: &Place) -> Option<LaneId> {
        let is_on = place.kind == PlaceKind::OnLane;
        is_on.then(|| self.chains[place.lane as usize].id)
    }

    /// The properties of place `i` for a vehicle, into `[N_FEATURES]`.
    pub fn write(&self, traffic: &Traffic, own: &NewVehicle, i: usize, into: &mut [f32]) {
        let (fixed, rest) = into.split_at_mut(FIXED);
        fixed.copy_from_slice(&self.fixed[i * FIXED..(i + 1) * FIXED]);
        let (seen, own_part) = rest.split_at_mut(N_TRAFFIC);
        traffic.write(&self.places[i], own, seen);
        features::own(own, &mut own_part[..N_OWN]);
    }
}

/// Metres from the nearest junction before a lane to its start, at most [`LOOK`].
fn since_junction(map: &MapGraph, lane: LaneId, depth: usize) -> f64 {
    let before = map.predecessors(lane).map(|lane| {
        if lane.in_intersection {
            0.0
        } else if depth == 0 {
            LOOK
        } else {
            lane.centerline.length() + since_junction(map, lane.id, depth - 1)
        }
    });
    before.fold(LOOK, f64::min)
}

#[cfg(test)]
mod tests {
    use gump_geometry::{OrientedBox, dvec2};
    use gump_scene::fixture;

    use super::*;

    fn scene(text: &str) -> (Arc<MapGraph>, Vec<Light>) {
        let scenario = fixture::scenario(&format!("{text}\nego vehicle 0: 0,0")).unwrap();
        let lights = scenario.present().now().lights().to_vec();
        (Arc::clone(&scenario.map), lights)
    }

    const ROAD: &str = "lane 1: -50,0 30,0 width 3.6 next 2\nlane 2: 30,0 50,0\n\
                        light 2 red: 30,0\nedge: -50,-5 50,-5\nedge: 50,5 -50,5";

    fn standing(x: f64, y: f64) -> PlacedVehicle {
        PlacedVehicle {
            outline: OrientedBox {
                pose: Pose::new(x, y, 0.0),
                length: 4.0,
                width: 2.0,
            },
            speed: 0.0,
        }
    }

    #[test]
    fn places_are_on_lanes_and_beside_them() {
        let (map, lights) = scene(ROAD);
        let places = Places::new(&map, Pose::IDENTITY, &lights);
        let on_lane = places.all().iter().filter(|p| p.kind == PlaceKind::OnLane);
        assert_eq!(on_lane.clone().count(), 100);
        let ids = on_lane.clone().map(|place| places.lane(place));
        assert_eq!(ids.clone().filter(|id| *id == Some(LaneId(2))).count(), 20);
        let beside = |y: f64| {
            let at = move |p: &&Place| p.pose.position.distance(dvec2(9.0, y)) < 0.1;
            let found: Vec<&Place> = places.all().iter().filter(at).collect();
            found
        };
        // Inside the edge, and beyond it; none within a lane.
        let open = beside(3.0);
        assert_eq!(open.len(), 2);
        assert!(
            open.iter()
                .all(|p| p.is_on_road() && places.lane(p).is_none())
        );
        assert!(beside(9.0).iter().all(|p| !p.is_on_road()) && beside(9.0).len() == 2);
        assert!(beside(1.0).is_empty());
        // Only who stands parks, and nobody drives against a lane.
        let moving = NewVehicle {
            velocity: dvec2(5.0, 0.0),
            length: 4.8,
        };
        let against = NewVehicle {
            velocity: dvec2(-5.0, 0.0),
            ..moving
        };
        let lane = on_lane.clone().next().unwrap();
        assert!(moving.suits(lane) && !against.suits(lane) && !moving.suits(open[0]));
        assert!(NewVehicle::STANDING_CAR.suits(open[0]));
    }

    #[test]
    fn properties_follow_lights_and_vehicles_across_lanes() {
        let (map, lights) = scene(ROAD);
        let places = Places::new(&map, Pose::IDENTITY, &lights);
        let index = |x: f64| {
            let at = |p: &Place| p.pose.position.distance(dvec2(x, 0.0)) < 0.1;
            places.all().iter().position(at).unwrap()
        };
        let row = |vehicles: Vec<PlacedVehicle>, x: f64| {
            let traffic = Traffic::new(&places, vehicles);
            let mut row = vec![f32::NAN; N_FEATURES];
            places.write(&traffic, &NewVehicle::STANDING_CAR, index(x), &mut row);
            assert!(row.iter().all(|value| value.is_finite()));
            row
        };
        // The same road without its light differs, as does one with a vehicle on the next lane.
        let dark = Places::new(&map, Pose::IDENTITY, &[]);
        assert_ne!(places.fixed, dark.fixed);
        let empty = row(Vec::new(), 20.5);
        let behind_one = row(vec![standing(35.0, 0.0)], 20.5);
        assert_eq!(empty[..FIXED], behind_one[..FIXED]);
        assert_ne!(empty, behind_one);
        // Beyond the reach of everything nothing is seen.
        assert_eq!(
            row(Vec::new(), -49.5),
            row(vec![standing(49.0, 0.0)], -49.5)
        );
        let traffic = Traffic::new(&places, vec![standing(35.0, 0.0)]);
        assert!(traffic.stands_near(dvec2(40.0, 0.0)) && !traffic.stands_near(dvec2(45.0, 0.0)));
    }
}
