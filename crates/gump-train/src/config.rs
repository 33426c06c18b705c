//! Configuration of a run: its file, and the part stored in a checkpoint.

use gump_model::config::ModelConfig;
use gump_nn::optimizer::OptimizerConfig;
use serde::{Deserialize, Serialize};

use crate::TrainError;
use crate::closed_loop_samples::ClosedLoopConfig;
use crate::loss::LossConfig;
use crate::sample::SampleConfig;

/// Training settings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainConfig {
    /// Optimiser steps of the whole run.
    pub steps: usize,
    /// Samples per step, over all processes.
    pub batch: usize,
    /// Number of parts that a process divides its samples of a step into, processed one after
    /// another to save memory. Results do not depend on it, except for a ResNet's batch statistics
    /// and dropout.
    pub accumulate: usize,
    /// The seed of all randomness.
    pub seed: u64,
    /// Decay of a moving average of the weights, which is then the network to validate and ship;
    /// `None` trains without. At step t it is at most (1 + t) / (10 + t), so that the initial
    /// weights are forgotten.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ema: Option<f64>,
    /// Whether matrices are multiplied in bfloat16, forward and backward; parameters, sums, norms
    /// and the optimizer stay in 32 bits. On a processor without bfloat16 instructions it saves no
    /// time.
    pub mixed_precision: bool,
    /// Settings of samples.
    pub sample: SampleConfig,
    /// Settings of the loss.
    pub loss: LossConfig,
    /// Settings of the optimizer.
    pub optimizer: OptimizerConfig,
    /// Closed-loop training data, generated before the first step; for runs that continue a trained
    /// network, because an untrained one does not drive usefully.
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
    /// Checks that the values are consistent, for this number of processes.
    ///
    /// # Errors
    /// [`TrainError::Config`] naming the first contradiction.
    pub fn validate(&self, processes: usize) -> Result<(), TrainError> {
        let fail = |key: &'static str, reason: String| Err(TrainError::Config { key, reason });
        if self.batch == 0 || self.accumulate == 0 {
            let key = if self.batch == 0 {
                "batch"
            } else {
                "accumulate"
            };
            return fail(key, "batch and accumulate must be at least 1".into());
        }
        if self.batch < self.accumulate * processes {
            return fail(
                "batch",
                format!(
                    "a batch of {} cannot be shared among {processes} processes with {} parts each",
                    self.batch, self.accumulate
                ),
            );
        }
        self.sample.validate()?;
        if let Some(drives) = &self.closed_loop {
            drives.validate()?;
        }
        self.optimizer.validate()?;
        match self.ema {
            Some(ema) if !(0.0..1.0).contains(&ema) => {
                fail("ema", format!("ema {ema} is not in 0..1"))
            }
            _ => Ok(()),
        }
    }
}

/// The content of a run's file: the model and the training settings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// A preset by name, or a complete [`ModelConfig`].
    pub model: ModelChoice,
    /// Training settings.
    #[serde(default)]
    pub train: TrainConfig,
}

/// A preset by name, or all values.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
#[non_exhaustive]
pub enum ModelChoice {
    /// One of [`ModelConfig::PRESETS`].
    Preset(String),
    /// All values.
    Config(Box<ModelConfig>),
}

impl RunConfig {
    /// Reads the TOML form.
    ///
    /// # Errors
    /// [`TrainError::Toml`] with the place and the key at fault.
    pub fn from_toml(text: &str) -> Result<Self, TrainError> {
        toml::from_str(text).map_err(TrainError::Toml)
    }

    /// The model's shape.
    ///
    /// # Errors
    /// [`TrainError::UnknownPreset`].
    pub fn model(&self) -> Result<ModelConfig, TrainError> {
        match &self.model {
            ModelChoice::Config(config) => Ok((**config).clone()),
            ModelChoice::Preset(name) => ModelConfig::preset(name)
                .ok_or_else(|| TrainError::UnknownPreset { name: name.clone() }),
        }
    }
}
