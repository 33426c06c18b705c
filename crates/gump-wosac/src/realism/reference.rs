//! Comparing rollouts with the log.

use std::borrow::Cow;
use std::collections::BTreeMap;

use gump_scene::{AgentId, AgentKind};
use rayon::prelude::*;

use super::WosacError;
use super::assemble::{self, SimulatedAgents};
use super::config::{Algorithm, Component, Config, Mode};
use super::estimate::{FeatureShape, log_likelihoods};
use super::features::{Features, Surroundings, measure};
use super::input::{Log, N_HISTORY, Rollouts, Track};
use super::kinematics::{Differences, validity};
use super::lights::Lights;
use super::road_edge::RoadEdges;
use super::scores::{Scores, rounded};

/// Scores `rollouts` of `log` with `config`.
///
/// # Errors
/// Those of [`Reference::new`] and [`Reference::evaluate`].
pub fn score(log: &Log, rollouts: &Rollouts, config: &Config) -> Result<Scores, WosacError> {
    Ok(Reference::new(log, config)?.evaluate(rollouts)?.scores)
}

/// A log prepared for comparing any number of worlds with it.
pub struct Reference<'a> {
    pub(crate) config: &'a Config,
    scenario: &'a str,
    simulated: Vec<&'a Track>,
    scored: Vec<usize>,
    surroundings: Surroundings,
    features: Features,
    /// Logged validity of the scored agents, `[agent, step]`; of their speeds, accelerations.
    valid: Vec<bool>,
    speed_valid: Vec<bool>,
    acceleration_valid: Vec<bool>,
}

impl<'a> Reference<'a> {
    /// Checks and measures a log.
    ///
    /// # Errors
    /// A log for which the metric is not defined: tracks of different lengths, roles without a
    /// track, scored agents that are absent at the present step, a map without road edges, numbers
    /// that are not finite.
    pub fn new(log: &'a Log, config: &'a Config) -> Result<Self, WosacError> {
        let (simulated, scored) = assemble::roles(log, config.mode)?;
        let surroundings = Surroundings {
            edges: RoadEdges::new(&log.road_edges, config.algorithm),
            lights: config
                .traffic_light_violation
                .and_then(|_| Lights::new(log)),
        };
        let ids: Vec<AgentId> = scored.iter().map(|&i| simulated[i].id).collect();
        let first = first_step(config.mode);
        let logged = SimulatedAgents::logged(&simulated, config);
        let algorithm = config.algorithm;
        let features = measure(&logged, &ids, &scored, first, &surroundings, algorithm);
        let mut reference = Self {
            config,
            scenario: &log.scenario,
            valid: Vec::new(),
            speed_valid: Vec::new(),
            acceleration_valid: Vec::new(),
            simulated,
            scored,
            surroundings,
            features,
        };
        for &agent in &reference.scored {
            let states = &reference.simulated[agent].states[first..];
            let valid: Vec<bool> = states.iter().map(|state| state.valid).collect();
            let (speed, acceleration) = validity(&valid, Differences::from(algorithm));
            reference.valid.extend(valid);
            reference.speed_valid.extend(speed);
            reference.acceleration_valid.extend(acceleration);
        }
        Ok(reference)
    }

    /// Features of the log.
    pub fn features(&self) -> &Features {
        &self.features
    }

    /// Agents that every rollout must contain.
    pub fn simulated(&self) -> impl Iterator<Item = AgentId> {
        self.simulated.iter().map(|track| track.id)
    }

    /// Compares rollouts with the log, in parallel over rollouts; results do not depend on the
    /// number of threads.
    ///
    /// # Errors
    /// Rollouts that do not fit: another scenario, no rollouts, agents missing, unknown or twice,
    /// wrong lengths, numbers that are not finite.
    pub fn evaluate(&self, rollouts: &Rollouts) -> Result<Evaluation<'_>, WosacError> {
        let mode = self.config.mode;
        assemble::check_rollouts(self.scenario, &self.simulated, rollouts, mode)?;
        let ids = &self.features.agents;
        let measured = rollouts.futures.par_iter().map(|future| {
            let simulated = SimulatedAgents::imagined(&self.simulated, future, mode);
            let features = measure(
                &simulated,
                ids,
                &self.scored,
                first_step(mode),
                &self.surroundings,
                self.config.algorithm,
            );
            (features, self.displacements(&simulated))
        });
        let (imagined, displacements) = measured.unzip();
        Ok(Evaluation::new(
            self,
            imagined,
            displacements,
            rollouts.copies,
        ))
    }

    /// Mean distance of each scored agent from its log, metres.
    fn displacements(&self, simulated: &SimulatedAgents) -> Vec<f32> {
        let of = |&agent: &usize| {
            let (mut sum, mut n) = (0.0f32, 0.0f32);
            let pairs = simulated
                .states(agent)
                .iter()
                .zip(&self.simulated[agent].states);
            for (state, logged) in pairs.filter(|(_, logged)| logged.valid) {
                let off: [f32; 3] = std::array::from_fn(|i| state.position[i] - logged.position[i]);
                sum += (off[0] * off[0] + off[1] * off[1] + off[2] * off[2]).sqrt();
                n += 1.0;
            }
            sum / n
        };
        self.scored.iter().map(of).collect()
    }

    /// Mask of the logged values of a component that count, `[agent, step]`.
    pub(crate) fn mask(&self, component: Component) -> Vec<bool> {
        let n_steps = self.features.n_steps;
        let kinds = &self.features.kinds;
        let vehicles = || {
            let valid = self.valid.iter().enumerate();
            valid.map(|(i, &valid)| valid && kinds[i / n_steps] == AgentKind::Vehicle)
        };
        match component {
            Component::LinearSpeed | Component::AngularSpeed => self.speed_valid.clone(),
            Component::LinearAcceleration | Component::AngularAcceleration => {
                self.acceleration_valid.clone()
            }
            Component::TimeToCollision if self.config.algorithm == Algorithm::V2025 => {
                vehicles().collect()
            }
            _ => self.valid.clone(),
        }
    }

    /// The steps at which an indicator of these features counts, `[agent, step]`.
    pub(crate) fn indicated(
        &self,
        features: &Features,
        component: Component,
        vehicles_only: bool,
    ) -> Vec<bool> {
        let everything = self.config.algorithm == Algorithm::V2023V0;
        let mut holds = features.holds(component);
        for (i, holds) in holds.iter_mut().enumerate() {
            let kind = features.kinds[i / features.n_steps];
            *holds &= everything || self.valid[i];
            *holds &= !vehicles_only || kind == AgentKind::Vehicle;
        }
        holds
    }

    /// The compared values of a component: number of steps, and values `[agent, step]` of the log
    /// and then of each rollout.
    pub(crate) fn values<'f>(
        &'f self,
        component: Component,
        imagined: &'f [Features],
    ) -> (usize, Vec<Cow<'f, [f32]>>) {
        let all = std::iter::once(&self.features).chain(imagined);
        if component.is_indication() {
            let vehicles_only = component == Component::TrafficLightViolation;
            let ever = |features| Cow::Owned(self.ever(features, component, vehicles_only));
            (1, all.map(ever).collect())
        } else {
            let values = |features: &'f Features| Cow::Borrowed(features.values(component));
            (self.features.n_steps, all.map(values).collect())
        }
    }

    /// Whether each scored agent ever has an indicator, as 0 or 1.
    pub(crate) fn ever(
        &self,
        features: &Features,
        component: Component,
        vehicles_only: bool,
    ) -> Vec<f32> {
        let indicated = self.indicated(features, component, vehicles_only);
        let agents = indicated.chunks(features.n_steps);
        agents
            .map(|steps| f32::from(u8::from(steps.contains(&true))))
            .collect()
    }
}

/// The first scored step.
fn first_step(mode: Mode) -> usize {
    match mode {
        Mode::SimAgents => N_HISTORY,
        Mode::Generation => 0,
    }
}

/// The result of comparing rollouts with a log.
pub struct Evaluation<'a> {
    /// The scores.
    pub scores: Scores,
    /// Features of each rollout; of equal rollouts only one.
    pub imagined: Vec<Features>,
    /// Mean distance of each scored agent from its log, metres, `[rollout][agent]`; see
    /// [`Scores::ade`].
    pub displacements: Vec<Vec<f32>>,
    pub(crate) reference: &'a Reference<'a>,
    /// Number of equal rollouts that each of `imagined` stands for.
    pub(crate) copies: usize,
    pub(crate) log_likelihoods: BTreeMap<Component, Vec<f32>>,
}

impl<'a> Evaluation<'a> {
    fn new(
        reference: &'a Reference<'a>,
        imagined: Vec<Features>,
        displacements: Vec<Vec<f32>>,
        copies: usize,
    ) -> Self {
        let config = reference.config;
        let log = &reference.features;
        let mut likelihoods = BTreeMap::new();
        for (component, feature) in config.components() {
            let (steps, values) = reference.values(component, &imagined);
            let (own, imagined) = values.split_first().expect("the log comes first");
            let imagined: Vec<&[f32]> = imagined.iter().map(AsRef::as_ref).collect();
            let shape = FeatureShape {
                agents: log.agents.len(),
                steps,
            };
            let found = log_likelihoods(feature, own, &imagined, copies, shape);
            likelihoods.insert(component, found);
        }
        let components = likelihoods.iter().map(|(&component, found)| {
            let mask = (!component.is_indication()).then(|| reference.mask(component));
            (component, rounded(geometric_mean(found, mask.as_deref())))
        });
        let mut scores = Scores::of_components(config, components.collect());
        if config.mode == Mode::SimAgents {
            let means: Vec<f64> = displacements.iter().map(|agents| mean(agents)).collect();
            scores.ade = rounded(means.iter().sum::<f64>() / means.len() as f64);
            scores.min_ade = rounded(means.iter().copied().fold(f64::INFINITY, f64::min));
        }
        let rate = |component| {
            let of = |f| mean(&reference.ever(f, component, false));
            rounded(imagined.iter().map(of).sum::<f64>() / imagined.len() as f64)
        };
        scores.collision_rate = rate(Component::Collision);
        scores.offroad_rate = rate(Component::Offroad);
        scores.traffic_light_violation_rate = config
            .traffic_light_violation
            .map(|_| rate(Component::TrafficLightViolation));
        Self {
            scores,
            imagined,
            displacements,
            reference,
            copies,
            log_likelihoods: likelihoods,
        }
    }

    /// As [`Reference::values`] of the rollouts.
    pub(crate) fn values(&self, component: Component) -> (usize, Vec<Cow<'_, [f32]>>) {
        self.reference.values(component, &self.imagined)
    }

    /// Log-likelihood of every logged value of a component before validity is applied,
    /// `[agent, step]`, of indicators `[agent]`; `None` if the year does not score it.
    pub fn log_likelihoods(&self, component: Component) -> Option<&[f32]> {
        self.log_likelihoods.get(&component).map(Vec::as_slice)
    }

    /// Whether each scored agent ever has an indicator: in the log, and in each rollout (of equal
    /// ones only one). Empty for other components.
    pub fn indications(&self, component: Component) -> (Vec<bool>, Vec<Vec<bool>>) {
        let vehicles_only = component == Component::TrafficLightViolation;
        let ever = |features: &Features| {
            let ever = self.reference.ever(features, component, vehicles_only);
            ever.into_iter().map(|ever| ever > 0.0).collect::<Vec<_>>()
        };
        let imagined = self.imagined.iter().map(ever).collect();
        (ever(self.reference.features()), imagined)
    }

    /// The scored step, from 0, at which an indicator first holds for each scored agent, in each
    /// rollout (of equal ones only one); `None` where it never does. Empty for other components.
    pub fn first_indications(&self, component: Component) -> Vec<Vec<Option<usize>>> {
        let vehicles_only = component == Component::TrafficLightViolation;
        let first = |features: &Features| {
            let holds = self.reference.indicated(features, component, vehicles_only);
            let agents = holds.chunks(features.n_steps);
            agents
                .map(|own| own.iter().position(|&holds| holds))
                .collect()
        };
        self.imagined.iter().map(first).collect()
    }
}

/// Exponential of the mean of the values that count; NaN if none does.
pub(crate) fn geometric_mean(log_likelihoods: &[f32], mask: Option<&[bool]>) -> f64 {
    let counts = |i: usize| mask.is_none_or(|mask| mask[i]);
    let values = log_likelihoods.iter().enumerate();
    let values = values.filter(|(i, _)| counts(*i));
    let (sum, n) = values.fold((0.0, 0.0), |(sum, n), (_, &v)| {
        (sum + f64::from(v), n + 1.0)
    });
    (sum / n).exp()
}

fn mean(values: &[f32]) -> f64 {
    values.iter().map(|&v| f64::from(v)).sum::<f64>() / values.len() as f64
}
