//! One gradient step of proximal policy optimization.

use super::PpoConfig;
use super::round::{Lessons, Round};
use crate::Actor;
use crate::networks::{Adam, Mlp, Pass, clip, norm};

/// Actor and critic with their optimizers.
#[derive(Clone, Debug)]
pub(super) struct PpoLearner {
    pub(super) actor: Actor,
    pub(super) actor_optimizer: Adam,
    pub(super) critic: Mlp,
    pub(super) critic_optimizer: Adam,
    work: Work,
}

/// Buffers that are reused from step to step.
#[derive(Clone, Debug, Default)]
struct Work {
    pass: Pass,
    outputs: Vec<f32>,
    gradient: Vec<f32>,
    observations: Vec<f32>,
}

/// Statistics of a gradient step; losses are those before the step.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PpoUpdate {
    /// Squared error of the critic, mean over the batch.
    pub critic_loss: f64,
    /// Divergence of the policy from the one that collected, nats per transition.
    pub divergence: f64,
    /// Share of transitions whose ratio no longer counts.
    pub clipped: f64,
    /// Minus the log density of the actions taken, nats, mean.
    pub entropy: f64,
    /// Negative log density of the experts' actions, nats, mean.
    pub imitation_loss: f64,
    /// Norm of the gradient of rewards and entropy by the actor's outputs.
    pub reward_gradient: f64,
    /// Norm of the gradient of the weighted imitation loss by the actor's outputs.
    pub imitation_gradient: f64,
}

/// Rows of a batch.
pub(super) struct Rows<'a> {
    pub(super) round: &'a Round,
    pub(super) lessons: &'a Lessons,
    pub(super) indices: &'a [usize],
    /// Normalized observations and actions of experts.
    pub(super) expert: (&'a [f32], &'a [f32]),
    /// Weight of the imitation loss.
    pub(super) imitation_weight: f64,
}

impl PpoLearner {
    pub(super) fn new(actor: Actor, critic: Mlp) -> Self {
        let (a, c) = (actor.network.parameters().len(), critic.parameters().len());
        Self {
            actor,
            actor_optimizer: Adam::new(a),
            critic,
            critic_optimizer: Adam::new(c),
            work: Work::default(),
        }
    }

    /// A step of the critic, and of the actor if `moves_actor`.
    pub(super) fn step(
        &mut self,
        rows: &Rows<'_>,
        config: &PpoConfig,
        rate: f64,
        moves_actor: bool,
    ) -> PpoUpdate {
        let mut update = PpoUpdate {
            critic_loss: self.step_critic(rows, config, rate),
            ..PpoUpdate::default()
        };
        if moves_actor {
            self.step_actor(rows, config, rate, &mut update);
        }
        update
    }

    fn step_critic(&mut self, rows: &Rows<'_>, config: &PpoConfig, rate: f64) -> f64 {
        let (work, n) = (&mut self.work, rows.indices.len());
        rows.gather(self.critic.sizes()[0], &mut work.observations);
        self.critic.forward(&work.observations, &mut work.pass);
        let mut loss = 0.0;
        work.outputs.clear();
        for (value, &i) in work.pass.output().iter().zip(rows.indices) {
            let error = f64::from(*value) - rows.lessons.returns[i];
            loss += error * error / n as f64;
            work.outputs.push((2.0 * error / n as f64) as f32);
        }
        work.gradient.clear();
        work.gradient.resize(self.critic.parameters().len(), 0.0);
        self.critic
            .backward(&work.outputs, &mut work.pass, &mut work.gradient);
        clip(&mut work.gradient, Some(config.clip));
        let parameters = self.critic.parameters_mut();
        self.critic_optimizer.step(parameters, &work.gradient, rate);
        loss
    }

    fn step_actor(
        &mut self,
        rows: &Rows<'_>,
        config: &PpoConfig,
        rate: f64,
        update: &mut PpoUpdate,
    ) {
        self.actor_gradient(rows, config, update);
        clip(&mut self.work.gradient, Some(config.clip));
        let parameters = self.actor.network.parameters_mut();
        self.actor_optimizer
            .step(parameters, &self.work.gradient, rate);
    }

    /// The gradient of the actor's loss.
    pub(super) fn actor_gradient(
        &mut self,
        rows: &Rows<'_>,
        config: &PpoConfig,
        update: &mut PpoUpdate,
    ) -> &[f32] {
        let (actor, work, n) = (&self.actor, &mut self.work, rows.indices.len() as f64);
        let a = actor.action_len();
        rows.gather(actor.n_features(), &mut work.observations);
        let (observed, shown) = rows.expert;
        work.observations.extend_from_slice(observed);
        actor.network.forward(&work.observations, &mut work.pass);
        work.outputs.clear();
        let outputs = work.pass.output();
        for (row, &i) in outputs.chunks_exact(2 * a).zip(rows.indices) {
            let taken = &rows.round.actions[i * a..][..a];
            let densities: Vec<_> = row
                .chunks_exact(2)
                .zip(taken)
                .map(|(of, &action)| actor.dimension(of).log_density(f64::from(action)))
                .collect();
            let density: f64 = densities.iter().map(|d| d.0).sum();
            let change = density - rows.round.log_densities[i];
            let ratio = change.exp();
            let advantage = rows.lessons.advantages[i];
            let is_clipped = match advantage > 0.0 {
                true => ratio > 1.0 + config.ratio,
                false => ratio < 1.0 - config.ratio,
            };
            update.entropy -= density / n;
            // An estimate without bias that is never negative (Schulman 2020, "Approximating KL
            // Divergence").
            update.divergence += (ratio - 1.0 - change) / n;
            update.clipped += f64::from(u8::from(is_clipped)) / n;
            let weight = if is_clipped {
                0.0
            } else {
                -advantage * ratio / n
            };
            for ((_, by), of) in densities.into_iter().zip(row.chunks_exact(2)) {
                // The entropy of a normal distribution is its log standard deviation and a constant.
                let by = [weight * by[0], weight * by[1] - config.entropy / n];
                let by = actor.dimension(of).descent(by);
                work.outputs.extend(by.map(|by| by as f32));
            }
        }
        let n_shown = (shown.len() / a).max(1) as f64;
        let own = 2 * a * rows.indices.len();
        for (of, &action) in outputs[own..].chunks_exact(2).zip(shown) {
            let dimension = actor.dimension(of);
            let (density, by) = dimension.log_density_of_shown(f64::from(action));
            update.imitation_loss -= density / n_shown;
            let by = by.map(|by| -rows.imitation_weight / n_shown * by);
            work.outputs
                .extend(dimension.descent(by).map(|by| by as f32));
        }
        let (rewarded, imitated) = work.outputs.split_at(own);
        update.reward_gradient = norm(rewarded);
        update.imitation_gradient = norm(imitated);
        work.gradient.clear();
        work.gradient.resize(actor.network.parameters().len(), 0.0);
        actor
            .network
            .backward(&work.outputs, &mut work.pass, &mut work.gradient);
        &work.gradient
    }
}

impl Rows<'_> {
    fn gather(&self, width: usize, into: &mut Vec<f32>) {
        into.clear();
        for &i in self.indices {
            into.extend_from_slice(&self.round.observations[i * width..][..width]);
        }
    }
}
