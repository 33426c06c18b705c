//! Motion predictions of scenarios: from files, from a network's trajectory heads, or condensed from
//! the futures of a world.
//!
//! The metrics are in `gump-wosac`.

mod files;
mod scores;

use std::collections::BTreeSet;
use std::path::Path;

use gump_data::{DataError, ScenarioRecord};
use gump_engine::{SamplingConfig, TransformerWorld};
use gump_model::{Device, checkpoint, relative};
use gump_scene::{AgentId, PredictedMode, Prediction, Scenario, Seed};
use gump_wosac::motion::{MotionConfig, evaluate_predictions, forecast};

use self::files::Predictions;
use crate::decoding::Decoding;
use crate::imagine::{frames, imagine};
use crate::monitor::simulating;
use crate::results::{Entry, ResultStore};
use crate::worlds::{WorldName, Worlds};
use crate::{ArgumentError, EvalError, Exclusions, HeadlessNetwork, Monitor, ResumePoint, digest};

pub use self::scores::ScenarioPredictions;

/// A source of predictions.
pub struct PredictionSource<'a>(Kind<'a>);

enum Kind<'a> {
    Files(Predictions),
    Heads(Box<TransformerWorld>),
    World {
        worlds: Box<Worlds<'a>>,
        n_futures: usize,
        decoding: Decoding,
        seed: Seed,
    },
}

/// Predictions of one scenario.
pub struct Predicted {
    /// One for each target, or for each pair of them.
    pub predictions: Vec<Prediction>,
    /// Digest of the futures, or of the heads' predictions; `None` for files.
    pub digest: Option<String>,
}

impl<'a> PredictionSource<'a> {
    /// Reads a `MotionChallengeSubmission` or `ScenarioRollouts` message, or a folder of such files.
    ///
    /// # Errors
    /// A file of another kind, or a scenario that occurs twice.
    pub fn files(path: &Path) -> Result<Self, EvalError> {
        Ok(Self(Kind::Files(Predictions::read(path)?)))
    }

    /// The trajectory heads of a network.
    ///
    /// # Errors
    /// [`ArgumentError::NoTrajectoryHeads`], and weights that cannot be read.
    pub fn heads(path: &Path, device: &Device) -> Result<Self, EvalError> {
        let without = |found| ArgumentError::NoTrajectoryHeads {
            found,
            path: path.to_owned(),
        };
        if relative::is_relative(path)? {
            return Err(without(HeadlessNetwork::Relative).into());
        }
        let network = checkpoint::load(path, device)?;
        if network.trajectory_heads.is_empty() {
            return Err(without(HeadlessNetwork::Sequence).into());
        }
        let world = TransformerWorld::reference(network, SamplingConfig::default());
        Ok(Self(Kind::Heads(Box::new(world))))
    }

    /// `n_futures` of a world; those of scenario `i` come from `seed.fork(i)`.
    pub fn world(
        device: &Device,
        name: &'a WorldName,
        decoding: Decoding,
        n_futures: usize,
        seed: Seed,
    ) -> Self {
        Self(Kind::World {
            worlds: Box::new(Worlds::new(device, name, decoding.sampling.clone())),
            n_futures,
            decoding,
            seed,
        })
    }

    /// [`Decoding::name`] of a world; [`Decoding::NONE`] of others.
    pub fn decoding(&self) -> &'static str {
        match &self.0 {
            Kind::Files(_) | Kind::Heads(_) => Decoding::NONE,
            Kind::World { decoding, .. } => decoding.name,
        }
    }

    /// Removes targets that no world can simulate because they are absent now, and returns their
    /// number.
    ///
    /// Removes none for a file, which must predict all targets, as in the challenge.
    pub fn drop_absent(&self, scenario: &mut Scenario) -> usize {
        let before = scenario.targets.len();
        if !matches!(self.0, Kind::Files(_)) {
            let now = &scenario.log[scenario.now];
            scenario.targets.retain(|&id| now.agent(id).is_some());
        }
        before - scenario.targets.len()
    }

    /// Frames that the monitor of [`predict`](Self::predict) counts; `None` where nothing is
    /// simulated.
    pub fn frames(&self, scenario: &Scenario, config: &MotionConfig) -> Option<u64> {
        match &self.0 {
            Kind::World {
                n_futures,
                decoding,
                ..
            } if !scenario.targets.is_empty() => Some(frames(
                scenario,
                *n_futures,
                &decoding.frames(seconds(config)),
            )),
            _ => None,
        }
    }

    /// Predictions of a scenario, which is the `index`-th.
    ///
    /// # Errors
    /// A scenario that the files lack, an error of the world, a scenario whose steps do not fit, or
    /// [`EvalError::Stopped`].
    pub fn predict(
        &mut self,
        scenario: &Scenario,
        index: usize,
        config: &MotionConfig,
        monitor: &dyn Monitor,
    ) -> Result<Predicted, EvalError> {
        let (predictions, digest) = match &mut self.0 {
            Kind::Files(files) => (files.of(scenario, config)?, None),
            Kind::Heads(world) => {
                let predictions = by_heads(world, scenario, config)?;
                let digest = digest::of_predictions(&predictions);
                (predictions, Some(digest))
            }
            Kind::World { .. } if scenario.targets.is_empty() => (Vec::new(), None),
            Kind::World {
                worlds,
                n_futures,
                decoding,
                seed,
            } => {
                let frames = decoding.frames(seconds(config));
                let world = worlds.of(scenario)?;
                let seed = seed.fork(index as u64);
                let imagined = imagine(world, scenario, *n_futures, &frames, seed, monitor)?;
                let digest = digest::of_rollouts(&imagined.rollouts);
                let predictions = forecast(scenario, &imagined.rollouts, config)?;
                (predictions, Some(digest))
            }
        };
        Ok(Predicted {
            predictions,
            digest,
        })
    }

    /// Scores the predictions of those of `records` that the store wants, and adds them to it; the
    /// monitor counts scenarios. Scenarios of another length or rate are excluded.
    ///
    /// # Errors
    /// The first scenario that cannot be read, predicted or scored, files with predictions of
    /// scenarios that are not there, or [`EvalError::StoppedAndStored`].
    pub fn fill(
        &mut self,
        store: &mut ResultStore<ScenarioPredictions>,
        records: impl Iterator<Item = Result<ScenarioRecord, DataError>>,
        config: &MotionConfig,
        monitor: &dyn Monitor,
    ) -> Result<Exclusions, EvalError> {
        let (mut ids, mut exclusions) = (BTreeSet::new(), Exclusions::default());
        for (index, record) in records.enumerate() {
            if monitor.is_stopped() {
                let from = ResumePoint::From(index);
                return Err(EvalError::StoppedAndStored { from });
            }
            let mut scenario = record?.scenario;
            ids.insert(scenario.id.clone());
            if !store.is_wanted(index) {
                continue;
            }
            let scores = self.score(&mut scenario, index, config, monitor);
            if let Some(scores) = exclusions.sift(scores)? {
                let id = scenario.id;
                store.add(Entry { index, id, scores })?;
                monitor.advance(1);
            }
        }
        self.check_all_used(&ids)?;
        Ok(exclusions)
    }

    /// Predicts a scenario, which is the `index`-th, without its absent targets, and scores it.
    fn score(
        &mut self,
        scenario: &mut Scenario,
        index: usize,
        config: &MotionConfig,
        monitor: &dyn Monitor,
    ) -> Result<ScenarioPredictions, EvalError> {
        let absent = self.drop_absent(scenario);
        let frames = self.frames(scenario, config);
        let monitor = simulating(monitor, frames);
        let predicted = self.predict(scenario, index, config, &*monitor)?;
        let scores = evaluate_predictions(scenario, &predicted.predictions, config)?;
        Ok(ScenarioPredictions::new(&scores, absent, predicted.digest))
    }

    /// Refuses files with predictions of scenarios that are not among `ids`.
    ///
    /// # Errors
    /// The first such scenario.
    pub fn check_all_used(&self, ids: &BTreeSet<String>) -> Result<(), EvalError> {
        match &self.0 {
            Kind::Files(files) => files.check_all_known(ids),
            Kind::Heads(_) | Kind::World { .. } => Ok(()),
        }
    }
}

/// Horizon of the predictions, seconds.
fn seconds(config: &MotionConfig) -> f64 {
    config.n_steps as f64 * config.step_seconds
}

/// The heads' predictions of every target. Targets outside the network's window keep their velocity.
fn by_heads(
    world: &TransformerWorld,
    scenario: &Scenario,
    config: &MotionConfig,
) -> Result<Vec<Prediction>, EvalError> {
    // The route is derived from where the ego drives later.
    let present = scenario.present().unguided();
    let predicted = world.predict_trajectories(present)?;
    let of = |&agent: &AgentId| {
        let own = predicted.iter().find(|found| found.agent == agent);
        let modes = match own {
            Some(own) => own
                .modes
                .iter()
                .map(|mode| PredictedMode {
                    confidence: mode.probability,
                    paths: vec![
                        mode.positions
                            .iter()
                            .take(config.n_steps)
                            .copied()
                            .collect(),
                    ],
                })
                .collect(),
            None => {
                let now = present.now().agent(agent).map(|agent| agent.state);
                let state = now.unwrap_or_default();
                let place = |step: usize| {
                    let seconds = (step + 1) as f64 * config.step_seconds;
                    state.pose.position + state.velocity * seconds
                };
                vec![PredictedMode {
                    confidence: 1.0,
                    paths: vec![(0..config.n_steps).map(place).collect()],
                }]
            }
        };
        Prediction {
            agents: vec![agent],
            modes,
        }
    };
    Ok(scenario.targets.iter().map(of).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_world_predicts_the_targets_that_are_there() {
        let mut scenario = gump_scene::fixture::scenario(
            "lane 1: -50,0 250,0
             ego vehicle 0: 0,0 velocity 8,0
             agent vehicle 1: 30,0 velocity 8,0
             history 1 future 8 dt 0.1",
        )
        .unwrap();
        scenario.targets = vec![AgentId(1), AgentId(9)];
        let (name, config) = (WorldName::ConstantVelocity, MotionConfig::challenge());
        let decoding = Decoding::of(SamplingConfig::default());
        let mut source = PredictionSource::world(&Device::Cpu, &name, decoding, 2, Seed(0));
        assert_eq!(source.drop_absent(&mut scenario), 1);
        assert_eq!(source.frames(&scenario, &config), Some(2 * 80));
        let predicted = source.predict(&scenario, 0, &config, &()).unwrap();
        assert_eq!(predicted.predictions.len(), 1);
        let mode = &predicted.predictions[0].modes[0];
        let last = mode.paths[0].last().unwrap();
        assert!((last.x - 94.0).abs() < 0.1, "{last}");
        source.check_all_used(&BTreeSet::new()).unwrap();
    }

    #[test]
    fn heads_need_a_network() {
        let path = Path::new("nowhere.safetensors");
        assert!(PredictionSource::heads(path, &Device::Cpu).is_err());
    }
}
