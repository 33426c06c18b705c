//! One gradient step of soft actor-critic, and of imitation, which is its last term alone.
//!
//! Source: Haarnoja et al. 2018, "Soft Actor-Critic Algorithms and Applications", with ALF's
//! conventions: critic losses are added and not halved, and all gradients are computed before any
//! parameter changes. Gradients are hand-written; tests compare them with finite differences.

use gump_scene::{Seed, standard_normal};

use super::critics::{Critic, critic_loss, soft_target};
use super::vision::{Seen, Vision};
use super::{Batch, Draw, SacConfig, Squashed};
use crate::ObservationForm;
use crate::actor::Actor;
use crate::networks::{Adam, Pass, clip, norm};

/// Actor, critics and temperature with their optimizers.
#[derive(Clone, Debug)]
pub struct Learner {
    pub(crate) config: SacConfig,
    pub(crate) actor: Actor,
    pub(crate) actor_optimizer: Adam,
    pub(crate) critics: [Critic; 2],
    /// None where observations are numbers.
    pub(crate) vision: Option<Vision>,
    pub(crate) log_alpha: f32,
    pub(crate) alpha_optimizer: Adam,
    pub(crate) steps: usize,
    work: Work,
}

/// Buffers that are reused from step to step.
#[derive(Clone, Debug, Default)]
struct Work {
    now: Pass,
    next: Pass,
    gradient: Vec<f32>,
    now_gradient: Vec<f32>,
    next_gradient: Vec<f32>,
}

/// Statistics of a gradient step; losses are those before the step.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct UpdateReport {
    /// Squared errors of the two critics, mean over the batch, added.
    pub critic_loss: f64,
    /// `alpha * log density - value`, mean over the learner's own transitions.
    pub actor_loss: f64,
    /// Negative log density of the experts' actions, nats, mean over their transitions.
    pub imitation_loss: f64,
    /// Norm of the gradient of the actor's loss by the actor's outputs for the learner's own
    /// transitions, which is the part of rewards and entropy.
    pub reward_gradient: f64,
    /// The same for the experts' transitions, which is the part of imitation, before
    /// [`SacConfig::imitation_limit`].
    pub imitation_gradient: f64,
    /// Minus the log density of drawn actions, nats, mean.
    pub entropy: f64,
    /// The temperature.
    pub alpha: f64,
    /// Mean value of the batch's actions, by the first critic.
    pub value: f64,
    /// Learning rate of the step.
    pub learning_rate: f64,
}

/// Drawn actions of some rows and what they depend on.
struct Draws {
    /// Shape: `[rows, action_len]`.
    actions: Vec<f32>,
    /// Shape: `[rows]`, nats.
    log_densities: Vec<f64>,
    /// The distributions drawn from, and what was drawn. Shape: `[rows * action_len]`.
    drawn: Vec<(Squashed, Draw)>,
}

impl Learner {
    /// An untrained learner.
    ///
    /// # Panics
    /// For a configuration without hidden layers or with empty ones, and for an encoder over
    /// numbers; see [`SacConfig::check`] and [`SacConfig::check_form`].
    pub fn new(
        config: SacConfig,
        form: impl Into<ObservationForm>,
        action_len: usize,
        seed: Seed,
    ) -> Self {
        let actor = Actor::new(&config, form, action_len, seed.fork(0));
        let n_features = actor.n_features();
        let critic = |k| Critic::new(&config.hidden, n_features, action_len, seed.fork(k));
        Self {
            vision: Vision::new(&config, &actor, seed.fork(3)),
            actor_optimizer: Adam::new(actor.network.parameters().len()),
            actor,
            critics: [critic(1), critic(2)],
            log_alpha: config.initial_log_alpha as f32,
            alpha_optimizer: Adam::new(1),
            steps: 0,
            work: Work::default(),
            config,
        }
    }

    /// The policy.
    pub fn actor(&self) -> &Actor {
        &self.actor
    }

    /// The critics.
    pub fn critics(&self) -> &[Critic; 2] {
        &self.critics
    }

    /// The temperature.
    pub fn alpha(&self) -> f64 {
        f64::from(self.log_alpha).exp()
    }

    /// Gradient steps done.
    pub fn steps(&self) -> usize {
        self.steps
    }

    /// One gradient step of actor, critics and temperature; expert transitions train the actor by
    /// imitation as well as the critics.
    ///
    /// The noise of all draws comes from `seed`.
    ///
    /// # Panics
    /// If the batch is empty or its rows have other lengths than the networks.
    pub fn update(&mut self, batch: &Batch, seed: Seed) -> UpdateReport {
        let alpha = self.alpha();
        let (actor, work) = (&self.actor, &mut self.work);
        let sight = self.vision.as_mut().zip(actor.encoder());
        let seen = match sight {
            Some((vision, encoder)) => vision.see(encoder, batch),
            None => Seen::unchanged(batch),
        };
        let [by_actor, next_by_actor] = &seen.by_actor;
        rayon::join(
            || actor.network.forward(by_actor, &mut work.now),
            || actor.network.forward(next_by_actor, &mut work.next),
        );
        let now = draw(actor, &work.now, seed.fork(0));
        let next = draw(actor, &work.next, seed.fork(1));

        // The rows the actor learns from: what the learner drove, perhaps also what it saw next.
        let (n_own, n_features) = (batch.n_own(), actor.n_features());
        let own = n_own * actor.action_len();
        let [by_critics, next_by_critics] = seen.by_critics();
        let mut judged = by_critics[..n_own * n_features].to_vec();
        let mut acted = now.actions[..own].to_vec();
        if self.config.actor_on_next {
            judged.extend_from_slice(&next_by_critics[..n_own * n_features]);
            acted.extend_from_slice(&next.actions[..own]);
        }
        both(&mut self.critics, |_, critic| {
            let taken = (by_critics.as_ref(), batch.actions.as_slice());
            critic.run(taken, (&seen.by_targets, &next.actions));
            critic.judge(&judged, &acted);
        });

        let [first, second] = &self.critics;
        let future = lower(first.future(), second.future());
        let entropy_weight = if self.config.entropy_in_target {
            alpha
        } else {
            0.0
        };
        let targets: Vec<f64> = (0..batch.len())
            .map(|i| {
                let soft_value = future[i].0 - entropy_weight * next.log_densities[i];
                let reward = f64::from(batch.rewards[i]);
                soft_target(
                    reward,
                    batch.terminated[i],
                    self.config.discount,
                    soft_value,
                )
            })
            .collect();
        let judged = lower(first.judged(), second.judged());
        let value = mean(first.value().iter().map(|&q| f64::from(q)));
        let (huber, has_vision) = (self.config.huber, self.vision.is_some());
        let losses = both(&mut self.critics, |k, critic| {
            let loss = |i: usize, q| critic_loss(f64::from(q) - targets[i], huber);
            let loss = critic.learn(has_vision, loss);
            critic.gradient_of_judged(|i| judged[i].1 == k);
            loss
        });
        let [first, second] = &self.critics;
        if let Some((vision, encoder)) = self.vision.as_mut().zip(self.actor.encoder()) {
            let pairs = first
                .taken_by_observation()
                .zip(second.taken_by_observation());
            let by_features: Vec<f32> = pairs.map(|(a, b)| a + b).collect();
            vision.learn_from_critics(encoder, &by_features);
        }

        // d (lower value) / d action, for the rows judged.
        let value_by_action: Vec<f64> = first
            .judged_by_action()
            .zip(second.judged_by_action())
            .map(|(a, b)| f64::from(a) + f64::from(b))
            .collect();
        let n_judged = judged.len();
        let mut report = UpdateReport {
            critic_loss: losses[0] + losses[1],
            alpha,
            value,
            learning_rate: self.config.rate(self.steps),
            ..UpdateReport::default()
        };
        self.actor_gradient(batch, [&now, &next], &value_by_action, &mut report);
        let log_densities = now.log_densities[..n_own]
            .iter()
            .chain(&next.log_densities[..n_own]);
        let log_densities: Vec<f64> = log_densities.copied().take(n_judged).collect();
        report.entropy = -mean(log_densities.iter().copied());
        let soft = judged.iter().zip(&log_densities);
        report.actor_loss = mean(soft.map(|((value, _), density)| alpha * density - value));
        self.apply(&report, n_judged > 0);
        report
    }

    /// One gradient step towards the experts' actions, of the actor only; every row counts as an
    /// expert's.
    ///
    /// # Panics
    /// If the batch is empty or its rows have other lengths than the network.
    pub fn imitate(&mut self, batch: &Batch) -> UpdateReport {
        let rate = self.config.rate(self.steps);
        let (actor, work) = (&self.actor, &mut self.work);
        match self.vision.as_mut().zip(actor.encoder()) {
            Some((vision, encoder)) => {
                let features = vision.see_now(encoder, batch);
                actor.network.forward(features, &mut work.now);
            }
            None => actor.network.forward(&batch.observations, &mut work.now),
        }
        let loss = imitation_gradient(
            actor,
            work.now.output(),
            &batch.actions,
            1.0,
            reset(&mut work.now_gradient, work.now.output().len()),
        );
        reset(&mut work.gradient, actor.network.parameters().len());
        let Work {
            now,
            now_gradient,
            gradient,
            ..
        } = work;
        match self.vision.as_mut().zip(actor.encoder()) {
            Some((vision, encoder)) => {
                actor.network.backward_through(now_gradient, now, gradient);
                vision.learn_from_actor(encoder, now.input_gradient(), None);
            }
            None => actor.network.backward(now_gradient, now, gradient),
        }
        self.step_actor(rate);
        self.step_actors_encoder(rate);
        self.steps += 1;
        UpdateReport {
            imitation_loss: loss,
            learning_rate: rate,
            ..UpdateReport::default()
        }
    }

    /// Leaves the gradient of the actor's loss in `work.gradient`.
    fn actor_gradient(
        &mut self,
        batch: &Batch,
        draws: [&Draws; 2],
        value_by_action: &[f64],
        report: &mut UpdateReport,
    ) {
        let alpha = report.alpha;
        let (actor, work) = (&self.actor, &mut self.work);
        let Work {
            now,
            next,
            gradient,
            now_gradient,
            next_gradient,
        } = work;
        reset(now_gradient, now.output().len());
        reset(next_gradient, next.output().len());
        let own = batch.n_own() * actor.action_len();
        let weight = actor.action_len() as f64 / value_by_action.len().max(1) as f64;
        let pieces = value_by_action.chunks(own.max(1));
        let outputs = [&mut *now_gradient, &mut *next_gradient];
        for ((values, draws), gradient) in pieces.zip(draws).zip(outputs) {
            let dimensions = gradient.chunks_exact_mut(2).zip(values);
            for ((gradient, value), (dimension, draw)) in dimensions.zip(&draws.drawn) {
                let by = |k| alpha * draw.log_density_by[k] - value * draw.action_by[k];
                let by = [0, 1].map(|k| weight * by(k));
                gradient.copy_from_slice(&dimension.descent(by).map(|by| by as f32));
            }
        }
        let (rewarded, imitated) = now_gradient.split_at_mut(2 * own);
        report.imitation_loss = imitation_gradient(
            actor,
            &now.output()[2 * own..],
            &batch.actions[own..],
            self.config.imitation_weight,
            imitated,
        );
        report.reward_gradient = norm(rewarded).hypot(norm(next_gradient));
        report.imitation_gradient = norm(imitated);
        if let Some(limit) = self.config.imitation_limit {
            clip(imitated, Some(limit * report.reward_gradient));
        }
        reset(gradient, actor.network.parameters().len());
        let separate = self.vision.as_mut().filter(|vision| vision.is_separate());
        let Some((vision, encoder)) = separate.zip(actor.encoder()) else {
            actor.network.backward(now_gradient, now, gradient);
            if self.config.actor_on_next {
                actor.network.backward(next_gradient, next, gradient);
            }
            return;
        };
        actor.network.backward_through(now_gradient, now, gradient);
        let by_next = self.config.actor_on_next.then(|| {
            actor
                .network
                .backward_through(next_gradient, next, gradient);
            next.input_gradient()
        });
        vision.learn_from_actor(encoder, now.input_gradient(), by_next);
    }

    /// Moves everything by its gradient, then the targets.
    fn apply(&mut self, report: &UpdateReport, learns_alpha: bool) {
        let rate = report.learning_rate;
        self.step_actor(rate);
        self.step_actors_encoder(rate);
        self.steps += 1;
        let moves_target = self.steps.is_multiple_of(self.config.target_period);
        let (limit, tau) = (self.config.clip, self.config.tau as f32);
        if let Some((vision, encoder)) = self.vision.as_mut().zip(self.actor.encoder()) {
            vision.step_critics(rate, limit);
            if moves_target {
                vision.move_target(encoder, tau);
            }
        }
        both(&mut self.critics, |_, critic| {
            critic.step(rate, limit);
            if moves_target {
                critic.move_target(tau);
            }
        });
        if self.config.learn_alpha && learns_alpha {
            // Entropy above its target lowers the temperature.
            let target = self.config.target_entropy * self.actor.action_len() as f64;
            let gradient = [(report.entropy - target) as f32];
            let log_alpha = std::slice::from_mut(&mut self.log_alpha);
            self.alpha_optimizer.step(log_alpha, &gradient, rate);
        }
    }

    /// The actor's gradient in the last step.
    #[cfg(test)]
    pub(super) fn actor_gradient_taken(&self) -> &[f32] {
        &self.work.gradient
    }

    fn step_actor(&mut self, rate: f64) {
        let gradient = &mut self.work.gradient;
        clip(gradient, self.config.clip);
        let parameters = self.actor.network.parameters_mut();
        self.actor_optimizer.step(parameters, gradient, rate);
    }

    fn step_actors_encoder(&mut self, rate: f64) {
        let sight = self.vision.as_mut().zip(self.actor.encoder_mut());
        if let Some((vision, encoder)) = sight {
            vision.step_actors(encoder, rate, self.config.clip);
        }
    }
}

/// Draws an action for every row that went through the network.
fn draw(actor: &Actor, pass: &Pass, seed: Seed) -> Draws {
    let mut rng = seed.rng();
    let drawn = pass.output().chunks_exact(2).map(|outputs| {
        let noise = standard_normal(&mut rng);
        let dimension = actor.dimension(outputs);
        (dimension, dimension.draw(noise))
    });
    let drawn: Vec<_> = drawn.collect();
    let rows = drawn.chunks_exact(actor.action_len());
    Draws {
        actions: drawn.iter().map(|(_, d)| d.action as f32).collect(),
        log_densities: rows
            .map(|row| row.iter().map(|(_, d)| d.log_density).sum())
            .collect(),
        drawn,
    }
}

/// Mean negative log density of experts' `actions`; its gradient times `weight` into `gradient`.
fn imitation_gradient(
    actor: &Actor,
    outputs: &[f32],
    actions: &[f32],
    weight: f64,
    gradient: &mut [f32],
) -> f64 {
    let rows = (actions.len() / actor.action_len()).max(1) as f64;
    let mut loss = 0.0;
    let dimensions = outputs.chunks_exact(2).zip(gradient.chunks_exact_mut(2));
    for ((outputs, gradient), &action) in dimensions.zip(actions) {
        let dimension = actor.dimension(outputs);
        let (density, by) = dimension.log_density_of_shown(f64::from(action));
        loss -= density / rows;
        let by = dimension.descent(by.map(|by| -weight * by / rows));
        gradient.copy_from_slice(&by.map(|by| by as f32));
    }
    loss
}

/// The lower of two values per row, and which critic it is of.
fn lower(first: &[f32], second: &[f32]) -> Vec<(f64, usize)> {
    let pairs = first.iter().zip(second);
    let lower = |(&a, &b)| {
        if b < a {
            (f64::from(b), 1)
        } else {
            (f64::from(a), 0)
        }
    };
    pairs.map(lower).collect()
}

/// Does the same to both critics, side by side.
fn both<T: Send>(
    critics: &mut [Critic; 2],
    work: impl Fn(usize, &mut Critic) -> T + Sync,
) -> [T; 2] {
    let [first, second] = critics;
    let (a, b) = rayon::join(|| work(0, first), || work(1, second));
    [a, b]
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (n, sum) = values.fold((0usize, 0.0), |(n, sum), x| (n + 1, sum + x));
    sum / n.max(1) as f64
}

/// Zeros of a length, in memory that was used before.
fn reset(values: &mut Vec<f32>, len: usize) -> &mut [f32] {
    values.clear();
    values.resize(len, 0.0);
    values
}
