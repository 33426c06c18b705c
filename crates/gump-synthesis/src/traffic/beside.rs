//! Passing parked vehicles that stand partly in the lane.

use gump_scene::AgentKind;

use super::occupancy::Occupancy;
use super::vehicle::Vehicle;
use super::{Body, TrafficSimulation};
use crate::network::{LaneIdx, Network};

// Recorded drivers (gpudrive/train and /tune) keep 0.8 to 1.7 m from the side of such a vehicle,
// drive over the middle of the road for it, and pass it at 3 to 9 m/s. The other numbers are chosen
// by eye.
/// A vehicle with more room between its side and the lane's centre is not in the way, metres.
const IN_THE_WAY: f64 = 2.0;
/// Metres of lane along which a vehicle that starts to move over is beside its place: in the time
/// that steering takes, and at low speed.
const REACH_S: f64 = 2.4;
const REACH_M: f64 = 12.0;
/// Metres to the middle of the road where somebody may come.
const FROM_MIDDLE: f64 = 0.15;
/// Metres that drivers go beyond the middle where nobody comes.
const BEYOND_MIDDLE: f64 = 0.6;
/// Metres ahead in which somebody who comes matters.
const ONCOMING: f64 = 50.0;
/// Speed without room, m/s, and what every metre of room adds to it.
const SPEED: [f64; 2] = [1.5, 5.5];
/// Deceleration before a narrow place, m/s².
const BRAKING: f64 = 1.2;

/// A stretch of a lane beside a parked vehicle.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Narrow {
    /// Arc lengths of the ends of the parked vehicle, metres.
    rear: f64,
    front: f64,
    /// Its left side, metres left of the lane's centre.
    side: f64,
    /// The lane of the other direction here and an arc length on it.
    opposite: Option<(LaneIdx, f64)>,
}

/// How a vehicle passes parked ones.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Beside {
    /// Metres to the left of its preferred place.
    pub(crate) aside: f64,
    /// Highest speed, m/s.
    pub(crate) speed: f64,
}

impl Beside {
    /// Where nothing is to be passed.
    pub(crate) const NOTHING: Self = Self {
        aside: 0.0,
        speed: f64::INFINITY,
    };
}

/// The narrow stretches of every lane.
pub(super) fn narrows(network: &Network, parked: &[Body]) -> Vec<Vec<Narrow>> {
    let mut narrows = vec![Vec::new(); network.lanes.len()];
    let vehicles = parked.iter().filter(|b| b.kind == AgentKind::Vehicle);
    for body in vehicles {
        for (i, lane) in network.lanes.iter().enumerate() {
            if lane.connector.is_some() || lane.right.is_some() {
                continue;
            }
            let s = lane.track.project(body.pose.position);
            let local = lane.track.pose_at(s).inverse() * body.pose.position;
            let side = local.y + body.size[1] / 2.0;
            if local.x.abs() > 0.5 || local.y > 0.0 || side < -IN_THE_WAY {
                continue;
            }
            narrows[i].push(Narrow {
                rear: s - body.size[0] / 2.0,
                front: s + body.size[0] / 2.0,
                side,
                opposite: opposite(network, i, s),
            });
        }
    }
    narrows
}

/// The lane of the other direction beside an outermost one, if they are the road's only ones.
fn opposite(network: &Network, lane: LaneIdx, s: f64) -> Option<(LaneIdx, f64)> {
    let here = network.lanes[lane].track.pose_at(s);
    let mut lanes = network.lanes.iter().enumerate();
    lanes.find_map(|(i, other)| {
        let foot = other.track.project(here.position);
        let local = here.inverse() * other.track.pose_at(foot);
        let comes = local.heading.cos() < -0.9 && local.position.x.abs() < 1.0;
        let apart = f64::midpoint(other.width, network.lanes[lane].width) + 0.1;
        let beside = (1.0..apart).contains(&local.position.y);
        (comes && beside && other.connector.is_none()).then_some((i, foot))
    })
}

impl TrafficSimulation<'_> {
    /// How a vehicle passes the parked ones that are beside it or next on its path.
    pub(super) fn beside(&self, vehicle: &Vehicle) -> Beside {
        let mut beside = Beside::NOTHING;
        let reach = (REACH_S * vehicle.speed).max(REACH_M);
        let rear = -vehicle.length();
        // From the front of the vehicle.
        let mut start = -vehicle.front();
        for &lane in &vehicle.path[vehicle.leg..] {
            for narrow in self.narrows.get(lane).into_iter().flatten() {
                let (from, to) = (start + narrow.rear, start + narrow.front);
                if to < rear - 0.5 || from > 3.0 * reach {
                    continue;
                }
                let middle = self.network.lanes[lane].width / 2.0;
                let most = middle - vehicle.width() / 2.0 - FROM_MIDDLE;
                let most = match narrow.opposite {
                    Some(other) if comes(&self.occupancy, other) => most,
                    _ => most + FROM_MIDDLE + BEYOND_MIDDLE,
                };
                let wanted = narrow.side + vehicle.driver.clearance + vehicle.width() / 2.0;
                let place = wanted.min(most.max(0.0)).max(vehicle.keep);
                let room = place - vehicle.width() / 2.0 - narrow.side;
                let speed = SPEED[0] + SPEED[1] * room.max(0.0);
                let allowed = (speed * speed + 2.0 * BRAKING * from.max(0.0)).sqrt();
                beside.speed = beside.speed.min(allowed);
                if from < reach {
                    beside.aside = beside.aside.max(place - vehicle.keep);
                }
            }
            start += self.network.lanes[lane].length();
            if start > 3.0 * reach {
                break;
            }
        }
        beside
    }
}

/// Whether somebody comes towards a place, or is there.
fn comes(occupancy: &Occupancy, (lane, at): (LaneIdx, f64)) -> bool {
    let near = |entry: &super::occupancy::Entry| (at - ONCOMING..at + 8.0).contains(&entry.front);
    occupancy.on(lane).iter().any(near)
}
