//! What a planner is, what it answers, and how it drives.

use gump_metrics::Score;
use gump_rollout::{BoxError, Command, Policy};
use gump_scene::SceneState;

use crate::{PlanError, Proposal};

/// Decides what the ego should do over the next seconds, and can say why.
pub trait Planner {
    /// A short name for tables and reports.
    fn name(&self) -> &str;

    /// The plan for one scene; it depends on the scene and the planner's configuration alone.
    ///
    /// # Errors
    /// [`PlanError`] where no plan can be made.
    fn plan(&mut self, scene: &SceneState<'_>) -> Result<Plan, PlanError>;
}

/// All candidates and which one was chosen.
#[derive(Clone, Debug, PartialEq)]
pub struct Plan {
    /// Index of the chosen candidate, less than the number of candidates.
    pub chosen: usize,
    /// Everything that was considered, in the order of the planner.
    pub candidates: Vec<Candidate>,
}

/// A proposal with what became of it.
#[derive(Clone, Debug, PartialEq)]
pub struct Candidate {
    /// The trajectory.
    pub proposal: Proposal,
    /// How it was judged; `None` if nobody imagined it.
    pub score: Option<CandidateScore>,
}

/// How a candidate did over the imagined futures.
#[derive(Clone, Debug, PartialEq)]
pub struct CandidateScore {
    /// Mean reward over the futures.
    pub mean: f64,
    /// Standard error of the mean; `None` with fewer than two futures.
    pub standard_error: Option<f64>,
    /// The reward of each future with its parts, in their order; never empty.
    pub futures: Vec<Score>,
}

impl Plan {
    /// The chosen candidate.
    ///
    /// # Panics
    /// If [`Plan::chosen`] is out of range.
    pub fn choice(&self) -> &Candidate {
        &self.candidates[self.chosen]
    }
}

impl CandidateScore {
    /// Sums up the futures of a candidate; `None` if there is none.
    pub fn new(futures: Vec<Score>) -> Option<Self> {
        let n = futures.len() as f64;
        if futures.is_empty() {
            return None;
        }
        let mean = futures.iter().map(|score| score.total).sum::<f64>() / n;
        let squares: f64 = futures
            .iter()
            .map(|score| (score.total - mean).powi(2))
            .sum();
        let standard_error = (futures.len() > 1).then(|| (squares / (n - 1.0) / n).sqrt());
        Some(Self {
            mean,
            standard_error,
            futures,
        })
    }

    /// Means over the futures of every gate's factor and every term's value, by name.
    pub fn parts(&self) -> Vec<(&'static str, f64)> {
        let Some(first) = self.futures.first() else {
            return Vec::new();
        };
        let n = self.futures.len() as f64;
        let mean = |value: &dyn Fn(&Score) -> f64| self.futures.iter().map(value).sum::<f64>() / n;
        let gates = (0..first.gates.len())
            .map(|i| (first.gates[i].name, mean(&|score| score.gates[i].factor)));
        let terms = (0..first.terms.len()).map(|i| {
            let value = |score: &Score| score.terms[i].value.unwrap_or(0.0);
            (first.terms[i].name, mean(&value))
        });
        gates.chain(terms).collect()
    }

    /// True if some gate is closed in every future: there is nothing good about the candidate.
    pub fn is_hopeless(&self) -> bool {
        let closed = |score: &Score| score.gates.iter().any(|gate| gate.factor == 0.0);
        self.futures.iter().all(closed)
    }
}

/// Lets a planner drive: it plans afresh at every step of the simulation and follows the choice
/// until the next.
#[derive(Clone, Debug)]
pub struct PlannerPolicy<P> {
    planner: P,
    plans: Vec<Plan>,
}

impl<P: Planner> PlannerPolicy<P> {
    /// Wraps a planner.
    pub fn new(planner: P) -> Self {
        Self {
            planner,
            plans: Vec::new(),
        }
    }

    /// The latest plans, one per scene of the batch; empty before the first.
    pub fn plans(&self) -> &[Plan] {
        &self.plans
    }
}

impl<P: Planner> Policy for PlannerPolicy<P> {
    fn name(&self) -> &str {
        self.planner.name()
    }

    fn act(&mut self, scenes: &[SceneState<'_>]) -> Result<Vec<Command>, BoxError> {
        self.plans = scenes
            .iter()
            .map(|scene| self.planner.plan(scene))
            .collect::<Result<_, _>>()?;
        let commands = self.plans.iter().zip(scenes).map(|(plan, scene)| {
            let now = scene.ego_now().state;
            Command::Follow {
                dt: scene.dt,
                states: plan.choice().proposal.resampled(&now, scene.dt),
            }
        });
        Ok(commands.collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{IdmPlanner, ProposalConfig};
    use gump_geometry::dvec2;
    use gump_metrics::Gate;
    use gump_rollout::worlds::ConstantVelocity;
    use gump_rollout::{SimulateConfig, Start, simulate};
    use gump_scene::{AgentId, Rollout, Seed, fixture};

    fn score(total: f64, factor: f64) -> Score {
        Score {
            total,
            gates: vec![Gate {
                name: "collision",
                factor,
            }],
            terms: vec![],
        }
    }

    fn drive(text: &str, planner: impl Planner) -> Result<(Rollout, Vec<Plan>), BoxError> {
        let scenario = fixture::scenario(text)?;
        let start = Start {
            scene: scenario.present(),
            n_futures: 1,
            seed: Seed(0),
        };
        let mut policy = PlannerPolicy::new(planner);
        let config = SimulateConfig::default();
        let mut rollouts = simulate(&ConstantVelocity, &[start], Some(&mut policy), &config)?;
        Ok((rollouts.remove(0), policy.plans().to_vec()))
    }

    #[test]
    fn the_error_of_a_mean_by_hand() {
        let futures = vec![score(1.0, 1.0), score(2.0, 0.0), score(6.0, 1.0)];
        let found = CandidateScore::new(futures).unwrap();
        assert_eq!(found.mean, 3.0);
        // Variance (4 + 1 + 9) / 2 = 7 over three futures.
        assert_eq!(found.standard_error, Some((7.0f64 / 3.0).sqrt()));
        assert!(!found.is_hopeless());
        let single = CandidateScore::new(vec![score(0.0, 0.0)]).unwrap();
        assert_eq!(single.standard_error, None);
        assert!(single.is_hopeless());
        assert_eq!(CandidateScore::new(vec![]), None);
    }

    #[test]
    fn a_planner_drives_a_simulation() {
        let street = "lane 1: 0,0 400,0 speed 12
ego vehicle 0: 10,0 velocity 12,0";
        let planner = || IdmPlanner::new(ProposalConfig::default()).unwrap();
        let (free, plans) = drive(street, planner()).unwrap();
        assert_eq!(plans.len(), 1);
        let end = free.last().ego_now().state;
        assert!((end.pose.position - dvec2(106.0, 0.0)).length() < 1.0);
        let blocked = format!(
            "{street}
agent vehicle 1: 80,0"
        );
        let (stopped, _) = drive(&blocked, planner()).unwrap();
        let end = stopped.last().ego_now().state;
        // It stands or creeps behind the obstacle, whose rear is at 77.6.
        assert!(
            end.speed() < 2.0 && (65.0..75.2).contains(&end.pose.position.x),
            "{end:?}"
        );
        let other = stopped.last().now().agent(AgentId(1)).unwrap();
        assert!(
            !stopped
                .last()
                .ego_now()
                .oriented_box()
                .overlaps(&other.oriented_box())
        );
    }

    #[test]
    fn displacements_of_a_driven_ego_agree_with_its_velocity() {
        let text = "lane 1: 0,0 60,0 120,40 400,40 speed 12
ego vehicle 0: 40,0.5 velocity 4,0";
        let planner = IdmPlanner::new(ProposalConfig::default()).unwrap();
        let (rollout, _) = drive(text, planner).unwrap();
        let states: Vec<_> = (0..=rollout.steps())
            .map(|step| rollout.at(step).ego_now().state)
            .collect();
        for pair in states.windows(2) {
            let moved = (pair[1].pose.position - pair[0].pose.position) / rollout.dt();
            let middle = (pair[0].velocity + pair[1].velocity) / 2.0;
            assert!((moved - middle).length() < 0.2, "{moved} but {middle}");
        }
    }

    #[test]
    fn an_error_of_the_planner_ends_the_simulation() {
        let planner = IdmPlanner::new(ProposalConfig::default()).unwrap();
        let nowhere = "lane 1: 0,50 100,50
ego vehicle 0: 10,0 velocity 5,0";
        let error = drive(nowhere, planner).unwrap_err();
        assert!(matches!(
            error.downcast_ref(),
            Some(PlanError::NoLaneAhead { .. })
        ));
    }
}
