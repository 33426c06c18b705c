//! Training: draw samples, differentiate, step, save; interrupted anywhere, it resumes exactly.
//!
//! Sample `i` of step `s` depends on the seed, `s` and `i` alone, so neither threads nor a restart
//! change what is learned.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, channel};

use candle_core::{Device, Tensor};
use gump_raster::RasterSpec;
use gump_scene::{Scenario, Seed};
use gump_tokenizer::{Tokenizer, TokenizerConfig};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::ModelError;
use crate::checkpoint::{self, Precision};
use crate::config::ModelConfig;
use crate::loss::{LossConfig, LossParts, loss};
use crate::mct::Dropout;
use crate::network::Network;
use crate::optimizer::{AdamW, OptimizerConfig};
use crate::parameters::Parameters;
use crate::sample::{Sample, SampleConfig, draw};

/// How to train.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainConfig {
    /// Optimiser steps of the whole run.
    pub steps: usize,
    /// Samples per step.
    pub batch: usize,
    /// Where all randomness comes from.
    pub seed: u64,
    /// How samples are drawn.
    pub sample: SampleConfig,
    /// What is minimised.
    pub loss: LossConfig,
    /// How.
    pub optimizer: OptimizerConfig,
}

impl Default for TrainConfig {
    fn default() -> Self {
        Self {
            steps: 5000,
            batch: 4,
            seed: 0,
            sample: SampleConfig::default(),
            loss: LossConfig::default(),
            optimizer: OptimizerConfig::default(),
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

/// What one step did.
#[derive(Clone, Debug, Serialize)]
pub struct StepReport {
    /// Steps done, this one included.
    pub step: usize,
    /// The loss before the step.
    pub loss: LossParts,
    /// Learning rate of the step.
    pub learning_rate: f64,
    /// Norm of the gradient before clipping.
    pub gradient_norm: f64,
    /// Tokens presented.
    pub tokens: usize,
}

/// A training run.
pub struct Trainer {
    network: Network,
    optimizer: AdamW,
    config: TrainConfig,
    step: usize,
    source: Arc<Source>,
    /// Samples of the next step, being drawn while the present one is computed.
    next: Receiver<Vec<Sample>>,
}

/// Where samples come from; shared with the threads that draw them.
struct Source {
    scenarios: Vec<Scenario>,
    spec: RasterSpec,
    tokenizer: Tokenizer,
    config: SampleConfig,
    batch: usize,
    seed: Seed,
}

impl Source {
    /// The samples of a step. A scenario too short for a sample is replaced by another draw.
    fn samples(&self, step: usize) -> Vec<Sample> {
        let seed = self.seed.fork(step as u64);
        (0..self.batch)
            .filter_map(|i| {
                let seed = seed.fork(i as u64);
                (0..64).find_map(|attempt| {
                    let seed = seed.fork(attempt);
                    let scenario =
                        &self.scenarios[(seed.fork(0).0 % self.scenarios.len() as u64) as usize];
                    draw(
                        scenario,
                        &self.spec,
                        &self.tokenizer,
                        &self.config,
                        seed.fork(1),
                    )
                })
            })
            .collect()
    }
}

impl Trainer {
    /// Starts a run on a new network.
    ///
    /// # Errors
    /// A configuration that contradicts itself, or no scenario to train on.
    pub fn new(
        model: ModelConfig,
        config: TrainConfig,
        scenarios: Vec<Scenario>,
        device: &Device,
    ) -> Result<Self, ModelError> {
        let network = Network::random(model, Seed(config.seed).fork(0), device)?;
        Self::continuing(network, config, scenarios)
    }

    /// Starts a run on a network that has learned something already, with a fresh optimiser.
    ///
    /// # Errors
    /// No scenario to train on.
    pub fn continuing(
        network: Network,
        config: TrainConfig,
        scenarios: Vec<Scenario>,
    ) -> Result<Self, ModelError> {
        let optimizer = AdamW::new(network.parameters())?;
        Self::assemble(network, optimizer, config, 0, scenarios)
    }

    /// Continues a run from its checkpoint, exactly as if it had not been interrupted.
    ///
    /// # Errors
    /// A file that is not a run's checkpoint, or no scenario to train on.
    pub fn resume(
        path: &Path,
        scenarios: Vec<Scenario>,
        device: &Device,
    ) -> Result<Self, ModelError> {
        let mut archive = checkpoint::read(path)?;
        let model = archive.config()?;
        let number = |key: &str| {
            let text = archive.entry(key)?;
            text.parse()
                .map_err(|_| archive.error(format!("its {key} is \"{text}\", expected a number")))
        };
        let step: usize = number("step")?;
        let config: TrainConfig =
            serde_json::from_str(archive.entry("train")?).map_err(|error| {
                archive.error(format!("its training configuration is not valid ({error})"))
            })?;
        let names: Vec<String> = archive
            .tensors
            .keys()
            .filter(|name| !name.starts_with("optimizer."))
            .cloned()
            .collect();
        let weights = names
            .into_iter()
            .filter_map(|name| archive.tensors.remove(&name).map(|tensor| (name, tensor)))
            .collect();
        let network = Network::build(model, Parameters::loaded(weights, device))?;
        let optimizer = AdamW::restore(network.parameters(), step, |name| {
            let tensor = archive.tensors.remove(name);
            tensor.ok_or_else(|| ModelError::MissingTensor {
                name: name.to_owned(),
            })
        })?;
        Self::assemble(network, optimizer, config, step, scenarios)
    }

    fn assemble(
        network: Network,
        optimizer: AdamW,
        config: TrainConfig,
        step: usize,
        scenarios: Vec<Scenario>,
    ) -> Result<Self, ModelError> {
        if scenarios.is_empty() || config.batch == 0 {
            return Err(ModelError::NoData {
                frames: config.sample.frames,
            });
        }
        let source = Arc::new(Source {
            scenarios,
            spec: network.raster_spec().clone(),
            tokenizer: Tokenizer::new(TokenizerConfig::default()),
            config: config.sample.clone(),
            batch: config.batch,
            seed: Seed(config.seed).fork(1),
        });
        let next = prefetch(&source, step);
        Ok(Self {
            network,
            optimizer,
            config,
            step,
            source,
            next,
        })
    }

    /// One optimiser step.
    ///
    /// # Errors
    /// [`ModelError::LossNotFinite`] before anything is changed, or a tensor error.
    pub fn step(&mut self) -> Result<StepReport, ModelError> {
        let samples = self.next.recv().map_err(|_| ModelError::NoData {
            frames: self.config.sample.frames,
        })?;
        if samples.is_empty() {
            return Err(ModelError::NoData {
                frames: self.config.sample.frames,
            });
        }
        self.next = prefetch(&self.source, self.step + 1);
        let seed = Seed(self.config.seed).fork(2).fork(self.step as u64);
        let dropout = Dropout::new(self.network.config().dropout, seed);
        let (total, parts) = loss(
            &self.network,
            &samples,
            &self.config.loss,
            true,
            dropout.as_ref(),
        )?;
        if let Some(field) = parts.first_not_finite() {
            return Err(ModelError::LossNotFinite {
                step: self.step,
                field,
            });
        }
        let gradients = total.backward()?;
        let learning_rate = self.config.optimizer.rate(self.step, self.config.steps);
        let gradient_norm = self.optimizer.step(
            self.network.parameters(),
            &gradients,
            &self.config.optimizer,
            learning_rate,
        )?;
        self.step += 1;
        let tokens = samples.iter().map(|sample| sample.slots.len()).sum();
        Ok(StepReport {
            step: self.step,
            loss: parts,
            learning_rate,
            gradient_norm,
            tokens,
        })
    }

    /// The loss on up to `limit` samples of other scenarios, the ego as centre, no augmentation.
    ///
    /// # Errors
    /// No scenario long enough, or a tensor error.
    pub fn validate(&self, scenarios: &[Scenario], limit: usize) -> Result<LossParts, ModelError> {
        let config = SampleConfig {
            max_agents: self.config.sample.max_agents,
            ..SampleConfig::plain(self.config.sample.frames)
        };
        let source = Arc::clone(&self.source);
        let samples: Vec<Sample> = scenarios
            .par_iter()
            .take(limit)
            .enumerate()
            .filter_map(|(i, scenario)| {
                draw(
                    scenario,
                    &source.spec,
                    &source.tokenizer,
                    &config,
                    Seed(0).fork(i as u64),
                )
            })
            .collect();
        if samples.is_empty() {
            return Err(ModelError::NoData {
                frames: config.frames,
            });
        }
        let loss_config = LossConfig {
            smoothing_bins: 0.0,
            ..self.config.loss.clone()
        };
        let mut sum = LossParts {
            fields: vec![0.0; crate::decoder::STEPS.len()],
            ..LossParts::default()
        };
        for chunk in samples.chunks(self.config.batch) {
            let (_, parts) = loss(&self.network, chunk, &loss_config, false, None)?;
            let share = chunk.len() as f64 / samples.len() as f64;
            sum.total += share * parts.total;
            sum.state += share * parts.state;
            sum.control += share * parts.control;
            sum.trajectory += share * parts.trajectory;
            sum.reconstruction += share * parts.reconstruction;
            sum.fields
                .iter_mut()
                .zip(&parts.fields)
                .for_each(|(s, p)| *s += share * p);
        }
        Ok(sum)
    }

    /// Writes everything a resumed run needs.
    ///
    /// # Errors
    /// [`ModelError::Io`]; the previous file is intact.
    pub fn save(&self, path: &Path) -> Result<(), ModelError> {
        let parameters = self.network.parameters().all();
        let mut tensors: BTreeMap<String, Tensor> = parameters
            .map(|(name, var)| (name.to_owned(), var.as_tensor().clone()))
            .collect();
        tensors.extend(
            self.optimizer
                .state()
                .map(|(name, tensor)| (name, tensor.clone())),
        );
        let mut header = checkpoint::header(self.network.config())?;
        let config =
            serde_json::to_string(&self.config).map_err(|e| ModelError::Config(e.to_string()))?;
        header.insert("train".to_owned(), config);
        header.insert("step".to_owned(), self.step.to_string());
        checkpoint::write(path, tensors, header, Precision::Full)
    }

    /// Steps done.
    pub fn steps_done(&self) -> usize {
        self.step
    }

    /// How it trains.
    pub fn config(&self) -> &TrainConfig {
        &self.config
    }

    /// The network as it is now.
    pub fn network(&self) -> &Network {
        &self.network
    }

    /// Ends the run and keeps the network.
    pub fn into_network(self) -> Network {
        self.network
    }
}

/// Draws the samples of a step while the present one is computed.
///
/// On a thread of its own: a job of the pool could wait for ever behind the step that waits for it.
fn prefetch(source: &Arc<Source>, step: usize) -> Receiver<Vec<Sample>> {
    let (sender, receiver) = channel();
    let source = Arc::clone(source);
    // A receiver that is gone belongs to a trainer that is gone.
    std::thread::spawn(move || drop(sender.send(source.samples(step))));
    receiver
}
