//! Variants of a network, trained on the same samples and judged by the same held-out scenes.

use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Context as _;
use gump_engine::Mode;
use gump_eval::datasets::{self, Part, Split};
use gump_eval::decoding::Decoding;
use gump_eval::training_set::TrainingSet;
use gump_eval::worlds::WorldName;
use gump_metrics::interval;
use gump_model::checkpoint::StorageType;
use gump_model::{ModelConfig, checkpoint};
use gump_scene::{Scenario, Seed};
use gump_train::{RunConfig, TrainConfig, Trainer};
use gump_wosac::realism::Scores;
use serde::Serialize;
use serde_json::{Value, json};

use super::decoding;
use crate::run::{Run, stop_if_interrupted};
use crate::sampling::Draw;
use crate::shipped;

/// Training configuration of the laptop model.
pub(super) const CONFIG: &str = include_str!("../../../../configs/tiny.toml");
/// Width of an attention head: that of `tiny`.
const HEAD: usize = 32;

/// Arguments shared by ablations that train networks: data, steps and evaluation.
#[derive(Debug, Serialize, clap::Args)]
pub(super) struct TrainVariant {
    /// A folder with a manifest.toml, or any file or folder of scenarios, to train on
    #[arg(long, value_name = "PATH")]
    data: PathBuf,
    /// Scenarios for loss and realism, none of them trained on [default: the shipped procedural
    /// ones]
    #[arg(long, value_name = "PATH")]
    scenarios: Option<PathBuf>,
    /// Optimiser steps of each network
    #[arg(long, value_name = "N", default_value = "1000")]
    steps: NonZeroUsize,
    /// Rollouts of each scenario
    #[arg(long, value_name = "N", default_value = "4")]
    rollouts_per_scenario: NonZeroUsize,
    #[command(flatten)]
    #[serde(flatten)]
    draw: Draw,
}

/// Result of training one network.
pub(super) struct Learned {
    pub(super) parameters: f64,
    /// The held-out loss after so many tokens.
    pub(super) losses: Vec<(f64, f64)>,
    /// The scores of each decoding, under its name.
    scores: Vec<(&'static str, Vec<Scores>)>,
    seconds: f64,
}

/// A training variant with its held-out scenes.
pub(super) struct HeldOut<'a> {
    train_variant: &'a TrainVariant,
    held_out: PathBuf,
    scenes: Vec<Scenario>,
    decodings: Vec<Decoding>,
}

impl TrainVariant {
    /// Optimiser steps of each network.
    pub(super) fn steps(&self) -> usize {
        self.steps.get()
    }

    /// Reads the held-out scenes.
    pub(super) fn begin(&self, run: &mut Run) -> anyhow::Result<HeldOut<'_>> {
        let held_out = match &self.scenarios {
            Some(path) => path.clone(),
            None => shipped::data().join("procedural.tfrecord.gz"),
        };
        run.setting("scenarios", held_out.display().to_string())?;
        let progress = run.progress("reading", 0, "scenarios");
        Ok(HeldOut {
            train_variant: self,
            scenes: datasets::read(&[Part::whole(&held_out)], &progress)?,
            decodings: self.draw.decodings(Mode::PartialAr)?,
            held_out,
        })
    }
}

/// The laptop model and how it is trained, in another width.
pub(super) fn of_width(width: usize) -> anyhow::Result<(ModelConfig, TrainConfig)> {
    let model = ModelConfig {
        width,
        heads: (width / HEAD).max(1),
        ..ModelConfig::tiny()
    };
    Ok((model, RunConfig::from_toml(CONFIG)?.train))
}

impl HeldOut<'_> {
    /// Trains a network, writes its weights as `name`, measures the loss after the steps in
    /// `measured`, and judges its traffic.
    pub(super) fn teach(
        &self,
        run: &mut Run,
        name: &str,
        (model, config): (ModelConfig, TrainConfig),
        measured: &[usize],
    ) -> anyhow::Result<Learned> {
        let weights = run.path(&format!("{name}.safetensors"));
        let began = Instant::now();
        let mut learned = run.phase(&format!("train {name}"), |run| {
            self.train(run, model, config, measured, &weights)
        })?;
        learned.seconds = began.elapsed().as_secs_f64();
        let n = self.train_variant.rollouts_per_scenario.get();
        for way in &self.decodings {
            let judged = run.phase(&format!("score {name}, {}", way.name), |run| {
                let world = WorldName::Model(weights.clone());
                decoding::score(run, &self.held_out, &world, way, n)
            })?;
            learned.scores.push((way.name, judged.scores));
        }
        Ok(learned)
    }

    fn train(
        &self,
        run: &Run,
        model: ModelConfig,
        mut config: TrainConfig,
        measured: &[usize],
        weights: &Path,
    ) -> anyhow::Result<Learned> {
        let progress = run.progress("reading", 0, "scenarios");
        let data = TrainingSet::open(
            &datasets::parts(&self.train_variant.data, Split::Train)?,
            &progress,
        )?;
        drop(progress);
        let steps = self.train_variant.steps();
        config.steps = steps;
        config.seed = run.seed().0;
        config.optimizer.warmup = config.optimizer.warmup.min(steps / 10);
        let mut trainer = Trainer::new(model, config, data, run.device())?;
        let progress = run.progress("training", steps as u64, "steps");
        let (mut tokens, mut losses) = (0, Vec::new());
        for step in 1..=steps {
            stop_if_interrupted()?;
            tokens += trainer.step()?.tokens;
            progress.advance(1);
            if measured.contains(&step) {
                let loss = trainer.validate(&self.scenes, usize::MAX)?.state;
                progress.message(&format!("held-out loss {loss:.3}"));
                losses.push((tokens as f64, loss));
            }
        }
        checkpoint::save(trainer.network(), weights, StorageType::Half)?;
        Ok(Learned {
            parameters: trainer.network().parameters().count() as f64,
            losses,
            scores: Vec::new(),
            seconds: 0.0,
        })
    }
}

impl Learned {
    /// A network with given losses, for tests of loss laws.
    #[cfg(test)]
    pub(super) fn of_losses(parameters: f64, losses: Vec<(f64, f64)>) -> Self {
        Self {
            parameters,
            losses,
            scores: Vec::new(),
            seconds: 0.0,
        }
    }

    /// The row of a table: what was learned in the end, and the realism of 2025; beside that under
    /// rules, that of the network alone.
    pub(super) fn row(&self) -> anyhow::Result<Value> {
        let (tokens, loss) = self.losses.last().context("no loss was measured")?;
        let mut row = json!({
            "parameters": self.parameters,
            "tokens": tokens,
            "loss": loss,
        });
        for (i, (name, scores)) in self.scores.iter().enumerate() {
            let mean = Scores::mean(scores).context("--scenarios: expected some, found none")?;
            let metametrics: Vec<f64> = scores.iter().map(|s| s.metametric).collect();
            let interval = interval(&metametrics, Seed(0));
            let numbers = [
                ("metametric", Some(mean.metametric)),
                ("low", interval.map(|interval| interval.low)),
                ("high", interval.map(|interval| interval.high)),
                ("min_ade", Some(mean.min_ade)),
                ("collision_rate", Some(mean.collision_rate)),
                ("offroad_rate", Some(mean.offroad_rate)),
            ];
            for (key, number) in numbers {
                let key = if i == 0 {
                    key.into()
                } else {
                    format!("{name}_{key}")
                };
                row[key] = json!(number);
            }
            if i == 0 {
                row["decoding"] = json!(name);
            }
        }
        row["training_seconds"] = json!(self.seconds);
        Ok(row)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_recorded_configuration_is_read() {
        let config = RunConfig::from_toml(CONFIG).unwrap();
        assert_eq!(config.model().unwrap(), ModelConfig::tiny());
        assert_eq!(of_width(128).unwrap(), (ModelConfig::tiny(), config.train));
    }
}
