//! Training of the relative network: draw samples, differentiate, step, save, resume exactly.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use candle_core::backprop::GradStore;
use candle_core::{Device, Tensor};
use gump_kernels::Operands;
use gump_model::checkpoint;
use gump_model::checkpoint::StorageType;
use gump_model::relative::grid::FIELDS;
use gump_model::relative::sample::{Sample, SampleConfig, draw};
use gump_model::relative::{RelativeConfig, RelativeNetwork};
use gump_nn::NnError;
use gump_nn::ops::{Deferred, PackedWeights};
use gump_nn::optimizer::{AdamW, OptimizerConfig};
use gump_nn::parameters::Parameters;
use gump_scene::{Scenario, Seed};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::TrainError;
use crate::gradients::Gradients;
use crate::learner::Update;
use crate::relative::batches::{Batch, BatchReceiver, BatchSource, Drivers, prefetch};
use crate::relative::divergence::Tether;
use crate::relative::drives::RelativeDrives;
use crate::relative::rewards::RewardExclusions;
use crate::relative::settings::RelativeRewards;
use crate::scenes::{DATA, ScenarioSource, check_data};

/// Training settings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RelativeTrainConfig {
    /// Optimiser steps of the whole run.
    pub steps: usize,
    /// Samples per step.
    pub batch: usize,
    /// The seed of all randomness.
    pub seed: u64,
    /// Decay of a moving average of the weights, which is the network to validate and ship.
    pub ema: f64,
    /// Width of the smoothing of targets over neighbouring bins of moves, standard deviation in bins;
    /// standing is never smoothed.
    pub smoothing_bins: f64,
    /// Whether matrix products take their operands in bfloat16; sums and weights stay f32.
    pub mixed_precision: bool,
    /// Drives by the network in training; without them samples show logs.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub closed_loop: Option<RelativeDrives>,
    /// Learning from rollouts with rewards, in addition to the samples.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub realism: Option<RelativeRewards>,
    /// Settings of samples.
    pub sample: SampleConfig,
    /// Settings of the optimizer.
    pub optimizer: OptimizerConfig,
}

impl Default for RelativeTrainConfig {
    fn default() -> Self {
        Self {
            steps: 20_000,
            batch: 4,
            seed: 0,
            ema: 0.999,
            smoothing_bins: 0.7,
            mixed_precision: false,
            closed_loop: None,
            realism: None,
            sample: SampleConfig::default(),
            optimizer: OptimizerConfig {
                learning_rate: 1e-3,
                clip: 1.0,
                ..OptimizerConfig::default()
            },
        }
    }
}

impl RelativeTrainConfig {
    /// Number of steps between updates of the driving network, if there is one.
    fn refresh(&self) -> Option<usize> {
        let drives = self.closed_loop.as_ref().map(|drives| drives.refresh);
        let rewards = self.realism.as_ref().map(|rewards| rewards.refresh);
        drives.into_iter().chain(rewards).min()
    }

    /// Checks that the values are in their ranges.
    ///
    /// # Errors
    /// [`TrainError::Config`] naming the first that is not.
    pub fn validate(&self) -> Result<(), TrainError> {
        if self.batch == 0 || self.steps == 0 {
            return Err(TrainError::Config {
                key: if self.batch == 0 { "batch" } else { "steps" },
                reason: "batch and steps must be at least 1".into(),
            });
        }
        let sample = &self.sample;
        // A target is the frame after one that is seen.
        let counts = [
            ("sample.frames", sample.frames, 2),
            ("sample.max_agents", sample.max_agents, 1),
        ];
        if let Some((key, found, least)) = counts.iter().find(|(_, found, least)| found < least) {
            return Err(TrainError::Config {
                key,
                reason: format!("{key} must be at least {least}, found {found}"),
            });
        }
        let probabilities = [
            ("sample.perturbed", sample.perturbed),
            ("sample.hide_limits", sample.hide_limits),
            ("sample.hide_stop_signs", sample.hide_stop_signs),
            ("sample.hide_lights", sample.hide_lights),
            ("sample.hide_size", sample.hide_size),
            ("sample.cut_tracks", sample.cut_tracks),
            ("sample.forget", sample.forget),
            ("sample.forget_free", sample.forget_free),
            ("sample.routes", sample.routes),
        ];
        let wrong = probabilities
            .iter()
            .find(|(_, value)| !(0.0..=1.0).contains(value));
        if let Some((key, value)) = wrong {
            return Err(TrainError::Config {
                key,
                reason: format!("{key} must be between 0 and 1, found {value}"),
            });
        }
        self.closed_loop
            .as_ref()
            .map_or(Ok(()), RelativeDrives::validate)?;
        self.realism
            .as_ref()
            .map_or(Ok(()), RelativeRewards::validate)?;
        Ok(self.optimizer.validate()?)
    }
}

/// The result of one step.
#[derive(Clone, Debug, Serialize)]
pub struct RelativeStep {
    /// Number of steps done, including this one.
    pub step: usize,
    /// Mean over moves, nats: all fields together.
    pub loss: f64,
    /// The same by field: stands, ahead, left, turn.
    pub fields: [f64; FIELDS],
    /// Norm of the gradient before clipping.
    pub gradient_norm: f64,
    /// Learning rate of the step.
    pub learning_rate: f64,
    /// Agent-frames presented.
    pub nodes: usize,
    /// Realism of the rollouts used in the step, if any.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rollouts: Option<f64>,
    /// Mean entropy of the network before the step on the rewarded moves, nats a move, if any.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub entropy: Option<f64>,
    /// Mean divergence from the network at the start of the run on the same moves, nats a move, with
    /// [`RelativeRewards::kl_target`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub kl: Option<f64>,
    /// Weight that it had in the loss.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub kl_weight: Option<f64>,
}

/// A training run.
pub struct RelativeTrainer {
    state: State,
    config: RelativeTrainConfig,
    source: Arc<BatchSource>,
    excluded: RewardExclusions,
    next: BatchReceiver,
}

/// What changes in a run, and what of its beginning is still needed.
struct State {
    trained: RelativeNetwork,
    average: RelativeNetwork,
    optimizer: AdamW,
    step: usize,
    /// The network that drives the agents of samples, as of the last update.
    driving: Option<RelativeNetwork>,
    /// Keeps the network near that of the beginning.
    tether: Option<Tether>,
}

impl RelativeTrainer {
    /// Starts a run on a new network.
    ///
    /// # Errors
    /// A configuration that contradicts itself, or no scenario to train on.
    pub fn new(
        model: RelativeConfig,
        config: RelativeTrainConfig,
        scenarios: impl ScenarioSource + 'static,
        device: &Device,
    ) -> Result<Self, TrainError> {
        let network = RelativeNetwork::random(model, Seed(config.seed).fork(0), device)?;
        Self::continuing(network, config, scenarios)
    }

    /// Starts a run on a trained network, with a new optimizer.
    ///
    /// # Errors
    /// A configuration that contradicts itself, or no scenario to train on.
    pub fn continuing(
        network: RelativeNetwork,
        config: RelativeTrainConfig,
        scenarios: impl ScenarioSource + 'static,
    ) -> Result<Self, TrainError> {
        let average = build_like(&network, copies(&network)?)?;
        let begin = || build_like(&network, copies(&network)?);
        let tether = Tether::begin(config.realism.as_ref(), begin)?;
        let state = State {
            optimizer: AdamW::new(network.parameters())?,
            step: 0,
            driving: driving(&average, &config)?,
            tether,
            trained: network,
            average,
        };
        Self::assemble(state, config, Box::new(scenarios))
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
        let mut archive = checkpoint::read(path)?;
        check_data(&archive, &scenarios)?;
        let model = gump_model::relative::config(&archive)?;
        let text = archive.entry("step")?;
        let step: usize = text
            .parse()
            .map_err(|_| archive.error(format!("its step is \"{text}\", expected a number")))?;
        let config: RelativeTrainConfig =
            serde_json::from_str(archive.entry("train")?).map_err(|error| {
                archive.error(format!("its training configuration is not valid ({error})"))
            })?;
        let mut moments = archive.take(checkpoint::OPTIMIZER);
        let trained = archive.take(checkpoint::TRAINED);
        let driver = archive.take(checkpoint::DRIVER);
        let reference = archive.take(checkpoint::REFERENCE);
        let build =
            |weights| RelativeNetwork::build(model.clone(), Parameters::loaded(weights, device));
        let driving = (!driver.is_empty()).then(|| build(driver)).transpose()?;
        let tether = Tether::begin(config.realism.as_ref(), || Ok(build(reference)?))?;
        let tether = tether.map(|tether| tether.restored(&archive)).transpose()?;
        let (network, average) = (build(trained)?, build(archive.tensors)?);
        let optimizer = AdamW::restore(network.parameters(), step, |name| {
            let tensor = moments.remove(name);
            tensor.ok_or_else(|| NnError::MissingTensor {
                name: name.to_owned(),
            })
        })?;
        let state = State {
            trained: network,
            average,
            optimizer,
            step,
            driving,
            tether,
        };
        Self::assemble(state, config, Box::new(scenarios))
    }

    fn assemble(
        state: State,
        config: RelativeTrainConfig,
        scenarios: Box<dyn ScenarioSource>,
    ) -> Result<Self, TrainError> {
        config.validate()?;
        if scenarios.is_empty() {
            return Err(TrainError::NoData { frames: 3 });
        }
        let source = Arc::new(BatchSource {
            scenarios,
            config: config.sample.clone(),
            seed: Seed(config.seed).fork(1),
            batch: config.batch,
        });
        let drivers = Drivers::new(state.driving.as_ref(), &config)?;
        let next = prefetch(&source, state.step, drivers);
        Ok(Self {
            state,
            config,
            source,
            excluded: RewardExclusions::default(),
            next,
        })
    }

    /// What rewards of realism have left out since the run began or was resumed.
    pub fn reward_exclusions(&self) -> RewardExclusions {
        self.excluded
    }

    /// One optimiser step.
    ///
    /// # Errors
    /// [`TrainError::LossNotFinite`], [`TrainError::GradientNotFinite`] or [`TrainError::TooFar`]
    /// before anything is changed, or errors of drawing samples.
    pub fn step(&mut self) -> Result<RelativeStep, TrainError> {
        let drawn = self.next.recv();
        let batch = drawn.unwrap_or(Err(TrainError::NoData { frames: 3 }))?;
        let (config, state) = (&self.config, &mut self.state);
        let is_due = |refresh| state.step.is_multiple_of(refresh);
        let renewed = match config.refresh().is_some_and(is_due) {
            true => driving(&state.average, config)?,
            false => None,
        };
        let drivers = Drivers::new(renewed.as_ref().or(state.driving.as_ref()), config)?;
        let upcoming = prefetch(&self.source, state.step + 1, drivers);
        let report = match state.learn(&batch, config) {
            Ok(report) => report,
            Err(error) => {
                self.next = batch.again();
                return Err(error);
            }
        };
        self.next = upcoming;
        if renewed.is_some() {
            state.driving = renewed;
        }
        let left_out = batch.group.map(|group| group.excluded).unwrap_or_default();
        self.excluded.scenes += left_out.scenes;
        self.excluded.agents += left_out.agents;
        Ok(report)
    }

    /// The loss on other scenarios, without hiding and smoothing; by field, nats.
    ///
    /// # Errors
    /// No scenario long enough, or a tensor error.
    pub fn validate(&self, scenarios: &[Scenario]) -> Result<[f64; FIELDS], TrainError> {
        let config = SampleConfig {
            max_agents: self.config.sample.max_agents,
            ..SampleConfig::plain()
        };
        let samples: Vec<Sample> = scenarios
            .par_iter()
            .enumerate()
            .filter_map(|(i, scenario)| draw(scenario, &config, None, Seed(0).fork(i as u64)))
            .filter(|sample| !sample.targets.is_empty())
            .collect();
        if samples.is_empty() {
            return Err(TrainError::NoData { frames: 3 });
        }
        let total = weight(&samples);
        let network = &self.state.average;
        let sums = samples
            .par_iter()
            .map(|sample| Ok(network.loss(sample, total, 0.0)?.1));
        let sums: Vec<_> = sums.collect::<Result<_, TrainError>>()?;
        Ok(mean_fields(sums.iter(), total))
    }

    /// Writes everything a resumed run needs; the file can also be loaded as a network.
    ///
    /// # Errors
    /// [`TrainError::Model`]; the previous file is intact.
    pub fn save(&self, path: &Path) -> Result<(), TrainError> {
        let named = |prefix: &str, network: &RelativeNetwork| -> BTreeMap<String, Tensor> {
            let all = network.parameters().all();
            all.map(|(name, var)| (format!("{prefix}{name}"), var.as_tensor().clone()))
                .collect()
        };
        let state = &self.state;
        let mut tensors = named("", &state.average);
        tensors.extend(named(checkpoint::TRAINED, &state.trained));
        if let Some(driving) = &state.driving {
            tensors.extend(named(checkpoint::DRIVER, driving));
        }
        let moments = state.optimizer.state();
        tensors.extend(moments.map(|(name, tensor)| (name, tensor.clone())));
        let mut header = gump_model::relative::header(state.trained.config())?;
        if let Some(tether) = &state.tether {
            tensors.extend(named(checkpoint::REFERENCE, tether.reference()));
            header.extend([tether.entry()]);
        }
        let config = serde_json::to_string(&self.config).map_err(TrainError::Json)?;
        header.insert("train".to_owned(), config);
        header.insert("step".to_owned(), state.step.to_string());
        header.insert(DATA.to_owned(), self.source.scenarios.identity());
        Ok(checkpoint::write(path, tensors, header, StorageType::Full)?)
    }

    /// Ends the run and returns the network to use.
    pub fn into_network(self) -> RelativeNetwork {
        self.state.average
    }

    /// Steps done.
    pub fn steps_done(&self) -> usize {
        self.state.step
    }

    /// Its settings.
    pub fn config(&self) -> &RelativeTrainConfig {
        &self.config
    }

    /// The network to use, in its present state: the moving average.
    pub fn network(&self) -> &RelativeNetwork {
        &self.state.average
    }

    /// A copy of it, for a world that is used while training continues.
    ///
    /// # Errors
    /// A tensor error.
    pub fn snapshot(&self) -> Result<RelativeNetwork, TrainError> {
        build_like(&self.state.average, copies(&self.state.average)?)
    }
}

/// The network that drives from now on, if any does.
fn driving(
    average: &RelativeNetwork,
    config: &RelativeTrainConfig,
) -> Result<Option<RelativeNetwork>, TrainError> {
    let copied = config.refresh();
    let copied = copied.map(|_| build_like(average, copies(average)?));
    copied.transpose()
}

/// The result for one sample of a step.
struct Part {
    gradients: GradStore,
    /// Gradients of matrices that are not yet multiplied out.
    deferred: Deferred,
    /// Sums of the fields' cross-entropies, nats.
    sums: [f64; FIELDS],
    /// Sums over rewarded moves, nats; 0 for other samples.
    entropy: f64,
    divergence: f64,
}

impl State {
    /// One step on a batch.
    ///
    /// Error: as [`RelativeTrainer::step`], and nothing has changed.
    fn learn(
        &mut self,
        batch: &Batch,
        config: &RelativeTrainConfig,
    ) -> Result<RelativeStep, TrainError> {
        let judged = batch.judged();
        let n_moves: usize = judged.iter().map(|sample| sample.targets.len()).sum();
        let total = weight(&batch.samples);
        let parts = self.differentiate(&batch.samples, &judged, (total, n_moves), config)?;
        let (imitated, preferred) = parts.split_at(batch.samples.len());
        let fields = mean_fields(imitated.iter().map(|part| &part.sums), total);
        let loss: f64 = fields.iter().sum();
        if !loss.is_finite() {
            let (step, field) = (self.step, "move".to_owned());
            return Err(TrainError::LossNotFinite { step, field });
        }
        let mean = |of: fn(&Part) -> f64| {
            let sum: f64 = preferred.iter().map(of).sum();
            (n_moves > 0).then_some(sum / n_moves as f64)
        };
        let entropy = mean(|part| part.entropy);
        let tether = self.tether.as_ref().filter(|_| n_moves > 0);
        let kl_weight = tether.map(Tether::weight);
        let kl = mean(|part| part.divergence).filter(|_| tether.is_some());
        if let Some((tether, kl)) = tether.zip(kl) {
            tether.check(kl, self.step)?;
        }
        let gradients = summed(self.trained.parameters(), &parts)?;
        let update = Update {
            parameters: self.trained.parameters(),
            average: Some((self.average.parameters(), config.ema)),
            optimizer: &config.optimizer,
            steps: config.steps,
        };
        let (gradient_norm, rate) =
            update.learn(&mut self.optimizer, &mut self.step, &gradients)?;
        if let Some((tether, kl)) = self.tether.as_mut().zip(kl) {
            tether.observe(kl);
        }
        Ok(RelativeStep {
            step: self.step,
            loss,
            fields,
            gradient_norm,
            learning_rate: rate,
            nodes: batch.n_nodes(),
            rollouts: batch.group.as_ref().map(|group| group.realism),
            entropy,
            kl,
            kl_weight,
        })
    }

    /// Gradients of the samples that are imitated, then of those that are rewarded; given the weight
    /// of the moves of the former and the number of the latter's.
    fn differentiate(
        &self,
        imitated: &[Sample],
        judged: &[&Sample],
        (total, n_moves): (f64, usize),
        config: &RelativeTrainConfig,
    ) -> Result<Vec<Part>, TrainError> {
        let (network, smoothing) = (&self.trained, config.smoothing_bins);
        let operands = match config.mixed_precision {
            true => Operands::Bf16,
            false => Operands::F32,
        };
        let rewards = config.realism.as_ref();
        let judged_total = rewards.map_or(1.0, |rewards| n_moves as f64 / rewards.weight);
        let anchor = self.tether.as_ref().map(|tether| tether.anchor(n_moves));
        let imitated = imitated.par_iter().map(|sample| (sample, true));
        let preferred = judged.par_iter().map(|sample| (*sample, false));
        let packed = PackedWeights::default();
        let parts = imitated.chain(preferred).map(|(sample, imitates)| {
            let deferred = Deferred::default();
            let build = || match imitates {
                true => {
                    let (loss, sums) = network.loss(sample, total, smoothing)?;
                    Ok((loss, sums, 0.0, 0.0))
                }
                false => {
                    let found = network.preference(sample, judged_total, anchor)?;
                    Ok((found.loss, found.sums, found.entropy, found.divergence))
                }
            };
            let built: candle_core::Result<_> =
                operands.during(|| packed.during(|| deferred.during(build)));
            let (loss, sums, entropy, divergence) = built?;
            Ok(Part {
                gradients: loss.backward()?,
                deferred,
                sums,
                entropy,
                divergence,
            })
        });
        parts.collect()
    }
}

/// Gradients of all parts together.
fn summed(parameters: &Parameters, parts: &[Part]) -> Result<Gradients, TrainError> {
    let trainable: Vec<_> = parameters.trainable().collect();
    let sums = trainable.into_par_iter().map(|(name, var)| {
        let mut of_samples = parts.iter().filter_map(|part| part.gradients.get(var));
        let sum = match of_samples.next() {
            Some(first) => {
                Some(of_samples.try_fold(first.clone(), |sum, gradient| sum + gradient)?)
            }
            None => None,
        };
        let deferred = parts.iter().map(|part| &part.deferred);
        let sum = Deferred::take_in(deferred, var, sum)?;
        Ok(sum.map(|sum| (name.to_owned(), sum)))
    });
    let sums: Vec<_> = sums.collect::<Result<_, TrainError>>()?;
    Ok(sums.into_iter().flatten().collect())
}

fn weight(samples: &[Sample]) -> f64 {
    let targets = samples.iter().flat_map(|sample| &sample.targets);
    targets.map(|target| f64::from(target.weight)).sum()
}

fn mean_fields<'a>(sums: impl Iterator<Item = &'a [f64; FIELDS]>, total: f64) -> [f64; FIELDS] {
    let mut mean = [0.0; FIELDS];
    for sums in sums {
        for (mean, sum) in mean.iter_mut().zip(sums) {
            *mean += sum / total;
        }
    }
    mean
}

fn copies(network: &RelativeNetwork) -> Result<BTreeMap<String, Tensor>, TrainError> {
    let all = network.parameters().all();
    all.map(|(name, var)| Ok((name.to_owned(), var.as_tensor().copy()?)))
        .collect()
}

fn build_like(
    network: &RelativeNetwork,
    weights: BTreeMap<String, Tensor>,
) -> Result<RelativeNetwork, TrainError> {
    let parameters = Parameters::loaded(weights, network.parameters().device());
    Ok(RelativeNetwork::build(
        network.config().clone(),
        parameters,
    )?)
}
