//! Similarity of generated and recorded scenes: maximum mean discrepancy of positions, headings,
//! velocities and sizes of agents, of the gaps between them and of their numbers per lane.
//!
//! Start with [`scene_mmd`] for one scene; [`MmdMean`] averages over scenes, [`mmd_squared`] is the
//! statistic itself.
//!
//! ```
//! use gump_metrics::mmd::{MmdProtocol, scene_mmd};
//!
//! let scene = |x: f64| gump_scene::fixture::scenario(&format!(
//!     "ego vehicle 0: 0,0\nagent vehicle 1: {x},3 velocity 5,0\nagent vehicle 2: 20,-3",
//! )).unwrap();
//! let (recorded, generated) = (scene(10.0), scene(30.0));
//! let protocol = MmdProtocol { min_vehicles: 2, ..MmdProtocol::gump() };
//! let found = scene_mmd(&recorded.present(), generated.present().now(), &protocol).unwrap();
//! assert!(found.position.unwrap() > 0.0);
//! assert_eq!(found.velocity, Some(0.0));
//! ```

use std::collections::BTreeMap;

use gump_geometry::{DVec2, angle_difference};
use gump_scene::{Agent, AgentId, AgentKind, Frame, LaneId, MapGraph, SceneState, lanes_ahead};

use crate::behaviour::reach::nearest;

/// The agents and scenes that are compared.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MmdProtocol {
    /// Agents whose centre is farther ahead of, behind or beside the ego than this are left out,
    /// metres.
    pub half_side: f64,
    /// Scenes with fewer recorded vehicles, not counting the ego, are left out.
    pub min_vehicles: usize,
    /// The maximum number of vehicles, those nearest to the ego.
    pub max_vehicles: usize,
}

impl MmdProtocol {
    /// The protocol of the GUMP paper's table: vehicles within 50 m, at least 8 of them.
    ///
    /// The bound of 32 is TrafficGen's (Feng et al. 2023).
    pub fn gump() -> Self {
        Self {
            half_side: 50.0,
            min_vehicles: 8,
            max_vehicles: 32,
        }
    }
}

/// Discrepancies of one scene, from 0 (equal) to 2. `None` where all agents of both scenes are the
/// same, so that there is no scale.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SceneMmd {
    /// Of positions in the ego frame.
    pub position: Option<f64>,
    /// Of headings in the ego frame, as numbers in [-π, π).
    pub heading: Option<f64>,
    /// Of velocity vectors in the ego frame; tables call it speed.
    pub velocity: Option<f64>,
    /// Of lengths and widths.
    pub size: Option<f64>,
    /// Of the distances from bumper to bumper to the next vehicle ahead on its lanes, for vehicles in
    /// a lane; 50 m if it is farther, or there is none.
    pub gap: Option<f64>,
    /// Of the numbers of vehicles in each lane that has any.
    pub per_lane: Option<f64>,
}

impl SceneMmd {
    /// The attributes in their order: `position`, `heading`, `velocity`, `size`, `gap`, `per_lane`.
    pub fn values(&self) -> [Option<f64>; 6] {
        [
            self.position,
            self.heading,
            self.velocity,
            self.size,
            self.gap,
            self.per_lane,
        ]
    }

    fn of_values([position, heading, velocity, size, gap, per_lane]: [Option<f64>; 6]) -> Self {
        Self {
            position,
            heading,
            velocity,
            size,
            gap,
            per_lane,
        }
    }
}

/// Compares the vehicles of a generated frame with those recorded at the present, without the ego.
///
/// Both are taken relative to the recorded ego, which the generator is given. The protocol has the
/// same number of vehicles in both; otherwise each set has the same total weight.
///
/// `None` if the recorded scene has too few vehicles, or the generated one has none.
pub fn scene_mmd(
    recorded: &SceneState<'_>,
    generated: &Frame,
    protocol: &MmdProtocol,
) -> Option<SceneMmd> {
    let (ego, map) = (recorded.ego_now(), recorded.map);
    let recorded = vehicles(recorded.now(), ego, protocol);
    let generated = vehicles(generated, ego, protocol);
    if recorded.len() < protocol.min_vehicles.max(1) || generated.is_empty() {
        return None;
    }
    let ego_from_world = ego.state.pose.inverse();
    let pair = |v: DVec2| [v.x, v.y];
    let compare = |of: &dyn Fn(&Agent) -> [f64; 2]| {
        let values = |agents: &[Agent]| agents.iter().map(of).collect::<Vec<_>>();
        mmd_squared(&values(&generated), &values(&recorded))
    };
    Some(SceneMmd {
        position: compare(&|a| pair(ego_from_world * a.state.pose.position)),
        // A second dimension that is the same everywhere adds nothing to any distance.
        heading: compare(&|a| {
            let heading = a.state.pose.heading;
            [angle_difference(heading, ego.state.pose.heading), 0.0]
        }),
        velocity: compare(&|a| pair(ego_from_world.rotate(a.state.velocity))),
        size: compare(&|a| [a.length, a.width]),
        gap: mmd_squared(&gaps(map, &generated, ego), &gaps(map, &recorded, ego)),
        per_lane: mmd_squared(&per_lane(map, &generated), &per_lane(map, &recorded)),
    })
}

/// Gaps are cut off at this distance, metres: half of the square that is compared, and at 50 km/h
/// more than three seconds away.
const MAX_GAP_M: f64 = 50.0;
/// A vehicle is in the lane whose centre is nearest, within this, metres (half a lane), ...
const IN_LANE_M: f64 = 1.75;
/// ... if it heads along it within this, radians.
const ALONG: f64 = std::f64::consts::FRAC_PI_6;

/// The gap ahead of every vehicle that is in a lane, metres; the ego counts as a vehicle ahead.
fn gaps(map: &MapGraph, vehicles: &[Agent], ego: &Agent) -> Vec<[f64; 1]> {
    let gap = |vehicle: &Agent| {
        let (lane, foot) = nearest(map, vehicle.state.pose, IN_LANE_M, ALONG)?;
        let front = foot.arc_length + vehicle.length / 2.0;
        let (reached, _) = lanes_ahead(map, lane, front, MAX_GAP_M);
        let others = vehicles.iter().chain([ego]).filter(|o| o.id != vehicle.id);
        let ahead = others.flat_map(|other| {
            reached.iter().filter_map(move |part| {
                let place = part.locate(other.state.pose.position);
                // The centre of a vehicle ahead is beyond its own.
                let is_ahead = place.ahead_m > -vehicle.length / 2.0;
                let gap = place.ahead_m - other.length / 2.0;
                (is_ahead && place.beside_m <= IN_LANE_M).then_some(gap.max(0.0))
            })
        });
        Some([ahead.fold(MAX_GAP_M, f64::min)])
    };
    vehicles.iter().filter_map(gap).collect()
}

/// The number of vehicles in every lane that has any.
fn per_lane(map: &MapGraph, vehicles: &[Agent]) -> Vec<[f64; 1]> {
    let mut counts: BTreeMap<LaneId, f64> = BTreeMap::new();
    for vehicle in vehicles {
        if let Some((lane, _)) = nearest(map, vehicle.state.pose, IN_LANE_M, ALONG) {
            *counts.entry(lane.id).or_default() += 1.0;
        }
    }
    counts.into_values().map(|count| [count]).collect()
}

/// The vehicles that are compared, the nearest first.
fn vehicles(frame: &Frame, ego: &Agent, protocol: &MmdProtocol) -> Vec<Agent> {
    let ego_from_world = ego.state.pose.inverse();
    let distance = |agent: &Agent| agent.state.pose.position.distance(ego.state.pose.position);
    let takes_part = |agent: &&Agent| {
        let position = ego_from_world * agent.state.pose.position;
        agent.kind == AgentKind::Vehicle
            && agent.id != ego.id
            && position.abs().max_element() <= protocol.half_side
    };
    let mut vehicles: Vec<Agent> = frame.agents().iter().filter(takes_part).copied().collect();
    let by_id = |agent: &Agent| -> AgentId { agent.id };
    vehicles.sort_by(|a, b| {
        let nearer = distance(a).total_cmp(&distance(b));
        nearer.then(by_id(a).cmp(&by_id(b)))
    });
    vehicles.truncate(protocol.max_vehicles);
    vehicles
}

/// Squared maximum mean discrepancy of two sets of points, from 0 (equal) to 2.
///
/// The kernel is exp(-d²/b), where b is the mean of d² over all pairs of different points of both
/// sets together. The estimate is the biased one: a point is also paired with itself. `None` if a
/// set is empty or all points are the same.
///
/// Source: TrafficGen's published evaluation with one kernel (Feng et al. 2023), which leaves out
/// attributes that are zero everywhere and has no number where all values are the same.
pub fn mmd_squared<const D: usize>(a: &[[f64; D]], b: &[[f64; D]]) -> Option<f64> {
    if a.is_empty() || b.is_empty() {
        return None;
    }
    let all: Vec<&[f64; D]> = a.iter().chain(b).collect();
    let squared = |x: &[f64; D], y: &[f64; D]| -> f64 {
        x.iter().zip(y).map(|(x, y)| (x - y) * (x - y)).sum()
    };
    let mut sum = 0.0;
    for (i, x) in all.iter().enumerate() {
        sum += all[..i].iter().map(|y| squared(x, y)).sum::<f64>();
    }
    let n_pairs = all.len() * (all.len() - 1) / 2;
    let bandwidth = sum / n_pairs as f64;
    if bandwidth <= 0.0 {
        return None;
    }
    let mean = |xs: &[[f64; D]], ys: &[[f64; D]]| {
        let row = |x| {
            ys.iter()
                .map(|y| (-squared(x, y) / bandwidth).exp())
                .sum::<f64>()
        };
        xs.iter().map(row).sum::<f64>() / (xs.len() * ys.len()) as f64
    };
    Some(mean(a, a) + mean(b, b) - 2.0 * mean(a, b))
}

/// Means over scenes, each attribute over the scenes that have it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct MmdMean {
    sums: [f64; 6],
    counts: [usize; 6],
    scenes: usize,
}

impl MmdMean {
    /// Adds a scene.
    pub fn add(&mut self, scene: &SceneMmd) {
        for (i, value) in scene.values().into_iter().enumerate() {
            if let Some(value) = value {
                self.sums[i] += value;
                self.counts[i] += 1;
            }
        }
        self.scenes += 1;
    }

    /// The means; `None` for an attribute that no scene had.
    pub fn mean(&self) -> SceneMmd {
        let of = |i: usize| {
            let n = self.counts[i];
            (n > 0).then(|| self.sums[i] / n as f64)
        };
        SceneMmd::of_values(std::array::from_fn(of))
    }

    /// Number of scenes added.
    pub fn scenes(&self) -> usize {
        self.scenes
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;
    use gump_scene::{Scenario, fixture};

    #[test]
    fn one_point_against_one_by_hand() {
        // One pair, so its d² is the bandwidth: 1 + 1 - 2/e, however far apart.
        for distance in [0.1, 3.0, 500.0] {
            let found = mmd_squared(&[[0.0]], &[[distance]]).unwrap();
            assert_abs_diff_eq!(found, 2.0 - 2.0 / std::f64::consts::E, epsilon = 1e-12);
        }
    }

    #[test]
    fn two_points_against_two_by_hand() {
        // d² of the six pairs: within a 1, within b 1, across 4, 9, 1, 4. Bandwidth 20/6.
        let (a, b) = ([[0.0], [1.0]], [[2.0], [3.0]]);
        let k = |d2: f64| (-d2 * 6.0 / 20.0).exp();
        let within = (2.0 + 2.0 * k(1.0)) / 4.0;
        let across = (2.0 * k(4.0) + k(9.0) + k(1.0)) / 4.0;
        let found = mmd_squared(&a, &b).unwrap();
        assert_abs_diff_eq!(found, 2.0 * within - 2.0 * across, epsilon = 1e-12);
        assert_abs_diff_eq!(found, 1.035_612_1, epsilon = 1e-6);
    }

    #[test]
    fn sets_of_different_sizes_by_hand() {
        // d²: 4 within a; across 1 and 1. Bandwidth 2.
        let found = mmd_squared(&[[-1.0, 0.0], [1.0, 0.0]], &[[0.0, 0.0]]).unwrap();
        let expected = (2.0 + 2.0 * (-2.0_f64).exp()) / 4.0 + 1.0 - 2.0 * (-0.5_f64).exp();
        assert_abs_diff_eq!(found, expected, epsilon = 1e-12);
    }

    #[test]
    fn equal_sets_are_alike_and_points_without_spread_have_no_number() {
        let a = [[1.0, 2.0], [3.0, -4.0], [0.5, 0.5]];
        assert_abs_diff_eq!(mmd_squared(&a, &a).unwrap(), 0.0, epsilon = 1e-15);
        let backwards = [a[2], a[0], a[1]];
        assert_abs_diff_eq!(mmd_squared(&a, &backwards).unwrap(), 0.0, epsilon = 1e-15);
        assert_eq!(mmd_squared(&[[1.0]], &[[1.0], [1.0]]), None);
        assert_eq!(mmd_squared::<1>(&[], &[[1.0]]), None);
    }

    fn scene(agents: &str) -> Scenario {
        fixture::scenario(&format!(
            "ego vehicle 0: 100,50 heading 1.5707963267948966\n{agents}"
        ))
        .unwrap()
    }

    fn check(recorded: &str, generated: &str) -> Option<SceneMmd> {
        let protocol = MmdProtocol {
            min_vehicles: 2,
            max_vehicles: 3,
            ..MmdProtocol::gump()
        };
        let (recorded, generated) = (scene(recorded), scene(generated));
        scene_mmd(&recorded.present(), generated.present().now(), &protocol)
    }

    const TWO: &str = "agent vehicle 1: 100,60 size 4,2\nagent vehicle 2: 103,40 size 5,2";

    #[test]
    fn only_vehicles_near_the_ego_take_part() {
        let nothing_else = format!("{TWO}\nagent pedestrian 3: 101,50\nagent vehicle 4: 151,50");
        let found = check(TWO, &nothing_else).unwrap();
        assert_abs_diff_eq!(found.position.unwrap(), 0.0, epsilon = 1e-15);
        assert_abs_diff_eq!(found.size.unwrap(), 0.0, epsilon = 1e-15);
        // All stand and look the same way: no scale.
        assert_eq!((found.velocity, found.heading), (None, None));
        assert_eq!(check("agent vehicle 1: 100,60", TWO), None);
        assert_eq!(check(TWO, "agent pedestrian 1: 100,60"), None);
    }

    #[test]
    fn of_many_vehicles_the_nearest_are_taken() {
        let three = format!("{TWO}\nagent vehicle 3: 100,65");
        let four = format!("{three}\nagent vehicle 4: 100,90 size 9,3");
        assert_eq!(check(&three, &three), check(&three, &four));
    }

    #[test]
    fn moving_and_turning_the_world_changes_nothing() {
        let recorded = "ego vehicle 0: 0,0\nagent vehicle 1: 10,3 velocity 5,0
             agent vehicle 2: 20,-3 heading 3.0";
        let generated = "ego vehicle 0: 0,0\nagent vehicle 1: 12,3 velocity 2,1
             agent vehicle 2: 20,4 heading 0.3";
        let turned = |text: &str| {
            let pose = gump_geometry::Pose::new(1000.0, -500.0, 2.5);
            let mut scenario = fixture::scenario(text).unwrap();
            for frame in &mut scenario.log {
                let agents = frame.agents().iter().map(|agent| {
                    let mut agent = *agent;
                    agent.state.pose = pose * agent.state.pose;
                    agent.state.velocity = pose.rotate(agent.state.velocity);
                    agent
                });
                *frame = Frame::new(agents.collect(), vec![]);
            }
            scenario
        };
        let protocol = MmdProtocol {
            min_vehicles: 2,
            ..MmdProtocol::gump()
        };
        let of = |a: &Scenario, b: &Scenario| {
            scene_mmd(&a.present(), b.present().now(), &protocol).unwrap()
        };
        let plain = of(
            &fixture::scenario(recorded).unwrap(),
            &fixture::scenario(generated).unwrap(),
        );
        let moved = of(&turned(recorded), &turned(generated));
        let all = |m: &SceneMmd| [m.position, m.heading, m.velocity].map(Option::unwrap);
        for (a, b) in all(&plain).into_iter().zip(all(&moved)) {
            assert_abs_diff_eq!(a, b, epsilon = 1e-9);
        }
        assert!(all(&plain).iter().all(|&x| x > 0.0));
    }

    #[test]
    fn gaps_and_numbers_per_lane_are_those_of_lanes() {
        let of = |agents: &str| {
            let scenario = fixture::scenario(&format!(
                "lane 1: -40,0 20,0 next 2\nlane 2: 20,0 200,0\nlane 3: -40,3.5 200,3.5\n\
                 ego vehicle 0: 0,0 size 4,2\n{agents}"
            ))
            .unwrap();
            let frame = scenario.present().now().clone();
            let vehicles: Vec<Agent> = frame.agents()[1..].to_vec();
            let flat = |values: Vec<[f64; 1]>| values.into_iter().flatten().collect::<Vec<f64>>();
            let ego = scenario.present().ego_now();
            (
                flat(gaps(&scenario.map, &vehicles, ego)),
                flat(per_lane(&scenario.map, &vehicles)),
            )
        };
        // Behind the ego, before it on the next lane, alone beside it, and across.
        let (gaps, counts) = of("agent vehicle 1: -10,0.5 size 4,2\n\
             agent vehicle 2: 25,0 size 4,2\nagent vehicle 3: 40,0 size 6,2\n\
             agent vehicle 4: 5,3.5 size 4,2\nagent vehicle 5: 60,0 heading 1.57 size 4,2");
        assert_eq!(gaps, [6.0, 10.0, 15.0, 50.0]);
        assert_eq!(counts, [1.0, 2.0, 1.0]);
    }

    #[test]
    fn means_are_over_scenes_that_have_the_attribute() {
        let mut mean = MmdMean::default();
        mean.add(&SceneMmd {
            position: Some(0.5),
            ..SceneMmd::default()
        });
        mean.add(&SceneMmd {
            position: Some(0.1),
            heading: Some(0.2),
            ..SceneMmd::default()
        });
        assert_eq!(mean.scenes(), 2);
        let found = mean.mean();
        assert_abs_diff_eq!(found.position.unwrap(), 0.3);
        assert_eq!((found.heading, found.size), (Some(0.2), None));
    }
}
