//! Vehicles that turn and wait within the junction: for oncoming traffic, or for people on the crosswalk
//! that they turn to.
//!
//! Such a vehicle has claimed its connector, but goes on only to where the first shared surface begins that
//! others may still use. Those may claim what lies beyond; what lies before is its own.

use gump_scene::LightState;

use super::TrafficSimulation;
use crate::network::{Connector, LaneIdx, Turn};
use crate::plan::Control;

// Chosen by hand.
/// Metres between its front and what it waits for: it comes to rest up to a metre beyond where it should.
const ROOM: f64 = 1.5;
/// It enters only if its front gets this far beyond the line, metres.
const LEAST: f64 = 3.0;

/// How far a vehicle may go into a junction for now.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Wait {
    /// The connector.
    pub(crate) lane: LaneIdx,
    /// Arc length on it that the front may reach, metres.
    pub(crate) until: f64,
}

impl TrafficSimulation<'_> {
    /// Lets those that wait within a junction go on as far as nothing is in their way any more.
    pub(super) fn end_waits(&mut self) {
        for i in 0..self.vehicles.len() {
            let vehicle = &self.vehicles[i];
            let Some(wait) = vehicle.wait else {
                continue;
            };
            let leg = vehicle.leg_on(wait.lane);
            let claimed = leg.filter(|_| vehicle.claims.contains(&wait.lane));
            self.vehicles[i].wait = claimed.and_then(|leg| {
                let distance = self.vehicles[i].distance_to(self.network, leg);
                let connector = self.connector(wait.lane);
                let goes = self.has_way(i, wait.lane, connector, distance);
                let until = self.free_until(i, connector, distance);
                (!goes).then_some(Wait {
                    until: until.max(wait.until),
                    ..wait
                })
            });
        }
    }

    /// Where vehicle `i` may wait within the junction at which it may not claim its whole way, `distance`
    /// metres ahead.
    pub(super) fn place_to_wait(&self, i: usize, leg: usize, distance: f64) -> Option<Wait> {
        let vehicle = &self.vehicles[i];
        let lane = vehicle.path[leg];
        let connector = self.connector(lane);
        let enters = vehicle.driver.waits_inside
            && connector.turn != Turn::Straight
            && self.network.junctions[connector.junction].control != Control::AllWayStop
            && !self.network.lanes[lane].in_ring
            && self.light(connector, self.time) == LightState::Green
            && self.has_stopped(vehicle, connector)
            && self.is_first_in_line(vehicle, leg)
            && self.nobody_waits_on(vehicle, lane)
            && self.has_room_beyond(i, leg)
            && self.has_room_in_ring(i, leg);
        let until = self.free_until(i, connector, distance);
        let enters = enters && until > LEAST && self.can_stop(vehicle, distance + until);
        enters.then_some(Wait { lane, until })
    }

    /// Arc length on a connector up to which nobody has claimed what it shares with others, none of whom
    /// goes first there, and no person crosses, metres.
    fn free_until(&self, i: usize, connector: &Connector, distance: f64) -> f64 {
        let vehicle = &self.vehicles[i];
        let conflicts = connector.conflicts.iter();
        let shared = conflicts.filter(|conflict| {
            let goes_first = self.connector(conflict.other).rank > connector.rank;
            goes_first || self.is_taken(i, conflict, distance)
        });
        let crossings = connector.crossings.iter();
        let crossed = crossings
            .filter(|crossing| !self.is_crossing_free(vehicle, connector, crossing, distance));
        let begins = shared.map(|conflict| conflict.mine.0);
        let begins = begins.chain(crossed.map(|crossing| crossing.along.0));
        begins.fold(f64::INFINITY, f64::min) - ROOM
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use gump_geometry::OrientedBox;
    use gump_scene::{AgentKind, Seed};

    use super::super::{Body, Demand, Scenery};
    use super::*;
    use crate::RoadFamily;
    use crate::layout::{Winding, draw_plan};
    use crate::network::Network;

    const DT: f64 = 0.1;

    /// Runs busy crossings for two minutes, and looks at every tenth step.
    fn watch(seeds: std::ops::Range<u64>, look: &mut dyn FnMut(u64, &TrafficSimulation<'_>)) {
        for seed in seeds {
            let mut rng = Seed(seed).rng();
            let family = RoadFamily::SignalizedCrossing;
            let plan = draw_plan(family, 150.0, Winding::Slight, &mut rng);
            let network = Network::new(&plan, &mut rng);
            let demand = Demand {
                moving: 24,
                parked: 0,
                people: 12,
                bicycles: 0,
                arrivals: 0.4,
                scenery: Scenery {
                    is_real: true,
                    ..Scenery::default()
                },
            };
            let mut traffic = TrafficSimulation::new(&network, demand, DT, rng);
            for step in 0..1200 {
                traffic.step();
                if step % 10 == 0 {
                    look(seed, &traffic);
                }
            }
        }
    }

    #[test]
    fn some_wait_within_the_junction_and_none_for_ever() {
        let (mut since, mut inside, mut longest) = (BTreeMap::new(), 0, 0.0_f64);
        watch(0..8, &mut |seed, traffic| {
            let waits = traffic.vehicles.iter().filter(|v| v.wait.is_some());
            let now: BTreeMap<_, f64> = waits
                .map(|v| {
                    (
                        (seed, v.id),
                        *since.get(&(seed, v.id)).unwrap_or(&traffic.time),
                    )
                })
                .collect();
            for ((_, id), began) in &now {
                let vehicle = traffic.vehicles.iter().find(|v| v.id == *id).unwrap();
                let wait = vehicle.wait.unwrap();
                let leg = vehicle.leg_on(wait.lane).unwrap();
                let front = -vehicle.distance_to(traffic.network, leg);
                assert!(front < wait.until + ROOM, "{front} of {}", wait.until);
                inside += usize::from(front > LEAST && vehicle.speed < 0.5);
                longest = longest.max(traffic.time - began);
            }
            since = now;
        });
        assert!(inside > 40, "{inside} times");
        assert!(longest < 60.0, "{longest} s");
    }

    #[test]
    fn those_who_wait_within_the_junction_are_in_nobodys_way() {
        let (mut overlaps, mut pairs) = (0, 0);
        watch(20..26, &mut |_, traffic| {
            let bodies: Vec<Body> = traffic.bodies();
            let cars = bodies
                .iter()
                .filter(|b| b.kind == AgentKind::Vehicle && b.is_mobile);
            let shapes: Vec<OrientedBox> = cars
                .map(|body| OrientedBox {
                    pose: body.pose,
                    length: body.size[0],
                    width: body.size[1],
                })
                .collect();
            for (i, a) in shapes.iter().enumerate() {
                for b in &shapes[i + 1..] {
                    pairs += 1;
                    overlaps += usize::from(a.overlaps(b));
                }
            }
        });
        assert!(1000 * overlaps < pairs, "{overlaps} of {pairs}");
    }
}
