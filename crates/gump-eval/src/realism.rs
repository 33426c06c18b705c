//! Waymo's realism of recorded scenarios: of a world or of files of rollouts, beside an oracle and
//! constant velocity.
//!
//! [`recordings`] reads scenarios as the metric sees them, [`RolloutSource`] reads or simulates
//! their rollouts, [`evaluate`] scores those of one scenario. The metric itself is in `gump-wosac`.
//!
//! ```no_run
//! use gump_engine::SamplingConfig;
//! use gump_eval::decoding::Decoding;
//! use gump_eval::realism::{RolloutSource, evaluate, recordings};
//! use gump_model::Device;
//! use gump_scene::Seed;
//! use gump_wosac::realism::{Config, Year};
//!
//! let (paths, config) = (["scenarios.tfrecord".into()], Config::of(Year::Y2025));
//! let decoding = Decoding::of(SamplingConfig::default());
//! let mut source = RolloutSource::world("idm".parse()?, decoding, 32, Seed(0));
//! for recorded in recordings(&paths, source.read_options(), |_| true)? {
//!     let recorded = recorded?;
//!     let rollouts = source.rollouts(&Device::Cpu, &recorded, config.mode, &())?;
//!     let scores = evaluate(&recorded, vec![rollouts], 32, &config, |_, _| {})?;
//!     println!("{}", scores.evaluated[0].scores.metametric);
//! }
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
#![allow(
    clippy::disallowed_methods,
    reason = "scoring is timed; layers 0-3 may not look at the clock"
)]

mod recordings;
mod rollouts;

use std::path::PathBuf;
use std::time::Instant;

use gump_model::Device;
use gump_rollout::worlds::ConstantVelocity;
use gump_rollout::{BoxError, SimulateConfig, Start, simulate};
use gump_scene::Seed;
use gump_wosac::realism::{Config, Evaluation, Mode, Reference, Rollouts, Scores};
use serde::{Deserialize, Serialize};

use crate::monitor::simulating;
use crate::results::{Entry, ResultStore};
use crate::{ArgumentError, ErrorContext, EvalError, Exclusions, Monitor, ResumePoint};

pub use recordings::{Recorded, Recordings, recordings};
pub use rollouts::{FoundRollouts, RolloutSource};

/// Scores of one scenario.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ScenarioScores {
    /// Wall seconds that scoring took, without simulation.
    pub seconds: f64,
    /// One for each decoding, in order.
    pub evaluated: Vec<DecodingScores>,
    /// Of the log itself.
    pub oracle: Scores,
    /// Of agents that keep their velocity.
    pub constant_velocity: Scores,
}

/// Scores of the evaluated rollouts under one decoding.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DecodingScores {
    /// `ruled`, `raw` or `paper`; `-` where nothing is decoded.
    pub decoding: String,
    /// Digest of the rollouts, if a world simulated them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub digest: Option<String>,
    /// Of the rollouts.
    pub scores: Scores,
}

/// An evaluation of all scenarios of a set.
pub struct RealismEvaluation<'a> {
    /// The metric.
    pub config: &'a Config,
    /// Rollouts of each scenario.
    pub n_rollouts: usize,
    /// Where learned worlds run.
    pub device: &'a Device,
}

/// Rollouts that were just scored, for [`RealismEvaluation::fill`]'s visitor.
pub struct VisitedRollouts<'a> {
    /// Position of their source.
    pub source: usize,
    /// The scenario.
    pub recorded: &'a Recorded,
    /// The rollouts.
    pub found: &'a FoundRollouts,
    /// Their evaluation.
    pub evaluation: &'a Evaluation<'a>,
}

impl RealismEvaluation<'_> {
    /// Scores those scenarios of `paths` that the store wants, with rollouts of every source, and
    /// adds them to it; the monitor counts scenarios. Scenarios of another length or rate than the
    /// challenge's are excluded.
    ///
    /// # Errors
    /// No source, a first path without scenarios, the first scenario that cannot be read, simulated
    /// or scored, an error of the visitor, or [`EvalError::StoppedAndStored`].
    pub fn fill(
        &self,
        store: &mut ResultStore<ScenarioScores>,
        paths: &[PathBuf],
        sources: &mut [RolloutSource],
        monitor: &dyn Monitor,
        visit: &mut dyn FnMut(VisitedRollouts<'_>) -> Result<(), BoxError>,
    ) -> Result<Exclusions, EvalError> {
        let first = sources.first().ok_or(ArgumentError::NoRollouts)?;
        let options = first.read_options();
        let (done, shard) = (store.indices(), store.shard());
        let wanted = move |index| shard.holds(index) && !done.contains(&index);
        let mut exclusions = Exclusions::default();
        for recorded in recordings(paths, options, wanted)? {
            let scored = recorded.and_then(|recorded| {
                let scores = self.score(&recorded, sources, monitor, visit)?;
                Ok((recorded, scores))
            });
            let Some((recorded, scores)) = exclusions.sift(scored)? else {
                continue;
            };
            let (index, id) = (recorded.index, recorded.log.scenario);
            store.add(Entry { index, id, scores })?;
            monitor.advance(1);
            if monitor.is_stopped() {
                let from = ResumePoint::After(index);
                return Err(EvalError::StoppedAndStored { from });
            }
        }
        Ok(exclusions)
    }

    fn score(
        &self,
        recorded: &Recorded,
        sources: &mut [RolloutSource],
        monitor: &dyn Monitor,
        visit: &mut dyn FnMut(VisitedRollouts<'_>) -> Result<(), BoxError>,
    ) -> Result<ScenarioScores, EvalError> {
        let place = || ErrorContext::Evaluation {
            id: recorded.log.scenario.clone(),
        };
        let found = sources.iter_mut().map(|source| {
            let monitor = simulating(monitor, source.frames(&recorded.scenario));
            let found = source.rollouts(self.device, recorded, self.config.mode, &*monitor);
            found.map_err(|error| error.at(place()))
        });
        let found = found.collect::<Result<Vec<_>, _>>()?;
        let (mut source, mut visited) = (0, Ok(()));
        let scores = evaluate(
            recorded,
            found,
            self.n_rollouts,
            self.config,
            |found, evaluation| {
                if visited.is_ok() {
                    visited = visit(VisitedRollouts {
                        source,
                        recorded,
                        found,
                        evaluation,
                    });
                }
                source += 1;
            },
        )?;
        visited.map_err(EvalError::of_simulation)?;
        Ok(scores)
    }
}

/// Scores the rollouts of one scenario, beside `n_rollouts` of the log and of constant velocity;
/// `visit` sees each evaluation with its rollouts.
///
/// # Errors
/// A log or rollouts that the metric is not defined on.
pub fn evaluate(
    recorded: &Recorded,
    rollouts: Vec<FoundRollouts>,
    n_rollouts: usize,
    config: &Config,
    mut visit: impl FnMut(&FoundRollouts, &Evaluation<'_>),
) -> Result<ScenarioScores, EvalError> {
    let id = &recorded.log.scenario;
    let of_this = |error: EvalError| error.at(ErrorContext::Evaluation { id: id.clone() });
    let baseline = constant_velocity(recorded, config.mode).map_err(of_this)?;
    let oracle = recorded
        .log
        .oracle(n_rollouts, config.mode == Mode::Generation);
    let began = Instant::now();
    let reference = Reference::new(&recorded.log, config)?;
    let mut evaluated = Vec::new();
    for found in rollouts {
        let evaluation = reference.evaluate(&found.rollouts)?;
        visit(&found, &evaluation);
        evaluated.push(DecodingScores {
            decoding: found.decoding.into(),
            digest: found.digest.clone(),
            scores: evaluation.scores,
        });
    }
    Ok(ScenarioScores {
        seconds: began.elapsed().as_secs_f64() / evaluated.len() as f64,
        oracle: reference.evaluate(&oracle)?.scores,
        constant_velocity: reference.evaluate(&baseline.repeated(n_rollouts))?.scores,
        evaluated,
    })
}

/// Rollouts at constant velocity: a single one, since all would be equal.
fn constant_velocity(recorded: &Recorded, mode: Mode) -> Result<Rollouts, EvalError> {
    let start = Start {
        scene: recorded.scenario.present().unguided(),
        n_futures: 1,
        seed: Seed(0),
    };
    let config = SimulateConfig::default();
    let rollouts = simulate(&ConstantVelocity, &[start], None, &config);
    let rollouts = rollouts.map_err(EvalError::of_simulation)?;
    Ok(Rollouts::of(&recorded.log.scenario, &rollouts, mode)?)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use gump_engine::SamplingConfig;
    use gump_model::Device;
    use gump_wosac::realism::Year;

    use super::*;
    use crate::decoding::Decoding;

    #[test]
    fn a_world_is_scored_beside_the_log_and_seen_once() {
        let file = "../../datasets/mini/sumo-hamburg.tfrecord.gz";
        let paths = [Path::new(env!("CARGO_MANIFEST_DIR")).join(file)];
        let config = Config::of(Year::Y2025);
        let decoding = Decoding::of(SamplingConfig::default());
        let idm = "idm".parse().unwrap();
        let mut source = RolloutSource::world(idm, decoding, 4, Seed(0));
        let first = recordings(&paths, source.read_options(), |index| index == 1)
            .unwrap()
            .next();
        let recorded = first.unwrap().unwrap();
        assert_eq!(recorded.index, 1);
        assert_eq!(source.frames(&recorded.scenario), Some(4 * 80));
        let found = source
            .rollouts(&Device::Cpu, &recorded, config.mode, &())
            .unwrap();
        assert_eq!(found.rollouts.count(), 4);
        let mut visited = 0;
        let scores = evaluate(&recorded, vec![found], 4, &config, |_, evaluation| {
            assert!(!evaluation.explain().is_empty());
            visited += 1;
        });
        let scores = scores.unwrap();
        assert_eq!((visited, scores.evaluated.len()), (1, 1));
        for found in [&scores.evaluated[0].scores, &scores.oracle] {
            assert!(0.0 < found.metametric && found.metametric < 1.0);
        }
        assert!(scores.evaluated[0].digest.is_some());
    }

    #[test]
    fn no_paths_and_no_rollouts_are_errors() {
        let error = recordings(&[], gump_data::ReadOptions::ALL, |_| true).err();
        assert!(error.unwrap().to_string().contains("found none"));
        let folder = tempfile::tempdir().unwrap();
        let error = RolloutSource::files(folder.path()).err().unwrap();
        assert!(error.to_string().contains("*.binproto*"), "{error}");
    }
}
