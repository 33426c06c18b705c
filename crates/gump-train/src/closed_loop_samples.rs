//! Closed-loop training data: scenes driven by the network itself, close to the log.
//!
//! A network trained only on logged histories drifts away from them in its own rollouts. Here it
//! drives recorded scenes: at every step the candidate nearest to the log is taken, agent by agent.
//! `sample` presents these histories with the return to the log as target.
//!
//! Source: closest-among-samples rollouts after Zhang et al. 2025 (CAT-K); one batch of rollouts
//! before training, rather than new ones at every step, after Garcia-Cobo et al. 2025 (RoaD).

use gump_engine::SamplingConfig;
use gump_engine::TransformerWorld;
use gump_geometry::angle_difference;
use gump_model::Network;
use gump_model::steps::{HISTORY, LONGEST_ROLLOUT, stride_of};
use gump_rollout::{Start, WorldModel};
use gump_scene::{Agent, Frame, SceneState, Seed};
use rand::Rng as _;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::TrainError;
use crate::scenes::ScenarioSource;

/// Weight of a radian of heading error, in metres, when candidates are compared: about half a car's
/// length, by which its corners move then. Chosen by hand.
const METRES_PER_RADIAN: f64 = 2.0;

/// Settings of closed-loop training data.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ClosedLoopConfig {
    /// Scenes driven before the first step, for up to 8 s each.
    pub drives: usize,
    /// Draws per agent and step, of which the nearest to the log is used.
    pub candidates: usize,
    /// Temperature of the draws.
    pub temperature: f64,
    /// Probability that a sample shows a driven history.
    pub share: f64,
    /// Share of an agent's distance from the log that is left in the target half a second later: 0
    /// means the logged state itself, however far.
    pub slack: f64,
}

impl Default for ClosedLoopConfig {
    /// Chosen by hand.
    fn default() -> Self {
        Self {
            drives: 1000,
            candidates: 4,
            temperature: 1.0,
            share: 0.5,
            slack: 0.3,
        }
    }
}

impl ClosedLoopConfig {
    /// Error: [`TrainError::Config`] naming the first number out of its range.
    pub(crate) fn validate(&self) -> Result<(), TrainError> {
        let fail = |key: &'static str, what: String| {
            let reason = format!("{key} must be {what}");
            Err(TrainError::Config { key, reason })
        };
        for (key, value) in [
            ("closed_loop.drives", self.drives),
            ("closed_loop.candidates", self.candidates),
        ] {
            if value == 0 {
                return fail(key, "at least 1, found 0".into());
            }
        }
        for (key, share) in [
            ("closed_loop.share", self.share),
            ("closed_loop.slack", self.slack),
        ] {
            if !(0.0..=1.0).contains(&share) {
                return fail(key, format!("between 0 and 1, found {share}"));
            }
        }
        if !self.temperature.is_finite() || self.temperature <= 0.0 {
            let key = "closed_loop.temperature";
            return fail(key, format!("above 0, found {}", self.temperature));
        }
        Ok(())
    }
}

/// A scenario as driven by the network.
#[derive(Clone, Debug)]
pub(crate) struct DrivenScenario {
    /// Index of the scenario.
    pub(crate) scenario: usize,
    /// Index of the log frame from which it starts.
    pub(crate) present: usize,
    /// Log frames per driven frame.
    pub(crate) stride: usize,
    /// Driven frames after the present, with the agents of the log at those times.
    pub(crate) frames: Vec<Frame>,
}

impl DrivenScenario {
    /// The driven frame at a log index; `None` at and before the present, beyond the drive, and
    /// between its frames.
    pub(crate) fn frame(&self, index: usize) -> Option<&Frame> {
        let after = index.checked_sub(self.present)?;
        let steps = after / self.stride;
        (after.is_multiple_of(self.stride) && steps > 0)
            .then(|| self.frames.get(steps - 1))
            .flatten()
    }
}

/// Drives scenes drawn by `seed`; fewer than requested where scenes are too short.
///
/// # Errors
/// Errors of the world.
pub(crate) fn drive(
    network: Network,
    scenarios: &dyn ScenarioSource,
    config: &ClosedLoopConfig,
    seed: Seed,
) -> Result<Vec<DrivenScenario>, TrainError> {
    let sampling = SamplingConfig {
        temperature: Some(config.temperature),
        ..SamplingConfig::default()
    };
    let world = TransformerWorld::new(network, sampling);
    let drives: Vec<Option<DrivenScenario>> = (0..config.drives)
        .into_par_iter()
        .map(|i| {
            let seed = seed.fork(i as u64);
            let scenario = scenarios.pick(0, seed.fork(0).0);
            drive_one(
                &world,
                scenarios,
                scenario,
                config.candidates.max(1),
                seed.fork(1),
            )
        })
        .collect::<Result<_, _>>()?;
    Ok(drives.into_iter().flatten().collect())
}

fn drive_one(
    world: &TransformerWorld,
    scenarios: &dyn ScenarioSource,
    index: usize,
    candidates: usize,
    seed: Seed,
) -> Result<Option<DrivenScenario>, TrainError> {
    let scenario = &*scenarios.get(index)?;
    let stride = stride_of(scenario.dt);
    let lead = (HISTORY - 1) * stride;
    let Some(last) = scenario.log.len().checked_sub(1 + HISTORY * stride) else {
        return Ok(None);
    };
    if last < lead {
        return Ok(None);
    }
    let present = seed.rng().random_range(lead..=last);
    let mut history: Vec<Frame> = (present - lead..=present)
        .step_by(stride)
        .map(|i| scenario.log[i].clone())
        .collect();
    let begun = history.len();
    let has_ego = |frame: &Frame| frame.agent(scenario.ego).is_some();
    if !history.iter().all(has_ego) {
        return Ok(None);
    }
    for step in 1..=LONGEST_ROLLOUT {
        let Some(logged) = scenario.log.get(present + step * stride) else {
            break;
        };
        if !has_ego(logged) {
            break;
        }
        let scene = SceneState {
            map: &scenario.map,
            route: scenario.route.as_ref(),
            history: &history,
            ego: scenario.ego,
            dt: stride as f64 * scenario.dt,
        };
        let start = Start {
            scene,
            n_futures: candidates,
            seed: seed.fork(step as u64),
        };
        let draws = world
            .open(&[start])
            .and_then(|mut session| session.step(None))
            .map_err(TrainError::Rollout)?;
        history.push(nearest(&draws, logged));
    }
    Ok(Some(DrivenScenario {
        scenario: index,
        present,
        stride,
        frames: history.split_off(begun),
    }))
}

/// The logged frame with the pose of every agent replaced by the nearest of its draws.
fn nearest(draws: &[Frame], logged: &Frame) -> Frame {
    let off = |agent: &Agent, truth: &Agent| {
        let turn = angle_difference(agent.state.pose.heading, truth.state.pose.heading);
        agent
            .state
            .pose
            .position
            .distance(truth.state.pose.position)
            + METRES_PER_RADIAN * turn.abs()
    };
    let agents = logged.agents().iter().map(|truth| {
        let drawn = draws.iter().filter_map(|frame| frame.agent(truth.id));
        drawn
            .min_by(|a, b| off(a, truth).total_cmp(&off(b, truth)))
            .map_or(*truth, |agent| truth.with_state(agent.state))
    });
    Frame::new(agents.collect(), logged.lights().to_vec())
}

#[cfg(test)]
mod tests {
    use candle_core::Device;
    use gump_model::ModelConfig;
    use gump_scene::{Scenario, fixture};

    use super::*;

    fn scenario() -> Scenario {
        fixture::scenario(
            "lane 1: -100,0 100,0
             ego vehicle 0: 0,0 velocity 8,0
             agent vehicle 1: 20,0 velocity 5,0
             history 1.0 future 4.0 dt 0.1",
        )
        .unwrap()
    }

    #[test]
    fn the_nearest_draw_of_each_agent_is_taken() {
        let scenario = scenario();
        let logged = &scenario.log[20];
        let moved = |by: [f64; 2]| {
            let agents = logged.agents().iter().zip(by).map(|(agent, by)| {
                let mut state = agent.state;
                state.pose.position.x += by;
                agent.with_state(state)
            });
            Frame::new(agents.collect(), Vec::new())
        };
        let taken = nearest(&[moved([3.0, -1.0]), moved([-2.0, 5.0])], logged);
        let off: Vec<f64> = taken
            .agents()
            .iter()
            .zip(logged.agents())
            .map(|(a, b)| a.state.pose.position.x - b.state.pose.position.x)
            .collect();
        assert!((off[0] + 2.0).abs() < 1e-9 && (off[1] + 1.0).abs() < 1e-9);
    }

    #[test]
    fn drives_repeat_and_more_candidates_stay_nearer_to_the_log() {
        let scenarios = vec![scenario()];
        let network = || Network::random(ModelConfig::tiny(), Seed(1), &Device::Cpu).unwrap();
        let drives = |candidates: usize| {
            let config = ClosedLoopConfig {
                drives: 2,
                candidates,
                ..ClosedLoopConfig::default()
            };
            drive(network(), &scenarios, &config, Seed(3)).unwrap()
        };
        let off = |drives: &[DrivenScenario]| -> f64 {
            let first = drives.iter().map(|drive| {
                let logged = &scenarios[0].log[drive.present + drive.stride];
                let driven = drive.frame(drive.present + drive.stride).unwrap();
                let pairs = driven.agents().iter().zip(logged.agents());
                pairs
                    .map(|(a, b)| a.state.pose.position.distance(b.state.pose.position))
                    .sum::<f64>()
            });
            first.sum()
        };
        let (one, eight) = (drives(1), drives(8));
        assert_eq!(format!("{one:?}"), format!("{:?}", drives(1)));
        assert!(off(&eight) < off(&one), "{} {}", off(&eight), off(&one));
    }
}
