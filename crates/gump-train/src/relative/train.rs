//! Training of the relative network: draw samples, differentiate, step, save, resume exactly.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, channel};

use candle_core::backprop::GradStore;
use candle_core::{Device, Tensor};
use gump_kernels::Operands;
use gump_model::checkpoint;
use gump_model::checkpoint::StorageType;
use gump_model::relative::grid::FIELDS;
use gump_model::relative::sample::{Sample, SampleConfig, draw};
use gump_model::relative::{RelativeConfig, RelativeNetwork};
use gump_nn::ops::Deferred;
use gump_nn::optimizer::{AdamW, OptimizerConfig};
use gump_nn::parameters::Parameters;
use gump_nn::{Gradients, NnError};
use gump_scene::{Scenario, Seed};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::TrainError;
use crate::learner::Update;
use crate::relative::drives::{NetworkDriver, RelativeDrives};
use crate::relative::rewards::{Group, Judged, RelativeRewards, RewardExclusions};
use crate::scenes::{DATA, ScenarioSource, check_data};

/// Maximum number of scenes tried for a sample: more mean that hardly any is long enough.
const ATTEMPTS: u64 = 64;
/// Separates the scenes to roll out from those of the samples.
const GROUP: u64 = 1 << 40;

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
}

/// A training run.
pub struct RelativeTrainer {
    trained: RelativeNetwork,
    average: RelativeNetwork,
    optimizer: AdamW,
    config: RelativeTrainConfig,
    step: usize,
    source: Arc<BatchSource>,
    /// The network that drives the agents of samples, as of the last update.
    driving: Option<RelativeNetwork>,
    excluded: RewardExclusions,
    next: Receiver<Result<Batch, TrainError>>,
}

/// The data of a step.
struct Batch {
    samples: Vec<Sample>,
    group: Option<Group>,
}

/// The driving network, for drives and for rewards.
#[derive(Default)]
struct Drivers {
    driver: Option<NetworkDriver>,
    judged: Option<Judged>,
}

struct BatchSource {
    scenarios: Box<dyn ScenarioSource>,
    config: SampleConfig,
    seed: Seed,
    batch: usize,
}

impl BatchSource {
    fn batch(&self, step: usize, drivers: &Drivers) -> Result<Batch, TrainError> {
        let group = drivers.judged.as_ref();
        let group = group.map(|judged| self.group(step, judged));
        Ok(Batch {
            samples: self.samples(step, drivers.driver.as_ref())?,
            group: group.transpose()?,
        })
    }

    fn group(&self, step: usize, judged: &Judged) -> Result<Group, TrainError> {
        let seed = self.seed.fork(step as u64).fork(GROUP);
        for attempt in 0..ATTEMPTS {
            let seed = seed.fork(attempt);
            let scenario = self.scenarios.pick(step, seed.fork(0).0);
            let scenario = self.scenarios.get(scenario)?;
            if let Some(mut group) = judged.group(&scenario, seed.fork(1))? {
                group.excluded.scenes = attempt as usize;
                return Ok(group);
            }
        }
        Err(TrainError::NoComparableScene)
    }

    fn samples(
        &self,
        step: usize,
        driver: Option<&NetworkDriver>,
    ) -> Result<Vec<Sample>, TrainError> {
        let seed = self.seed.fork(step as u64);
        let drawn = (0..self.batch).map(|i| {
            let seed = seed.fork(i as u64);
            for attempt in 0..ATTEMPTS {
                let seed = seed.fork(attempt);
                let scenario = self.scenarios.pick(step, seed.fork(0).0);
                let scenario = self.scenarios.get(scenario)?;
                let sample = draw(
                    &scenario,
                    &self.config,
                    driver.map(|d| d as _),
                    seed.fork(1),
                );
                if let Some(sample) = sample.filter(|sample| !sample.targets.is_empty()) {
                    return Ok(sample);
                }
            }
            Err(TrainError::NoData { frames: 3 })
        });
        drawn.collect()
    }
}

fn prefetch(
    source: &Arc<BatchSource>,
    step: usize,
    drivers: Drivers,
) -> Receiver<Result<Batch, TrainError>> {
    let (sender, receiver) = channel();
    let source = Arc::clone(source);
    // A receiver that is gone belongs to a trainer that is gone.
    std::thread::spawn(move || drop(sender.send(source.batch(step, &drivers))));
    receiver
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
        let optimizer = AdamW::new(network.parameters())?;
        let driving = driving(&average, &config)?;
        let run = (network, average, driving);
        Self::assemble(run, optimizer, config, 0, Box::new(scenarios))
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
        let build =
            |weights| RelativeNetwork::build(model.clone(), Parameters::loaded(weights, device));
        let (network, average) = (build(trained)?, build(archive.tensors)?);
        let driving = (!driver.is_empty()).then(|| build(driver)).transpose()?;
        let optimizer = AdamW::restore(network.parameters(), step, |name| {
            let tensor = moments.remove(name);
            tensor.ok_or_else(|| NnError::MissingTensor {
                name: name.to_owned(),
            })
        })?;
        let run = (network, average, driving);
        Self::assemble(run, optimizer, config, step, Box::new(scenarios))
    }

    fn assemble(
        (network, average, driving): (RelativeNetwork, RelativeNetwork, Option<RelativeNetwork>),
        optimizer: AdamW,
        config: RelativeTrainConfig,
        step: usize,
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
        let next = prefetch(&source, step, drivers(driving.as_ref(), &config)?);
        Ok(Self {
            trained: network,
            average,
            optimizer,
            config,
            step,
            source,
            driving,
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
    /// [`TrainError::LossNotFinite`] or [`TrainError::GradientNotFinite`] before anything is changed, or
    /// errors of drawing samples.
    pub fn step(&mut self) -> Result<RelativeStep, TrainError> {
        let drawn = self.next.recv();
        let Batch { samples, group } = drawn.unwrap_or(Err(TrainError::NoData { frames: 3 }))?;
        let refresh = self.config.refresh();
        if refresh.is_some_and(|refresh| self.step.is_multiple_of(refresh)) {
            self.driving = driving(&self.average, &self.config)?;
        }
        let drivers = drivers(self.driving.as_ref(), &self.config)?;
        self.next = prefetch(&self.source, self.step + 1, drivers);
        let left_out = group
            .as_ref()
            .map(|group| group.excluded)
            .unwrap_or_default();
        self.excluded.scenes += left_out.scenes;
        self.excluded.agents += left_out.agents;
        let total = weight(&samples);
        let (network, smoothing) = (&self.trained, self.config.smoothing_bins);
        let operands = match self.config.mixed_precision {
            true => Operands::Bf16,
            false => Operands::F32,
        };
        let judged = group.as_ref().map_or(&[][..], |group| &group.samples);
        let n_judged: usize = judged.iter().map(|sample| sample.targets.len()).sum();
        let rewards = self.config.realism.as_ref();
        let judged_total = rewards.map_or(1.0, |rewards| n_judged as f64 / rewards.weight);
        let imitated = samples.par_iter().map(|sample| (sample, true));
        let preferred = judged
            .par_iter()
            .filter(|sample| !sample.targets.is_empty());
        let all = imitated.chain(preferred.map(|sample| (sample, false)));
        let parts = all.map(|(sample, imitates)| {
            let deferred = Deferred::default();
            let build = || match imitates {
                true => network.loss(sample, total, smoothing),
                false => network.preference(sample, judged_total),
            };
            let (loss, sums) = operands.during(|| deferred.during(build))?;
            Ok(Part {
                gradients: loss.backward()?,
                deferred,
                sums,
            })
        });
        let parts: Vec<_> = parts.collect::<Result<_, TrainError>>()?;
        let imitated = parts[..samples.len()].iter();
        let fields = mean_fields(imitated.map(|part| &part.sums), total);
        let loss: f64 = fields.iter().sum();
        if !loss.is_finite() {
            let field = "move".to_owned();
            return Err(TrainError::LossNotFinite {
                step: self.step,
                field,
            });
        }
        let trainable: Vec<_> = self.trained.parameters().trainable().collect();
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
        let gradients: Gradients = sums.into_iter().flatten().collect();
        let update = Update {
            parameters: self.trained.parameters(),
            average: Some((self.average.parameters(), self.config.ema)),
            optimizer: &self.config.optimizer,
            steps: self.config.steps,
        };
        let (gradient_norm, rate) =
            update.learn(&mut self.optimizer, &mut self.step, &gradients)?;
        Ok(RelativeStep {
            step: self.step,
            loss,
            fields,
            gradient_norm,
            learning_rate: rate,
            nodes: samples.iter().chain(judged).map(Sample::n_nodes).sum(),
            rollouts: group.as_ref().map(|group| group.realism),
        })
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
        let network = &self.average;
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
        let mut tensors = named("", &self.average);
        tensors.extend(named(checkpoint::TRAINED, &self.trained));
        if let Some(driving) = &self.driving {
            tensors.extend(named(checkpoint::DRIVER, driving));
        }
        let state = self.optimizer.state();
        tensors.extend(state.map(|(name, tensor)| (name, tensor.clone())));
        let mut header = gump_model::relative::header(self.trained.config())?;
        let config = serde_json::to_string(&self.config).map_err(TrainError::Json)?;
        header.insert("train".to_owned(), config);
        header.insert("step".to_owned(), self.step.to_string());
        header.insert(DATA.to_owned(), self.source.scenarios.identity());
        Ok(checkpoint::write(path, tensors, header, StorageType::Full)?)
    }

    /// Ends the run and returns the network to use.
    pub fn into_network(self) -> RelativeNetwork {
        self.average
    }

    /// Steps done.
    pub fn steps_done(&self) -> usize {
        self.step
    }

    /// Its settings.
    pub fn config(&self) -> &RelativeTrainConfig {
        &self.config
    }

    /// The network to use, in its present state: the moving average.
    pub fn network(&self) -> &RelativeNetwork {
        &self.average
    }

    /// A copy of it, for a world that is used while training continues.
    ///
    /// # Errors
    /// A tensor error.
    pub fn snapshot(&self) -> Result<RelativeNetwork, TrainError> {
        build_like(&self.average, copies(&self.average)?)
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

fn drivers(
    driving: Option<&RelativeNetwork>,
    config: &RelativeTrainConfig,
) -> Result<Drivers, TrainError> {
    let driver = driving.zip(config.closed_loop.as_ref());
    let driver = driver.map(|(network, drives)| NetworkDriver::new(network, drives));
    let judged = driving.zip(config.realism.as_ref());
    let judged = judged.map(|(network, rewards)| Judged::new(network, rewards));
    Ok(Drivers {
        driver: driver.transpose()?,
        judged: judged.transpose()?,
    })
}

/// The result for one sample of a step.
struct Part {
    gradients: GradStore,
    /// Gradients of matrices that are not yet multiplied out.
    deferred: Deferred,
    /// Sums of the fields' cross-entropies, nats.
    sums: [f64; FIELDS],
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
