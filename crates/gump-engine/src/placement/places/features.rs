//! Properties as numbers of about one.

use gump_geometry::angle_difference;
use gump_scene::{AreaKind, LightState};

use super::{LOOK, NewVehicle, PlaceKind, Places};

/// Number of properties from the map, the lights and the ego.
pub(super) const FIXED: usize = 49;
/// Number of properties from vehicles already placed.
pub(super) const N_TRAFFIC: usize = 50;
/// Number of properties of the vehicle itself.
pub(super) const N_OWN: usize = 4;

/// Number of properties of a place for a vehicle.
pub const N_FEATURES: usize = FIXED + N_TRAFFIC + N_OWN;

/// Speed limit of lanes that state none, metres per second.
const UNKNOWN_LIMIT: f64 = 13.4;
/// Half of the length over which a lane's curvature is taken, metres.
const BEND: f64 = 5.0;

/// Properties written one after another.
pub(super) struct Row<'a> {
    into: &'a mut [f32],
    at: usize,
}

impl<'a> Row<'a> {
    pub(super) fn new(into: &'a mut [f32]) -> Self {
        Self { into, at: 0 }
    }

    pub(super) fn push(&mut self, value: f64) {
        self.into[self.at] = value as f32;
        self.at += 1;
    }

    pub(super) fn mark(&mut self, is_so: bool) {
        self.push(f64::from(u8::from(is_so)));
    }

    /// A distance on five scales: one alone cannot tell both 2 from 3 m and 20 from 40 m.
    pub(super) fn distance(&mut self, metres: f64) {
        let metres = metres.clamp(0.0, LOOK);
        self.push(metres / LOOK);
        for scale in [2.0, 6.0, 18.0] {
            self.push((-metres / scale).exp());
        }
        self.mark(metres < LOOK);
    }

    /// Ends a row, which must be full.
    pub(super) fn finish(self) {
        debug_assert_eq!(self.at, self.into.len());
    }
}

/// The properties of all places, `[places, FIXED]`.
pub(super) fn fixed(scene: &Places) -> Vec<f32> {
    let mut rows = vec![0.0; scene.places.len() * FIXED];
    for (place, row) in scene.places.iter().zip(rows.chunks_exact_mut(FIXED)) {
        let mut row = Row::new(row);
        let chain = &scene.chains[place.lane as usize];
        let lane = scene
            .map
            .lane(chain.id)
            .expect("places are of lanes of the map");
        let along = f64::from(place.along);
        for kind in [PlaceKind::OnLane, PlaceKind::Along, PlaceKind::Across] {
            row.mark(place.kind == kind);
        }
        let scene_from_world = scene.world_from_scene.inverse();
        let foot = scene_from_world * lane.centerline.pose_at(along);
        let beside = (foot.inverse() * place.pose.position).y;
        row.push(beside / 10.0);
        row.push(beside.abs() / 10.0);
        row.push((beside.abs() / (lane.width / 2.0).max(1.0)).min(4.0) - 1.0);
        row.mark(!place.is_open);
        row.push(f64::from(place.edge).clamp(-5.0, 5.0) / 5.0);
        row.push((-f64::from(place.edge).abs() / 1.5).exp());
        row.mark(lane.in_intersection);
        row.push(lane.width / 4.0 - 1.0);
        row.mark(!lane.left_neighbors.is_empty());
        row.mark(!lane.right_neighbors.is_empty());
        row.mark(lane.successors.len() > 1);
        row.mark(lane.successors.is_empty());
        row.mark(lane.predecessors.is_empty());
        row.push(lane.speed_limit.unwrap_or(UNKNOWN_LIMIT) / 10.0 - 1.0);
        let way = |metres: f64| lane.centerline.pose_at(metres).heading;
        let bend = angle_difference(way(along + BEND), way(along - BEND));
        row.push(bend.clamp(-1.0, 1.0));
        row.push(bend.abs().min(1.0));
        let ahead = |metres: f64| {
            if metres >= along {
                metres - along
            } else {
                f64::INFINITY
            }
        };
        row.distance(ahead(chain.junction));
        row.distance(ahead(chain.stop));
        row.distance(if lane.in_intersection {
            0.0
        } else {
            chain.behind + along
        });
        let light = chain.lights.iter().filter(|(at, _)| *at >= along);
        let light = light.min_by(|a, b| a.0.total_cmp(&b.0)).copied();
        row.distance(light.map_or(f64::INFINITY, |(at, _)| at - along));
        let shows = |state| light.is_some_and(|(_, shown)| shown == state);
        for state in [LightState::Red, LightState::Yellow, LightState::Green] {
            row.mark(shows(state));
        }
        let world = scene.world_from_scene * place.pose.position;
        row.mark(
            scene
                .map
                .areas_containing(world, AreaKind::Crosswalk)
                .next()
                .is_some(),
        );
        let local = place.pose.position;
        row.push(local.length() / 50.0);
        row.push(local.x / 50.0);
        row.push(local.y.abs() / 50.0);
        row.push(place.pose.heading.cos());
        row.push(place.pose.heading.sin().abs());
        row.mark(!scene.map.drivable().is_empty() && scene.map.road_edges().is_empty());
        row.finish();
    }
    rows
}

/// The properties of the vehicle itself.
pub(super) fn own(vehicle: &NewVehicle, into: &mut [f32]) {
    let mut row = Row::new(into);
    let speed = vehicle.velocity.length();
    row.mark(vehicle.stands());
    row.push(speed / 10.0);
    row.push((speed - 10.0).max(0.0) / 10.0);
    row.push(vehicle.length / 5.0 - 1.0);
    row.finish();
}
