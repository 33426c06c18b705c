//! A small microscopic traffic simulation on a [`Network`]: vehicles, bicycles and pedestrians.
//!
//! Vehicles follow lane centres by arc length, which determines their poses in the plane. Claims
//! decide who may enter a junction ([`right_of_way`]): a vehicle that has claimed a connector
//! shares no part of it with another claim, so boxes do not overlap.

mod beside;
mod crosser;
mod demand;
mod driver;
mod lane_change;
mod occupancy;
mod people;
mod right_of_way;
mod size;
mod vehicle;
mod wait_inside;

pub(crate) use crosser::{Jaywalk, Span};
pub(crate) use demand::{Demand, Scenery, Standing};
pub(crate) use people::draw_beside;
pub(crate) use size::{draw_person_size, draw_real_size};

use gump_geometry::{DVec2, Pose};
use gump_scene::{AgentKind, LightState, Rng};

use crate::network::{LaneIdx, Network};
use beside::Narrow;
use crosser::Crosser;
use driver::Leader;
use occupancy::Occupancy;
use people::Person;
use vehicle::{STANDS_MPS, Vehicle};

/// Size and pose of a body, in the scene's frame.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Body {
    /// Unique in the simulation.
    pub(crate) id: i64,
    pub(crate) kind: AgentKind,
    /// Length, width and height, metres.
    pub(crate) size: [f64; 3],
    /// Box centre and heading.
    pub(crate) pose: Pose,
    /// Moves in this simulation; parked vehicles do not.
    pub(crate) is_mobile: bool,
    /// Its own id, or that of the pedestrian it walks with: a group walks so close that boxes overlap.
    pub(crate) group: i64,
    /// Lane of the centre and arc length on it, for vehicles in traffic.
    pub(crate) place: Option<(LaneIdx, f64)>,
}

/// Traffic in progress.
#[derive(Debug)]
pub(crate) struct TrafficSimulation<'a> {
    network: &'a Network,
    demand: Demand,
    rng: Rng,
    dt: f64,
    time: f64,
    vehicles: Vec<Vehicle>,
    parked: Vec<Body>,
    /// Where parked vehicles stand partly in the lane, by lane; only in scenes like recorded ones.
    narrows: Vec<Vec<Narrow>>,
    people: Vec<Person>,
    occupancy: Occupancy,
    next_id: i64,
    /// People who cross the road away from crosswalks.
    crossers: Vec<Crosser>,
    /// Vehicles neither appear nor vanish at the ends of yards and car parks any more.
    is_watched: bool,
}

impl<'a> TrafficSimulation<'a> {
    /// Adds the initial vehicles and pedestrians to the network.
    pub(crate) fn new(network: &'a Network, demand: Demand, dt: f64, rng: Rng) -> Self {
        let mut traffic = Self {
            network,
            demand,
            rng,
            dt,
            time: 0.0,
            vehicles: Vec::new(),
            parked: Vec::new(),
            narrows: Vec::new(),
            people: Vec::new(),
            occupancy: Occupancy::new(network.lanes.len()),
            next_id: 0,
            crossers: Vec::new(),
            is_watched: false,
        };
        traffic.populate();
        traffic
    }

    /// Advances everything by one step.
    pub(crate) fn step(&mut self) {
        self.step_people();
        self.occupancy.fill(self.network, &self.vehicles);
        self.step_crossers();
        self.settle_claims();
        self.choose_lanes();
        for i in 0..self.vehicles.len() {
            self.vehicles[i].beside = self.beside(&self.vehicles[i]);
        }
        let accelerations: Vec<f64> = (0..self.vehicles.len())
            .map(|i| self.acceleration(i))
            .collect();
        for (vehicle, acceleration) in self.vehicles.iter_mut().zip(accelerations) {
            vehicle.advance(self.network, acceleration, self.dt, &mut self.rng);
        }
        let mut vehicles = std::mem::take(&mut self.vehicles);
        vehicles.retain(|vehicle| {
            let parks = self.is_watched && self.is_inner(vehicle.lane());
            parks || !vehicle.has_left(self.network)
        });
        self.vehicles = vehicles;
        self.time += self.dt;
        self.replenish();
    }

    /// Everything that has a body now.
    pub(crate) fn bodies(&self) -> Vec<Body> {
        let vehicles = self
            .vehicles
            .iter()
            .map(|vehicle| vehicle.body(self.network));
        let people = self.people.iter().map(Person::body);
        let companions = self.people.iter().flat_map(Person::companions);
        let crossers = self.crossers.iter().map(Crosser::body);
        vehicles
            .chain(people)
            .chain(companions)
            .chain(crossers)
            .chain(self.parked.iter().copied())
            .collect()
    }

    /// The lights now: connector, colour and where vehicles stop for it.
    pub(crate) fn lights(&self) -> Vec<(LaneIdx, LightState, DVec2)> {
        let controlled = self
            .network
            .lanes
            .iter()
            .enumerate()
            .filter_map(|(i, lane)| {
                let connector = lane.connector.as_ref()?;
                let cycle = self.network.junctions[connector.junction].cycle.as_ref()?;
                let state = cycle.state(connector.signal?, self.time);
                Some((i, state, lane.track.pose_at(0.0).position))
            });
        controlled.collect()
    }

    /// The lanes a vehicle still has to drive, the present one first, and its id's path.
    pub(crate) fn remaining_path(&self, id: i64) -> Option<Vec<LaneIdx>> {
        let vehicle = self.vehicles.iter().find(|vehicle| vehicle.id == id)?;
        Some(vehicle.path[vehicle.leg..].to_vec())
    }

    fn acceleration(&mut self, i: usize) -> f64 {
        let vehicle = &self.vehicles[i];
        if vehicle.is_held || self.time < vehicle.starts {
            return -1.0;
        }
        let ahead = self.occupancy.leader(self.network, vehicle);
        let ahead = ahead.map(|leader| match leader.speed < STANDS_MPS {
            true => Leader {
                gap: leader.gap - vehicle.short(),
                ..leader
            },
            false => leader,
        });
        let stop = self.distance_to_stop(i).map(|left| left - vehicle.short());
        let stop = stop.or_else(|| self.distance_to_end(i));
        let speed = vehicle.allowed_speed(self.network);
        vehicle
            .driver
            .acceleration(vehicle.speed, speed, ahead, stop)
            + vehicle.noise()
    }
}
