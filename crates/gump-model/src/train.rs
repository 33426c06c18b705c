//! Training: draw samples, differentiate, step, save; interrupted anywhere, it resumes exactly.
//!
//! Sample `i` of step `s` depends on the seed, `s` and `i` alone, so neither threads nor a restart
//! change what is learned.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, channel};

use candle_core::{Device, Tensor};
use gump_scene::{Scenario, Seed};
use rand::Rng as _;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::ModelError;
use crate::checkpoint::{self, Precision};
use crate::closed_loop::{self, ClosedLoopConfig, Drive};
use crate::config::ModelConfig;
use crate::loss::{LossConfig, LossParts, loss};
use crate::mct::Dropout;
use crate::network::Network;
use crate::optimizer::{AdamW, OptimizerConfig};
use crate::parameters::Parameters;
use crate::sample::{Driven, Reader, Sample, SampleConfig, draw};
use crate::scenes::Scenes;

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
            seed: 0,
            sample: SampleConfig::default(),
            loss: LossConfig::default(),
            optimizer: OptimizerConfig::default(),
            closed_loop: None,
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
    /// The weights that drove, for a resumed run to drive the same; empty without closed loop.
    drivers: BTreeMap<String, Tensor>,
    source: Arc<Source>,
    /// Samples of the next step, being drawn while the present one is computed.
    next: Receiver<Result<Vec<Sample>, ModelError>>,
}

/// Where samples come from; shared with the threads that draw them.
struct Source {
    scenarios: Box<dyn Scenes>,
    /// Scenes as the network drove them.
    drives: Vec<Drive>,
    closed_loop: ClosedLoopConfig,
    reader: Reader,
    config: SampleConfig,
    batch: usize,
    seed: Seed,
}

impl Source {
    /// The samples of a step. A scenario too short for a sample is replaced by another draw.
    fn samples(&self, step: usize) -> Result<Vec<Sample>, ModelError> {
        const ATTEMPTS: u64 = 64;
        let seed = self.seed.fork(step as u64);
        let mut samples = Vec::with_capacity(self.batch);
        for i in 0..self.batch {
            let seed = seed.fork(i as u64);
            for attempt in 0..ATTEMPTS {
                if let Some(sample) = self.sample(seed.fork(attempt))? {
                    samples.push(sample);
                    break;
                }
            }
        }
        Ok(samples)
    }

    /// One draw; `None` if the scenario drawn is too short.
    fn sample(&self, seed: Seed) -> Result<Option<Sample>, ModelError> {
        let pick = |n: usize| (seed.fork(0).0 % n as u64) as usize;
        let is_driven =
            !self.drives.is_empty() && seed.fork(2).rng().random_bool(self.closed_loop.share);
        let driven = is_driven.then(|| Driven {
            drive: &self.drives[pick(self.drives.len())],
            slack: self.closed_loop.slack,
        });
        let scenario = driven.map_or_else(|| pick(self.scenarios.len()), |d| d.drive.scenario);
        Ok(draw(
            &*self.scenarios.get(scenario)?,
            driven,
            &self.reader,
            &self.config,
            seed.fork(1),
        ))
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
        scenarios: impl Scenes + 'static,
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
        scenarios: impl Scenes + 'static,
    ) -> Result<Self, ModelError> {
        let optimizer = AdamW::new(network.parameters())?;
        let drivers = match config.closed_loop {
            Some(_) => copies(&network)?,
            None => BTreeMap::new(),
        };
        Self::assemble(network, optimizer, config, 0, drivers, Box::new(scenarios))
    }

    /// Continues a run from its checkpoint, exactly as if it had not been interrupted.
    ///
    /// # Errors
    /// A file that is not a run's checkpoint, or no scenario to train on.
    pub fn resume(
        path: &Path,
        scenarios: impl Scenes + 'static,
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
        let drivers = archive.take(checkpoint::DRIVER);
        let mut moments = archive.take(checkpoint::OPTIMIZER);
        let weights = archive.tensors;
        let network = Network::build(model, Parameters::loaded(weights, device))?;
        let optimizer = AdamW::restore(network.parameters(), step, |name| {
            let tensor = moments.remove(name);
            tensor.ok_or_else(|| ModelError::MissingTensor {
                name: name.to_owned(),
            })
        })?;
        Self::assemble(
            network,
            optimizer,
            config,
            step,
            drivers,
            Box::new(scenarios),
        )
    }

    fn assemble(
        network: Network,
        optimizer: AdamW,
        config: TrainConfig,
        step: usize,
        drivers: BTreeMap<String, Tensor>,
        scenarios: Box<dyn Scenes>,
    ) -> Result<Self, ModelError> {
        if scenarios.is_empty() || config.batch == 0 {
            return Err(ModelError::NoData {
                frames: config.sample.frames,
            });
        }
        let drives = match &config.closed_loop {
            Some(closed_loop) => {
                let weights = Parameters::loaded(drivers.clone(), network.device());
                let driver = Network::build(network.config().clone(), weights)?;
                let seed = Seed(config.seed).fork(3);
                closed_loop::drive(driver, scenarios.as_ref(), closed_loop, seed)?
            }
            None => Vec::new(),
        };
        let source = Arc::new(Source {
            drives,
            closed_loop: config.closed_loop.clone().unwrap_or_default(),
            scenarios,
            reader: Reader::of(&network),
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
            drivers,
            source,
            next,
        })
    }

    /// One optimiser step.
    ///
    /// # Errors
    /// [`ModelError::LossNotFinite`] before anything is changed, [`ModelError::Scene`] for a scenario
    /// that cannot be fetched, or a tensor error.
    pub fn step(&mut self) -> Result<StepReport, ModelError> {
        let samples = self.next.recv().map_err(|_| ModelError::NoData {
            frames: self.config.sample.frames,
        })??;
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
                    None,
                    &source.reader,
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
            sum.lights += share * parts.lights;
            sum.classes += share * parts.classes;
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
        let drivers = self.drivers.iter();
        tensors.extend(
            drivers.map(|(name, tensor)| (format!("{}{name}", checkpoint::DRIVER), tensor.clone())),
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

/// The weights as they are now, whatever becomes of them.
fn copies(network: &Network) -> Result<BTreeMap<String, Tensor>, ModelError> {
    let all = network.parameters().all();
    all.map(|(name, var)| Ok((name.to_owned(), var.as_tensor().copy()?)))
        .collect()
}

/// Draws the samples of a step while the present one is computed.
///
/// On a thread of its own: a job of the pool could wait for ever behind the step that waits for it.
fn prefetch(source: &Arc<Source>, step: usize) -> Receiver<Result<Vec<Sample>, ModelError>> {
    let (sender, receiver) = channel();
    let source = Arc::clone(source);
    // A receiver that is gone belongs to a trainer that is gone.
    std::thread::spawn(move || drop(sender.send(source.samples(step))));
    receiver
}
