//! Occupied stretches of lanes, and the leader of a vehicle.

use gump_scene::AgentKind;

use super::driver::Leader;
use super::vehicle::Vehicle;
use crate::network::{LaneIdx, Network};

/// Metres that drivers look ahead. Chosen by hand.
const SIGHT: f64 = 100.0;
/// Metres between the sides of two bodies that pass each other within a lane. Chosen by hand.
pub(crate) const SIDE_CLEARANCE: f64 = 0.5;

/// A body, or a part of one, on a lane.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Entry {
    /// Index of the vehicle.
    pub(crate) vehicle: usize,
    pub(crate) id: i64,
    /// Arc length of its rear on this lane, metres.
    pub(crate) rear: f64,
    /// Arc length of its front on this lane, metres.
    pub(crate) front: f64,
    /// Speed along this lane, metres per second.
    pub(crate) speed: f64,
    /// Right and left side, metres left of the lane centre; infinite where it takes all of it.
    pub(crate) sides: (f64, f64),
}

/// The taken stretches of all lanes.
#[derive(Debug)]
pub(crate) struct Occupancy {
    entries: Vec<Vec<Entry>>,
    /// Lanes and arc lengths of obstacles other than vehicles.
    blocks: Vec<(LaneIdx, f64)>,
}

impl Occupancy {
    pub(crate) fn new(n_lanes: usize) -> Self {
        Self {
            entries: vec![Vec::new(); n_lanes],
            blocks: Vec::new(),
        }
    }

    /// Everything on a lane, in no order.
    pub(crate) fn on(&self, lane: LaneIdx) -> &[Entry] {
        &self.entries[lane]
    }

    /// Notes where every vehicle is.
    pub(crate) fn fill(&mut self, network: &Network, vehicles: &[Vehicle]) {
        for entries in &mut self.entries {
            entries.clear();
        }
        self.blocks.clear();
        for (i, vehicle) in vehicles.iter().enumerate() {
            self.add(network, i, vehicle);
        }
    }

    /// Blocks a position on a lane until the lanes are filled again.
    pub(crate) fn block(&mut self, lane: LaneIdx, at: f64) {
        self.blocks.push((lane, at));
    }

    /// Notes where one vehicle is.
    pub(crate) fn add(&mut self, network: &Network, index: usize, vehicle: &Vehicle) {
        let (rear, front) = (vehicle.s - vehicle.length() / 2.0, vehicle.front());
        let half = vehicle.width() / 2.0;
        let entry = |rear, front, offset: f64| Entry {
            vehicle: index,
            id: vehicle.id,
            rear,
            front,
            speed: vehicle.speed,
            sides: (offset - half, offset + half),
        };
        let lane = vehicle.lane();
        self.put(network, lane, entry(rear, front, vehicle.offset()));
        if rear < 0.0 && vehicle.leg > 0 {
            let before = vehicle.path[vehicle.leg - 1];
            let length = network.lanes[before].length();
            self.put(
                network,
                before,
                entry(rear + length, length, vehicle.lateral),
            );
        }
        let length = network.lanes[lane].length();
        if front > length && vehicle.leg + 1 < vehicle.path.len() {
            let next = vehicle.path[vehicle.leg + 1];
            self.put(network, next, entry(0.0, front - length, vehicle.lateral));
        }
        if let Some(change) = vehicle.change {
            let shift = change.arc_shift;
            let offset = vehicle.offset() - change.offset;
            self.entries[change.from].push(entry(rear + shift - 1.0, front + shift, offset));
        }
    }

    /// Adds an entry to its lane and to every lane that shares the surface there.
    fn put(&mut self, network: &Network, lane: LaneIdx, entry: Entry) {
        self.entries[lane].push(entry);
        let step = network.lanes[lane].track.step();
        for overlap in &network.lanes[lane].overlaps {
            let from = ((entry.rear / step).floor().max(0.0) as usize).max(overlap.first);
            let last = overlap.first + overlap.at.len() - 1;
            let to = ((entry.front / step).ceil().max(0.0) as usize).min(last);
            let (mut rear, mut front) = (f64::INFINITY, f64::NEG_INFINITY);
            for sample in from..=to {
                let at = overlap.at[sample - overlap.first];
                if !at.is_nan() {
                    (rear, front) = (rear.min(at), front.max(at));
                }
            }
            if rear > front {
                continue;
            }
            let middle = (entry.rear + entry.front) / 2.0;
            let mine = network.lanes[lane].track.pose_at(middle).direction();
            let other = &network.lanes[overlap.other];
            let theirs = other.track.pose_at((rear + front) / 2.0).direction();
            self.entries[overlap.other].push(Entry {
                rear: rear - 0.3,
                front: front + 0.3,
                speed: (entry.speed * mine.dot(theirs)).max(0.0),
                sides: (f64::NEG_INFINITY, f64::INFINITY),
                ..entry
            });
        }
    }

    /// Returns the vehicle that `vehicle` has to follow, or the point where it has to stop.
    pub(crate) fn leader(&self, network: &Network, vehicle: &Vehicle) -> Option<Leader> {
        let sides = {
            let (a, b) = (vehicle.offset(), vehicle.lateral);
            let half = vehicle.width() / 2.0;
            (a.min(b) - half, a.max(b) + half)
        };
        let mut best: Option<Leader> = None;
        let mut consider = |gap: f64, speed: f64| {
            let leader = Leader { gap, speed };
            let stricter = |b: Leader| {
                vehicle
                    .driver
                    .acceleration(vehicle.speed, 50.0, Some(leader), None)
                    < vehicle
                        .driver
                        .acceleration(vehicle.speed, 50.0, Some(b), None)
            };
            if best.is_none_or(stricter) {
                best = Some(leader);
            }
        };
        let mut start = -vehicle.front();
        for (n, &lane) in vehicle.path[vehicle.leg..].iter().enumerate() {
            for entry in &self.entries[lane] {
                let behind = n == 0 && (entry.rear + entry.front) / 2.0 <= vehicle.s;
                if entry.id == vehicle.id || behind || passes(sides, entry.sides) {
                    continue;
                }
                consider(start + entry.rear, entry.speed);
            }
            for &(_, at) in self.blocks.iter().filter(|(there, _)| *there == lane) {
                if n > 0 || at > vehicle.s {
                    consider(start + at, 0.0);
                }
            }
            start += network.lanes[lane].length();
            if start > SIGHT {
                break;
            }
        }
        if let Some(change) = vehicle.change
            && change.driven < 0.8 * change.length
        {
            let s = vehicle.s + change.arc_shift;
            for entry in &self.entries[change.from] {
                let behind = (entry.rear + entry.front) / 2.0 <= s;
                if entry.id != vehicle.id && !behind {
                    consider(entry.rear - s - vehicle.length() / 2.0, entry.speed);
                }
            }
        }
        if let Some(&last) = vehicle.path.last()
            && network.lanes[last].is_dead_end()
            && start <= SIGHT
            && vehicle.change.is_none()
        {
            consider(start - 24.0, 0.0);
        }
        best
    }

    /// The bicycle that `vehicle` comes up to in its lane within `reach` metres, if any.
    pub(crate) fn bicycle_ahead(
        &self,
        vehicle: &Vehicle,
        vehicles: &[Vehicle],
        reach: f64,
    ) -> Option<Entry> {
        let near = |entry: &&Entry| {
            vehicles[entry.vehicle].kind == AgentKind::Bicycle
                && entry.front > vehicle.s - vehicle.length() / 2.0 - 2.0
                && entry.rear < vehicle.front() + reach
                && entry.sides.1.is_finite()
        };
        self.entries[vehicle.lane()].iter().find(near).copied()
    }
}

/// True if two bodies with these sides can pass each other within a lane.
fn passes(a: (f64, f64), b: (f64, f64)) -> bool {
    a.0 > b.1 + SIDE_CLEARANCE || b.0 > a.1 + SIDE_CLEARANCE
}
