//! Rewards: metrics combined into one number.

use gump_scene::{Agent, AgentId, Rollout, SceneState};
use rayon::prelude::*;

use crate::{Collision, Discomfort, Metric, OffRoad, Progress, over_rollout};

/// Gates multiply, weighted terms add: `score = Π gates · Σ weight · term`.
///
/// A gate is a metric of something bad, from 0 (did not happen) to 1 (happened); its factor is one
/// minus that. A term is any metric. An undefined value leaves a gate open and gives a term no
/// weight in the sum.
///
/// ```
/// use gump_metrics::{Collision, Progress, Reward, logged};
/// use gump_scene::AgentId;
///
/// let scenario = gump_scene::fixture::scenario(
///     "lane 1: 0,0 100,0\nroute 1\nego vehicle 0: 10,0 velocity 5,0",
/// ).unwrap();
/// let reward = Reward::new().gate(Collision).term(0.1, Progress);
/// let score = reward.over_rollout(&logged(&scenario), AgentId(0));
/// assert!((score.total - 4.0).abs() < 1e-9);
/// ```
#[derive(Default)]
pub struct Reward {
    gates: Vec<Box<dyn Metric>>,
    terms: Vec<(f64, Box<dyn Metric>)>,
}

/// The value of a reward with its parts.
#[derive(Clone, Debug, PartialEq)]
pub struct Score {
    /// The reward.
    pub total: f64,
    /// Factors in 0..=1, in the order of the reward.
    pub gates: Vec<Gate>,
    /// Summands, in the order of the reward.
    pub terms: Vec<Term>,
}

/// The effect of one gate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gate {
    /// The metric's name.
    pub name: &'static str,
    /// The factor of the sum, in 0..=1.
    pub factor: f64,
}

/// The contribution of one term.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Term {
    /// The metric's name.
    pub name: &'static str,
    /// Its weight.
    pub weight: f64,
    /// Its value, if it was defined.
    pub value: Option<f64>,
}

impl Reward {
    /// An empty reward.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds a gate: a metric of something bad that cancels the rest.
    #[must_use]
    pub fn gate(mut self, metric: impl Metric + 'static) -> Self {
        self.gates.push(Box::new(metric));
        self
    }

    /// Adds a weighted metric.
    #[must_use]
    pub fn term(mut self, weight: f64, metric: impl Metric + 'static) -> Self {
        self.terms.push((weight, Box::new(metric)));
        self
    }

    /// The reward of one step of reinforcement learning: 0.1 per metre of progress, -5 for a
    /// collision, -5 for leaving the road, -0.05 for discomfort.
    ///
    /// Source: the four parts of the paper's reward. The paper states no weights; ours make a
    /// failure cost about the progress of one episode (50 m).
    pub fn driving_step() -> Self {
        Self::new()
            .term(0.1, Progress)
            .term(-5.0, Collision)
            .term(-5.0, OffRoad)
            .term(-0.05, Discomfort)
    }

    /// The reward of `agent` now.
    pub fn at(&self, scene: &SceneState<'_>, agent: &Agent) -> Score {
        self.score(|metric| metric.at(scene, agent))
    }

    /// The reward of an agent over a whole rollout, every metric reduced over time first.
    pub fn over_rollout(&self, rollout: &Rollout, agent: AgentId) -> Score {
        self.score(|metric| over_rollout(metric, rollout, agent))
    }

    /// [`Reward::over_rollout`] for many rollouts in parallel, in their order.
    pub fn over_rollouts(&self, rollouts: &[Rollout], agent: AgentId) -> Vec<Score> {
        let one = |rollout| self.over_rollout(rollout, agent);
        rollouts.par_iter().map(one).collect()
    }

    fn score(&self, value: impl Fn(&dyn Metric) -> Option<f64>) -> Score {
        let gates = self.gates.iter().map(|metric| Gate {
            name: metric.name(),
            factor: 1.0 - value(metric.as_ref()).unwrap_or(0.0).clamp(0.0, 1.0),
        });
        let terms = self.terms.iter().map(|(weight, metric)| Term {
            name: metric.name(),
            weight: *weight,
            value: value(metric.as_ref()),
        });
        Score::new(gates.collect(), terms.collect())
    }
}

impl Score {
    /// Combines parts as a [`Reward`] does.
    pub fn new(gates: Vec<Gate>, terms: Vec<Term>) -> Self {
        let open: f64 = gates.iter().map(|gate| gate.factor).product();
        let sum: f64 = terms.iter().map(Term::contribution).sum();
        Self {
            total: open * sum,
            gates,
            terms,
        }
    }
}

impl Term {
    /// Weight times value; 0 where the value is not defined.
    pub fn contribution(&self) -> f64 {
        self.value.map_or(0.0, |value| self.weight * value)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Speed, logged};
    use approx::assert_abs_diff_eq;
    use gump_scene::fixture;

    fn score(reward: &Reward, others: &str) -> Score {
        let text = format!("lane 1: 0,0 100,0\nroute 1\nego vehicle 0: 0,0 velocity 5,0\n{others}");
        let rollout = logged(&fixture::scenario(&text).unwrap());
        reward.over_rollout(&rollout, AgentId(0))
    }

    #[test]
    fn terms_add_and_gates_multiply() {
        let reward = Reward::new()
            .gate(Collision)
            .term(0.1, Progress)
            .term(2.0, Speed);
        let free = score(&reward, "");
        assert_abs_diff_eq!(free.total, 0.1 * 40.0 + 2.0 * 5.0, epsilon = 1e-9);
        let hit = score(&reward, "agent vehicle 1: 20,0");
        assert_eq!(hit.total, 0.0);
        assert_eq!((hit.gates[0].name, hit.gates[0].factor), ("collision", 0.0));
        // The parts say what would have been.
        assert_abs_diff_eq!(hit.terms[0].contribution(), 4.0, epsilon = 1e-9);
    }

    #[test]
    fn undefined_values_neither_close_nor_add() {
        // No road edges and no surfaces: off-road is not defined.
        let reward = Reward::new()
            .gate(OffRoad)
            .term(1.0, OffRoad)
            .term(1.0, Speed);
        let free = score(&reward, "");
        assert_eq!(free.gates[0].factor, 1.0);
        assert_eq!(free.terms[0].value, None);
        assert_abs_diff_eq!(free.total, 5.0, epsilon = 1e-9);
        assert_eq!(score(&Reward::new(), "").total, 0.0);
    }

    #[test]
    fn a_step_of_driving_by_hand() {
        let check = |others: &str, expected: f64| {
            let text =
                format!("lane 1: 0,0 100,0\nroute 1\nego vehicle 0: 0,0 velocity 5,0\n{others}");
            let scenario = fixture::scenario(&text).unwrap();
            let scene = scenario.at(scenario.now + 1);
            let score = Reward::driving_step().at(&scene, scene.ego_now());
            assert_abs_diff_eq!(score.total, expected, epsilon = 1e-9);
        };
        check("", 0.05);
        check("agent vehicle 1: 4,0", 0.05 - 5.0);
        check("edge: -9,-0.5 100,-0.5", 0.05 - 5.0);
    }

    #[test]
    fn many_rollouts_keep_their_order() {
        let slow = fixture::scenario("ego vehicle 0: 0,0 velocity 5,0").unwrap();
        let fast = fixture::scenario("ego vehicle 0: 0,0 velocity 9,0").unwrap();
        let reward = Reward::new().term(1.0, Speed);
        let scores = reward.over_rollouts(&[logged(&slow), logged(&fast)], AgentId(0));
        assert_abs_diff_eq!(scores[0].total, 5.0, epsilon = 1e-9);
        assert_abs_diff_eq!(scores[1].total, 9.0, epsilon = 1e-9);
    }
}
