//! Random traffic demand for SUMO runs.
//!
//! Traffic is drawn within a part of the network, so that it is dense where scenes are cut out,
//! whatever the size of the city.

use std::ops::RangeInclusive;

use gump_data::sumo::{Demand, Edge, EdgeFunction, Network, Trip, TripKind, VehicleType};
use gump_geometry::{DVec2, dvec2};
use gump_scene::{Rng, Seed};
use rand::Rng as _;

/// Amount of traffic.
#[derive(Clone, Debug, PartialEq)]
pub struct SumoDemand {
    /// Seconds in which trips begin.
    pub until_s: f64,
    /// Radius of the part of the network that has traffic, metres.
    pub radius_m: f64,
    /// Approximate number of vehicles on the road at a time.
    pub vehicles: RangeInclusive<usize>,
    /// Bicycles per vehicle.
    pub bicycles: f64,
    /// Pedestrians per vehicle.
    pub people: f64,
    /// Multiplies all numbers.
    pub density: f64,
    /// Whether vehicles have the headings of bodies that are steered at the front ([`crate::steer`]), or
    /// those of SUMO.
    pub steered: bool,
}

impl SumoDemand {
    /// Streets of a city by day; numbers chosen by hand.
    pub fn standard() -> Self {
        Self {
            until_s: 150.0,
            radius_m: 450.0,
            vehicles: 50..=220,
            bicycles: 0.08,
            people: 0.45,
            density: 1.0,
            steered: true,
        }
    }

    /// The configuration of a version of the generator, field by field: it does not change when
    /// [`Self::standard`] does. `None` for a version that does not exist.
    pub fn of_version(version: u32) -> Option<Self> {
        (1..=2).contains(&version).then_some(Self {
            until_s: 150.0,
            radius_m: 450.0,
            vehicles: 50..=220,
            bicycles: 0.08,
            people: 0.45,
            density: 1.0,
            steered: version > 1,
        })
    }
}

// These are chosen by hand.
/// Minimum metres of lane per vehicle: with more vehicles traffic jams.
const METRES_PER_VEHICLE: f64 = 45.0;
/// Share of the trips that begin in the first seconds, to fill empty streets.
const FIRST_SHARE: f64 = 0.5;
/// Those seconds.
const FIRST_S: f64 = 20.0;
/// About how long a vehicle stays on the road, seconds; as many arrive in that time as are there.
const STAY_S: f64 = 110.0;
/// Shortest way of a vehicle as the crow flies, metres.
const SHORTEST_DRIVE: f64 = 150.0;
/// Longest way of a person, metres.
const LONGEST_WALK: f64 = 350.0;

/// A kind of vehicle: class, shares, and the ranges that its types are drawn from.
struct Family {
    name: &'static str,
    class: &'static str,
    share: f64,
    types: usize,
    length: [f64; 2],
    width: [f64; 2],
    height: [f64; 2],
    max_speed: f64,
    speed_factor: [f64; 2],
    acceleration: [f64; 2],
}

/// Sizes are those of vehicles on sale; accelerations are comfortable ones, below SUMO's defaults
/// of 2.6 and 4.5, because recorded drivers are gentler. Shares are chosen by hand.
const FAMILIES: [Family; 5] = [
    Family {
        name: "car",
        class: "passenger",
        share: 0.84,
        types: 8,
        length: [3.7, 5.2],
        width: [1.7, 2.0],
        height: [1.4, 1.8],
        max_speed: 50.0,
        speed_factor: [0.98, 0.09],
        acceleration: [2.1, 3.2],
    },
    Family {
        name: "van",
        class: "delivery",
        share: 0.07,
        types: 2,
        length: [5.3, 6.8],
        width: [2.0, 2.2],
        height: [2.2, 2.8],
        max_speed: 40.0,
        speed_factor: [0.95, 0.07],
        acceleration: [1.8, 3.0],
    },
    Family {
        name: "truck",
        class: "truck",
        share: 0.05,
        types: 3,
        length: [7.5, 11.5],
        width: [2.4, 2.55],
        height: [3.0, 3.8],
        max_speed: 28.0,
        speed_factor: [0.88, 0.05],
        acceleration: [1.2, 2.8],
    },
    Family {
        name: "bus",
        class: "bus",
        share: 0.02,
        types: 1,
        length: [11.5, 12.3],
        width: [2.5, 2.55],
        height: [3.0, 3.2],
        max_speed: 25.0,
        speed_factor: [0.9, 0.05],
        acceleration: [1.2, 2.5],
    },
    Family {
        name: "motorcycle",
        class: "motorcycle",
        share: 0.02,
        types: 1,
        length: [2.0, 2.3],
        width: [0.75, 0.9],
        height: [1.4, 1.6],
        max_speed: 50.0,
        speed_factor: [1.05, 0.1],
        acceleration: [3.0, 4.0],
    },
];

/// Draws types and trips for a run on a network; the same seed gives the same ones.
pub fn draw_sumo_demand(network: &Network, config: &SumoDemand, seed: Seed) -> Demand {
    let mut rng = seed.rng();
    let mut demand = Demand::default();
    let motor = draw_types(&mut demand, &mut rng);
    let part = Part::draw(network, config.radius_m, &mut rng);
    let lanes = part.roads.iter().map(|road| road.lane_m).sum::<f64>();
    let wanted = rng.random_range(config.vehicles.clone()) as f64;
    let n = wanted.min(lanes / METRES_PER_VEHICLE) * config.density;
    let arrivals = n * (FIRST_SHARE + config.until_s / STAY_S);
    for _ in 0..arrivals.round() as usize {
        let family = pick(&mut rng, FAMILIES.iter().map(|family| family.share));
        let kind = motor[family][rng.random_range(0..motor[family].len())];
        demand.trips.extend(part.drive(kind, config, &mut rng));
    }
    let bicycle = demand.types.len() - 2;
    for _ in 0..(arrivals * config.bicycles).round() as usize {
        demand.trips.extend(part.drive(bicycle, config, &mut rng));
    }
    for _ in 0..(arrivals * config.people).round() as usize {
        demand
            .trips
            .extend(part.walk(bicycle + 1, config, &mut rng));
    }
    demand
}

/// Adds the types of every family, then bicycles and people; the types of each family.
fn draw_types(demand: &mut Demand, rng: &mut Rng) -> Vec<Vec<usize>> {
    let mut of_family = Vec::new();
    for family in &FAMILIES {
        let first = demand.types.len();
        for i in 0..family.types {
            let mut between = |[low, high]: [f64; 2]| rng.random_range(low..high);
            demand.types.push(VehicleType {
                id: format!("{}{i}", family.name),
                class: family.class,
                size: [
                    between(family.length),
                    between(family.width),
                    between(family.height),
                ],
                max_speed: family.max_speed,
                speed_factor: family.speed_factor,
                acceleration: family.acceleration,
            });
        }
        of_family.push((first..demand.types.len()).collect());
    }
    let slow = |id: &str, class, size, max_speed| VehicleType {
        id: id.into(),
        class,
        size,
        max_speed,
        speed_factor: [1.0, 0.1],
        acceleration: [1.2, 3.0],
    };
    demand
        .types
        .push(slow("bicycle", "bicycle", [1.8, 0.65, 1.75], 5.5));
    demand
        .types
        .push(slow("person", "pedestrian", [0.6, 0.65, 1.72], 1.6));
    of_family
}

/// The roads of the part that has traffic.
struct Part<'a> {
    roads: Vec<Road<'a>>,
    walks: Vec<Road<'a>>,
}

struct Road<'a> {
    edge: &'a Edge,
    middle: DVec2,
    lane_m: f64,
}

impl<'a> Part<'a> {
    fn draw(network: &'a Network, radius_m: f64, rng: &mut Rng) -> Self {
        let normal = || {
            network
                .edges
                .iter()
                .filter(|e| e.function == EdgeFunction::Normal)
        };
        let mut roads: Vec<Road<'_>> = normal()
            .filter_map(|edge| Road::of(edge, |lane| lane.access.cars))
            .collect();
        // Without walking areas people jump from one end of a junction to the other.
        let can_walk = network
            .edges
            .iter()
            .any(|e| e.function == EdgeFunction::WalkingArea);
        let mut walks: Vec<Road<'_>> = normal()
            .filter(|_| can_walk)
            .filter_map(|edge| Road::of(edge, |lane| lane.access.pedestrians))
            .collect();
        if !roads.is_empty() {
            let centre = roads[pick(rng, roads.iter().map(|road| road.lane_m))].middle;
            roads.retain(|road| road.middle.distance(centre) <= radius_m);
            walks.retain(|road| road.middle.distance(centre) <= radius_m);
        }
        Self { roads, walks }
    }

    fn drive(&self, kind: usize, config: &SumoDemand, rng: &mut Rng) -> Option<Trip> {
        let far = |a: DVec2, b: DVec2| a.distance(b) >= SHORTEST_DRIVE;
        trip(&self.roads, kind, TripKind::Wheels, far, config, rng)
    }

    fn walk(&self, kind: usize, config: &SumoDemand, rng: &mut Rng) -> Option<Trip> {
        let near = |a: DVec2, b: DVec2| a.distance(b) <= LONGEST_WALK;
        trip(&self.walks, kind, TripKind::Foot, near, config, rng)
    }
}

impl<'a> Road<'a> {
    fn of(edge: &'a Edge, wanted: impl Fn(&gump_data::sumo::NetworkLane) -> bool) -> Option<Self> {
        let lanes: Vec<_> = edge.lanes.iter().filter(|lane| wanted(lane)).collect();
        let shape = &lanes.first()?.shape;
        let [x, y, _] = shape[shape.len() / 2];
        Some(Self {
            edge,
            middle: dvec2(x, y),
            lane_m: lanes.iter().map(|lane| lane.length).sum(),
        })
    }
}

/// A trip between two roads that `suits`; `None` if a few draws find none.
fn trip(
    roads: &[Road<'_>],
    kind: usize,
    on: TripKind,
    suits: impl Fn(DVec2, DVec2) -> bool,
    config: &SumoDemand,
    rng: &mut Rng,
) -> Option<Trip> {
    let early = rng.random_bool(FIRST_SHARE / (FIRST_SHARE + config.until_s / STAY_S));
    let latest = if early { FIRST_S } else { config.until_s };
    let depart_s = rng.random_range(0.0..latest);
    for _ in 0..8 {
        let from = &roads.get(pick(rng, roads.iter().map(|road| road.lane_m)))?;
        let to = &roads[rng.random_range(0..roads.len())];
        if from.edge.id != to.edge.id && suits(from.middle, to.middle) {
            return Some(Trip {
                depart_s,
                from: from.edge.id.clone(),
                to: to.edge.id.clone(),
                kind,
                on,
            });
        }
    }
    None
}

/// An index drawn with these weights; 0 if there are none.
fn pick(rng: &mut Rng, weights: impl Iterator<Item = f64> + Clone) -> usize {
    let total: f64 = weights.clone().sum();
    let mut left = rng.random_range(0.0..1.0) * total;
    let mut last = 0;
    for (i, weight) in weights.enumerate() {
        last = i;
        if left < weight {
            break;
        }
        left -= weight;
    }
    last
}

#[cfg(test)]
mod tests {
    use super::*;

    fn network() -> Network {
        let path = concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/../gump-data/tests/sumo/small.net.xml.gz"
        );
        Network::read(std::path::Path::new(path)).unwrap()
    }

    #[test]
    fn the_same_seed_draws_the_same_trips_of_all_kinds() {
        let network = network();
        let draw = |seed| draw_sumo_demand(&network, &SumoDemand::standard(), Seed(seed));
        assert_eq!(draw(3), draw(3));
        assert_ne!(draw(3), draw(4));
        let demand = draw(3);
        let classes: std::collections::BTreeSet<_> = demand
            .trips
            .iter()
            .map(|trip| demand.types[trip.kind].class)
            .collect();
        for class in ["passenger", "bicycle", "pedestrian"] {
            assert!(classes.contains(class), "{class} in {classes:?}");
        }
        assert!(demand.trips.iter().all(|trip| trip.from != trip.to));
    }

    #[test]
    fn density_multiplies() {
        let network = network();
        let n = |density| {
            let config = SumoDemand {
                density,
                ..SumoDemand::standard()
            };
            draw_sumo_demand(&network, &config, Seed(1)).trips.len() as f64
        };
        assert!((n(0.5) / n(1.0) - 0.5).abs() < 0.1);
    }

    #[test]
    fn a_network_without_roads_has_no_trips() {
        let demand = draw_sumo_demand(&Network::default(), &SumoDemand::standard(), Seed(0));
        assert!(demand.trips.is_empty());
    }
}
