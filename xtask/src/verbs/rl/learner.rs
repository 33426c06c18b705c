//! A run of any algorithm.

use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::Path;

use anyhow::Context as _;
use gump_rl::ppo::PpoTraining;
use gump_rl::sac::{ReplayBuffer, Training};
use gump_rl::{Actor, Algorithm, RlError, VectorEnv};
use gump_scene::Seed;

use super::curves::Curves;
use super::{Settings, read};
use crate::cli::WrongArguments;

/// A run that learns until all of its steps are done: gradient steps, of PPO rounds.
pub(super) enum Learner {
    Sac(Box<Training>),
    Ppo(Box<PpoTraining>),
}

impl Learner {
    /// A new run; `from` is the checkpoint of a run of PPO to begin with.
    ///
    /// Error: a configuration that does not fit, or a checkpoint that cannot be read.
    pub(super) fn new(
        algorithm: Algorithm,
        settings: &Settings,
        experts: ReplayBuffer,
        seed: Seed,
        from: Option<&Path>,
    ) -> anyhow::Result<Self> {
        if algorithm != Algorithm::Ppo {
            let config = settings.sac.clone();
            let run = Training::new(algorithm, config, experts, seed)?;
            return Ok(Self::Sac(Box::new(run)));
        }
        let config = settings.ppo.clone();
        let Some(path) = from else {
            let run = PpoTraining::new(config, experts, seed)?;
            return Ok(Self::Ppo(Box::new(run)));
        };
        let in_file = || path.display().to_string();
        let (other, _) = PpoTraining::from_bytes(&read(path)?).with_context(in_file)?;
        let run = PpoTraining::continuing(config, &other, experts, seed).with_context(in_file)?;
        Ok(Self::Ppo(Box::new(run)))
    }

    /// A stored run, and its notes.
    ///
    /// Error: [`RlError::Archive`] for bytes that hold none of this algorithm.
    pub(super) fn from_bytes(
        algorithm: Algorithm,
        bytes: &[u8],
    ) -> Result<(Self, BTreeMap<String, String>), RlError> {
        match algorithm {
            Algorithm::Ppo => {
                PpoTraining::from_bytes(bytes).map(|(run, notes)| (Self::Ppo(Box::new(run)), notes))
            }
            _ => Training::from_bytes(bytes).map(|(run, notes)| (Self::Sac(Box::new(run)), notes)),
        }
    }

    /// Error: [`WrongArguments`] if the run has other hyperparameters than the settings.
    pub(super) fn check(&self, settings: &Settings) -> Result<(), WrongArguments> {
        let (requested, begun) = (Self::total_of(self.algorithm(), settings), self.total());
        if requested != begun {
            let wrong = format!("--steps {requested}: the run to resume began with {begun}");
            return Err(WrongArguments(wrong));
        }
        let is_same = match self {
            Self::Sac(run) => *run.config() == settings.sac,
            Self::Ppo(run) => *run.config() == settings.ppo,
        };
        match is_same {
            true => Ok(()),
            false => Err(WrongArguments(
                "--config: the run to resume began with another configuration".into(),
            )),
        }
    }

    /// Steps of a run with these settings.
    pub(super) fn total_of(algorithm: Algorithm, settings: &Settings) -> usize {
        match algorithm {
            Algorithm::Ppo => settings.ppo.rounds,
            _ => settings.sac.steps,
        }
    }

    fn algorithm(&self) -> Algorithm {
        match self {
            Self::Sac(run) => run.algorithm(),
            Self::Ppo(_) => Algorithm::Ppo,
        }
    }

    /// Steps of the whole run.
    pub(super) fn total(&self) -> usize {
        match self {
            Self::Sac(run) => run.config().steps,
            Self::Ppo(run) => run.config().rounds,
        }
    }

    /// Steps done.
    pub(super) fn steps(&self) -> usize {
        match self {
            Self::Sac(run) => run.steps(),
            Self::Ppo(run) => run.rounds(),
        }
    }

    /// Steps between checkpoints.
    pub(super) fn segment_len(&self) -> usize {
        match self {
            Self::Sac(run) => run.config().segment,
            Self::Ppo(run) => run.config().segment,
        }
    }

    /// Steps of environments done.
    pub(super) fn env_steps(&self) -> u64 {
        match self {
            Self::Sac(run) => run.env_steps(),
            Self::Ppo(run) => run.env_steps(),
        }
    }

    pub(super) fn seed(&self) -> Seed {
        match self {
            Self::Sac(run) => run.seed(),
            Self::Ppo(run) => run.seed(),
        }
    }

    /// Number of expert transitions.
    pub(super) fn n_demonstrated(&self) -> usize {
        match self {
            Self::Sac(run) => run.n_demonstrated(),
            Self::Ppo(run) => run.n_demonstrated(),
        }
    }

    pub(super) fn is_done(&self) -> bool {
        self.steps() >= self.total()
    }

    /// The policy.
    pub(super) fn actor(&self) -> &Actor {
        match self {
            Self::Sac(run) => run.actor(),
            Self::Ppo(run) => run.actor(),
        }
    }

    /// Continues to the end of the segment, or until `goes_on`, asked after each step, is false.
    ///
    /// Error: of the environment, or [`RlError::Diverged`].
    pub(super) fn segment(
        &mut self,
        env: &mut dyn VectorEnv,
        curves: &mut Curves,
        mut goes_on: impl FnMut() -> bool,
    ) -> Result<(), RlError> {
        let mut next = || match goes_on() {
            true => ControlFlow::Continue(()),
            false => ControlFlow::Break(()),
        };
        match self {
            Self::Ppo(run) => run.segment(env, |report| {
                curves.push_round(&report);
                next()
            }),
            Self::Sac(run) => {
                let observe = |report| {
                    curves.push(report);
                    next()
                };
                match run.algorithm() {
                    Algorithm::Imitation => run.imitation_segment(observe),
                    _ => run.segment(env, observe),
                }
            }
        }
    }

    /// The whole run, with notes.
    ///
    /// Error: [`RlError::Diverged`] for a run with a number that is not finite.
    pub(super) fn to_bytes(&self, notes: &BTreeMap<String, String>) -> Result<Vec<u8>, RlError> {
        match self {
            Self::Sac(run) => run.to_bytes(notes),
            Self::Ppo(run) => run.to_bytes(notes),
        }
    }
}
