//! Builds lanes and connectors from a plan.

use gump_geometry::{angle_difference, wrap_angle};
use gump_scene::{LaneKind, Rng};
use rand::Rng as _;

use crate::curve::{Track, connect};
use crate::network::leg::{Leg, legs_of};
use crate::network::{Connector, Junction, LaneIdx, Network, NetworkLane, Turn, signal};
use crate::plan::{BIKE_LANE_WIDTH, Control, Plan, RoadPlan};

/// Sideways acceleration that drivers accept in a bend, m/s², the same as in SUMO's junctions: more
/// makes yaw rates exceed recorded ones (docs/results/0006-factory.md).
const COMFORTABLE_LATERAL: f64 = 2.2;
/// Deceleration ahead of a bend, m/s²: no more than any driver's comfortable one. Chosen by hand.
const COMFORTABLE_BRAKING: f64 = 1.3;
/// Turns up to this many radians count as straight on: roads meet askew by up to 0.3
/// ([`crate::layout`]), so real turns have over 1.2.
const STRAIGHT: f64 = 0.62;

impl Network {
    /// Builds everything in the plan; `rng` decides on light phases, turning lanes and parking
    /// lots.
    pub(crate) fn new(plan: &Plan, rng: &mut Rng) -> Self {
        let (mut network, trimmed) = Self::roads(plan, rng);
        let n_lots = rng.random_range(0..=4);
        network.lay_lots(plan, &trimmed, n_lots, 1..=1, rng);
        network
    }

    /// Builds everything in the plan but parking lots; also gives the references of the roads
    /// between the mouths of their junctions.
    pub(crate) fn roads(plan: &Plan, rng: &mut Rng) -> (Self, Vec<Track>) {
        let mut network = Self::default();
        let mut legs: Vec<Vec<Leg>> = (0..plan.nodes.len()).map(|n| legs_of(plan, n)).collect();
        let trimmed: Vec<Track> = (0..plan.roads.len())
            .map(|r| trim(plan, &legs, r))
            .collect();
        for (road, track) in trimmed.iter().enumerate() {
            network.add_road(plan, road, track, &mut legs);
        }
        for (node, legs) in legs.iter().enumerate() {
            network.add_junction(plan, node, legs, rng);
        }
        for lane in 0..network.lanes.len() {
            for next in network.lanes[lane].successors.clone() {
                network.lanes[next].predecessors.push(lane);
            }
        }
        network.find_overlaps();
        network.furnish(plan, &legs, &trimmed);
        network.lay_walks(plan, &legs, &trimmed);
        network.find_crossings();
        (network, trimmed)
    }

    fn add_road(&mut self, plan: &Plan, road: usize, track: &Track, legs: &mut [Vec<Leg>]) {
        let r = &plan.roads[road];
        for forward in [true, false] {
            let sign = if forward { -1.0 } else { 1.0 };
            let along = |offset: f64| {
                let lane = track.offset(sign * offset);
                if forward { lane } else { lane.reversed() }
            };
            let first = self.lanes.len();
            let n = r.n_lanes(forward);
            for k in 0..n {
                let mut lane = road_lane(r, forward, along(r.lane_offset(k)));
                lane.left = (k > 0).then(|| first + k - 1);
                lane.right = (k + 1 < n).then_some(first + k + 1);
                self.lanes.push(lane);
            }
            let bike = (n > 0 && r.bike_lanes).then(|| {
                let mut lane = road_lane(r, forward, along(r.bike_offset(forward)));
                (lane.kind, lane.width) = (LaneKind::BikeLane, BIKE_LANE_WIDTH);
                self.lanes.push(lane);
                self.lanes.len() - 1
            });
            if n > 0 && r.parking {
                let strips = if r.bays {
                    &mut self.bays
                } else {
                    &mut self.parking
                };
                strips.push(along(r.parking_offset(forward)));
            }
            let lanes: Vec<LaneIdx> = (first..first + n).collect();
            for leg in legs.iter_mut().flatten().filter(|leg| leg.road == road) {
                if leg.at_start == forward {
                    (leg.outgoing, leg.bike_out) = (lanes.clone(), bike);
                } else {
                    (leg.incoming, leg.bike_in) = (lanes.clone(), bike);
                }
            }
        }
    }

    fn add_junction(&mut self, plan: &Plan, node: usize, legs: &[Leg], rng: &mut Rng) {
        let control = plan.nodes[node].control;
        let first = self.lanes.len();
        let mut left_only = vec![false; legs.len()];
        for (from, leg) in legs.iter().enumerate() {
            // Two lanes may be shared out either way; three always leave one to left turns.
            let prefers = control == Control::Signals && rng.random_bool(0.6);
            let links = links(legs, from, if prefers { 2 } else { 3 });
            let turns_off = |link: &Link| {
                let same_lane = |other: &&Link| other.from == link.from;
                links
                    .iter()
                    .filter(same_lane)
                    .all(|other| other.turn == Turn::Left)
            };
            // A single lane that can only turn left is the end of a road, not a lane for turning.
            left_only[from] = leg.incoming.len() > 1 && links.iter().any(turns_off);
            for link in &links {
                let group = 2 * from + usize::from(left_only[from] && turns_off(link));
                self.add_connector(
                    &plan.roads[leg.road],
                    (node, control),
                    (from, legs),
                    *link,
                    group,
                );
            }
        }
        let cycle =
            (control == Control::Signals).then(|| signal::plan_cycle(legs, &left_only, rng));
        self.junctions.push(Junction {
            control,
            cycle,
            connectors: (first..self.lanes.len()).collect(),
        });
    }

    fn add_connector(
        &mut self,
        road: &RoadPlan,
        (node, control): (usize, Control),
        (from, legs): (usize, &[Leg]),
        link: Link,
        group: usize,
    ) {
        let major = road.major;
        let (a, b) = (&self.lanes[link.from], &self.lanes[link.to]);
        let start = a.track.pose_at(a.length());
        let end = b.track.pose_at(0.0);
        let curvatures = [-legs[from].curvature, legs[link.leg].curvature];
        let track = Track::through(&connect(start, end, curvatures, 22.0));
        let sharpest = track
            .curvatures()
            .iter()
            .fold(0.0, |m: f64, k| m.max(k.abs()));
        let is_bike = a.is_bike_lane();
        let rank = match (control, major, link.turn) {
            (Control::Free | Control::AllWayStop, _, _) => 3,
            (Control::Signals, _, Turn::Left) => 1,
            (Control::Signals, _, _) => 3,
            (Control::MinorStop | Control::MinorYield, true, Turn::Left) => 2,
            (Control::MinorStop | Control::MinorYield, true, _) => 3,
            (Control::MinorStop | Control::MinorYield, false, Turn::Left) => 0,
            (Control::MinorStop | Control::MinorYield, false, _) => 1,
        };
        let must_stop = match control {
            Control::AllWayStop => true,
            Control::MinorStop => !major,
            _ => false,
        };
        let signal = (control == Control::Signals).then_some(group);
        let connector = Connector {
            junction: node,
            from_leg: from,
            turn: link.turn,
            rank,
            must_stop,
            signal,
            conflicts: Vec::new(),
            crossings: Vec::new(),
            sharpest,
        };
        let lane = NetworkLane {
            bend_speeds: bend_speeds(&track),
            bumps: Vec::new(),
            track,
            width: if is_bike {
                BIKE_LANE_WIDTH
            } else {
                road.lane_width
            },
            speed_limit: a.speed_limit.min(b.speed_limit),
            kind: a.kind,
            successors: vec![link.to],
            predecessors: Vec::new(),
            left: None,
            right: None,
            is_entry: false,
            is_exit: false,
            in_ring: a.in_ring && b.in_ring,
            connector: Some(connector),
            overlaps: Vec::new(),
            drawn: None,
        };
        let idx = self.lanes.len();
        self.lanes.push(lane);
        self.lanes[link.from].successors.push(idx);
    }
}

/// A path from an incoming lane to an outgoing lane of another leg.
#[derive(Clone, Copy, Debug)]
struct Link {
    from: LaneIdx,
    to: LaneIdx,
    leg: usize,
    turn: Turn,
}

/// Returns the links from the lanes of leg `from`; with `lanes_for_left` lanes or more the leftmost
/// only turns left.
fn links(legs: &[Leg], from: usize, lanes_for_left: usize) -> Vec<Link> {
    let leg = &legs[from];
    let inward = wrap_angle(leg.mouth.heading + std::f64::consts::PI);
    let ways: Vec<(usize, Turn, f64)> = (0..legs.len())
        .filter(|&to| to != from && !legs[to].outgoing.is_empty())
        .map(|to| {
            let angle = angle_difference(legs[to].mouth.heading, inward);
            let turn = match angle {
                a if a > STRAIGHT => Turn::Left,
                a if a < -STRAIGHT => Turn::Right,
                _ => Turn::Straight,
            };
            (to, turn, angle)
        })
        // Sharper ones are U-turns.
        .filter(|(_, _, angle)| angle.abs() < 2.4)
        .collect();
    let has = |turn| ways.iter().any(|way| way.1 == turn);
    let n = leg.incoming.len();
    let mut links = Vec::new();
    for &(to, turn, _) in &ways {
        let out = &legs[to].outgoing;
        let m = out.len();
        for (k, &lane) in leg.incoming.iter().enumerate() {
            let (leftmost, rightmost) = (k == 0, k + 1 == n);
            let target = match turn {
                Turn::Left if leftmost => Some(0),
                Turn::Right if rightmost => Some(m - 1),
                Turn::Straight if n >= lanes_for_left && leftmost && has(Turn::Left) => None,
                // Lanes that do not go on beyond the junction must turn.
                // A ramp joins on the outside.
                Turn::Straight if leg.joins => Some(m - n.min(m) + k.min(m - 1)),
                Turn::Straight if k < m => Some(k),
                // On open road a lane that does not go on ends: traffic changes lanes before.
                Turn::Straight if legs.iter().all(|leg| leg.is_open) => None,
                Turn::Straight if !(rightmost && has(Turn::Right)) => Some(m - 1),
                _ => None,
            };
            links.extend(target.map(|t| Link {
                from: lane,
                to: out[t],
                leg: to,
                turn,
            }));
        }
        if let Some(bike) = leg.bike_in.filter(|_| turn != Turn::Left) {
            let target = legs[to].bike_out.unwrap_or(out[m - 1]);
            links.push(Link {
                from: bike,
                to: target,
                leg: to,
                turn,
            });
        }
    }
    links
}

fn road_lane(road: &RoadPlan, forward: bool, track: Track) -> NetworkLane {
    let (first, last) = if forward {
        (road.ends[0], road.ends[1])
    } else {
        (road.ends[1], road.ends[0])
    };
    NetworkLane {
        bend_speeds: bend_speeds(&track),
        bumps: Vec::new(),
        track,
        width: road.lane_width,
        speed_limit: road.speed_limit,
        kind: if road.freeway {
            LaneKind::Freeway
        } else {
            LaneKind::SurfaceStreet
        },
        successors: Vec::new(),
        predecessors: Vec::new(),
        left: None,
        right: None,
        is_entry: first.is_none(),
        is_exit: last.is_none(),
        in_ring: road.ring,
        connector: None,
        overlaps: Vec::new(),
        drawn: None,
    }
}

/// The reference of a road between the mouths of its junctions.
fn trim(plan: &Plan, legs: &[Vec<Leg>], road: usize) -> Track {
    let reference = &plan.roads[road].reference;
    let (mut from, mut to) = (0.0, reference.length());
    for leg in legs.iter().flatten().filter(|leg| leg.road == road) {
        if leg.at_start {
            from = leg.setback;
        } else {
            to = reference.length() - leg.setback;
        }
    }
    reference.slice(from, to.max(from + 4.0))
}

/// The highest speed at each sample from which the bends ahead can be taken comfortably.
fn bend_speeds(track: &Track) -> Vec<f64> {
    let mut speeds: Vec<f64> = track
        .curvatures()
        .iter()
        .map(|k| (COMFORTABLE_LATERAL / k.abs().max(1e-4)).sqrt())
        .collect();
    for i in (0..speeds.len() - 1).rev() {
        let ahead: f64 = speeds[i + 1];
        let reachable = (ahead * ahead + 2.0 * COMFORTABLE_BRAKING * track.step()).sqrt();
        speeds[i] = speeds[i].min(reachable);
    }
    speeds
}
