//! The interactive planner: imagine every proposal, take the one that went best.
//!
//! Which proposals there are is `proposal`'s business, how traffic answers the world's.

use std::sync::Arc;

use gump_metrics::{Collision, Discomfort, Metric, OffRoad, Progress, RedLight, Reduce, Reward};
use gump_rollout::{BoxError, Command, Policy, SimulateConfig, Start, WorldModel, simulate};
use gump_scene::{Agent, AgentState, SceneState, Seed};

use crate::{
    Candidate, CandidateScore, Plan, PlanError, Planner, Proposal, ProposalConfig, emergency_brake,
    propose,
};

/// Two mean rewards this close are a tie; rounding must not decide.
const TIE: f64 = 1e-6;

/// How much to imagine.
#[derive(Clone, Debug, PartialEq)]
pub struct InteractiveConfig {
    /// Which proposals to make.
    pub proposals: ProposalConfig,
    /// Futures per proposal, > 0.
    pub n_futures: usize,
    /// Where chance comes from; every plan starts from it afresh.
    pub seed: Seed,
}

impl Default for InteractiveConfig {
    /// Four futures per proposal, as in the paper.
    fn default() -> Self {
        Self {
            proposals: ProposalConfig::default(),
            n_futures: 4,
            seed: Seed(0),
        }
    }
}

/// Imagines every proposal in a world and takes the one with the best mean reward.
///
/// All proposals times all futures share one session. Future *k* of every proposal has the same
/// seed (common random numbers), so candidates differ through the ego's motion and less through
/// chance. On ties the earlier candidate wins. If every candidate is hopeless
/// ([`CandidateScore::is_hopeless`]), the emergency brake is appended, not imagined, and chosen.
///
/// Scenes are imagined with the way of the proposals as their route: the route itself, continued
/// where it ends, or the lanes ahead where there is none, so that progress always means something.
///
/// Source: the planning of the GUMP paper; it names neither the reward's weights nor the ties.
pub struct Interactive<'w> {
    world: &'w dyn WorldModel,
    reward: Reward,
    config: InteractiveConfig,
}

impl<'w> Interactive<'w> {
    /// Plans with [`planning_reward`].
    ///
    /// # Errors
    /// [`PlanError::Parameter`] for a parameter out of range.
    pub fn new(world: &'w dyn WorldModel, config: InteractiveConfig) -> Result<Self, PlanError> {
        config.proposals.check()?;
        if config.n_futures == 0 {
            return Err(PlanError::Parameter {
                name: "n_futures",
                value: 0.0,
                expected: "at least one future",
            });
        }
        Ok(Self {
            world,
            reward: planning_reward(),
            config,
        })
    }

    /// The same planner with another idea of what is good.
    #[must_use]
    pub fn with_reward(self, reward: Reward) -> Self {
        Self { reward, ..self }
    }

    fn imagine(
        &self,
        scene: SceneState<'_>,
        proposals: Vec<Proposal>,
    ) -> Result<Vec<Candidate>, PlanError> {
        let n_futures = self.config.n_futures;
        let start = Start {
            scene,
            n_futures,
            seed: self.config.seed,
        };
        let starts = vec![start; proposals.len()];
        let horizon = proposals.iter().map(Proposal::horizon).fold(0.0, f64::max);
        let config = SimulateConfig {
            seconds: horizon,
            ..SimulateConfig::default()
        };
        let mut policy = FollowProposals {
            proposals: &proposals,
            n_futures,
            now: scene.ego_now().state,
            n_steps: 0,
        };
        let rollouts =
            simulate(self.world, &starts, Some(&mut policy), &config).map_err(|source| {
                PlanError::World {
                    world: self.world.name().to_owned(),
                    source,
                }
            })?;
        let mut scores = self.reward.over_rollouts(&rollouts, scene.ego).into_iter();
        let candidates = proposals.into_iter().map(|proposal| Candidate {
            proposal,
            score: CandidateScore::new(scores.by_ref().take(n_futures).collect()),
        });
        Ok(candidates.collect())
    }
}

impl Planner for Interactive<'_> {
    fn name(&self) -> &str {
        "interactive"
    }

    fn plan(&mut self, scene: &SceneState<'_>) -> Result<Plan, PlanError> {
        let proposed = propose(scene, &self.config.proposals)?;
        let way = Arc::new(proposed.way);
        let scene_with_way = SceneState {
            route: Some(&way),
            ..*scene
        };
        let mut candidates = self.imagine(scene_with_way, proposed.proposals)?;
        let chosen = match best(&candidates) {
            Some(chosen) => chosen,
            None => {
                candidates.push(Candidate {
                    proposal: emergency_brake(scene, &self.config.proposals)?,
                    score: None,
                });
                candidates.len() - 1
            }
        };
        Ok(Plan { chosen, candidates })
    }
}

/// What [`Interactive`] plans for: getting ahead comfortably, never at the cost of a collision,
/// of leaving the road or of a red light.
///
/// A perfect candidate that drives 60 m in 4 s, 15 m/s, scores 1; standing still in comfort 2/7.
///
/// Source: the weights of progress (5) and comfort (2) in PDM. Progress is taken per 60 m and not
/// as a share of the best candidate's, so that a score means the same in every plan; comfort is
/// the share of frames, as unsmoothed frames nearly always break a bound once.
pub fn planning_reward() -> Reward {
    Reward::new()
        .gate(Collision)
        .gate(OffRoad)
        .gate(RedLight)
        .term(5.0 / 7.0 / 60.0, Progress)
        .term(2.0 / 7.0, Comfort)
}

/// The share of frames that keep all comfort bounds.
#[derive(Clone, Copy, Debug)]
struct Comfort;

impl Metric for Comfort {
    fn name(&self) -> &'static str {
        "comfort"
    }

    fn at(&self, scene: &SceneState<'_>, agent: &Agent) -> Option<f64> {
        Discomfort.at(scene, agent).map(|broken| 1.0 - broken)
    }

    fn reduce(&self) -> Reduce {
        Reduce::Mean
    }
}

/// The first of the best candidates that are not hopeless.
fn best(candidates: &[Candidate]) -> Option<usize> {
    let mut best: Option<(usize, f64)> = None;
    for (i, candidate) in candidates.iter().enumerate() {
        let Some(score) = candidate.score.as_ref().filter(|s| !s.is_hopeless()) else {
            continue;
        };
        if best.is_none_or(|(_, mean)| score.mean > mean + TIE) {
            best = Some((i, score.mean));
        }
    }
    best.map(|(i, _)| i)
}

/// Drives row `i * n_futures + k` of a session along proposal `i`.
struct FollowProposals<'a> {
    proposals: &'a [Proposal],
    n_futures: usize,
    /// The ego where all proposals start.
    now: AgentState,
    n_steps: usize,
}

impl Policy for FollowProposals<'_> {
    fn name(&self) -> &str {
        "proposals"
    }

    fn act(&mut self, scenes: &[SceneState<'_>]) -> Result<Vec<Command>, BoxError> {
        self.n_steps += 1;
        let commands = scenes.iter().enumerate().map(|(row, scene)| {
            let elapsed = self.n_steps as f64 * scene.dt;
            let proposal = &self.proposals[row / self.n_futures];
            Command::Follow {
                dt: scene.dt,
                states: vec![proposal.state_at(&self.now, elapsed)],
            }
        });
        Ok(commands.collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ProposalKind;
    use gump_geometry::dvec2;
    use gump_metrics::Speed;
    use gump_rollout::worlds::{ConstantVelocity, Idm};
    use gump_rollout::{RolloutError, Session};
    use gump_scene::{AgentId, Frame, Scenario, fixture};
    use std::sync::Mutex;

    const STREET: &str = "lane 1: 0,0 150,0 400,0 speed 15\nego vehicle 0: 10,0 velocity 10,0\n";

    fn scene(others: &str) -> Scenario {
        fixture::scenario(&format!("{STREET}{others}")).unwrap()
    }

    fn plan_in(world: &dyn WorldModel, scenario: &Scenario) -> Plan {
        let config = InteractiveConfig {
            n_futures: 2,
            ..InteractiveConfig::default()
        };
        let mut planner = Interactive::new(world, config).unwrap();
        planner.plan(&scenario.present()).unwrap()
    }

    fn fraction_and_offset(plan: &Plan) -> (f64, f64) {
        match plan.choice().proposal.kind {
            ProposalKind::Idm {
                speed_fraction,
                lateral_offset,
            } => (speed_fraction, lateral_offset),
            other => panic!("{other} was chosen"),
        }
    }

    #[test]
    fn a_free_road_is_driven_fast_and_in_the_middle() {
        for route in ["", "route 1"] {
            let plan = plan_in(&ConstantVelocity, &scene(route));
            assert_eq!(fraction_and_offset(&plan), (1.0, 0.0));
        }
    }

    #[test]
    fn a_stopped_vehicle_is_stopped_for() {
        let scenario = scene("agent vehicle 1: 45,0");
        for world in [&ConstantVelocity as &dyn WorldModel, &Idm::default()] {
            let plan = plan_in(world, &scenario);
            let last = plan.choice().proposal.states.last().unwrap();
            assert!(last.speed() < 3.0 && last.pose.position.x < 45.0 - 4.8);
            assert!(plan.choice().score.as_ref().unwrap().mean > 0.0);
        }
    }

    #[test]
    fn every_candidate_keeps_its_score() {
        let plan = plan_in(
            &ConstantVelocity,
            &scene("agent vehicle 1: 60,0 velocity 5,0"),
        );
        assert_eq!(plan.candidates.len(), 15);
        let chosen = plan.choice().score.as_ref().unwrap();
        for candidate in &plan.candidates {
            let score = candidate.score.as_ref().unwrap();
            assert_eq!(score.futures.len(), 2);
            assert!(score.mean <= chosen.mean + TIE);
            // The futures of this world are equal.
            assert_eq!(score.standard_error, Some(0.0));
            let names = score.futures[0].gates.iter().map(|gate| gate.name);
            assert_eq!(
                names.collect::<Vec<_>>(),
                ["collision", "off_road", "red_light"]
            );
        }
    }

    #[test]
    fn the_score_of_a_drive_by_hand() {
        let plan = plan_in(&ConstantVelocity, &scene(""));
        // The centred proposal for 6 m/s brakes from 10 m/s; what it drives is its progress.
        let candidate = &plan.candidates[1];
        let driven = candidate.proposal.states.last().unwrap().pose.position.x - 10.0;
        let score = &candidate.score.as_ref().unwrap().futures[0];
        let (progress, comfort) = (score.terms[0].value.unwrap(), score.terms[1].value.unwrap());
        assert!((progress - driven).abs() < 1e-9);
        assert!((0.8..=1.0).contains(&comfort));
        let expected = 5.0 / 7.0 * driven / 60.0 + 2.0 / 7.0 * comfort;
        assert!((score.total - expected).abs() < 1e-12);
    }

    #[test]
    fn plans_repeat_and_do_not_depend_on_earlier_plans() {
        let world = Idm::default();
        let (a, b) = (scene("agent vehicle 1: 50,0 velocity 6,0"), scene(""));
        let mut planner = Interactive::new(&world, InteractiveConfig::default()).unwrap();
        let first = planner.plan(&a.present()).unwrap();
        planner.plan(&b.present()).unwrap();
        assert_eq!(planner.plan(&a.present()).unwrap(), first);
        let mut other = Interactive::new(&world, InteractiveConfig::default()).unwrap();
        assert_eq!(other.plan(&a.present()).unwrap(), first);
    }

    #[test]
    fn the_emergency_brake_is_the_last_resort() {
        let plan = plan_in(&ConstantVelocity, &scene("agent vehicle 1: 17,0"));
        assert_eq!((plan.candidates.len(), plan.chosen), (16, 15));
        assert_eq!(plan.choice().proposal.kind, ProposalKind::EmergencyBrake);
        assert_eq!(plan.choice().score, None);
        let judged = &plan.candidates[..15];
        assert!(
            judged
                .iter()
                .all(|c| c.score.as_ref().unwrap().is_hopeless())
        );
    }

    #[test]
    fn the_reward_decides() {
        let scenario = scene("");
        let mut planner = Interactive::new(&ConstantVelocity, InteractiveConfig::default())
            .unwrap()
            .with_reward(Reward::new().term(-1.0, Speed));
        let plan = planner.plan(&scenario.present()).unwrap();
        assert_eq!(fraction_and_offset(&plan), (0.2, 0.0));
    }

    /// A vehicle at the side pulls out in front of the ego; the rest is constant velocity.
    struct PullsOut {
        starts: Mutex<Vec<(usize, Seed)>>,
    }

    struct PullingOut<'a>(Box<dyn Session + 'a>);

    impl WorldModel for PullsOut {
        fn name(&self) -> &str {
            "pulls-out"
        }

        fn open(&self, starts: &[Start<'_>]) -> Result<Box<dyn Session + '_>, BoxError> {
            self.starts
                .lock()
                .unwrap()
                .extend(starts.iter().map(|start| (start.n_futures, start.seed)));
            Ok(Box::new(PullingOut(ConstantVelocity.open(starts)?)))
        }
    }

    impl Session for PullingOut<'_> {
        fn dt(&self) -> f64 {
            self.0.dt()
        }

        fn step(&mut self, ego: Option<&[AgentState]>) -> Result<Vec<Frame>, BoxError> {
            let frames = self.0.step(ego)?.into_iter().map(|frame| {
                let mut agents = frame.agents().to_vec();
                let intruder = agents.iter_mut().find(|agent| agent.id == AgentId(1));
                if let Some(intruder) = intruder {
                    intruder.state.pose.position.y = 0.0;
                }
                Frame::new(agents, vec![])
            });
            Ok(frames.collect())
        }

        fn replace(&mut self, future: usize, start: Start<'_>) -> Result<(), BoxError> {
            self.0.replace(future, start)
        }
    }

    #[test]
    fn what_the_world_imagines_decides() {
        let scenario = scene("agent vehicle 1: 50,6");
        let (fast, _) = fraction_and_offset(&plan_in(&ConstantVelocity, &scenario));
        let world = PullsOut {
            starts: Mutex::default(),
        };
        let plan = plan_in(&world, &scenario);
        let (slow, _) = fraction_and_offset(&plan);
        assert!(slow < fast, "{slow} is not slower than {fast}");
        assert!(plan.candidates[4].score.as_ref().unwrap().is_hopeless());
        // Common random numbers: one session, every candidate from the same seed.
        assert_eq!(*world.starts.lock().unwrap(), [(2, Seed(0)); 15]);
    }

    struct Broken;

    impl WorldModel for Broken {
        fn name(&self) -> &str {
            "broken"
        }

        fn open(&self, _: &[Start<'_>]) -> Result<Box<dyn Session + '_>, BoxError> {
            Err(RolloutError::Duration(0.0).into())
        }
    }

    #[test]
    fn what_goes_wrong_is_reported() {
        let check = |world: &dyn WorldModel, config, scenario: &Scenario| {
            Interactive::new(world, config)
                .and_then(|mut planner| planner.plan(&scenario.present()))
                .unwrap_err()
        };
        let config = InteractiveConfig::default();
        let error = check(&Broken, config.clone(), &scene(""));
        assert!(matches!(error, PlanError::World { ref world, .. } if world == "broken"));
        let none = InteractiveConfig {
            n_futures: 0,
            ..config.clone()
        };
        let error = check(&ConstantVelocity, none, &scene(""));
        assert!(matches!(
            error,
            PlanError::Parameter {
                name: "n_futures",
                ..
            }
        ));
        let mut broken = scene("agent vehicle 1: 50,0");
        let frame = &broken.log[broken.now];
        let mut agents = frame.agents().to_vec();
        agents[1].state.velocity = dvec2(f64::NAN, 0.0);
        broken.log[broken.now] = Frame::new(agents, vec![]);
        let error = check(&ConstantVelocity, config, &broken);
        assert!(matches!(error, PlanError::NotFinite { agent: AgentId(1) }));
    }
}
