//! Reinforcement learning from rollouts: the contribution of a rollout to the realism of its group
//! is the reward.
//!
//! Futures of a scene are drawn by the network without rules, with the lights of the log, and compared
//! with the log by the metric of Waymo's Sim Agents Challenge. The contribution of each (its
//! leave-one-out value) is the reward, as in RLFTSim (Ahmadi et al., "RLFTSim: Realistic and Controllable Multi-Agent
//! Traffic Simulation via Reinforcement Learning Fine-Tuning", CVPR 2026), here split by agent and
//! step: the return of a move is the sum of later rewards. Moves with a higher return than those of
//! the other futures become more likely, the others less likely.

use std::sync::Arc;

use gump_engine::Routes;
use gump_engine::relative::{MAP_M, RelativeSampling, RelativeWorld};
use gump_model::relative::RelativeNetwork;
use gump_model::relative::map::{Hidden, VectorMap};
use gump_model::relative::sample::{Sample, whole};
use gump_model::steps::{TOKEN_DT, stride_of};
use gump_rollout::{SimulateConfig, Start, simulate};
use gump_scene::{AgentId, Frame, Rollout, Scenario, Seed};
use gump_traffic::{LightControl, Living, LivingConfig, RecordedLights};
use gump_wosac::realism::{Config, LeaveOneOut, Log, Mode, Reference, Rollouts, Year};
use serde::Serialize;

use crate::TrainError;
use crate::relative::advantages::{ByMove, advantages, faults};
use crate::relative::settings::RelativeRewards;
use crate::scenes::with_log;

/// Futures of one scene with the returns of their moves.
pub(super) struct Group {
    pub(super) samples: Vec<Sample>,
    /// Metametric of all of them together.
    pub(super) realism: f64,
    /// What is left out of it and was before it.
    pub(super) excluded: RewardExclusions,
}

/// What rewards of realism have left out.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct RewardExclusions {
    /// Scenes that cannot be compared with their log (too short, without road edges, with another time
    /// step), or whose futures all earn the same.
    pub scenes: usize,
    /// Agents of compared scenes that are not scored, because they are not in the log throughout.
    pub agents: usize,
}

/// A snapshot of the network at a step, which is rolled out.
pub(super) struct Judged {
    world: RelativeWorld,
    config: RelativeRewards,
    metric: Config,
}

impl Judged {
    pub(super) fn new(
        network: &RelativeNetwork,
        config: &RelativeRewards,
    ) -> Result<Self, TrainError> {
        // Moves are judged as the network evaluates them, which is without routes.
        let sampling = RelativeSampling {
            routes: Routes::Never,
            ..RelativeSampling::default()
        };
        Ok(Self {
            world: RelativeWorld::new(network, sampling)?,
            config: config.clone(),
            metric: Config::of(Year::Y2025),
        })
    }

    /// Share of the groups that are drawn among scenes with traffic lights.
    pub(super) fn lit(&self) -> f64 {
        self.config.lit
    }

    /// Rolls a scene out and computes returns; `None` for a scene for which realism is not defined
    /// (too short, without road edges, with another time step) or in which all futures have equal
    /// rewards.
    ///
    /// Error: errors of the rollout.
    pub(super) fn group(
        &self,
        scenario: &Scenario,
        seed: Seed,
    ) -> Result<Option<Group>, TrainError> {
        let scenario = nearest(scenario, self.config.agents);
        let Ok(log) = Log::of(&scenario) else {
            return Ok(None);
        };
        let futures = self.imagine(&scenario, seed)?;
        let Ok(rollouts) = Rollouts::of(&scenario.id, &futures, Mode::SimAgents) else {
            return Ok(None);
        };
        let Ok(reference) = Reference::new(&log, &self.metric) else {
            return Ok(None);
        };
        let Ok(evaluation) = reference.evaluate(&rollouts) else {
            return Ok(None);
        };
        let realism = evaluation.scores.metametric;
        let worth = evaluation.leave_one_out();
        let Some(worth) = worth.filter(|_| realism.is_finite()) else {
            return Ok(None);
        };
        let now = scenario.log[scenario.now].agents().iter();
        let agents = now.filter(|agent| !worth.agents.contains(&agent.id));
        let excluded = RewardExclusions {
            scenes: 0,
            agents: agents.count(),
        };
        let worth = &worth;
        let per_move = (TOKEN_DT / scenario.dt).round() as usize;
        let found = (realism, worth);
        let (config, agents) = (&self.config, &worth.agents);
        let faults = faults(config, &evaluation, agents, &scenario, &futures);
        let earnings = advantages(config, found, &faults, per_move);
        let samples = earnings.and_then(|earned| judged(&scenario, &futures, worth, &earned));
        Ok(samples.map(|samples| Group {
            samples,
            realism,
            excluded,
        }))
    }

    /// Futures of a scene as they are judged: without rules, with the lights of the log, by which the
    /// metric tells who passes at red.
    ///
    /// Error: errors of the rollout.
    pub(super) fn imagine(
        &self,
        scenario: &Scenario,
        seed: Seed,
    ) -> Result<Vec<Rollout>, TrainError> {
        let surroundings = LivingConfig {
            lights: LightControl::Recorded(Arc::new(RecordedLights::of(scenario))),
            arrivals: None,
        };
        let world = Living::new(&self.world, surroundings);
        let start = Start {
            scene: scenario.present().unguided(),
            n_futures: self.config.rollouts,
            seed,
        };
        simulate(&world, &[start], None, &SimulateConfig::default())
            .map_err(|error| TrainError::Rollout(format!("{}: {error}", scenario.id).into()))
    }
}

/// A scene with only the agents nearest to its ego; those that are in the log throughout are scored.
fn nearest(scenario: &Scenario, most: usize) -> Scenario {
    let now = &scenario.log[scenario.now];
    let ego = now.agent(scenario.ego).map(|ego| ego.state.pose.position);
    let ego = ego.unwrap_or_default();
    let moving = now.agents().iter().filter(|agent| agent.kind.is_moving());
    let mut by_distance: Vec<(f64, AgentId)> = moving
        .map(|agent| (agent.state.pose.position.distance(ego), agent.id))
        .collect();
    by_distance.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    by_distance.truncate(most);
    let mut kept: Vec<AgentId> = by_distance.into_iter().map(|(_, id)| id).collect();
    kept.sort_unstable();
    let crop = |frame: &Frame| {
        let agents = frame.agents().iter();
        let agents = agents.filter(|agent| kept.binary_search(&agent.id).is_ok());
        Frame::new(agents.copied().collect(), frame.lights().to_vec())
    };
    let log = scenario.log.iter().map(crop).collect();
    let targets = kept.iter().copied().filter(|id| *id != scenario.ego);
    Scenario {
        targets: targets.collect(),
        ..with_log(scenario, log)
    }
}

/// Each future as a sample whose moves are weighted by their advantages.
fn judged(
    scenario: &Scenario,
    futures: &[Rollout],
    worth: &LeaveOneOut,
    earnings: &ByMove,
) -> Option<Vec<Sample>> {
    let n_moves = earnings.first()?.len() / worth.agents.len();
    let stride = stride_of(scenario.dt);
    let (start, first_move) = (scenario.now % stride, scenario.now / stride);
    let now = &scenario.log[scenario.now];
    let ids: Vec<AgentId> = now.agents().iter().map(|agent| agent.id).collect();
    let scored = |id: &AgentId| worth.agents.iter().position(|agent| agent == id);
    let scored: Vec<Option<usize>> = ids.iter().map(scored).collect();
    let centre = now.agent(scenario.ego)?.state.pose.position;
    let map = VectorMap::new(&scenario.map, centre, MAP_M, Hidden::default());
    let samples = futures.iter().zip(earnings).map(|(future, earned)| {
        let mut log = scenario.log[..=scenario.now].to_vec();
        log.extend(future.imagined().iter().cloned());
        let driven = with_log(scenario, log);
        let mut sample = whole(&driven, start, &ids, &map)?;
        sample.weigh(|agent, frame| {
            let own = scored[agent].zip(frame.checked_sub(first_move));
            own.map_or(0.0, |(agent, k)| earned[agent * n_moves + k] as f32)
        });
        Some(sample)
    });
    samples.collect()
}
