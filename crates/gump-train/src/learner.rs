//! The state of a training run, and its representation in a checkpoint.

use std::collections::BTreeMap;
use std::path::Path;

use candle_core::{DType, Device, Tensor};
use gump_kernels::Operands;
use gump_model::checkpoint::StorageType;
use gump_model::{Network, checkpoint};
use gump_nn::NnError;
use gump_nn::optimizer::{AdamW, OptimizerConfig, move_average};
use gump_nn::parameters::Parameters;

use super::config::TrainConfig;
use super::gradients::Gradients;
use crate::TrainError;
use crate::scenes::{DATA, ScenarioSource, check_data};

/// A network in training.
pub(super) struct TrainState {
    pub(super) network: Network,
    /// The moving average of the network, if there is one.
    average: Option<Network>,
    optimizer: AdamW,
    /// Steps done.
    pub(super) step: usize,
    /// Type of the operands of matrix products on a CPU; on a device the network decides it.
    pub(super) operands: Operands,
    /// The weights that drove, so that a resumed run can repeat the drives; empty without closed
    /// loop.
    drivers: BTreeMap<String, Tensor>,
}

impl TrainState {
    /// At the start of a run.
    pub(super) fn new(network: Network, config: &TrainConfig) -> Result<Self, TrainError> {
        let average = match config.ema {
            Some(_) => Some(build_like(&network, copies(&network)?)?),
            None => None,
        };
        let drivers = match config.closed_loop {
            Some(_) => copies(&network)?,
            None => BTreeMap::new(),
        };
        Ok(Self {
            optimizer: AdamW::new(network.parameters())?,
            network,
            average,
            step: 0,
            operands: Operands::F32,
            drivers,
        })
    }

    /// From a checkpoint, with the training settings.
    pub(super) fn restore(
        path: &Path,
        scenarios: &dyn ScenarioSource,
        device: &Device,
    ) -> Result<(Self, TrainConfig), TrainError> {
        let mut archive = checkpoint::read(path)?;
        check_data(&archive, scenarios)?;
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
        let trained = archive.take(checkpoint::TRAINED);
        let build = |weights| Network::build(model.clone(), Parameters::loaded(weights, device));
        let weights = archive.tensors;
        let (network, average) = match config.ema {
            Some(_) => (build(trained)?, Some(build(weights)?)),
            None => (build(weights)?, None),
        };
        let optimizer = AdamW::restore(network.parameters(), step, |name| {
            let tensor = moments.remove(name);
            tensor.ok_or_else(|| NnError::MissingTensor {
                name: name.to_owned(),
            })
        })?;
        let learner = Self {
            network,
            average,
            optimizer,
            step,
            operands: Operands::F32,
            drivers,
        };
        Ok((learner, config))
    }

    /// Writes everything a resumed run needs. The weights to use have the plain names, so that the
    /// file can also be loaded as a network.
    pub(super) fn save(
        &self,
        path: &Path,
        config: &TrainConfig,
        scenarios: &dyn ScenarioSource,
    ) -> Result<(), TrainError> {
        let mut tensors = named("", self.shipped());
        if self.average.is_some() {
            tensors.extend(named(checkpoint::TRAINED, &self.network));
        }
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
        let config = serde_json::to_string(config).map_err(TrainError::Json)?;
        header.insert("train".to_owned(), config);
        header.insert("step".to_owned(), self.step.to_string());
        header.insert(DATA.to_owned(), scenarios.identity());
        Ok(checkpoint::write(path, tensors, header, StorageType::Full)?)
    }

    /// The network to validate and to ship: the moving average if there is one.
    pub(super) fn shipped(&self) -> &Network {
        self.average.as_ref().unwrap_or(&self.network)
    }

    /// Ends the run and returns the network to ship.
    pub(super) fn into_shipped(self) -> Network {
        self.average.unwrap_or(self.network)
    }

    /// Switches matrix products to operands with fewer bits, if the run uses them.
    ///
    /// Error: a tensor error.
    pub(super) fn in_precision_of(self, config: &TrainConfig) -> Result<Self, TrainError> {
        if !config.mixed_precision {
            return Ok(self);
        }
        if self.network.device().is_cpu() {
            return Ok(Self {
                operands: Operands::Bf16,
                ..self
            });
        }
        Ok(Self {
            network: self.network.multiplying_in(DType::BF16)?,
            ..self
        })
    }

    /// A copy of the network to ship.
    pub(super) fn snapshot(&self) -> Result<Network, TrainError> {
        build_like(self.shipped(), copies(self.shipped())?)
    }

    /// The network that drives the scenes of closed-loop training.
    pub(super) fn driver(&self) -> Result<Network, TrainError> {
        build_like(&self.network, self.drivers.clone())
    }

    /// One step along the gradients; returns their norm before clipping.
    pub(super) fn learn(
        &mut self,
        gradients: &Gradients,
        config: &TrainConfig,
    ) -> Result<f64, TrainError> {
        let average = self.average.as_ref().map(Network::parameters);
        let update = Update {
            parameters: self.network.parameters(),
            average: average.zip(config.ema),
            optimizer: &config.optimizer,
            steps: config.steps,
        };
        let (norm, _) = update.learn(&mut self.optimizer, &mut self.step, gradients)?;
        Ok(norm)
    }
}

/// A step of a run, whatever it trains.
pub(crate) struct Update<'a> {
    pub(crate) parameters: &'a Parameters,
    /// The moving average, and the share of it that stays in a step.
    pub(crate) average: Option<(&'a Parameters, f64)>,
    pub(crate) optimizer: &'a OptimizerConfig,
    /// Length of the run.
    pub(crate) steps: usize,
}

impl Update<'_> {
    /// Moves the parameters along the gradients and the average towards them, and counts the step.
    /// Returns the norm of the gradients before clipping, and the learning rate.
    ///
    /// Error: [`TrainError::GradientNotFinite`], and nothing has changed.
    pub(crate) fn learn(
        &self,
        state: &mut AdamW,
        step: &mut usize,
        gradients: &Gradients,
    ) -> Result<(f64, f64), TrainError> {
        let rate = self.optimizer.rate(*step, self.steps);
        let norm = state.step(self.parameters, gradients, self.optimizer, rate)?;
        if !norm.is_finite() {
            return Err(TrainError::GradientNotFinite { step: *step });
        }
        *step += 1;
        if let Some((average, stays)) = self.average {
            // At first the average is of the steps done so far.
            let t = *step as f64;
            let share = stays.min((1.0 + t) / (10.0 + t));
            move_average(average, self.parameters, share)?;
        }
        Ok((norm, rate))
    }
}

fn named(prefix: &str, network: &Network) -> BTreeMap<String, Tensor> {
    let all = network.parameters().all();
    all.map(|(name, var)| (format!("{prefix}{name}"), var.as_tensor().clone()))
        .collect()
}

/// A copy of the present weights.
fn copies(network: &Network) -> Result<BTreeMap<String, Tensor>, TrainError> {
    let all = network.parameters().all();
    all.map(|(name, var)| Ok((name.to_owned(), var.as_tensor().copy()?)))
        .collect()
}

/// A network of the same shape with these weights.
fn build_like(network: &Network, weights: BTreeMap<String, Tensor>) -> Result<Network, TrainError> {
    let parameters = Parameters::loaded(weights, network.device());
    Ok(Network::build(network.config().clone(), parameters)?)
}
