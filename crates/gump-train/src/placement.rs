//! Training of the placement network: given some vehicles of a scene, where is another one?
//!
//! A sample is a moment of a scene, seen from one of its vehicles. A random subset of the other
//! vehicles is shown, and the network is asked for the place of each of a few more, given its
//! velocity. The softmax is over the true place and a random share of the others, whose scores are
//! raised by the logarithm of the share's inverse.

use std::collections::BTreeMap;
use std::path::Path;

use candle_core::{D, Device, Tensor};
use gump_engine::placement::places::{
    CELL, N_FEATURES, NewVehicle, PlaceKind, PlacedVehicle, Places, Traffic,
};
use gump_geometry::{OrientedBox, Pose, angle_difference};
use gump_kernels::Operands;
use gump_model::checkpoint::{self, StorageType};
use gump_model::placement::{PlacementConfig, PlacementNetwork};
use gump_nn::NnError;
use gump_nn::optimizer::{AdamW, OptimizerConfig};
use gump_nn::parameters::Parameters;
use gump_scene::{Agent, AgentKind, Scenario, Seed};
use rand::Rng as _;
use rand::seq::SliceRandom as _;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::TrainError;
use crate::learner::Update;
use crate::scenes::{DATA, ScenarioSource, check_data};

/// Maximum number of scenes tried for a sample: more mean that hardly any has two vehicles on roads.
const ATTEMPTS: u64 = 64;
/// Half the sides of the squares that are filled, metres: that of the evaluation and that of a
/// scene.
const HALF_SIDES: [f64; 2] = [50.0, 100.0];
/// A vehicle is at a place on a lane within this distance, metres, ...
const AT_LANE: f64 = 1.6;
/// ... if it heads along it within this, radians.
const ALONG_LANE: f64 = 0.4;

/// Training settings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PlacementTrainConfig {
    /// Optimiser steps of the whole run.
    pub steps: usize,
    /// Scenes per step.
    pub batch: usize,
    /// The seed of all randomness.
    pub seed: u64,
    /// Decay of a moving average of the weights, which is the network to use.
    pub ema: f64,
    /// Width of the hidden layers.
    pub hidden: usize,
    /// Vehicles placed per scene.
    pub vehicles: usize,
    /// Other places per vehicle.
    pub others: usize,
    /// Settings of the optimizer.
    pub optimizer: OptimizerConfig,
}

impl Default for PlacementTrainConfig {
    fn default() -> Self {
        Self {
            steps: 6000,
            batch: 8,
            seed: 0,
            ema: 0.998,
            hidden: 64,
            vehicles: 4,
            others: 384,
            optimizer: OptimizerConfig {
                learning_rate: 2e-3,
                warmup: 100,
                ..OptimizerConfig::default()
            },
        }
    }
}

impl PlacementTrainConfig {
    /// Checks the values.
    ///
    /// # Errors
    /// [`TrainError::Config`] for the first that is out of its range.
    pub fn validate(&self) -> Result<(), TrainError> {
        for (key, value) in [
            ("train.steps", self.steps),
            ("train.batch", self.batch),
            ("train.hidden", self.hidden),
            ("train.vehicles", self.vehicles),
            ("train.others", self.others),
        ] {
            if value == 0 {
                let reason = format!("{key} is 0, expected at least 1");
                return Err(TrainError::Config { key, reason });
            }
        }
        if !(0.0..1.0).contains(&self.ema) {
            return Err(TrainError::Config {
                key: "train.ema",
                reason: format!("train.ema is {}, expected 0 to below 1", self.ema),
            });
        }
        Ok(self
            .optimizer
            .validate()
            .map_err(gump_model::ModelError::from)?)
    }

    fn model(&self) -> PlacementConfig {
        PlacementConfig {
            features: N_FEATURES,
            hidden: self.hidden,
        }
    }
}

/// The questions of one scene.
struct Sample {
    /// `[questions, 1 + others, N_FEATURES]`, the true place first.
    rows: Vec<f32>,
    /// Added to the scores, `[questions, 1 + others]`.
    offsets: Vec<f32>,
    /// Number of places of each question.
    n_places: Vec<usize>,
}

/// The result of a step.
#[derive(Clone, Copy, Debug)]
pub struct PlacementStep {
    /// Number of the step, from 1.
    pub step: usize,
    /// Mean of the negative logarithms of the probabilities of the true places, nats.
    pub loss: f64,
    /// The same for places drawn evenly.
    pub uniform: f64,
    /// Norm of the gradient before clipping.
    pub gradient_norm: f64,
    /// Learning rate.
    pub learning_rate: f64,
    /// Vehicles placed.
    pub vehicles: usize,
}

/// A placement network in training.
pub struct PlacementTrainer {
    trained: PlacementNetwork,
    average: PlacementNetwork,
    optimizer: AdamW,
    config: PlacementTrainConfig,
    step: usize,
    scenarios: Box<dyn ScenarioSource>,
}

impl PlacementTrainer {
    /// A new run.
    ///
    /// # Errors
    /// An invalid configuration, or no scenario.
    pub fn new(
        config: PlacementTrainConfig,
        scenarios: impl ScenarioSource + 'static,
    ) -> Result<Self, TrainError> {
        config.validate()?;
        let network = PlacementNetwork::random(config.model(), Seed(config.seed).fork(0))?;
        let optimizer = AdamW::new(network.parameters())?;
        let average = copy(&network)?;
        Self::assemble(network, average, optimizer, config, 0, Box::new(scenarios))
    }

    /// Continues the run that a checkpoint holds, exactly as if it had not been interrupted.
    ///
    /// # Errors
    /// A file that is not a checkpoint of such a run, or other scenarios than it began with.
    pub fn resume(
        path: &Path,
        scenarios: impl ScenarioSource + 'static,
    ) -> Result<Self, TrainError> {
        let mut archive = checkpoint::read(path)?;
        check_data(&archive, &scenarios)?;
        let text = archive.entry("step")?;
        let step: usize = text
            .parse()
            .map_err(|_| archive.error(format!("its step is \"{text}\", expected a number")))?;
        let config: PlacementTrainConfig =
            serde_json::from_str(archive.entry("train")?).map_err(|error| {
                archive.error(format!("its training configuration is not valid ({error})"))
            })?;
        let mut moments = archive.take(checkpoint::OPTIMIZER);
        let trained = archive.take(checkpoint::TRAINED);
        let build = |weights| {
            let parameters = Parameters::loaded(weights, &Device::Cpu);
            PlacementNetwork::build(config.model(), parameters)
        };
        let (network, average) = (build(trained)?, build(archive.tensors)?);
        let optimizer = AdamW::restore(network.parameters(), step, |name| {
            let tensor = moments.remove(name);
            tensor.ok_or_else(|| NnError::MissingTensor {
                name: name.to_owned(),
            })
        })
        .map_err(gump_model::ModelError::from)?;
        Self::assemble(
            network,
            average,
            optimizer,
            config,
            step,
            Box::new(scenarios),
        )
    }

    fn assemble(
        trained: PlacementNetwork,
        average: PlacementNetwork,
        optimizer: AdamW,
        config: PlacementTrainConfig,
        step: usize,
        scenarios: Box<dyn ScenarioSource>,
    ) -> Result<Self, TrainError> {
        if scenarios.is_empty() {
            return Err(TrainError::NoData { frames: 1 });
        }
        Ok(Self {
            trained,
            average,
            optimizer,
            config,
            step,
            scenarios,
        })
    }

    /// One optimiser step.
    ///
    /// # Errors
    /// [`TrainError::LossNotFinite`] before anything is changed, or errors of reading scenes.
    pub fn step(&mut self) -> Result<PlacementStep, TrainError> {
        let seed = Seed(self.config.seed).fork(1).fork(self.step as u64);
        let samples = (0..self.config.batch as u64).into_par_iter().map(|i| {
            let seed = seed.fork(i);
            for attempt in 0..ATTEMPTS {
                let seed = seed.fork(attempt);
                let index = self.scenarios.pick(self.step, seed.fork(0).0);
                let scenario = self.scenarios.get(index)?;
                if let Some(sample) = draw(&scenario, &self.config, seed.fork(1)) {
                    return Ok(sample);
                }
            }
            Err(TrainError::NoData { frames: 1 })
        });
        let samples: Vec<Sample> = samples.collect::<Result<_, _>>()?;
        let vehicles: usize = samples.iter().map(|sample| sample.n_places.len()).sum();
        let parts = samples.par_iter().map(|sample| {
            // Said here, as a thread may take this up while it waits for products of another run.
            Operands::F32.during(|| {
                let loss = (loss(&self.trained, sample, self.config.others)? / vehicles as f64)?;
                let value = f64::from(loss.to_scalar::<f32>()?);
                Ok((loss.backward()?, value))
            })
        });
        let parts: Vec<_> = parts.collect::<Result<_, TrainError>>()?;
        let loss: f64 = parts.iter().map(|(_, value)| value).sum();
        if !loss.is_finite() {
            let field = "place".to_owned();
            return Err(TrainError::LossNotFinite {
                step: self.step,
                field,
            });
        }
        let mut gradients = BTreeMap::new();
        for (name, var) in self.trained.parameters().trainable() {
            let mut all = parts.iter().filter_map(|(store, _)| store.get(var));
            if let Some(first) = all.next() {
                let sum = all.try_fold(first.clone(), |sum, gradient| sum + gradient)?;
                gradients.insert(name.to_owned(), sum);
            }
        }
        let update = Update {
            parameters: self.trained.parameters(),
            average: Some((self.average.parameters(), self.config.ema)),
            optimizer: &self.config.optimizer,
            steps: self.config.steps,
        };
        let (gradient_norm, rate) =
            update.learn(&mut self.optimizer, &mut self.step, &gradients)?;
        Ok(PlacementStep {
            step: self.step,
            loss,
            uniform: uniform(&samples),
            gradient_norm,
            learning_rate: rate,
            vehicles,
        })
    }

    /// The loss on other scenarios, and that of places drawn evenly, nats.
    ///
    /// # Errors
    /// No scenario with two vehicles on roads.
    pub fn validate(&self, scenarios: &[Scenario]) -> Result<[f64; 2], TrainError> {
        let drawn = scenarios.par_iter().enumerate();
        let samples: Vec<Sample> = drawn
            .filter_map(|(i, scenario)| draw(scenario, &self.config, Seed(0).fork(i as u64)))
            .collect();
        if samples.is_empty() {
            return Err(TrainError::NoData { frames: 1 });
        }
        let losses = samples.par_iter().map(|sample| {
            let loss = || loss(&self.average, sample, self.config.others);
            Ok(f64::from(Operands::F32.during(loss)?.to_scalar::<f32>()?))
        });
        let losses: Vec<f64> = losses.collect::<Result<_, TrainError>>()?;
        let vehicles: usize = samples.iter().map(|sample| sample.n_places.len()).sum();
        Ok([
            losses.iter().sum::<f64>() / vehicles as f64,
            uniform(&samples),
        ])
    }

    /// Writes everything a resumed run needs.
    ///
    /// # Errors
    /// [`TrainError::Model`]; the previous file is intact.
    pub fn save(&self, path: &Path) -> Result<(), TrainError> {
        let named = |prefix: &str, network: &PlacementNetwork| -> BTreeMap<String, Tensor> {
            let all = network.parameters().all();
            all.map(|(name, var)| (format!("{prefix}{name}"), var.as_tensor().clone()))
                .collect()
        };
        let mut tensors = named("", &self.average);
        tensors.extend(named(checkpoint::TRAINED, &self.trained));
        let state = self.optimizer.state();
        tensors.extend(state.map(|(name, tensor)| (name, tensor.clone())));
        let mut header = self.average.header()?;
        let config = serde_json::to_string(&self.config).map_err(TrainError::Json)?;
        header.insert("train".to_owned(), config);
        header.insert("step".to_owned(), self.step.to_string());
        header.insert(DATA.to_owned(), self.scenarios.identity());
        Ok(checkpoint::write(path, tensors, header, StorageType::Full)?)
    }

    /// The network to use, in its present state.
    pub fn network(&self) -> &PlacementNetwork {
        &self.average
    }

    /// Its settings.
    pub fn config(&self) -> &PlacementTrainConfig {
        &self.config
    }

    /// Steps done.
    pub fn steps_done(&self) -> usize {
        self.step
    }
}

fn copy(network: &PlacementNetwork) -> Result<PlacementNetwork, TrainError> {
    let all = network.parameters().all();
    let tensors = all.map(|(name, var)| Ok((name.to_owned(), var.as_tensor().copy()?)));
    let tensors = tensors.collect::<Result<BTreeMap<_, _>, TrainError>>()?;
    let parameters = Parameters::loaded(tensors, &Device::Cpu);
    Ok(PlacementNetwork::build(network.config(), parameters)?)
}

/// The sum of the losses of a sample's questions.
fn loss(network: &PlacementNetwork, sample: &Sample, others: usize) -> Result<Tensor, TrainError> {
    let n = sample.n_places.len();
    let rows = Tensor::from_slice(&sample.rows, (n * (1 + others), N_FEATURES), &Device::Cpu)?;
    let offsets = Tensor::from_slice(&sample.offsets, (n, 1 + others), &Device::Cpu)?;
    let scores = (network.scores(&rows)?.reshape((n, 1 + others))? + offsets)?;
    let all = scores.log_sum_exp(D::Minus1)?;
    Ok((all - scores.narrow(1, 0, 1)?.squeeze(1)?)?.sum_all()?)
}

/// The mean loss of places drawn evenly.
fn uniform(samples: &[Sample]) -> f64 {
    let places = samples.iter().flat_map(|sample| &sample.n_places);
    let n = places.clone().count().max(1);
    places.map(|n| (*n as f64).ln()).sum::<f64>() / n as f64
}

/// The questions of a random moment of a scene; `None` without a vehicle at a place.
fn draw(scenario: &Scenario, config: &PlacementTrainConfig, seed: Seed) -> Option<Sample> {
    let mut rng = seed.rng();
    let frame = &scenario.log[rng.random_range(0..scenario.log.len())];
    let all = frame.agents().iter();
    let mut vehicles: Vec<&Agent> = all.filter(|a| a.kind == AgentKind::Vehicle).collect();
    vehicles.shuffle(&mut rng);
    let own = vehicles.iter().position(|agent| agent.id == scenario.ego);
    let own = own
        .filter(|_| rng.random_bool(0.5))
        .or((!vehicles.is_empty()).then_some(0))?;
    let ego = vehicles.swap_remove(own);
    let world_from_scene = ego.state.pose;
    let scene_from_world = world_from_scene.inverse();
    let half_side = HALF_SIDES[rng.random_range(0..HALF_SIDES.len())];
    let placed = |agent: &Agent| PlacedVehicle {
        outline: OrientedBox {
            pose: scene_from_world * agent.state.pose,
            length: agent.length,
            width: agent.width,
        },
        speed: agent.state.speed(),
    };
    let is_inside = |pose: Pose| pose.position.abs().max_element() <= half_side;
    vehicles.retain(|agent| is_inside(scene_from_world * agent.state.pose));
    let n_shown = rng.random_range(0..vehicles.len().max(1));
    let (shown, hidden) = vehicles.split_at_checked(n_shown)?;
    let places = Places::new(&scenario.map, world_from_scene, frame.lights());
    let shown = std::iter::once(ego).chain(shown.iter().copied());
    let traffic = Traffic::new(&places, shown.map(placed).collect());
    let mut sample = Sample {
        rows: Vec::new(),
        offsets: Vec::new(),
        n_places: Vec::new(),
    };
    for agent in hidden {
        if sample.n_places.len() == config.vehicles {
            break;
        }
        let own = NewVehicle {
            velocity: scene_from_world.rotate(agent.state.velocity),
            length: agent.length,
        };
        let pose = scene_from_world * agent.state.pose;
        let all = places.all();
        let suits = |i: &usize| own.suits(&all[*i]) && is_inside(all[*i].pose);
        let mut which: Vec<usize> = (0..all.len()).filter(suits).collect();
        let Some(is_at) = place_of(&places, &which, pose) else {
            continue;
        };
        let at = which.swap_remove(is_at);
        if which.is_empty() {
            continue;
        }
        let (n, total) = (config.others, which.len());
        let (others, _) = which.partial_shuffle(&mut rng, n);
        let n_drawn = others.len();
        let offset = (total as f32 / n_drawn as f32).ln();
        let begin = sample.rows.len();
        sample.rows.resize(begin + (1 + n) * N_FEATURES, 0.0);
        let rows = sample.rows[begin..].chunks_exact_mut(N_FEATURES);
        for (i, row) in std::iter::once(&at).chain(others.iter()).zip(rows) {
            places.write(&traffic, &own, *i, row);
        }
        sample.offsets.push(0.0);
        // Rows beyond the places there are do not count.
        let offsets = (0..n).map(|i| if i < n_drawn { offset } else { -1e9 });
        sample.offsets.extend(offsets);
        sample.n_places.push(total + 1);
    }
    (!sample.n_places.is_empty()).then_some(sample)
}

/// The index in `which` of the place at which a vehicle is, if there is one.
fn place_of(places: &Places, which: &[usize], pose: Pose) -> Option<usize> {
    let all = places.all();
    let costs = which.iter().enumerate().filter_map(|(k, i)| {
        let place = &all[*i];
        let from_place = place.pose.inverse() * pose.position;
        let turn = angle_difference(pose.heading, place.pose.heading);
        let (distance, kind) = (from_place.length(), place.kind);
        let cost = if kind == PlaceKind::OnLane {
            let is_on = distance <= AT_LANE && turn.abs() <= ALONG_LANE;
            is_on.then_some(distance + turn.abs())
        } else {
            let beside = (place.pose.position - pose.position).abs().max_element();
            // Forwards or backwards, within 45 degrees; after all places on lanes.
            let is_along = turn.cos().abs() >= std::f64::consts::FRAC_1_SQRT_2;
            (beside <= CELL / 2.0 && is_along).then_some(10.0 + distance)
        }?;
        Some((k, cost))
    });
    costs.min_by(|a, b| a.1.total_cmp(&b.1)).map(|(k, _)| k)
}

#[cfg(test)]
mod tests {
    use gump_engine::placement::network::PlacementScorer;
    use gump_model::placement::PlacementWeights;
    use gump_scene::fixture;

    use super::*;

    /// A queue of four before a red light.
    fn scenario() -> Scenario {
        fixture::scenario(
            "lane 1: -80,0 40,0 width 3.6 next 2\nlane 2: 40,0 60,0\nlight 2 red: 40,0\n\
             ego vehicle 0: 0,0\nagent vehicle 1: 36,0\nagent vehicle 2: 29,0\n\
             agent vehicle 3: 22,0\nagent vehicle 4: 15,0",
        )
        .unwrap()
    }

    fn config() -> PlacementTrainConfig {
        PlacementTrainConfig {
            steps: 120,
            batch: 2,
            hidden: 16,
            others: 24,
            ema: 0.9,
            optimizer: OptimizerConfig {
                learning_rate: 1e-2,
                warmup: 5,
                ..OptimizerConfig::default()
            },
            ..PlacementTrainConfig::default()
        }
    }

    fn numbers(trainer: &PlacementTrainer) -> Vec<f32> {
        let all = trainer.network().parameters().all();
        all.flat_map(|(_, var)| var.flatten_all().unwrap().to_vec1::<f32>().unwrap())
            .collect()
    }

    #[test]
    fn it_learns_a_queue_and_resumes_exactly() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run.safetensors");
        let mut whole = PlacementTrainer::new(config(), vec![scenario()]).unwrap();
        let mut broken = PlacementTrainer::new(config(), vec![scenario()]).unwrap();
        for _ in 0..120 {
            let step = whole.step().unwrap();
            assert!(step.loss.is_finite() && step.uniform > 4.0);
        }
        (0..20).for_each(|_| _ = broken.step().unwrap());
        broken.save(&path).unwrap();
        let mut resumed = PlacementTrainer::resume(&path, vec![scenario()]).unwrap();
        assert_eq!(resumed.steps_done(), 20);
        (20..120).for_each(|_| _ = resumed.step().unwrap());
        assert_eq!(numbers(&whole), numbers(&resumed));
        let [loss, uniform] = whole.validate(&[scenario()]).unwrap();
        assert!(loss < uniform - 0.3, "{loss} of {uniform}");
    }

    #[test]
    fn weights_with_other_properties_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("other.safetensors");
        let other = PlacementConfig {
            features: 3,
            hidden: 4,
        };
        PlacementNetwork::random(other, Seed(0))
            .unwrap()
            .save(&path)
            .unwrap();
        let weights = PlacementWeights::read(&std::fs::read(&path).unwrap()).unwrap();
        let error = PlacementScorer::new(&weights).unwrap_err().to_string();
        assert!(error.contains("reads 3 properties of a place"), "{error}");
    }

    #[test]
    fn a_scene_without_another_vehicle_teaches_nothing() {
        let alone = fixture::scenario("lane 1: -80,0 40,0\nego vehicle 0: 0,0").unwrap();
        let mut trainer = PlacementTrainer::new(config(), vec![alone]).unwrap();
        assert!(matches!(trainer.step(), Err(TrainError::NoData { .. })));
        let wrong = PlacementTrainConfig {
            others: 0,
            ..config()
        };
        let error = PlacementTrainer::new(wrong, vec![scenario()])
            .err()
            .unwrap();
        assert!(error.to_string().contains("train.others"), "{error}");
    }
}
