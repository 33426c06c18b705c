//! Right of way at junctions, and where waiting vehicles stop.
//!
//! A vehicle claims the connector it wants before it gets so near that it could no longer stop
//! comfortably. The claim is refused while another claim, a pedestrian on a crosswalk, a light, a
//! stop sign, traffic with priority or a full exit is in the way. Claims end when the rear is
//! clear.

use gump_scene::LightState;

use super::TrafficSimulation;
use super::people::Activity;
use super::vehicle::Vehicle;
use super::wait_inside::Wait;
use crate::network::{Conflict, Connector, Crossing, LaneIdx};
use crate::plan::Control;

// Clearances and the thresholds below are chosen by hand; tests check that boxes seldom overlap.
/// Metres behind the last conflict at which a claim ends.
const CLEAR: f64 = 1.0;
/// Metres that vehicles keep to the end of a yard or car park where they park.
const INNER_GAP: f64 = 0.5;
/// Metres of pavement beside a vehicle's way that must be free of people.
const PERSON_CLEARANCE: f64 = 0.9;
/// A faster vehicle in a junction is not about to stop, m/s.
const SURE: f64 = 2.0;
/// The speed that drivers expect of people, m/s.
const FAST_WALK: f64 = 1.7;

impl TrafficSimulation<'_> {
    /// Ends claims that are used up, then lets vehicles claim, those with priority first.
    pub(super) fn settle_claims(&mut self) {
        for i in 0..self.vehicles.len() {
            self.end_claims(i);
            self.note_waiting(i);
        }
        self.end_waits();
        let mut order: Vec<(u8, f64, usize, usize)> = Vec::new();
        for (i, vehicle) in self.vehicles.iter().enumerate() {
            let Some(leg) = vehicle.next_connector(self.network) else {
                continue;
            };
            let distance = vehicle.distance_to(self.network, leg);
            let lane = vehicle.path[leg];
            let rank = self.connector(lane).rank;
            if distance < self.decision_distance(vehicle) && !vehicle.claims.contains(&lane) {
                order.push((rank, distance, i, leg));
            }
        }
        order.sort_by(|a, b| b.0.cmp(&a.0).then(a.1.total_cmp(&b.1)).then(a.2.cmp(&b.2)));
        for (_, distance, i, leg) in order {
            let wait = match self.may_claim(i, leg, distance) {
                true => None,
                false => match self.place_to_wait(i, leg, distance) {
                    None => continue,
                    place => place,
                },
            };
            let lane = self.vehicles[i].path[leg];
            self.vehicles[i].claims.push(lane);
            self.vehicles[i].wait = wait;
            self.vehicles[i].waiting_since = None;
        }
    }

    /// Metres from the front to the line where vehicle `i` has to stop, if it has to.
    pub(super) fn distance_to_stop(&self, i: usize) -> Option<f64> {
        let vehicle = &self.vehicles[i];
        if let Some(wait) = vehicle.wait {
            let leg = vehicle.leg_on(wait.lane)?;
            return Some(vehicle.distance_to(self.network, leg) + wait.until);
        }
        let leg = vehicle.next_connector(self.network)?;
        if vehicle.claims.contains(&vehicle.path[leg]) {
            return None;
        }
        let distance = vehicle.distance_to(self.network, leg);
        let near = distance < self.decision_distance(vehicle);
        near.then_some(distance - vehicle.driver.line_gap)
    }

    /// Metres from the front to where vehicle `i` parks, if its way ends in a yard or car park that is
    /// watched.
    pub(super) fn distance_to_end(&self, i: usize) -> Option<f64> {
        let vehicle = &self.vehicles[i];
        let last = vehicle.path.len() - 1;
        let lane = vehicle.path[last];
        if !self.is_watched || !self.is_inner(lane) || !self.network.lanes[lane].is_exit {
            return None;
        }
        let end = vehicle.distance_to(self.network, last) + self.network.lanes[lane].length();
        let distance = end - INNER_GAP;
        (distance < self.decision_distance(vehicle)).then_some(distance)
    }

    pub(super) fn connector(&self, lane: LaneIdx) -> &Connector {
        self.network.lanes[lane]
            .connector
            .as_ref()
            .expect("only connectors are claimed")
    }

    /// Distance from a stop line at which a driver starts to react to it, metres.
    fn decision_distance(&self, vehicle: &Vehicle) -> f64 {
        vehicle.driver.wanted_gap(vehicle.speed, 0.0) + vehicle.driver.line_gap + 6.0
    }

    fn end_claims(&mut self, i: usize) {
        let (network, time) = (self.network, self.time);
        let vehicle = &self.vehicles[i];
        let keep = |lane: &LaneIdx| {
            let Some(rear) = vehicle.rear_on(network, *lane) else {
                return false;
            };
            let connector = self.connector(*lane);
            let distance = -(rear + vehicle.length());
            if distance > 0.0 {
                // Not yet over the line: a light that has changed may still stop it.
                let state = self.light(connector, time);
                let can_stop = self.can_stop(vehicle, distance);
                return state == LightState::Green || !can_stop;
            }
            let conflicts = connector.conflicts.iter().map(|conflict| conflict.mine.1);
            let crossings = connector.crossings.iter().map(|crossing| crossing.along.1);
            let last = conflicts.chain(crossings).fold(0.0, f64::max);
            rear <= last + CLEAR
        };
        let claims = vehicle.claims.iter().copied().filter(keep).collect();
        self.vehicles[i].claims = claims;
    }

    pub(super) fn can_stop(&self, vehicle: &Vehicle, distance: f64) -> bool {
        // Brakes do not bite at once.
        let left = distance - 0.3 - 0.3 * vehicle.speed;
        vehicle.speed * vehicle.speed < 2.0 * vehicle.driver.yellow_braking * left.max(0.01)
    }

    /// Records the time since which a vehicle has been stopped at its line.
    fn note_waiting(&mut self, i: usize) {
        let vehicle = &self.vehicles[i];
        let at_line = vehicle
            .next_connector(self.network)
            .is_some_and(|leg| vehicle.distance_to(self.network, leg) < 3.5);
        let stands = at_line && vehicle.speed < vehicle.driver.rolling_stop;
        if !at_line {
            self.vehicles[i].waiting_since = None;
        } else if stands && vehicle.waiting_since.is_none() {
            self.vehicles[i].waiting_since = Some(self.time);
        }
    }

    pub(super) fn light(&self, connector: &Connector, time: f64) -> LightState {
        let cycle = self.network.junctions[connector.junction].cycle.as_ref();
        match (cycle, connector.signal) {
            (Some(cycle), Some(group)) => cycle.state(group, time),
            _ => LightState::Green,
        }
    }

    fn may_claim(&self, i: usize, leg: usize, distance: f64) -> bool {
        let vehicle = &self.vehicles[i];
        let lane = vehicle.path[leg];
        let connector = self.connector(lane);
        let light = self.light(connector, self.time);
        // Late drivers react to yellow for a little longer than it lasts.
        let was = self.light(connector, self.time - vehicle.driver.late);
        let light = match (light, was) {
            (LightState::Red, LightState::Yellow) => LightState::Yellow,
            (light, _) => light,
        };
        let goes = match light {
            LightState::Green => true,
            LightState::Yellow => !self.can_stop(vehicle, distance),
            LightState::Red | LightState::Unknown => false,
        };
        goes && self.has_stopped(vehicle, connector)
            && self.is_first_in_line(vehicle, leg)
            && self.nobody_waits_on(vehicle, lane)
            && self.has_way(i, lane, connector, distance)
            && self.has_room_beyond(i, leg)
            && self.has_room_in_ring(i, leg)
    }

    /// True if it has stopped at its line, or need not.
    pub(super) fn has_stopped(&self, vehicle: &Vehicle, connector: &Connector) -> bool {
        match (connector.must_stop, vehicle.waiting_since) {
            (true, Some(since)) => self.time - since > vehicle.driver.pause,
            (true, None) => false,
            (false, _) => true,
        }
    }

    /// True if neither vehicles nor people are in the way on a connector, or go first there.
    pub(super) fn has_way(
        &self,
        i: usize,
        lane: LaneIdx,
        connector: &Connector,
        distance: f64,
    ) -> bool {
        self.is_unclaimed(i, lane, connector, distance)
            && self.has_priority(i, lane, connector, distance)
            && self.is_free_of_people(&self.vehicles[i], connector, distance)
    }

    /// True unless another vehicle from the same lane waits within the junction.
    pub(super) fn nobody_waits_on(&self, vehicle: &Vehicle, lane: LaneIdx) -> bool {
        let lanes = &self.network.lanes;
        self.vehicles.iter().all(|other| {
            let waits = |wait: Wait| lanes[wait.lane].predecessors == lanes[lane].predecessors;
            other.id == vehicle.id || !other.wait.is_some_and(waits)
        })
    }

    /// True unless entering a roundabout that is as full as can still flow.
    pub(super) fn has_room_in_ring(&self, i: usize, leg: usize) -> bool {
        let lanes = &self.network.lanes;
        let vehicle = &self.vehicles[i];
        let enters = vehicle
            .path
            .get(leg + 1)
            .is_some_and(|&lane| lanes[lane].in_ring)
            && !lanes[vehicle.lane()].in_ring;
        let on_it = |other: &&Vehicle| {
            lanes[other.lane()].in_ring
                || other.claims.iter().any(|&claim| {
                    lanes[claim]
                        .successors
                        .iter()
                        .any(|&next| lanes[next].in_ring)
                })
        };
        let capacity = lanes.iter().filter(|lane| lane.in_ring).count() / 2 + 1;
        !enters || self.vehicles.iter().filter(on_it).count() < capacity
    }

    /// True if all vehicles between the vehicle and the line have decided.
    pub(super) fn is_first_in_line(&self, vehicle: &Vehicle, leg: usize) -> bool {
        vehicle.path[vehicle.leg..leg]
            .iter()
            .enumerate()
            .all(|(n, &lane)| {
                self.occupancy.on(lane).iter().all(|entry| {
                    let ahead = n > 0 || entry.rear + entry.front > 2.0 * vehicle.s;
                    let other = &self.vehicles[entry.vehicle];
                    let undecided = other
                        .next_connector(self.network)
                        .is_some_and(|leg| !other.claims.contains(&other.path[leg]));
                    entry.id == vehicle.id || !ahead || !undecided
                })
            })
    }

    /// True if no claim conflicts with this connector.
    fn is_unclaimed(&self, i: usize, lane: LaneIdx, connector: &Connector, distance: f64) -> bool {
        let conflicts = connector.conflicts.iter();
        let mut others = conflicts.filter(|conflict| conflict.other != lane);
        others.all(|conflict| !self.is_taken(i, conflict, distance))
    }

    /// True if another vehicle has claimed what vehicle `i` would share with it, and is not out of it in time.
    pub(super) fn is_taken(&self, i: usize, conflict: &Conflict, distance: f64) -> bool {
        let vehicle = &self.vehicles[i];
        let takes = |other: &Vehicle| {
            let Some(rear) = other.rear_on(self.network, conflict.other) else {
                return false;
            };
            let waits = |wait: Wait| wait.lane == conflict.other && wait.until < conflict.theirs.0;
            if other.wait.is_some_and(waits) {
                return false;
            }
            let left = conflict.theirs.1 - rear;
            let leaves = |spare: f64| {
                let out = left / other.speed;
                let sure = other.speed > SURE && other.acceleration > -0.5;
                let way = distance + conflict.mine.0;
                sure && out + spare < vehicle.soonest(way)
            };
            left >= 0.0 && !vehicle.driver.behind_others.is_some_and(leaves)
        };
        let others = self.vehicles.iter().enumerate().filter(|(j, _)| *j != i);
        let mut claimants = others.filter(|(_, other)| other.claims.contains(&conflict.other));
        claimants.any(|(_, other)| takes(other))
    }

    /// True if no traffic that goes first comes too soon.
    fn has_priority(&self, i: usize, lane: LaneIdx, connector: &Connector, distance: f64) -> bool {
        let vehicle = &self.vehicles[i];
        let all_stop = self.network.junctions[connector.junction].control == Control::AllWayStop;
        let yields_to = |other: &Vehicle| {
            let Some(leg) = other.next_connector(self.network) else {
                return false;
            };
            let theirs = other.path[leg];
            let Some(conflict) = connector.conflicts.iter().find(|c| c.other == theirs) else {
                return false;
            };
            let their = self.connector(theirs);
            if all_stop {
                // First come, first served.
                return match (other.waiting_since, vehicle.waiting_since) {
                    (Some(they), Some(me)) => they < me || (they == me && other.id < vehicle.id),
                    _ => false,
                };
            }
            if their.rank <= connector.rank || self.light(their, self.time) == LightState::Red {
                return false;
            }
            let away = other.distance_to(self.network, leg) + conflict.theirs.0.max(0.0);
            let arrival = away / other.speed.max(1.0);
            // How long the own way to the far side of the conflict takes.
            let mine =
                (distance + conflict.mine.1 + vehicle.length()) / (0.5 * vehicle.speed + 4.0);
            other.speed > 1.0 && arrival < vehicle.driver.gap_time.max(mine + 1.0)
        };
        let others = self.vehicles.iter().enumerate().filter(|(j, _)| *j != i);
        let undecided = |other: &Vehicle| !other.claims.contains(&lane);
        !others
            .map(|(_, other)| other)
            .any(|other| undecided(other) && yields_to(other))
    }

    /// True if no pedestrian is on the crosswalks on the path, or waits there and is given way.
    fn is_free_of_people(&self, vehicle: &Vehicle, connector: &Connector, distance: f64) -> bool {
        let mut crossings = connector.crossings.iter();
        crossings.all(|crossing| self.is_crossing_free(vehicle, connector, crossing, distance))
    }

    /// The same for one of them.
    pub(super) fn is_crossing_free(
        &self,
        vehicle: &Vehicle,
        connector: &Connector,
        crossing: &Crossing,
        distance: f64,
    ) -> bool {
        let signalled = connector.signal.is_some();
        // Metres that people have to be away for the vehicle to pass before them.
        let passes = distance + crossing.along.1 + vehicle.length();
        let passed = passes / (0.5 * vehicle.speed + 4.0);
        let spare = vehicle.driver.before_people;
        let before = spare.map_or(f64::INFINITY, |spare| FAST_WALK * (passed + spare));
        let at = self.people.iter();
        let mut at = at.flat_map(|person| person.on_crosswalk(self.network, crossing.crosswalk));
        at.all(|at| match at.activity {
            Activity::Crosses { forward } => {
                let (low, high) = crossing.across;
                if forward {
                    at.last > high + PERSON_CLEARANCE || at.first < low - before
                } else {
                    at.last < low - PERSON_CLEARANCE || at.first > high + before
                }
            }
            Activity::Waits { may_go } => !(may_go && (signalled || vehicle.driver.is_polite)),
        })
    }

    /// True if the vehicle will not have to stop inside the junction.
    pub(super) fn has_room_beyond(&self, i: usize, leg: usize) -> bool {
        let vehicle = &self.vehicles[i];
        let Some(&exit) = vehicle.path.get(leg + 1) else {
            return true;
        };
        let slow = self
            .occupancy
            .on(exit)
            .iter()
            .filter(|entry| entry.speed < 3.0);
        let room = slow.map(|entry| entry.rear).fold(f64::INFINITY, f64::min);
        let under_way: f64 = self
            .vehicles
            .iter()
            .enumerate()
            .filter(|(j, other)| {
                let on_way = other
                    .claims
                    .iter()
                    .any(|&claim| self.network.lanes[claim].successors.contains(&exit));
                *j != i && on_way && !other.path[..=other.leg].contains(&exit)
            })
            .map(|(_, other)| other.length() + 2.5)
            .sum();
        room > under_way + vehicle.length() + 3.0
    }

    /// True if no vehicle with a claim is still to pass this crosswalk.
    pub(super) fn is_free_of_claims(&self, crosswalk: usize) -> bool {
        self.network.crosswalks[crosswalk]
            .passed_by
            .iter()
            .all(|&(lane, place)| {
                let (begins, past) = self.connector(lane).crossings[place].along;
                self.vehicles.iter().all(|vehicle| {
                    let waits = |wait: Wait| wait.lane == lane && wait.until < begins;
                    if vehicle.wait.is_some_and(waits) {
                        return true;
                    }
                    let claimed = vehicle.claims.contains(&lane);
                    let rear = vehicle.rear_on(self.network, lane);
                    let on_it =
                        rear.is_some_and(|rear| -vehicle.length() < rear && rear <= past + 0.5);
                    !(on_it || claimed && rear.is_some_and(|rear| rear <= past + 0.5))
                })
            })
    }
}
