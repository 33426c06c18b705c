//! The trainer: draws samples, differentiates, updates, saves; interrupted anywhere, it resumes
//! exactly.
//!
//! Sample `i` of step `s` depends only on the seed, `s` and `i`, so results do not depend on
//! threads, processes or restarts. Settings are in `config`, samples come from `source`, parts of a
//! batch are summed in `gradients` and `process_group`, and `learner` defines what is saved.

use std::path::Path;
use std::sync::Arc;

use candle_core::Device;
use gump_scene::{Scenario, Seed};
use rayon::prelude::*;
use serde::Serialize;

use gump_model::Network;
use gump_model::checkpoint::{self, StorageType};
use gump_model::config::ModelConfig;
use gump_nn::layers::Dropout;
use gump_nn::ops::{Deferred, PackedWeights};

use crate::closed_loop_samples;
use crate::config::TrainConfig;
use crate::gradients::{BatchGradients, Part};
use crate::learner::TrainState;
use crate::loss::{Counts, LossConfig, LossParts, export, loss};
use crate::process_group::{ProcessGroup, SingleProcess};
use crate::sample::{Reader, Sample, SampleConfig, draw};
use crate::scenes::ScenarioSource;
use crate::source::{SampleReceiver, SampleSource, check_rate, prefetch};
use crate::{ProcessGroupError, TrainError};

/// The result of one step.
#[derive(Clone, Debug, Serialize)]
pub struct StepReport {
    /// Number of steps done, including this one.
    pub step: usize,
    /// The loss before the step.
    pub loss: LossParts,
    /// Learning rate of the step.
    pub learning_rate: f64,
    /// Norm of the gradient before clipping.
    pub gradient_norm: f64,
    /// Tokens presented.
    pub tokens: usize,
    /// Realism of the rollouts used in the step, if any.
    pub rollouts: Option<f64>,
    /// Mean entropy of the network on the rewarded moves, nats a move, if any.
    pub entropy: Option<f64>,
    /// Mean divergence from the network at the start of the run on the same moves, nats a move.
    pub kl: Option<f64>,
    /// Weight that it had in the loss.
    pub kl_weight: Option<f64>,
}

/// The samples of a step.
pub struct Batch {
    samples: Vec<Sample>,
}

impl Batch {
    /// Its tokens.
    pub fn tokens(&self) -> usize {
        self.samples.iter().map(|sample| sample.slots.len()).sum()
    }
}

/// A training run.
pub struct Trainer {
    pub(crate) learner: TrainState,
    pub(crate) config: TrainConfig,
    pub(crate) group: Box<dyn ProcessGroup>,
    pub(crate) source: Arc<SampleSource>,
    /// Samples of the next step, being drawn while the present one is computed.
    pub(crate) next: SampleReceiver,
}

impl Trainer {
    /// Starts a run on a new network.
    ///
    /// # Errors
    /// A configuration that contradicts itself, or no scenario to train on.
    pub fn new(
        model: ModelConfig,
        config: TrainConfig,
        scenarios: impl ScenarioSource + 'static,
        device: &Device,
    ) -> Result<Self, TrainError> {
        let network = Network::random(model, Seed(config.seed).fork(0), device)?;
        Self::continuing(network, config, scenarios)
    }

    /// Starts a run on a trained network, with a new optimizer.
    ///
    /// # Errors
    /// A configuration that contradicts itself, or no scenario to train on.
    pub fn continuing(
        network: Network,
        config: TrainConfig,
        scenarios: impl ScenarioSource + 'static,
    ) -> Result<Self, TrainError> {
        let learner = TrainState::new(network, &config)?;
        Self::assemble(learner, config, Box::new(scenarios))
    }

    /// Continues a run from its checkpoint, exactly as if it had not been interrupted.
    ///
    /// # Errors
    /// A file that is not the checkpoint of a run, other scenarios than it began with, or none.
    pub fn resume(
        path: &Path,
        scenarios: impl ScenarioSource + 'static,
        device: &Device,
    ) -> Result<Self, TrainError> {
        let (learner, config) = TrainState::restore(path, &scenarios, device)?;
        Self::assemble(learner, config, Box::new(scenarios))
    }

    fn assemble(
        learner: TrainState,
        config: TrainConfig,
        scenarios: Box<dyn ScenarioSource>,
    ) -> Result<Self, TrainError> {
        config.validate(1)?;
        let learner = learner.in_precision_of(&config)?;
        if scenarios.is_empty() {
            return Err(TrainError::NoData {
                frames: config.sample.frames,
            });
        }
        let drives = match &config.closed_loop {
            Some(closed_loop) => {
                let seed = Seed(config.seed).fork(3);
                closed_loop_samples::drive(
                    learner.driver()?,
                    scenarios.as_ref(),
                    closed_loop,
                    seed,
                )?
            }
            None => Vec::new(),
        };
        let source = Arc::new(SampleSource {
            drives,
            closed_loop: config.closed_loop.clone().unwrap_or_default(),
            scenarios,
            reader: Reader::of(&learner.network),
            config: config.sample.clone(),
            seed: Seed(config.seed).fork(1),
        });
        let next = prefetch(&source, learner.step, share(&config, &SingleProcess));
        Ok(Self {
            learner,
            config,
            group: Box::new(SingleProcess),
            source,
            next,
        })
    }

    /// The same run, shared with other processes that have started it with the same arguments.
    ///
    /// # Errors
    /// A batch that is too small to be shared.
    pub fn with_group(self, group: impl ProcessGroup + 'static) -> Result<Self, TrainError> {
        self.config.validate(group.size())?;
        let share = share(&self.config, &group);
        Ok(Self {
            next: prefetch(&self.source, self.learner.step, share),
            group: Box::new(group),
            ..self
        })
    }

    /// One optimiser step.
    ///
    /// # Errors
    /// [`TrainError::LossNotFinite`] before anything is changed, [`TrainError::Source`] for a
    /// scenario that cannot be read, [`TrainError::ProcessGroup`] if another process failed, or a tensor
    /// error.
    pub fn step(&mut self) -> Result<StepReport, TrainError> {
        let no_data = TrainError::NoData {
            frames: self.config.sample.frames,
        };
        let drawn = self.next.recv().unwrap_or(Err(no_data));
        if self.any(drawn.is_err())? {
            drawn?;
            return Err(ProcessGroupError::NoSamples.into());
        }
        let samples = drawn?;
        let share = share(&self.config, &*self.group);
        self.next = prefetch(&self.source, self.learner.step + 1, share);
        self.learn_from(&samples)
    }

    /// This process's samples of a step, drawn now.
    ///
    /// # Errors
    /// [`TrainError::Source`] for a scenario that cannot be read.
    pub fn batch(&self, step: usize) -> Result<Batch, TrainError> {
        let share = share(&self.config, &*self.group);
        let samples = self.source.samples(step, &share)?;
        Ok(Batch { samples })
    }

    /// One optimiser step on these samples, which any number of steps may share.
    ///
    /// # Errors
    /// As [`Trainer::step`].
    pub fn step_on(&mut self, batch: &Batch) -> Result<StepReport, TrainError> {
        self.learn_from(&batch.samples)
    }

    /// The loss of a training pass over these samples, without dropout.
    ///
    /// # Errors
    /// A tensor error.
    pub fn loss_of(&self, batch: &Batch) -> Result<f64, TrainError> {
        let (network, config) = (&self.learner.network, &self.config.loss);
        let whole = Counts::of(&batch.samples, config);
        let (_, parts) = loss(network, &batch.samples, config, &whole, true, None)?;
        Ok(parts.total)
    }

    /// Writes the weights and everything that the loss of these samples depends on as safetensors,
    /// for the same step in another language; the metadata `shape` has the configuration as JSON.
    ///
    /// # Errors
    /// [`TrainError::Model`], or a tensor error.
    pub fn export(&self, batch: &Batch, path: &Path) -> Result<(), TrainError> {
        let network = &self.learner.network;
        let (tensors, shape) = export(network, &batch.samples, &self.config.loss)?;
        let mut header = checkpoint::header(network.config())?;
        header.insert("shape".to_owned(), shape.to_string());
        Ok(checkpoint::write(path, tensors, header, StorageType::Full)?)
    }

    fn learn_from(&mut self, samples: &[Sample]) -> Result<StepReport, TrainError> {
        let step = self.learner.step;
        let found = self.differentiate(samples)?;
        if let Some(field) = found.loss.first_not_finite() {
            return Err(TrainError::LossNotFinite { step, field });
        }
        let gradient_norm = self.learner.learn(&found.gradients, &self.config)?;
        Ok(StepReport {
            step: self.learner.step,
            loss: found.loss,
            learning_rate: self.config.optimizer.rate(step, self.config.steps),
            gradient_norm,
            tokens: found.tokens,
            rollouts: None,
            entropy: None,
            kl: None,
            kl_weight: None,
        })
    }

    /// Loss and gradients of a batch, given this process's samples.
    pub(crate) fn differentiate(&self, samples: &[Sample]) -> Result<BatchGradients, TrainError> {
        let (network, config) = (&self.learner.network, &self.config.loss);
        let operands = self.learner.operands;
        let whole = self.total(Counts::of(samples, &self.config.loss))?;
        let seed = Seed(self.config.seed).fork(2);
        let seed = seed.fork(self.learner.step as u64);
        let (mut found, packed) = (BatchGradients::default(), PackedWeights::default());
        let part = samples.len().div_ceil(self.config.accumulate).max(1);
        for (i, samples) in samples.chunks(part).enumerate() {
            let seed = seed.fork((i * self.group.size() + self.group.rank()) as u64);
            let alone = network.samples_together(samples.len());
            let parts = samples.par_chunks(alone).enumerate().map(|(j, samples)| {
                let dropout = Dropout::new(network.config().dropout, seed.fork(j as u64));
                let deferred = Deferred::default();
                let build = || loss(network, samples, config, &whole, true, dropout.as_ref());
                let (total, loss) = operands.during(|| packed.during(|| deferred.during(build)))?;
                let tokens = samples.iter().map(|sample| sample.slots.len()).sum();
                Ok(Part {
                    gradients: total.backward()?,
                    deferred,
                    loss,
                    tokens,
                })
            });
            let parts: Vec<_> = parts.collect::<Result<_, TrainError>>()?;
            found.add(network.parameters(), &parts)?;
        }
        found.share(network.parameters(), &*self.group)?;
        Ok(found)
    }

    /// The loss on up to `limit` samples of other scenarios, with the ego as centre and without
    /// augmentation.
    ///
    /// # Errors
    /// No scenario long enough, or a tensor error.
    pub fn validate(&self, scenarios: &[Scenario], limit: usize) -> Result<LossParts, TrainError> {
        let config = SampleConfig {
            max_agents: self.config.sample.max_agents,
            ..SampleConfig::plain(self.config.sample.frames)
        };
        scenarios.iter().take(limit).try_for_each(check_rate)?;
        let (reader, network) = (&self.source.reader, self.learner.shipped());
        let (rank, size) = (self.group.rank(), self.group.size());
        let samples: Vec<Sample> = scenarios
            .par_iter()
            .take(limit)
            .enumerate()
            .filter(|(i, _)| i % size == rank)
            .filter_map(|(i, scenario)| {
                draw(scenario, None, reader, &config, Seed(0).fork(i as u64))
            })
            .collect();
        let loss_config = LossConfig {
            smoothing_bins: 0.0,
            ..self.config.loss.clone()
        };
        let whole = self.total(Counts::of(&samples, &loss_config))?;
        let mut sum = LossParts::default();
        let part = self.config.batch.div_ceil(self.config.accumulate * size);
        for samples in samples.chunks(part) {
            let (_, parts) = loss(network, samples, &loss_config, &whole, false, None)?;
            sum.add(&parts);
        }
        if size > 1 {
            let mut numbers = sum.numbers();
            self.group.sum(&mut numbers)?;
            sum = LossParts::of_numbers(&numbers);
        }
        Ok(sum)
    }

    /// Targets over all processes.
    ///
    /// Error: there are no targets.
    fn total(&self, own: Counts) -> Result<Counts, TrainError> {
        let mut whole = own;
        if self.group.size() > 1 {
            let mut numbers = whole.numbers();
            self.group.sum(&mut numbers)?;
            whole = Counts::of_numbers(&numbers);
        }
        if whole.scenes == 0.0 {
            let frames = self.config.sample.frames;
            return Err(TrainError::NoData { frames });
        }
        Ok(whole)
    }

    /// True if it is true in any process.
    ///
    /// # Errors
    /// [`TrainError::ProcessGroup`] if the connection to another process is lost.
    pub fn any(&self, flag: bool) -> Result<bool, TrainError> {
        let mut number = [f32::from(u8::from(flag))];
        self.group.sum(&mut number)?;
        Ok(number[0] > 0.0)
    }

    /// Writes everything a resumed run needs.
    ///
    /// # Errors
    /// [`TrainError::Model`]; the previous file is intact.
    pub fn save(&self, path: &Path) -> Result<(), TrainError> {
        let scenarios = self.source.scenarios.as_ref();
        self.learner.save(path, &self.config, scenarios)
    }

    /// Steps done.
    pub fn steps_done(&self) -> usize {
        self.learner.step
    }

    /// Its settings.
    pub fn config(&self) -> &TrainConfig {
        &self.config
    }

    /// The network to use, in its present state: the moving average if there is one.
    pub fn network(&self) -> &Network {
        self.learner.shipped()
    }

    /// A copy of that network, for a world that is used while training continues.
    ///
    /// # Errors
    /// A tensor error.
    pub fn snapshot(&self) -> Result<Network, TrainError> {
        self.learner.snapshot()
    }

    /// Ends the run and returns the network to use.
    pub fn into_network(self) -> Network {
        self.learner.into_shipped()
    }
}

/// Numbers of the samples of a step that a process draws.
pub(crate) fn share(config: &TrainConfig, group: &dyn ProcessGroup) -> Vec<usize> {
    (group.rank()..config.batch).step_by(group.size()).collect()
}
