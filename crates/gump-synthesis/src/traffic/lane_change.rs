//! Lane changes, and moving over for a bicycle.

use gump_scene::AgentKind;
use rand::Rng as _;

use super::TrafficSimulation;
use super::driver::Leader;
use super::vehicle::{LaneChange, Vehicle};
use crate::network::LaneIdx;

/// Shortest lane that is left after a change, metres, and how long a change takes that need not be
/// made: seconds, and more of them per second of headway, and metres at most. In plain scenes, and in
/// those like recorded ones, where minor roads cut lanes into short pieces. Chosen by hand; recorded
/// vehicles at over 7 m/s move from a tenth of a lane to nine tenths in 4.1 s (median of nine).
const ROOM_AFTER: [f64; 2] = [40.0, 12.0];
const TAKES_S: [(f64, f64); 2] = [(3.4, 0.8), (5.1, 1.6)];
const LONGEST_M: [f64; 2] = [70.0, 130.0];
/// Deceleration that a change may impose on the vehicle behind, m/s²: a comfortable one. Chosen by
/// hand.
const IMPOSED_BRAKING: f64 = 2.0;
/// Acceleration that a change must gain, m/s²: in plain scenes, and in those like recorded ones, below and
/// above [`FAST_MPS`]. Chosen by hand: recorded vehicles change lanes more often than plain ones
/// (docs/results/0020-learning-from-realism.md), but less often where they are fast (result 52).
const GAIN: [f64; 3] = [0.25, 0.05, 0.25];
/// Probability of a lane change without gain when a vehicle considers one; as above.
const WHIM: [f64; 3] = [0.04, 0.7, 0.1];
const FAST_MPS: f64 = 13.0;

impl TrafficSimulation<'_> {
    /// Starts lane changes and moves over for bicycles.
    pub(super) fn choose_lanes(&mut self) {
        for i in 0..self.vehicles.len() {
            self.evade_bicycle(i);
            let vehicle = &self.vehicles[i];
            let lane = &self.network.lanes[vehicle.lane()];
            let fits = vehicle.kind == AgentKind::Vehicle && vehicle.length() < 7.0;
            let must = lane.is_dead_end();
            if !fits || vehicle.change.is_some() || !(must || vehicle.patience < 0.0) {
                continue;
            }
            if !must && lane.left.is_none() && lane.right.is_none() {
                continue;
            }
            let whim = WHIM[self.kind_of(vehicle)];
            let whim = !must && self.rng.random_bool(whim);
            let patience = self.rng.random_range(1.0..3.0);
            let vehicle = &self.vehicles[i];
            let sides = [lane.left, lane.right];
            let target = sides
                .into_iter()
                .flatten()
                .find(|&to| self.wants(vehicle, to, must, whim));
            match target {
                Some(to) => self.start_change(i, to),
                None if !must => self.vehicles[i].patience = patience,
                None => {}
            }
        }
    }

    /// True if changing to lane `to` is allowed, safe and worth while.
    fn wants(&self, vehicle: &Vehicle, to: LaneIdx, must: bool, whim: bool) -> bool {
        let (from, target) = (&self.network.lanes[vehicle.lane()], &self.network.lanes[to]);
        let length = self.change_length(vehicle, must);
        let left = from.length() - vehicle.s;
        let ends = !target.is_exit && !must;
        if target.is_bike_lane()
            || target.is_dead_end()
            || vehicle.speed < 3.0 && !must
            || vehicle.s < vehicle.length() + 2.0
            || ends && left < length + ROOM_AFTER[self.is_real()]
            || !vehicle.claims.is_empty() && !must
            || must && left < 0.7 * length
        {
            return false;
        }
        let s = target.track.project(vehicle.pose(self.network).position);
        let (mut ahead, mut behind_ok) = (None::<Leader>, true);
        for entry in self.occupancy.on(to) {
            if (entry.front + entry.rear) / 2.0 > s {
                let gap = entry.rear - s - vehicle.length() / 2.0;
                if ahead.is_none_or(|leader| gap < leader.gap) {
                    ahead = Some(Leader {
                        gap,
                        speed: entry.speed,
                    });
                }
            } else {
                let gap = s - vehicle.length() / 2.0 - entry.front;
                let follower = &self.vehicles[entry.vehicle];
                let me = Leader {
                    gap,
                    speed: vehicle.speed,
                };
                let imposed = follower
                    .driver
                    .acceleration(follower.speed, 50.0, Some(me), None);
                behind_ok &= gap > 2.5 + 0.25 * entry.speed && imposed > -IMPOSED_BRAKING;
            }
        }
        let speed = vehicle.allowed_speed(self.network);
        let driver = &vehicle.driver;
        let then = driver.acceleration(vehicle.speed, speed, ahead, None);
        let room = ahead.is_none_or(|leader| leader.gap > 3.0 + 0.3 * vehicle.speed);
        if !(behind_ok && room && then > -IMPOSED_BRAKING) {
            return false;
        }
        let now = self.occupancy.leader(self.network, vehicle);
        must || whim
            || then
                > driver.acceleration(vehicle.speed, speed, now, None) + GAIN[self.kind_of(vehicle)]
    }

    /// 1 in scenes like recorded ones, 0 in plain ones.
    fn is_real(&self) -> usize {
        usize::from(self.demand.scenery.is_real)
    }

    /// 2 for fast vehicles in scenes like recorded ones, 1 for others there, 0 in plain ones.
    fn kind_of(&self, vehicle: &Vehicle) -> usize {
        self.is_real() * (1 + usize::from(vehicle.speed > FAST_MPS))
    }

    fn change_length(&self, vehicle: &Vehicle, must: bool) -> f64 {
        let seconds = if must {
            3.2
        } else {
            let (least, per_headway) = TAKES_S[self.is_real()];
            least + per_headway * vehicle.driver.headway
        };
        (vehicle.speed.max(6.0) * seconds).min(LONGEST_M[self.is_real()])
    }

    fn start_change(&mut self, i: usize, to: LaneIdx) {
        let network = self.network;
        let vehicle = &self.vehicles[i];
        let from = vehicle.lane();
        let must = network.lanes[from].is_dead_end();
        let length = self.change_length(vehicle, must);
        let on_old = network.lanes[from].track.pose_at(vehicle.s);
        let target = &network.lanes[to].track;
        let s = target.project(on_old.position);
        let offset = (target.pose_at(s).inverse() * on_old.position).y;
        let mut path = self.plan_path(to, vehicle.length());
        let vehicle = &mut self.vehicles[i];
        vehicle.change = Some(LaneChange {
            from,
            arc_shift: vehicle.s - s,
            offset,
            driven: 0.0,
            length,
        });
        // Lanes behind stay known: the rear may still be on them.
        let behind = vehicle.path[..vehicle.leg].to_vec();
        vehicle.leg = behind.len();
        vehicle.path = behind;
        vehicle.path.append(&mut path);
        vehicle.s = s;
        vehicle.patience = self.rng.random_range(6.0..20.0);
        // The next vehicle that considers the same gap must see this one in it.
        let vehicle = &self.vehicles[i];
        self.occupancy.add(network, i, vehicle);
    }

    /// Moves to the left in the lane to pass a bicycle, where lane and vehicle leave room.
    fn evade_bicycle(&mut self, i: usize) {
        let vehicle = &self.vehicles[i];
        if vehicle.kind != AgentKind::Vehicle {
            return;
        }
        let lane = &self.network.lanes[vehicle.lane()];
        let far_from_junction = lane.is_exit || lane.length() - vehicle.s > 30.0;
        let bicycle = self.occupancy.bicycle_ahead(vehicle, &self.vehicles, 30.0);
        let room = lane.connector.is_none() && vehicle.change.is_none() && far_from_junction;
        let evade = match bicycle {
            Some(entry) if room => {
                let side = entry.sides.1 + super::occupancy::SIDE_CLEARANCE + 0.2;
                let needed = side + vehicle.width() / 2.0 - vehicle.keep;
                let most = lane.width / 2.0 + 0.1 - vehicle.width() / 2.0;
                if (0.0..=most).contains(&needed) {
                    needed
                } else {
                    0.0
                }
            }
            _ => 0.0,
        };
        self.vehicles[i].evade = evade;
    }
}
