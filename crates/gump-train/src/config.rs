//! How a run is described: its file, and what `--resume` finds in a checkpoint.

use gump_model::ModelError;
use gump_model::config::ModelConfig;
use gump_nn::optimizer::OptimizerConfig;
use serde::{Deserialize, Serialize};

use crate::closed_loop::ClosedLoopConfig;
use crate::loss::LossConfig;
use crate::sample::SampleConfig;

/// How to train.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainConfig {
    /// Optimiser steps of the whole run.
    pub steps: usize,
    /// Samples per step, over all processes.
    pub batch: usize,
    /// Parts that a process cuts its samples of a step into, one after the other in memory. What is
    /// learned does not depend on it, but for a ResNet's batch statistics and dropout.
    pub accumulate: usize,
    /// Where all randomness comes from.
    pub seed: u64,
    /// Share of the old in a moving average of the weights, which is then what is validated and
    /// shipped; none trains without. At step t it is at most (1 + t) / (10 + t), so that the average
    /// forgets where it began.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ema: Option<f64>,
    /// Whether matrices are multiplied in bfloat16, forward and backward; parameters, sums, norms and
    /// the optimiser stay in 32 bits. On a processor without a unit for bfloat16 it saves no time.
    pub mixed_precision: bool,
    /// How samples are drawn.
    pub sample: SampleConfig,
    /// What is minimised.
    pub loss: LossConfig,
    /// How.
    pub optimizer: OptimizerConfig,
    /// Learning from scenes the network drove itself before the first step; for a run that
    /// continues a network, because one that knows nothing drives nowhere.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub closed_loop: Option<ClosedLoopConfig>,
}

impl Default for TrainConfig {
    fn default() -> Self {
        Self {
            steps: 5000,
            batch: 4,
            accumulate: 1,
            seed: 0,
            ema: None,
            mixed_precision: false,
            sample: SampleConfig::default(),
            loss: LossConfig::default(),
            optimizer: OptimizerConfig::default(),
            closed_loop: None,
        }
    }
}

impl TrainConfig {
    /// Checks that the numbers fit together, for so many processes.
    ///
    /// # Errors
    /// [`ModelError::Config`] naming the first contradiction.
    pub fn validate(&self, processes: usize) -> Result<(), ModelError> {
        let fail = |what: String| Err(ModelError::Config(what));
        if self.batch == 0 || self.accumulate == 0 {
            return fail("batch and accumulate must be at least 1".into());
        }
        if self.batch < self.accumulate * processes {
            return fail(format!(
                "a batch of {} cannot be shared among {processes} processes with {} parts each",
                self.batch, self.accumulate
            ));
        }
        self.optimizer.validate()?;
        match self.ema {
            Some(ema) if !(0.0..1.0).contains(&ema) => fail(format!("ema {ema} is not in 0..1")),
            _ => Ok(()),
        }
    }
}

/// A run as its file states it: which model, and how it is trained.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// A preset by name, or a whole [`ModelConfig`].
    pub model: ModelChoice,
    /// How it is trained.
    #[serde(default)]
    pub train: TrainConfig,
}

/// A preset by name, or every number spelled out.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum ModelChoice {
    /// One of [`ModelConfig::PRESETS`].
    Preset(String),
    /// Spelled out.
    Config(Box<ModelConfig>),
}

impl RunConfig {
    /// Reads the TOML form.
    ///
    /// # Errors
    /// [`ModelError::Config`] with the place and the key at fault.
    pub fn from_toml(text: &str) -> Result<Self, ModelError> {
        toml::from_str(text).map_err(|error| ModelError::Config(error.to_string()))
    }

    /// The model's shape.
    ///
    /// # Errors
    /// [`ModelError::Config`] for a preset that does not exist.
    pub fn model(&self) -> Result<ModelConfig, ModelError> {
        match &self.model {
            ModelChoice::Config(config) => Ok((**config).clone()),
            ModelChoice::Preset(name) => ModelConfig::preset(name).ok_or_else(|| {
                let known = ModelConfig::PRESETS.join(", ");
                ModelError::Config(format!("unknown model \"{name}\", expected one of {known}"))
            }),
        }
    }
}
