//! The transitions of a round, and their advantages.

use gump_scene::Seed;

use crate::networks::{Mlp, Pass};
use crate::{Actor, RlError, VectorEnv};

/// Transitions of consecutive steps of all environments, step by step.
#[derive(Clone, Debug, Default)]
pub(super) struct Round {
    /// Normalized. Shape: `[n, observation_len]`.
    pub(super) observations: Vec<f32>,
    /// Shape: `[n, action_len]`.
    pub(super) actions: Vec<f32>,
    /// Of the actions when they were taken, nats. Shape: `[n]`.
    pub(super) log_densities: Vec<f64>,
    /// Shape: `[n]`.
    pub(super) rewards: Vec<f32>,
    /// Normalized observations after the step, in the same episode.
    pub(super) nexts: Vec<f32>,
    pub(super) terminated: Vec<bool>,
    /// Whether the episode ended, terminated or truncated.
    pub(super) ended: Vec<bool>,
}

/// What actor and critic learn from a round. Shapes: `[n]`.
#[derive(Clone, Debug, Default)]
pub(super) struct Lessons {
    /// Mean 0, variance 1.
    pub(super) advantages: Vec<f64>,
    /// Targets of the critic.
    pub(super) returns: Vec<f64>,
}

impl Round {
    /// Lets the actor drive `steps` steps of all environments. `observe` is called after each step.
    ///
    /// Error: of the environment, or [`RlError::Diverged`] by `check` for an action or a reward that
    /// is not finite.
    pub(super) fn collect(
        actor: &Actor,
        env: &mut dyn VectorEnv,
        steps: usize,
        seed: Seed,
        check: impl Fn(&[f32], &str) -> Result<(), RlError>,
        mut observe: impl FnMut(&dyn VectorEnv),
    ) -> Result<Self, RlError> {
        let mut round = Self::default();
        let normalized = |observations: &[f32]| {
            let mut observations = observations.to_vec();
            if let Some(normalizer) = actor.normalizer() {
                normalizer.apply(&mut observations);
            }
            observations
        };
        for t in 0..steps {
            let before = env.observations().to_vec();
            let actions = actor.sample(&before, &mut seed.fork(t as u64).rng());
            check(&actions, "an action")?;
            env.step(&actions)?;
            check(env.rewards(), "a reward")?;
            round.observations.extend(normalized(&before));
            round.actions.extend(actions);
            round.rewards.extend(env.rewards());
            round.nexts.extend(normalized(env.final_observations()));
            round.terminated.extend(env.terminated());
            let ends = env.terminated().iter().zip(env.truncated());
            round.ended.extend(ends.map(|(a, b)| *a || *b));
            observe(env);
        }
        let mut pass = Pass::default();
        actor.network.forward(&round.observations, &mut pass);
        round.log_densities = log_densities(actor, pass.output(), &round.actions);
        Ok(round)
    }

    /// Number of transitions.
    pub(super) fn len(&self) -> usize {
        self.rewards.len()
    }

    /// Generalized advantage estimates (Schulman et al. 2016) over `n_envs` environments.
    pub(super) fn lessons(
        &self,
        critic: &Mlp,
        n_envs: usize,
        (discount, lambda): (f64, f64),
    ) -> Lessons {
        let values = |observations: &[f32]| {
            let mut pass = Pass::default();
            critic.forward(observations, &mut pass);
            pass.output()
                .iter()
                .map(|&v| f64::from(v))
                .collect::<Vec<_>>()
        };
        let (now, next) = (values(&self.observations), values(&self.nexts));
        let mut advantages = vec![0.0; self.len()];
        for i in (0..self.len()).rev() {
            // Where an episode is truncated, nobody ever acts on what is seen last, so the critic
            // never learns its value; that of the observation before it stands in.
            let future = match (self.terminated[i], self.ended[i]) {
                (true, _) => 0.0,
                (false, true) => now[i],
                (false, false) => next[i],
            };
            let error = f64::from(self.rewards[i]) + discount * future - now[i];
            let later = match self.ended[i] {
                true => 0.0,
                false => advantages.get(i + n_envs).copied().unwrap_or(0.0),
            };
            advantages[i] = error + discount * lambda * later;
        }
        let returns = advantages.iter().zip(&now).map(|(a, v)| a + v).collect();
        let n = advantages.len().max(1) as f64;
        let mean = advantages.iter().sum::<f64>() / n;
        let variance = advantages.iter().map(|a| (a - mean).powi(2)).sum::<f64>() / n;
        let scale = 1.0 / variance.sqrt().max(1e-8);
        for advantage in &mut advantages {
            *advantage = (*advantage - mean) * scale;
        }
        Lessons {
            advantages,
            returns,
        }
    }
}

/// Log densities of actions under the distributions with these network outputs, nats. Shape: `[n]`.
pub(super) fn log_densities(actor: &Actor, outputs: &[f32], actions: &[f32]) -> Vec<f64> {
    let a = actor.action_len();
    let rows = outputs.chunks_exact(2 * a).zip(actions.chunks_exact(a));
    rows.map(|(outputs, actions)| {
        let dimensions = outputs.chunks_exact(2).zip(actions);
        dimensions
            .map(|(of, &action)| actor.dimension(of).log_density(f64::from(action)).0)
            .sum()
    })
    .collect()
}
