//! Serialization of runs, in the format of [`crate::sac`]'s.
//!
//! The caller stores the bytes; [`Actor::from_bytes`] reads the policy of a run.

use std::collections::BTreeMap;

use gump_scene::Seed;
use serde::{Deserialize, Serialize};

use super::learner::PpoLearner;
use super::training::critic_sizes;
use super::{PpoConfig, PpoTraining};
use crate::RlError;
use crate::networks::Mlp;
use crate::sac::archive::BufferHeader;
use crate::sac::tensors::{Reader, Writer, wrong};

/// The metadata of a run.
#[derive(Debug, Serialize, Deserialize)]
struct RunHeader {
    seed: u64,
    /// As TOML, which keeps all digits of floats; JSON loses the last one.
    config: String,
    rounds: usize,
    env_steps: u64,
    optimizer_steps: [u64; 2],
    expert: BufferHeader,
}

impl PpoTraining {
    /// The whole run, with notes of the caller; complete between two segments.
    ///
    /// # Errors
    /// [`RlError::Diverged`] for a run with a number that is not finite, from which no run could be
    /// resumed; [`RlError::Archive`] if it cannot be encoded.
    pub fn to_bytes(&self, notes: &BTreeMap<String, String>) -> Result<Vec<u8>, RlError> {
        let mut writer = Writer::default();
        let learner = &self.learner;
        writer.actor(&learner.actor, notes)?;
        writer.adam("actor", &learner.actor_optimizer);
        writer.floats("critic.parameters", learner.critic.parameters());
        writer.adam("critic", &learner.critic_optimizer);
        writer.buffer("expert", &self.expert);
        if let Some(name) = writer.not_finite() {
            return Err(RlError::Diverged {
                step: self.rounds,
                what: format!("a number of \"{name}\""),
            });
        }
        let adams = [&learner.actor_optimizer, &learner.critic_optimizer];
        writer.header(
            "ppo",
            &RunHeader {
                seed: self.seed.0,
                config: toml::to_string(&self.config).map_err(|error| wrong(error.to_string()))?,
                rounds: self.rounds,
                env_steps: self.env_steps,
                optimizer_steps: adams.map(|adam| adam.steps),
                expert: BufferHeader::of(&self.expert),
            },
        )?;
        writer.finish()
    }

    /// Reads a run to resume, and its notes.
    ///
    /// # Errors
    /// [`RlError::Archive`] for bytes that hold none.
    pub fn from_bytes(bytes: &[u8]) -> Result<(Self, BTreeMap<String, String>), RlError> {
        let mut reader = Reader::new(bytes)?;
        let header: RunHeader = reader.header("ppo")?;
        let config: PpoConfig = toml::from_str(&header.config)
            .map_err(|error| wrong(format!("its configuration is not valid ({error})")))?;
        config.check()?;
        let (actor, notes) = reader.actor()?;
        let expert = reader.buffer("expert", &header.expert)?;
        let mut layers = vec![actor.observation_len()];
        layers.extend(&config.hidden);
        layers.push(2 * actor.action_len());
        let fits = actor.network.sizes() == layers
            && (expert.form().len(), expert.action_len)
                == (actor.observation_len(), actor.action_len());
        if !fits {
            return Err(wrong("its policy does not fit its configuration"));
        }
        let sizes = critic_sizes(actor.observation_len(), &config);
        let critic = Mlp::from_parameters(&sizes, reader.floats("critic.parameters")?);
        let critic = critic.ok_or_else(|| wrong("its critic does not fit its configuration"))?;
        let mut learner = PpoLearner::new(actor, critic);
        let [of_actor, of_critic] = header.optimizer_steps;
        reader.adam("actor", &mut learner.actor_optimizer, of_actor)?;
        reader.adam("critic", &mut learner.critic_optimizer, of_critic)?;
        let done = (header.rounds, header.env_steps);
        let training = Self::restored(config, Seed(header.seed), learner, expert, done);
        Ok((training, notes))
    }
}
