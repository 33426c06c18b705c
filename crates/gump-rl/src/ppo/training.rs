//! Training runs: imitation, then rounds of collecting and learning, in segments between which a
//! run can be resumed.

use std::ops::ControlFlow;

use gump_scene::Seed;
use rand::seq::SliceRandom as _;

use super::learner::{PpoLearner, Rows};
use super::round::Round;
use super::{PpoConfig, PpoUpdate};
use crate::actor::Perception;
use crate::networks::{Mlp, Normalizer};
use crate::sac::{Batch, Episode, ReplayBuffer, SacConfig, Training};
use crate::{Actor, Algorithm, ObservationForm, RlError, VectorEnv};

/// A run: the learner, its experts and its progress.
///
/// Everything random is drawn from forks of one seed, and all episodes start anew at the beginning
/// of a segment, so the state between two segments is complete.
#[derive(Clone, Debug)]
pub struct PpoTraining {
    pub(super) config: PpoConfig,
    pub(super) seed: Seed,
    pub(super) learner: PpoLearner,
    pub(super) expert: ReplayBuffer,
    pub(super) rounds: usize,
    pub(super) env_steps: u64,
    batch: Batch,
    running: Vec<Episode>,
}

/// Progress and statistics of a round.
#[derive(Clone, Debug, PartialEq)]
pub struct PpoReport {
    /// Rounds done, including this one.
    pub round: usize,
    /// Steps of environments done.
    pub env_steps: u64,
    /// Mean over the round's gradient steps.
    pub update: PpoUpdate,
    /// Learning rate of the round.
    pub learning_rate: f64,
    /// Episodes that ended in the round.
    pub episodes: Vec<Episode>,
}

/// The purposes that a seed is forked for.
#[derive(Clone, Copy)]
enum Purpose {
    Networks,
    Imitation,
    Episodes,
    Actions,
    Order,
    Experts,
}

impl PpoTraining {
    /// A new run; `expert` contains expert transitions, possibly none, which are imitated first.
    ///
    /// # Errors
    /// [`RlError::Parameter`] for a configuration out of range, or for observations that are
    /// pictures; [`RlError::Diverged`] if imitation is not finite.
    pub fn new(config: PpoConfig, expert: ReplayBuffer, seed: Seed) -> Result<Self, RlError> {
        config.check()?;
        let form = expert.form();
        let ObservationForm::Numbers(observation_len) = form else {
            return Err(RlError::Parameter {
                name: "observation",
                value: form.len() as f64,
                expected: "numbers, not pictures, for PPO",
            });
        };
        let actor = imitated(&config, &expert, fork(seed, Purpose::Imitation, 0))?;
        let sizes = critic_sizes(observation_len, &config);
        let mut rng = fork(seed, Purpose::Networks, 0).rng();
        let critic = Mlp::new(&sizes, 1.0, &mut rng);
        let learner = PpoLearner::new(actor, critic);
        Ok(Self::restored(config, seed, learner, expert, (0, 0)))
    }

    /// A new run that begins with the policy and the critic of another, with new optimizers.
    ///
    /// # Errors
    /// [`RlError::Parameter`] for a configuration out of range; [`RlError::Archive`] for networks of
    /// other sizes than the configuration's.
    pub fn continuing(
        config: PpoConfig,
        other: &Self,
        expert: ReplayBuffer,
        seed: Seed,
    ) -> Result<Self, RlError> {
        config.check()?;
        let (actor, critic) = (other.actor().clone(), other.learner.critic.clone());
        let fits = |what: &'static str, expected, found| match expected == found {
            true => Ok(()),
            false => Err(RlError::Shape {
                what,
                expected,
                found,
            }),
        };
        fits("observations", actor.observation_len(), expert.form().len())?;
        fits("actions", actor.action_len(), expert.action_len)?;
        if other.config.hidden != config.hidden {
            let hidden = config.hidden.iter().sum::<usize>() as f64;
            return Err(RlError::Parameter {
                name: "hidden",
                value: hidden,
                expected: "the layers of the run to begin with",
            });
        }
        let actor = Actor {
            log_std_bounds: config.log_std_bounds,
            ..actor
        };
        let learner = PpoLearner::new(actor, critic);
        Ok(Self::restored(config, seed, learner, expert, (0, 0)))
    }

    /// A run from its parts; `done` are the rounds and environment steps done.
    pub(super) fn restored(
        config: PpoConfig,
        seed: Seed,
        learner: PpoLearner,
        expert: ReplayBuffer,
        (rounds, env_steps): (usize, u64),
    ) -> Self {
        Self {
            config,
            seed,
            learner,
            expert,
            rounds,
            env_steps,
            batch: Batch::default(),
            running: Vec::new(),
        }
    }

    /// The policy.
    pub fn actor(&self) -> &Actor {
        &self.learner.actor
    }

    /// The configuration.
    pub fn config(&self) -> &PpoConfig {
        &self.config
    }

    /// The seed of all randomness.
    pub fn seed(&self) -> Seed {
        self.seed
    }

    /// Rounds done.
    pub fn rounds(&self) -> usize {
        self.rounds
    }

    /// Steps of environments done.
    pub fn env_steps(&self) -> u64 {
        self.env_steps
    }

    /// Number of expert transitions.
    pub fn n_demonstrated(&self) -> usize {
        self.expert.len()
    }

    /// True once all rounds are done.
    pub fn is_done(&self) -> bool {
        self.rounds >= self.config.rounds
    }

    /// Continues to the end of the segment, or until `observe` breaks.
    ///
    /// # Errors
    /// Errors of the environment; [`RlError::Shape`] for one with other observations or actions than
    /// the run was started with; [`RlError::Diverged`] for a loss, an action or a reward that is not
    /// finite.
    pub fn segment(
        &mut self,
        env: &mut dyn VectorEnv,
        mut observe: impl FnMut(PpoReport) -> ControlFlow<()>,
    ) -> Result<(), RlError> {
        self.actor().check_shape(env)?;
        let PpoConfig {
            rounds, segment, ..
        } = self.config;
        let end = ((self.rounds / segment + 1) * segment).min(rounds);
        env.reset(fork(self.seed, Purpose::Episodes, self.rounds as u64))?;
        self.running = vec![Episode::default(); env.n_envs()];
        if self.rounds == 0 && !self.is_scaled() {
            self.fit_normalizer(env)?;
        }
        while self.rounds < end {
            let report = self.round(env)?;
            if observe(report).is_break() {
                break;
            }
        }
        Ok(())
    }

    /// Whether the policy scales observations already, by those of experts or as the run that it
    /// comes from.
    fn is_scaled(&self) -> bool {
        let normalizer = self.actor().normalizer();
        normalizer.is_none_or(|normalizer| !normalizer.is_identity())
    }

    /// Scales observations as an untrained policy sees them.
    fn fit_normalizer(&mut self, env: &mut dyn VectorEnv) -> Result<(), RlError> {
        let seed = fork(self.seed, Purpose::Imitation, 1);
        let (actor, check) = (&self.learner.actor, finite(0));
        let round = Round::collect(actor, env, self.config.unroll, seed, check, |_| ())?;
        self.env_steps += round.len() as u64;
        let normalizer = Normalizer::fitted(actor.observation_len(), &[&round.observations]);
        self.learner.actor.perception = Perception::Scaled(normalizer);
        self.running = vec![Episode::default(); env.n_envs()];
        env.reset(fork(self.seed, Purpose::Episodes, 0))
    }

    fn round(&mut self, env: &mut dyn VectorEnv) -> Result<PpoReport, RlError> {
        let k = self.rounds as u64;
        let (config, running) = (&self.config, &mut self.running);
        let mut episodes = Vec::new();
        let check = finite(self.rounds);
        let round = Round::collect(
            &self.learner.actor,
            env,
            config.unroll,
            fork(self.seed, Purpose::Actions, k),
            &check,
            |env| Episode::advance(running, env, &mut episodes),
        )?;
        self.env_steps += round.len() as u64;
        let estimate = (config.discount, config.lambda);
        let lessons = round.lessons(&self.learner.critic, env.n_envs(), estimate);
        let rate = config.rate(self.rounds);
        let imitation_weight = config.imitation_weight_of(self.rounds);
        let moves_actor = self.rounds >= config.critic_rounds;
        let mut order: Vec<usize> = (0..round.len()).collect();
        let mut rng = fork(self.seed, Purpose::Order, k).rng();
        let mut experts = fork(self.seed, Purpose::Experts, k).rng();
        let (mut sum, mut n) = (PpoUpdate::default(), 0.0f64);
        for _ in 0..config.epochs {
            order.shuffle(&mut rng);
            let mut moved = (0.0, 0.0f64);
            for indices in order.chunks(config.batch) {
                let imitates = imitation_weight > 0.0 && !self.expert.is_empty();
                if imitates && moves_actor {
                    let none = (&self.expert, 0);
                    let shown = (&self.expert, indices.len());
                    let normalizer = self.learner.actor.normalizer();
                    self.batch.draw(none, shown, normalizer, &mut experts)?;
                }
                let rows = Rows {
                    round: &round,
                    lessons: &lessons,
                    indices,
                    expert: (&self.batch.observations, &self.batch.actions),
                    imitation_weight,
                };
                let update = self.learner.step(&rows, config, rate, moves_actor);
                sum = sum + update;
                moved = (moved.0 + update.divergence, moved.1 + 1.0);
                n += 1.0;
            }
            if moved.0 / moved.1.max(1.0) > config.divergence {
                break;
            }
        }
        let update = sum.over(n);
        let losses = [update.critic_loss, update.divergence, update.imitation_loss];
        check(&losses.map(|x| x as f32), "a loss")?;
        self.rounds += 1;
        Ok(PpoReport {
            round: self.rounds,
            env_steps: self.env_steps,
            update,
            learning_rate: rate,
            episodes,
        })
    }
}

/// The layer sizes of the critic.
pub(super) fn critic_sizes(observation_len: usize, config: &PpoConfig) -> Vec<usize> {
    let mut sizes = vec![observation_len];
    sizes.extend(&config.hidden);
    sizes.push(1);
    sizes
}

/// A check of values in a round; its error is [`RlError::Diverged`].
fn finite(round: usize) -> impl Fn(&[f32], &str) -> Result<(), RlError> {
    move |values, what| match values.iter().all(|x| x.is_finite()) {
        true => Ok(()),
        false => Err(RlError::Diverged {
            step: round,
            what: what.to_owned(),
        }),
    }
}

/// An actor that has imitated the experts, or an untrained one if there are none.
fn imitated(config: &PpoConfig, expert: &ReplayBuffer, seed: Seed) -> Result<Actor, RlError> {
    let imitation = SacConfig {
        steps: config.imitation_steps,
        batch: 256,
        hidden: config.hidden.clone(),
        head_gain: config.head_gain,
        log_std_bounds: config.log_std_bounds,
        learning_rate: 3e-4,
        final_learning_rate: 6e-5,
        ..SacConfig::default()
    };
    if expert.is_empty() || config.imitation_steps == 0 {
        return Ok(Actor::new(
            &imitation,
            expert.form(),
            expert.action_len,
            seed,
        ));
    }
    let mut training = Training::new(Algorithm::Imitation, imitation, expert.clone(), seed)?;
    while !training.is_done() {
        training.imitation_segment(|_| ControlFlow::Continue(()))?;
    }
    Ok(training.actor().clone())
}

fn fork(seed: Seed, purpose: Purpose, k: u64) -> Seed {
    seed.fork(purpose as u64).fork(k)
}

impl std::ops::Add for PpoUpdate {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self {
            critic_loss: self.critic_loss + other.critic_loss,
            divergence: self.divergence + other.divergence,
            clipped: self.clipped + other.clipped,
            entropy: self.entropy + other.entropy,
            imitation_loss: self.imitation_loss + other.imitation_loss,
            reward_gradient: self.reward_gradient + other.reward_gradient,
            imitation_gradient: self.imitation_gradient + other.imitation_gradient,
        }
    }
}

impl PpoUpdate {
    fn over(self, n: f64) -> Self {
        Self {
            critic_loss: self.critic_loss / n,
            divergence: self.divergence / n,
            clipped: self.clipped / n,
            entropy: self.entropy / n,
            imitation_loss: self.imitation_loss / n,
            reward_gradient: self.reward_gradient / n,
            imitation_gradient: self.imitation_gradient / n,
        }
    }
}
