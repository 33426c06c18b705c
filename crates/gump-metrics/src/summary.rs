//! A few rates over many futures, stored as counts so that tables can be merged.

use std::collections::{BTreeMap, BTreeSet};

use gump_geometry::DVec2;
use gump_scene::{Agent, AgentId, AgentKind, Rollout, Scenario, SceneState};
use rayon::prelude::*;

use crate::{Metric, OffRoad, average_displacement, overlapping};

/// Counts and sums over agents; methods compute rates.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Part {
    /// Agents times futures.
    pub agents: usize,
    /// Of these, the number that ever overlap an agent that they did not overlap at the start.
    pub collided: usize,
    /// Vehicles times futures that were on the road at the start.
    pub on_road: usize,
    /// Of these, the number that leave it.
    pub left_road: usize,
    /// Agents (not times futures) with displacements from the log.
    pub compared: usize,
    /// Sum of their average displacements, metres.
    pub sum_ade: f64,
    /// The same of the best future, metres.
    pub sum_min_ade: f64,
    /// Sum of their final displacements, metres.
    pub sum_fde: f64,
    /// The same of the best future, metres.
    pub sum_min_fde: f64,
}

impl Part {
    /// Share of agents that collide, 0..1.
    pub fn collision_rate(&self) -> Option<f64> {
        share(self.collided as f64, self.agents)
    }

    /// Share of vehicles on the road that leave it, 0..1.
    pub fn offroad_rate(&self) -> Option<f64> {
        share(self.left_road as f64, self.on_road)
    }

    /// Average displacement, metres, mean over futures and agents.
    pub fn ade(&self) -> Option<f64> {
        share(self.sum_ade, self.compared)
    }

    /// Average displacement of every agent's best future, metres.
    pub fn min_ade(&self) -> Option<f64> {
        share(self.sum_min_ade, self.compared)
    }

    /// Final displacement, metres, mean over futures and agents.
    pub fn fde(&self) -> Option<f64> {
        share(self.sum_fde, self.compared)
    }

    /// Final displacement of every agent's best future, metres.
    pub fn min_fde(&self) -> Option<f64> {
        share(self.sum_min_fde, self.compared)
    }

    /// Adds the counts of another part.
    pub fn merge(&mut self, other: &Self) {
        self.agents += other.agents;
        self.collided += other.collided;
        self.on_road += other.on_road;
        self.left_road += other.left_road;
        self.compared += other.compared;
        self.sum_ade += other.sum_ade;
        self.sum_min_ade += other.sum_min_ade;
        self.sum_fde += other.sum_fde;
        self.sum_min_fde += other.sum_min_fde;
    }
}

fn share(sum: f64, n: usize) -> Option<f64> {
    (n > 0).then(|| sum / n as f64)
}

/// The counts of [`summarize`], by kind of agent.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Summary {
    /// Number of rollouts.
    pub futures: usize,
    /// One part for every kind that occurs.
    pub by_kind: BTreeMap<AgentKind, Part>,
}

impl Summary {
    /// All kinds together.
    pub fn total(&self) -> Part {
        let mut total = Part::default();
        for part in self.by_kind.values() {
            total.merge(part);
        }
        total
    }

    /// Adds the counts of another summary.
    pub fn merge(&mut self, other: &Self) {
        self.futures += other.futures;
        for (&kind, part) in &other.by_kind {
            self.by_kind.entry(kind).or_default().merge(part);
        }
    }
}

/// Collisions, off-road driving and, given the log, displacements of all futures of one scenario.
///
/// Agents that are present at the start count, except those of [`AgentKind::STATIC`], which are
/// obstacles only. Overlaps of pairs that already overlap at the start and vehicles that are off
/// the road at the start do not count.
///
/// # Panics
/// If a rollout has another time step than `scenario`.
pub fn summarize(rollouts: &[Rollout], scenario: Option<&Scenario>) -> Summary {
    let futures: Vec<Summary> = rollouts.par_iter().map(one_future).collect();
    let mut summary = Summary::default();
    for future in &futures {
        summary.merge(future);
    }
    if let (Some(scenario), Some(first)) = (scenario, rollouts.first()) {
        let start = first.start();
        let ids: Vec<AgentId> = evaluated(start.agents()).map(|agent| agent.id).collect();
        for displacement in average_displacement(rollouts, scenario, &ids) {
            let agent = start.agent(displacement.agent);
            let kind = agent.map_or(AgentKind::Other, |agent| agent.kind);
            summary.by_kind.entry(kind).or_default().merge(&Part {
                compared: 1,
                sum_ade: displacement.ade,
                sum_min_ade: displacement.min_ade,
                sum_fde: displacement.fde,
                sum_min_fde: displacement.min_fde,
                ..Part::default()
            });
        }
    }
    summary
}

fn evaluated(agents: &[Agent]) -> impl Iterator<Item = &Agent> {
    agents.iter().filter(|agent| agent.kind.is_moving())
}

fn one_future(rollout: &Rollout) -> Summary {
    let collided = collided(rollout);
    let mut summary = Summary {
        futures: 1,
        ..Summary::default()
    };
    for agent in evaluated(rollout.start().agents()) {
        let on_road = is_on_road(&rollout.at(0), agent);
        summary.by_kind.entry(agent.kind).or_default().merge(&Part {
            agents: 1,
            collided: usize::from(collided.contains(&agent.id)),
            on_road: usize::from(on_road),
            left_road: usize::from(on_road && leaves_road(rollout, agent.id)),
            ..Part::default()
        });
    }
    summary
}

/// The agents that ever overlap one that they did not overlap at the start.
fn collided(rollout: &Rollout) -> BTreeSet<AgentId> {
    let start = rollout.start();
    let mut collided = BTreeSet::new();
    for frame in rollout.imagined() {
        for agent in frame.agents() {
            if collided.contains(&agent.id) {
                continue;
            }
            let known = |other: &AgentId| {
                let (a, b) = (start.agent(agent.id), start.agent(*other));
                a.zip(b)
                    .is_some_and(|(a, b)| a.oriented_box().overlaps(&b.oriented_box()))
            };
            if overlapping(frame, agent).any(|other| !known(&other)) {
                collided.insert(agent.id);
            }
        }
    }
    collided
}

/// True for a vehicle that is on the road now, where that is known.
pub(crate) fn is_on_road(scene: &SceneState<'_>, agent: &Agent) -> bool {
    OffRoad.at(scene, agent) == Some(0.0)
}

/// True if a vehicle is off the road at any simulated frame.
pub(crate) fn leaves_road(rollout: &Rollout, id: AgentId) -> bool {
    // Many vehicles stand, and where one stands nothing changes.
    let mut last: Option<([DVec2; 4], f64)> = None;
    (1..=rollout.steps()).any(|step| {
        let scene = rollout.at(step);
        let Some(agent) = scene.now().agent(id) else {
            return false;
        };
        let place = (agent.oriented_box().corners(), agent.elevation);
        if last == Some(place) {
            return false;
        }
        last = Some(place);
        OffRoad.at(&scene, agent) == Some(1.0)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::logged;
    use approx::assert_abs_diff_eq;
    use gump_scene::fixture;

    fn scenario(agents: &str) -> Scenario {
        let road = "edge: -50,-2 200,-2";
        fixture::scenario(&format!(
            "{road}\nego vehicle 0: 0,0 velocity 5,0\n{agents}"
        ))
        .unwrap()
    }

    fn check(agents: &str, collided: usize, left_road: usize) -> Part {
        let scenario = scenario(agents);
        let total = summarize(&[logged(&scenario)], Some(&scenario)).total();
        assert_eq!(
            (total.collided, total.left_road),
            (collided, left_road),
            "{agents}"
        );
        total
    }

    #[test]
    fn both_sides_of_a_collision_count() {
        check("agent vehicle 1: 30,0", 2, 0);
        check("agent vehicle 1: 30,4", 0, 0);
        // An obstacle is hit but not judged.
        let total = check("agent other 1: 30,0", 1, 0);
        assert_eq!(total.agents, 1);
        assert_eq!(total.collision_rate(), Some(1.0));
    }

    #[test]
    fn touching_boxes_do_not_collide() {
        check("agent vehicle 1: 30,2", 0, 0);
    }

    #[test]
    fn agents_that_overlap_from_the_start_do_not_collide_anew() {
        // Beside the ego and faster: they part, or stay together.
        check("agent vehicle 1: 1,0.5 velocity 5,0", 0, 0);
        check("agent vehicle 1: 1,0.5 velocity 8,0", 0, 0);
        // With a third one further on it is another matter.
        check(
            "agent vehicle 1: 1,0.5 velocity 5,0\nagent pedestrian 2: 30,0",
            3,
            0,
        );
    }

    #[test]
    fn leaving_the_road_counts_once_and_only_from_the_road() {
        let total = check("agent vehicle 1: 0,10 velocity 0,-3", 0, 1);
        assert_eq!((total.on_road, total.offroad_rate()), (2, Some(0.5)));
        let total = check("agent vehicle 1: 20,-9 velocity 1,0", 0, 0);
        assert_eq!(total.on_road, 1);
        check("agent pedestrian 1: 40,2 velocity 0,-1", 0, 0);
    }

    #[test]
    fn two_rollouts_and_merging() {
        let scenario = scenario("agent pedestrian 1: 30,5 velocity 0,0");
        let still = {
            let mut rollout = Rollout::begin(scenario.present());
            for _ in 0..80 {
                rollout.push(scenario.present().now().clone());
            }
            rollout
        };
        let rollouts = [logged(&scenario), still];
        let both = summarize(&rollouts, Some(&scenario));
        let vehicles = both.by_kind[&AgentKind::Vehicle];
        assert_eq!(
            (both.futures, vehicles.agents, vehicles.compared),
            (2, 2, 1)
        );
        // The standing ego is 0.5 m behind for every step: 20.25 m on average, 40 m at the end.
        assert_abs_diff_eq!(vehicles.ade().unwrap(), 20.25 / 2.0, epsilon = 1e-9);
        assert_abs_diff_eq!(vehicles.fde().unwrap(), 20.0, epsilon = 1e-9);
        assert_eq!(
            (vehicles.min_ade(), vehicles.min_fde()),
            (Some(0.0), Some(0.0))
        );
        assert_eq!(both.by_kind[&AgentKind::Pedestrian].ade(), Some(0.0));
        assert_eq!(both.total().compared, 2);

        let mut merged = summarize(&rollouts[..1], None);
        merged.merge(&summarize(&rollouts[1..], None));
        assert_eq!(merged, summarize(&rollouts, None));
        assert_eq!(merged.total().ade(), None);
    }

    #[test]
    fn the_number_of_threads_changes_nothing() {
        let scenario = scenario("agent vehicle 1: 30,0\nagent vehicle 2: 0,10 velocity 0,-3");
        let rollouts = vec![logged(&scenario); 5];
        let with = |n: usize| {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(n)
                .build()
                .unwrap();
            pool.install(|| summarize(&rollouts, Some(&scenario)))
        };
        assert_eq!(with(1), with(4));
    }
}
