//! Training runs: collecting and learning alternate, in segments between which a run can be
//! resumed.

use std::ops::ControlFlow;

use gump_scene::Seed;
use rand::Rng as _;

use super::replay_buffer::{ReplayBuffer, Transition};
use super::{Batch, Learner, SacConfig, UpdateReport};
use crate::actor::Perception;
use crate::networks::Normalizer;
use crate::{Actor, Algorithm, ObservationForm, RlError, VectorEnv};

/// A run: the learner, its replay buffer and its progress.
///
/// No random state is kept between gradient steps: everything is drawn from forks of one seed, and
/// all episodes start anew at the beginning of a segment. The state between two segments is
/// therefore complete, and [`Training::to_bytes`] contains all of it.
#[derive(Clone, Debug)]
pub struct Training {
    pub(super) algorithm: Algorithm,
    pub(super) seed: Seed,
    pub(super) learner: Learner,
    pub(super) replay: ReplayBuffer,
    pub(super) expert: ReplayBuffer,
    pub(super) env_steps: u64,
    batch: Batch,
    /// Reward and steps so far of the episode in progress in every environment.
    running: Vec<Episode>,
    finished: Vec<Episode>,
}

/// An episode that ended while learning.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Episode {
    /// Sum of its rewards, not discounted.
    pub total: f64,
    /// Its steps.
    pub steps: usize,
    /// Whether it terminated, rather than being truncated.
    pub terminated: bool,
}

impl Episode {
    /// Adds the last step of all environments to their episodes; those that ended go to `finished`.
    pub(crate) fn advance(running: &mut [Self], env: &dyn VectorEnv, finished: &mut Vec<Self>) {
        for (i, episode) in running.iter_mut().enumerate() {
            episode.total += f64::from(env.rewards()[i]);
            episode.steps += 1;
            episode.terminated = env.terminated()[i];
            if episode.terminated || env.truncated()[i] {
                finished.push(std::mem::take(episode));
            }
        }
    }
}

/// Progress and statistics of one gradient step.
#[derive(Clone, Debug, PartialEq)]
pub struct StepReport {
    /// Gradient steps done, including this one.
    pub step: usize,
    /// Steps of environments done.
    pub env_steps: u64,
    /// The gradient step.
    pub update: UpdateReport,
    /// Episodes that ended since the last gradient step.
    pub episodes: Vec<Episode>,
}

/// The purposes that a seed is forked for.
#[derive(Clone, Copy)]
enum Purpose {
    Networks,
    Episodes,
    Actions,
    Batch,
    Noise,
}

impl Training {
    /// A new run; `expert` contains expert transitions, possibly none.
    ///
    /// # Errors
    /// [`RlError::Parameter`] for a configuration out of range; [`RlError::NoPicture`] for an
    /// encoder of pictures over numbers; [`RlError::EmptyBuffer`] for imitation without experts;
    /// [`RlError::OtherAlgorithm`] for [`Algorithm::Ppo`], which is [`crate::ppo`]'s.
    pub fn new(
        algorithm: Algorithm,
        config: SacConfig,
        expert: ReplayBuffer,
        seed: Seed,
    ) -> Result<Self, RlError> {
        config.check()?;
        if algorithm == Algorithm::Ppo {
            return Err(RlError::OtherAlgorithm { algorithm });
        }
        if algorithm == Algorithm::Imitation && expert.is_empty() {
            return Err(RlError::EmptyBuffer {
                requested: config.batch,
            });
        }
        let (form, a) = (expert.form(), expert.action_len);
        config.check_form(form)?;
        let networks = fork(seed, Purpose::Networks, 0);
        let mut training = Self {
            algorithm,
            seed,
            replay: ReplayBuffer::new(config.replay_capacity, form, a)?,
            learner: Learner::new(config, form, a, networks),
            expert,
            env_steps: 0,
            batch: Batch::default(),
            running: Vec::new(),
            finished: Vec::new(),
        };
        if algorithm == Algorithm::Imitation {
            training.fit_normalizer();
        }
        Ok(training)
    }

    /// A run from its stored parts.
    pub(super) fn restored(
        (algorithm, seed): (Algorithm, Seed),
        learner: Learner,
        [replay, expert]: [ReplayBuffer; 2],
        env_steps: u64,
    ) -> Self {
        Self {
            algorithm,
            seed,
            learner,
            replay,
            expert,
            env_steps,
            batch: Batch::default(),
            running: Vec::new(),
            finished: Vec::new(),
        }
    }

    /// The policy.
    pub fn actor(&self) -> &Actor {
        self.learner.actor()
    }

    /// The learner.
    pub fn learner(&self) -> &Learner {
        &self.learner
    }

    /// The configuration.
    pub fn config(&self) -> &SacConfig {
        &self.learner.config
    }

    /// The training signal.
    pub fn algorithm(&self) -> Algorithm {
        self.algorithm
    }

    /// The seed of all randomness.
    pub fn seed(&self) -> Seed {
        self.seed
    }

    /// Gradient steps done.
    pub fn steps(&self) -> usize {
        self.learner.steps()
    }

    /// Steps of environments done.
    pub fn env_steps(&self) -> u64 {
        self.env_steps
    }

    /// Number of expert transitions.
    pub fn n_demonstrated(&self) -> usize {
        self.expert.len()
    }

    /// True once all gradient steps are done.
    pub fn is_done(&self) -> bool {
        self.steps() >= self.config().steps
    }

    /// Continues to the end of the segment, or until `observe` breaks. A run that was broken off
    /// can be continued, but then differs from an uninterrupted one.
    ///
    /// # Errors
    /// Errors of the environment; [`RlError::Shape`] for one with other observations or actions
    /// than the run was started with; [`RlError::Diverged`] for a loss, an action or a reward that
    /// is not finite.
    pub fn segment(
        &mut self,
        env: &mut dyn VectorEnv,
        mut observe: impl FnMut(StepReport) -> ControlFlow<()>,
    ) -> Result<(), RlError> {
        self.actor().check_shape(env)?;
        let end = self.end_of_segment();
        env.reset(fork(self.seed, Purpose::Episodes, self.steps() as u64))?;
        self.running = vec![Episode::default(); env.n_envs()];
        self.finished.clear();
        if self.steps() == 0 {
            while self.env_steps < self.config().initial_steps as u64 {
                self.collect(env)?;
            }
            self.fit_normalizer();
        }
        while self.steps() < end {
            for _ in 0..self.config().unroll {
                self.collect(env)?;
            }
            for _ in 0..self.config().updates {
                let report = self.learn()?;
                if observe(report).is_break() {
                    return Ok(());
                }
                if self.steps() == end {
                    break;
                }
            }
        }
        Ok(())
    }

    /// As [`Training::segment`], from expert transitions only.
    ///
    /// # Errors
    /// [`RlError::Diverged`] for a loss that is not finite.
    pub fn imitation_segment(
        &mut self,
        mut observe: impl FnMut(StepReport) -> ControlFlow<()>,
    ) -> Result<(), RlError> {
        let end = self.end_of_segment();
        while self.steps() < end {
            let report = self.learn()?;
            if observe(report).is_break() {
                return Ok(());
            }
        }
        Ok(())
    }

    fn end_of_segment(&self) -> usize {
        let SacConfig { steps, segment, .. } = self.config();
        ((self.steps() / segment + 1) * segment).min(*steps)
    }

    /// One step of all environments; at random before learning.
    fn collect(&mut self, env: &mut dyn VectorEnv) -> Result<(), RlError> {
        let before = env.observations().to_vec();
        let mut rng = fork(self.seed, Purpose::Actions, self.env_steps).rng();
        let is_random = self.env_steps < self.config().initial_steps as u64;
        let actions: Vec<f32> = if is_random {
            let n = env.n_envs() * env.action_len();
            (0..n).map(|_| rng.random_range(-1.0..=1.0)).collect()
        } else {
            self.actor().sample(&before, &mut rng)
        };
        self.check_finite(&actions, "an action")?;
        env.step(&actions)?;
        // A buffer with such a reward would spoil every checkpoint from here on.
        self.check_finite(env.rewards(), "a reward")?;
        let (o, a) = (env.observation_len(), env.action_len());
        for i in 0..env.n_envs() {
            let (reward, terminated) = (env.rewards()[i], env.terminated()[i]);
            self.replay.push(Transition {
                observation: before[i * o..][..o].into(),
                action: &actions[i * a..][..a],
                reward,
                next: env.final_observations()[i * o..][..o].into(),
                terminated,
            });
        }
        Episode::advance(&mut self.running, env, &mut self.finished);
        self.env_steps += env.n_envs() as u64;
        Ok(())
    }

    /// One gradient step.
    fn learn(&mut self) -> Result<StepReport, RlError> {
        let step = self.steps() as u64;
        let (batch, learner) = (&mut self.batch, &mut self.learner);
        let n = learner.config.batch;
        let n_imitated = match self.algorithm {
            Algorithm::Imitation => n,
            _ if self.expert.is_empty() => 0,
            _ => learner.config.n_imitated(),
        };
        batch.draw(
            (&self.replay, n - n_imitated),
            (&self.expert, n_imitated),
            learner.actor.normalizer(),
            &mut fork(self.seed, Purpose::Batch, step).rng(),
        )?;
        let update = match self.algorithm {
            Algorithm::Imitation => learner.imitate(batch),
            _ => learner.update(batch, fork(self.seed, Purpose::Noise, step)),
        };
        if !(update.critic_loss + update.actor_loss + update.imitation_loss).is_finite() {
            return Err(self.diverged("a loss"));
        }
        Ok(StepReport {
            step: self.steps(),
            env_steps: self.env_steps,
            update,
            episodes: std::mem::take(&mut self.finished),
        })
    }

    /// Error: [`RlError::Diverged`] for a value that is not finite.
    fn check_finite(&self, values: &[f32], what: &str) -> Result<(), RlError> {
        match values.iter().all(|value| value.is_finite()) {
            true => Ok(()),
            false => Err(self.diverged(what)),
        }
    }

    /// The error that ends this run where `what` is not finite.
    pub(super) fn diverged(&self, what: &str) -> RlError {
        RlError::Diverged {
            step: self.steps(),
            what: what.to_owned(),
        }
    }

    /// Fixes the normalization of observations from all known ones.
    fn fit_normalizer(&mut self) {
        if let (true, ObservationForm::Numbers(len)) = (self.config().normalize, self.replay.form())
        {
            let pieces = [self.replay.numbers(), self.expert.numbers()];
            self.learner.actor.perception = Perception::Scaled(Normalizer::fitted(len, &pieces));
        }
    }
}

fn fork(seed: Seed, purpose: Purpose, k: u64) -> Seed {
    seed.fork(purpose as u64).fork(k)
}
