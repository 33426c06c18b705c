//! Numbers of agents, where they enter and where they go.

use gump_geometry::{Pose, wrap_angle};
use gump_scene::AgentKind;
use rand::Rng as _;

use super::crosser::{Crosser, Jaywalk};
use super::driver::DriverParameters;
use super::people::{Person, draw_beside};
use super::size::{draw_bicycle_size, draw_person_size, draw_real_size, draw_size};
use super::vehicle::Vehicle;
use super::{Body, TrafficSimulation};
use crate::network::{LaneIdx, Turn};
use crate::plan::CAR_PARK_SPEED;

/// Longest path that is planned, in lanes: an end for ways around a circle or a block.
const LONGEST_PATH: usize = 40;
/// Sideways metres that a long vehicle may sweep beside its centre line. Chosen by eye.
const SWEEP: f64 = 0.55;
/// Vehicles of scenes like recorded ones enter at this share of the speed that they may drive, at least.
const ENTERS_AT: f64 = 0.9;

/// Numbers of agents in a scene.
#[derive(Clone, Debug)]
pub(crate) struct Demand {
    /// Vehicles in motion (or in a queue).
    pub(crate) moving: usize,
    /// Parked vehicles, if there is where to park.
    pub(crate) parked: usize,
    /// People on foot.
    pub(crate) people: usize,
    pub(crate) bicycles: usize,
    /// Vehicles that want to enter, per second and entry lane.
    pub(crate) arrivals: f64,
    /// Additional content of scenes with the statistics of recorded ones.
    pub(crate) scenery: Scenery,
}

/// Additional content of scenes with the statistics of recorded ones.
#[derive(Clone, Debug, Default)]
pub(crate) struct Scenery {
    /// All driving styles, and realistic sizes of vehicles.
    pub(crate) is_real: bool,
    /// Parked vehicles and standing pedestrians.
    pub(crate) standing: Vec<Standing>,
    /// Vehicles that have stopped in their lane: the lane and the arc length of their centre.
    pub(crate) held: Vec<(LaneIdx, f64)>,
    /// Ways across the road away from crosswalks.
    pub(crate) jaywalks: Vec<Jaywalk>,
    /// Pedestrians that use them: the index of the way, and the second of the simulation at which
    /// they start.
    pub(crate) crossers: Vec<(usize, f64, f64)>,
}

/// A body that stays in place.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Standing {
    pub(crate) kind: AgentKind,
    /// Length, width and height, metres.
    pub(crate) size: [f64; 3],
    /// Box centre and heading, in the scene's frame.
    pub(crate) pose: Pose,
}

/// Weight of a turn into a yard or car park relative to one into another road, in plain scenes and in
/// those like recorded ones. Chosen by hand: about as many vehicles leave the road as in recordings
/// (docs/results/0025-where-realism-is-lost.md).
const INTO_YARDS: [f64; 2] = [0.5, 0.3];
/// The same for turns into slower roads in scenes like recorded ones: the square of how much slower,
/// and at least this. Chosen by hand: most of the traffic of wide roads stays on them.
const LEAST_TURNS: f64 = 0.15;
/// Cyclists of scenes like recorded ones ride at most this far from the lane's centre, metres: in wide
/// lanes vehicles park beside them.
const BICYCLE_ASIDE: f64 = 1.35;
/// From this limit on a lane of a scene like a recorded one is fully used, m/s. Fitted by hand:
/// recorded traffic drives faster than a plain draw of lanes.
const FAST_LANE: f64 = 16.0;
/// A lane of a freeway belongs to a ramp if another lane has a limit this many times as high; its use is
/// multiplied by the second number. Fitted by hand: vehicles here stop before they merge, and hold the
/// freeway up (result 51).
const RAMP: f64 = 1.1;
const ON_RAMPS: f64 = 0.06;

impl TrafficSimulation<'_> {
    /// Fills the network once, before the first step.
    pub(super) fn populate(&mut self) {
        if self.demand.scenery.is_real {
            self.set_scenery();
        } else {
            self.park();
        }
        for _ in 0..self.demand.people {
            self.add_person(None);
        }
        let lanes: Vec<LaneIdx> = (0..self.network.lanes.len())
            .filter(|&lane| self.network.lanes[lane].connector.is_none())
            .filter(|&lane| self.network.lanes[lane].length() > 20.0)
            .collect();
        if lanes.is_empty() {
            return;
        }
        let tries = if self.demand.scenery.is_real { 10 } else { 4 };
        for _ in 0..tries * self.demand.moving {
            if self.count(AgentKind::Vehicle) >= self.demand.moving {
                break;
            }
            let lane = lanes[self.rng.random_range(0..lanes.len())];
            if !self.is_used(lane) {
                continue;
            }
            let length = self.network.lanes[lane].length();
            let s = self.rng.random_range(6.0..length - 6.0);
            self.try_add(AgentKind::Vehicle, lane, s);
        }
        for _ in 0..4 * self.demand.bicycles {
            if self.count(AgentKind::Bicycle) >= self.demand.bicycles {
                break;
            }
            let lane = lanes[self.rng.random_range(0..lanes.len())];
            let length = self.network.lanes[lane].length();
            let s = self.rng.random_range(4.0..length - 4.0);
            self.try_add(AgentKind::Bicycle, lane, s);
        }
    }

    /// Adds static bodies, and the pedestrians at the curbs from which they will cross.
    fn set_scenery(&mut self) {
        for body in std::mem::take(&mut self.demand.scenery.standing) {
            let id = self.new_id();
            self.parked.push(Body {
                id,
                group: id,
                kind: body.kind,
                size: body.size,
                pose: body.pose,
                is_mobile: false,
                place: None,
            });
        }
        self.narrows = super::beside::narrows(self.network, &self.parked);
        for (lane, s) in std::mem::take(&mut self.demand.scenery.held) {
            let size = draw_real_size(&mut self.rng);
            let size = [size[0].min(9.0), size[1], size[2]];
            let driver = DriverParameters::of_any_temper(&mut self.rng);
            let path = self.plan_path(lane, size[0]);
            let id = self.new_id();
            let held = (AgentKind::Vehicle, size, driver);
            let mut vehicle = Vehicle::new(id, held, path, s, 0.0, &mut self.rng);
            // Towards the curb, as far as the lane allows.
            let aside = self.network.lanes[lane].width / 2.0 - size[1] / 2.0 - 0.1;
            vehicle.settle(-aside.max(0.0));
            vehicle.is_held = true;
            self.vehicles.push(vehicle);
        }
        for (jaywalk, pace, sets_off) in std::mem::take(&mut self.demand.scenery.crossers) {
            let id = self.new_id();
            let size = draw_person_size(&mut self.rng);
            let way = (jaywalk, &self.demand.scenery.jaywalks[jaywalk]);
            let first = Crosser::new(id, size, way, pace, sets_off);
            let aside = draw_beside(&mut self.rng);
            if self.rng.random_bool(0.4) {
                let id = self.new_id();
                let size = draw_person_size(&mut self.rng);
                self.crossers.push(first.companion(id, size, aside));
            }
            self.crossers.push(first);
        }
    }

    fn new_id(&mut self) -> i64 {
        self.next_id += 1;
        self.next_id - 1
    }

    /// Adds new agents at the border.
    pub(super) fn replenish(&mut self) {
        let entries = (0..self.network.lanes.len()).filter(|&l| self.network.lanes[l].is_entry);
        let entries = entries.filter(|&lane| !self.is_watched || !self.is_inner(lane));
        for lane in entries.collect::<Vec<_>>() {
            let arrives = self
                .rng
                .random_bool((self.demand.arrivals * self.dt).min(1.0));
            if !arrives || !self.is_used(lane) {
                continue;
            }
            let bicycles = self.count(AgentKind::Bicycle) < self.demand.bicycles;
            if bicycles && self.rng.random_bool(0.3) {
                self.try_add(AgentKind::Bicycle, lane, 1.5);
            } else if self.count(AgentKind::Vehicle) < self.demand.moving {
                self.try_add(AgentKind::Vehicle, lane, 3.0);
            }
        }
        if self.people.len() < self.demand.people && self.rng.random_bool(0.5 * self.dt) {
            self.add_person(Some(()));
        }
    }

    /// True for lanes of yards and car parks in scenes like recorded ones, whose ends are in view.
    pub(super) fn is_inner(&self, lane: LaneIdx) -> bool {
        self.demand.scenery.is_real && self.network.lanes[lane].speed_limit < CAR_PARK_SPEED
    }

    /// Prepares for the next `n_steps` steps, which are seen: nobody appears or vanishes at the ends of
    /// yards and car parks. Vehicles that would have come from there stand there until they set off,
    /// and those that get there park.
    pub(crate) fn watch(&mut self, n_steps: usize) {
        if !self.demand.scenery.is_real {
            return;
        }
        self.is_watched = true;
        let can_park = |i: usize| {
            let vehicle = &self.vehicles[i];
            let distance = self.distance_to_end(i).unwrap_or(f64::INFINITY);
            distance > vehicle.speed * vehicle.speed / (2.0 * vehicle.driver.braking)
        };
        let mut parks = (0..self.vehicles.len())
            .map(can_park)
            .collect::<Vec<_>>()
            .into_iter();
        self.vehicles.retain(|_| parks.next() == Some(true));
        let seconds = n_steps as f64 * self.dt;
        let lanes = (0..self.network.lanes.len())
            .filter(|&lane| self.network.lanes[lane].is_entry && self.is_inner(lane));
        for lane in lanes.collect::<Vec<_>>() {
            let arrives = self
                .rng
                .random_bool((self.demand.arrivals * seconds).min(1.0));
            let n = self.vehicles.len();
            if arrives && self.is_used(lane) && self.count(AgentKind::Vehicle) < self.demand.moving
            {
                self.try_add(AgentKind::Vehicle, lane, 3.0);
            }
            if let Some(vehicle) = self.vehicles.get_mut(n) {
                vehicle.speed = 0.0;
                vehicle.starts = self.time + self.rng.random_range(0.0..seconds);
            }
        }
    }

    /// Random: faster lanes are used more; uniform in plain scenes.
    fn is_used(&mut self, lane: LaneIdx) -> bool {
        if !self.demand.scenery.is_real {
            return true;
        }
        let lanes = &self.network.lanes;
        let is_freeway = lanes[lane].kind == gump_scene::LaneKind::Freeway;
        let limit = lanes[lane].speed_limit;
        let is_ramp = is_freeway && lanes.iter().any(|other| other.speed_limit > RAMP * limit);
        let share = (limit / FAST_LANE).powi(3).clamp(0.08, 1.0);
        self.rng
            .random_bool(if is_ramp { ON_RAMPS * share } else { share })
    }

    fn count(&self, kind: AgentKind) -> usize {
        self.vehicles
            .iter()
            .filter(|vehicle| vehicle.kind == kind)
            .count()
    }

    /// Adds a vehicle or bicycle at arc length `s` of a lane if it fits there.
    fn try_add(&mut self, kind: AgentKind, lane: LaneIdx, s: f64) {
        let network = self.network;
        let l = &network.lanes[lane];
        let suits = match kind {
            AgentKind::Bicycle => {
                l.is_bike_lane() || l.right.is_none() && !self.has_bike_lane(lane)
            }
            _ => !l.is_bike_lane() && !l.is_dead_end(),
        };
        let freeway = l.kind == gump_scene::LaneKind::Freeway;
        if !suits || freeway && kind == AgentKind::Bicycle {
            return;
        }
        let (size, driver) = self.draw_vehicle(kind);
        let path = self.plan_path(lane, size[0]);
        let sweep = |&lane: &LaneIdx| {
            let sharpest = network.lanes[lane]
                .connector
                .as_ref()
                .map_or(0.0, |c| c.sharpest);
            size[0] * size[0] / 8.0 * sharpest
        };
        // Long vehicles neither turn sharply nor change lanes.
        let ends_dead = path
            .last()
            .is_some_and(|&lane| network.lanes[lane].is_dead_end());
        if size[0] > 7.0 && (ends_dead || path.iter().any(|lane| sweep(lane) > SWEEP)) {
            return;
        }
        let s = s.max(size[0] / 2.0);
        let id = self.next_id;
        let mut vehicle = Vehicle::new(id, (kind, size, driver), path, s, 0.0, &mut self.rng);
        let to_line = (l.length() - vehicle.front()).max(0.0);
        let is_real = self.demand.scenery.is_real;
        // Nobody has to stop where a lane of a freeway goes on.
        let goes_on = is_real && freeway && !l.successors.is_empty();
        let stops = match goes_on {
            true => f64::INFINITY,
            false => (2.0 * 1.2 * to_line).sqrt(),
        };
        let speed = vehicle.allowed_speed(network).min(stops);
        // Queries need an up-to-date picture; newcomers are few.
        self.occupancy.fill(network, &self.vehicles);
        let slowest = if is_real { ENTERS_AT } else { 0.8 };
        let mut speed = speed * self.rng.random_range(slowest..1.0);
        for entry in self.occupancy.on(lane) {
            let gap_ahead = entry.rear - vehicle.front();
            let gap_behind = s - size[0] / 2.0 - entry.front;
            let beyond = (entry.front + entry.rear) / 2.0 > s;
            if beyond {
                speed = speed.min(entry.speed + 0.4 * gap_ahead.max(0.0));
            }
            let follower = self.vehicles[entry.vehicle]
                .driver
                .wanted_gap(entry.speed, speed);
            if beyond && gap_ahead < 4.0 + 0.8 * entry.speed
                || !beyond && gap_behind < follower.max(4.0)
            {
                return;
            }
        }
        vehicle.speed = speed;
        if kind == AgentKind::Bicycle && !l.is_bike_lane() {
            let most = match self.demand.scenery.is_real {
                true => BICYCLE_ASIDE,
                false => f64::INFINITY,
            };
            vehicle.settle(-(l.width / 2.0 - 0.55).min(most));
        }
        if is_real && kind == AgentKind::Vehicle {
            // Hardly anybody drives in the very middle of the lane.
            let room = (l.width / 2.0 - vehicle.width() / 2.0 - 0.1).clamp(0.0, 0.8);
            let part: f64 = self.rng.random_range(-1.0..1.0);
            vehicle.settle(part * room);
        }
        vehicle.beside = self.beside(&vehicle);
        vehicle.lateral += vehicle.beside.aside;
        vehicle.speed = vehicle.speed.min(vehicle.beside.speed);
        self.next_id += 1;
        self.vehicles.push(vehicle);
    }

    /// True if the road of this lane has a separate lane for bicycles.
    fn has_bike_lane(&self, lane: LaneIdx) -> bool {
        let start = self.network.lanes[lane].track.pose_at(0.0);
        self.network.lanes.iter().any(|other| {
            let local = start.inverse() * other.track.points()[0];
            other.is_bike_lane()
                && other.connector.is_none()
                && local.x.abs() < 1.0
                && local.y.abs() < 14.0
        })
    }

    fn draw_vehicle(&mut self, kind: AgentKind) -> ([f64; 3], DriverParameters) {
        let rng = &mut self.rng;
        if kind == AgentKind::Bicycle {
            let size = [
                rng.random_range(1.6..1.95),
                rng.random_range(0.55..0.8),
                rng.random_range(1.6..1.9),
            ];
            if self.demand.scenery.is_real {
                let size = draw_bicycle_size(rng);
                let top_speed = rng.random_range(3.2..8.0);
                let driver = DriverParameters::of_bicycle(rng);
                return (
                    size,
                    DriverParameters {
                        top_speed,
                        ..driver
                    },
                );
            }
            return (size, DriverParameters::of_bicycle(rng));
        }
        let is_real = self.demand.scenery.is_real;
        let size = if is_real {
            draw_real_size(rng)
        } else {
            draw_size(rng)
        };
        let driver = if size[0] > 7.0 {
            DriverParameters::of_heavy_vehicle(rng)
        } else if is_real {
            DriverParameters::of_any_temper(rng)
        } else {
            DriverParameters::of_car(rng)
        };
        (size, driver)
    }

    /// A random way from a lane to the border of the scene.
    pub(super) fn plan_path(&mut self, lane: LaneIdx, length: f64) -> Vec<LaneIdx> {
        let lanes = &self.network.lanes;
        let mut path = vec![lane];
        while path.len() < LONGEST_PATH {
            let here = &lanes[path[path.len() - 1]];
            let weight = |&next: &LaneIdx| {
                let Some(connector) = &lanes[next].connector else {
                    return 1.0;
                };
                let fits = length * length / 8.0 * connector.sharpest < SWEEP || length < 7.0;
                let turn = match connector.turn {
                    Turn::Straight => 0.55,
                    Turn::Right => 0.25,
                    Turn::Left => 0.25,
                };
                let beyond = lanes[next].successors.first();
                let limit = beyond.map_or(here.speed_limit, |&beyond| lanes[beyond].speed_limit);
                let is_real = self.demand.scenery.is_real;
                let turn = match limit < CAR_PARK_SPEED {
                    true => turn * INTO_YARDS[usize::from(is_real)],
                    false if is_real => {
                        turn * (limit / here.speed_limit).powi(2).clamp(LEAST_TURNS, 1.0)
                    }
                    false => turn,
                };
                if fits { turn } else { 1e-6 }
            };
            let total: f64 = here.successors.iter().map(weight).sum();
            if total <= 0.0 {
                break;
            }
            let mut draw = self.rng.random_range(0.0..total);
            let mut chosen = here.successors[0];
            for next in &here.successors {
                chosen = *next;
                draw -= weight(next);
                if draw < 0.0 {
                    break;
                }
            }
            path.push(chosen);
        }
        path
    }

    fn add_person(&mut self, at_border: Option<()>) {
        let walks: Vec<usize> = (0..self.network.walks.len())
            .filter(|&walk| self.network.walks[walk].crosswalk.is_none())
            .collect();
        if walks.is_empty() {
            return;
        }
        let (walk, forward, progress) = if at_border.is_some() {
            let outer = self.border_walks(&walks);
            if outer.is_empty() {
                return;
            }
            let (walk, forward) = outer[self.rng.random_range(0..outer.len())];
            (walk, forward, 0.0)
        } else {
            let mut walk = walks[self.rng.random_range(0..walks.len())];
            let mut forward = self.rng.random_bool(0.5);
            for _ in 0..12 {
                // People far from the centre are not visible, and most are where roads are crossed.
                let track = &self.network.walks[walk].track;
                let near = track.pose_at(track.length() / 2.0).position.length() < 75.0;
                let suits = near && self.leads_across(walk, forward);
                if suits || !self.demand.scenery.is_real {
                    break;
                }
                walk = walks[self.rng.random_range(0..walks.len())];
                forward = self.rng.random_bool(0.5);
            }
            let length = self.network.walks[walk].track.length();
            let progress = self.rng.random_range(0.0..length);
            if self.demand.scenery.is_real {
                // More people are near the corners: they come there when the scene is warm.
                let left = self.rng.random_range(10.0..40.0_f64).min(length);
                (walk, forward, progress.max(length - left))
            } else {
                (walk, forward, progress)
            }
        };
        let id = self.next_id;
        self.next_id += 1;
        let mut person = Person::new(id, self.network, (walk, forward, progress), &mut self.rng);
        if self.demand.scenery.is_real {
            // Some pedestrians have company.
            let n = [0, 0, 0, 0, 0, 0, 1, 1, 1, 3][self.rng.random_range(0..10)];
            person.accompany(self.next_id, n, &mut self.rng);
            self.next_id += n as i64;
        }
        self.people.push(person);
    }

    /// True if a walk leads to a crosswalk.
    fn leads_across(&self, walk: usize, forward: bool) -> bool {
        let end = self.network.walks[walk].ends[usize::from(forward)];
        let mut walks = self.network.walks.iter();
        walks.any(|other| other.crosswalk.is_some() && other.ends.contains(&end))
    }

    /// Walks with an end that no other walk has, entered there.
    fn border_walks(&self, walks: &[usize]) -> Vec<(usize, bool)> {
        let mut ends = vec![0; self.network.n_walk_nodes];
        for end in self.network.walks.iter().flat_map(|walk| walk.ends) {
            ends[end] += 1;
        }
        let both = |&walk: &usize| [(walk, true), (walk, false)];
        walks
            .iter()
            .flat_map(both)
            .filter(|&(walk, forward)| {
                ends[self.network.walks[walk].ends[usize::from(!forward)]] == 1
            })
            .collect()
    }

    /// Parks vehicles along the curbs and in the lots, in some of the places.
    fn park(&mut self) {
        let fill = self.rng.random_range(0.25..0.95);
        let mut places = Vec::new();
        for strip in &self.network.parking {
            let mut s = 10.0;
            while s < strip.length() - 12.0 {
                if self.rng.random_bool(fill) {
                    places.push(strip.pose_at(s));
                }
                s += self.rng.random_range(6.3..7.2);
            }
        }
        for &place in &self.network.lot_places {
            if self.rng.random_bool(fill) {
                places.push(place);
            }
        }
        while places.len() > self.demand.parked {
            let drop = self.rng.random_range(0..places.len());
            places.swap_remove(drop);
        }
        for place in places {
            let mut size = draw_size(&mut self.rng);
            size[0] = size[0].min(5.6);
            size[1] = size[1].min(2.05);
            let local = Pose::new(
                self.rng.random_range(-0.15..0.15),
                self.rng.random_range(-0.15..0.05),
                self.rng.random_range(-0.025..0.025),
            );
            let pose = place * local;
            let pose = Pose {
                heading: wrap_angle(pose.heading),
                ..pose
            };
            let id = self.next_id;
            self.next_id += 1;
            self.parked.push(Body {
                id,
                group: id,
                kind: AgentKind::Vehicle,
                size,
                pose,
                is_mobile: false,
                place: None,
            });
        }
    }
}
