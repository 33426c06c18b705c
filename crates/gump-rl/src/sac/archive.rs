//! Serialization of policies and runs: safetensors, with everything else as JSON in the header.
//!
//! The caller stores the bytes.

use std::collections::BTreeMap;

use gump_scene::Seed;
use safetensors::tensor::Dtype;
use serde::{Deserialize, Serialize};

use super::replay_buffer::{ReplayBuffer, Store};
use super::tensors::{Reader, Writer, check_len, wrong};
use super::training::Training;
use super::{Learner, SacConfig};
use crate::actor::Perception;
use crate::networks::{Architecture, ConvNet, Mlp, Normalizer, Picture};
use crate::{Actor, Algorithm, ObservationForm, RlError};

/// Version of the layout.
const FORMAT: &str = "gump-rl-1";

/// The metadata of a policy.
#[derive(Debug, Serialize, Deserialize)]
struct PolicyHeader {
    format: String,
    /// Layer sizes of the network, input first.
    sizes: Vec<usize>,
    /// The encoder, if observations are images.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    encoder: Option<EncoderHeader>,
    log_std_bounds: [f64; 2],
    /// Notes of the caller.
    notes: BTreeMap<String, String>,
}

#[derive(Debug, Serialize, Deserialize)]
struct EncoderHeader {
    architecture: Architecture,
    picture: Picture,
}

/// The metadata of a run.
#[derive(Debug, Serialize, Deserialize)]
struct RunHeader {
    algorithm: Algorithm,
    seed: u64,
    /// As TOML, which keeps all digits of floats; JSON loses the last one.
    config: String,
    steps: usize,
    env_steps: u64,
    optimizer_steps: [u64; 4],
    /// Of the actor's encoder and the critics' own, where there are any.
    #[serde(default)]
    encoder_steps: [u64; 2],
    buffers: [BufferHeader; 2],
}

#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct BufferHeader {
    capacity: usize,
    head: usize,
    observation_len: usize,
    /// If observations are bits.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    picture: Option<Picture>,
    action_len: usize,
}

impl BufferHeader {
    pub(crate) fn of(buffer: &ReplayBuffer) -> Self {
        Self {
            capacity: buffer.capacity,
            head: buffer.head,
            observation_len: buffer.form.len(),
            picture: match buffer.form {
                ObservationForm::Numbers(_) => None,
                ObservationForm::Bits(picture) => Some(picture),
            },
            action_len: buffer.action_len,
        }
    }

    fn form(&self) -> ObservationForm {
        match self.picture {
            Some(picture) => picture.into(),
            None => self.observation_len.into(),
        }
    }
}

impl Actor {
    /// The policy, with notes of the caller.
    ///
    /// # Errors
    /// [`RlError::Archive`] if it cannot be encoded.
    pub fn to_bytes(&self, notes: &BTreeMap<String, String>) -> Result<Vec<u8>, RlError> {
        let mut writer = Writer::default();
        writer.actor(self, notes)?;
        writer.finish()
    }

    /// Reads the policy of a stored policy or run, and its notes.
    ///
    /// # Errors
    /// [`RlError::Archive`] for bytes that hold none.
    pub fn from_bytes(bytes: &[u8]) -> Result<(Self, BTreeMap<String, String>), RlError> {
        Reader::new(bytes)?.actor()
    }
}

impl Training {
    /// The whole run, with notes of the caller; complete between two segments.
    ///
    /// # Errors
    /// [`RlError::Diverged`] for a run with a number that is not finite, from which no run could be
    /// resumed; [`RlError::Archive`] if it cannot be encoded.
    pub fn to_bytes(&self, notes: &BTreeMap<String, String>) -> Result<Vec<u8>, RlError> {
        let mut writer = Writer::default();
        let learner = &self.learner;
        writer.actor(self.actor(), notes)?;
        writer.adam("actor", &learner.actor_optimizer);
        for (critic, name) in learner.critics.iter().zip(["critic.0", "critic.1"]) {
            writer.floats(&format!("{name}.parameters"), critic.online.parameters());
            writer.floats(&format!("{name}.target"), critic.target.parameters());
            writer.adam(name, &critic.optimizer);
        }
        writer.floats("log_alpha", &[learner.log_alpha]);
        writer.adam("log_alpha", &learner.alpha_optimizer);
        for (buffer, name) in [(&self.replay, "replay"), (&self.expert, "expert")] {
            writer.buffer(name, buffer);
        }
        let mut encoder_steps = [0; 2];
        if let Some(vision) = &learner.vision {
            writer.adam("actor.encoder", &vision.training.optimizer);
            writer.floats("critics.encoder.target", vision.target.parameters());
            encoder_steps[0] = vision.training.optimizer.steps;
            if let Some((encoder, training)) = &vision.separate {
                writer.floats("critics.encoder", encoder.parameters());
                writer.adam("critics.encoder", &training.optimizer);
                encoder_steps[1] = training.optimizer.steps;
            }
        }
        // Losses are those before a step, so that only the parameters show what the last one did.
        if let Some(name) = writer.not_finite() {
            return Err(self.diverged(&format!("a number of \"{name}\"")));
        }
        let [first, second] = &learner.critics;
        let adams = [
            &learner.actor_optimizer,
            &first.optimizer,
            &second.optimizer,
        ];
        let [a, b, c] = adams.map(|adam| adam.steps);
        writer.header(
            "run",
            &RunHeader {
                algorithm: self.algorithm,
                seed: self.seed.0,
                config: toml::to_string(&learner.config)
                    .map_err(|error| wrong(error.to_string()))?,
                steps: learner.steps,
                env_steps: self.env_steps,
                optimizer_steps: [a, b, c, learner.alpha_optimizer.steps],
                encoder_steps,
                buffers: [&self.replay, &self.expert].map(BufferHeader::of),
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
        let header: RunHeader = reader.header("run")?;
        let config: SacConfig = toml::from_str(&header.config)
            .map_err(|error| wrong(format!("its configuration is not valid ({error})")))?;
        config.check()?;
        let (actor, notes) = reader.actor()?;
        let [replay, expert] = &header.buffers;
        let buffers = [
            reader.buffer("replay", replay)?,
            reader.buffer("expert", expert)?,
        ];
        let (form, a) = (buffers[0].form, actor.action_len());
        config.check_form(form)?;
        let fits = |b: &ReplayBuffer| (b.form, b.action_len) == (form, a);
        if !buffers.iter().all(fits) || form.len() != actor.observation_len() {
            return Err(wrong("its buffers do not fit its policy"));
        }
        let mut learner = Learner::new(config, form, a, Seed(0));
        let kind = |actor: &Actor| {
            let encoder = actor.encoder();
            (
                actor.network.sizes().to_vec(),
                encoder.map(|e| (e.architecture(), e.picture())),
            )
        };
        if kind(&learner.actor) != kind(&actor) {
            return Err(wrong("its policy does not fit its configuration"));
        }
        learner.actor = actor;
        learner.steps = header.steps;
        let [of_actor, of_first, of_second, of_alpha] = header.optimizer_steps;
        reader.adam("actor", &mut learner.actor_optimizer, of_actor)?;
        let names = [("critic.0", of_first), ("critic.1", of_second)];
        for (critic, (name, steps)) in learner.critics.iter_mut().zip(names) {
            reader.fill(
                &format!("{name}.parameters"),
                critic.online.parameters_mut(),
            )?;
            reader.fill(&format!("{name}.target"), critic.target.parameters_mut())?;
            reader.adam(name, &mut critic.optimizer, steps)?;
        }
        if let Some(vision) = &mut learner.vision {
            let [of_actors, of_critics] = header.encoder_steps;
            reader.adam("actor.encoder", &mut vision.training.optimizer, of_actors)?;
            reader.fill("critics.encoder.target", vision.target.parameters_mut())?;
            if let Some((encoder, training)) = &mut vision.separate {
                reader.fill("critics.encoder", encoder.parameters_mut())?;
                reader.adam("critics.encoder", &mut training.optimizer, of_critics)?;
            }
        }
        reader.fill("log_alpha", std::slice::from_mut(&mut learner.log_alpha))?;
        reader.adam("log_alpha", &mut learner.alpha_optimizer, of_alpha)?;
        let origin = (header.algorithm, Seed(header.seed));
        let training = Self::restored(origin, learner, buffers, header.env_steps);
        Ok((training, notes))
    }
}

impl Writer {
    pub(crate) fn buffer(&mut self, name: &str, buffer: &ReplayBuffer) {
        self.store(&format!("{name}.observations"), &buffer.observations);
        self.floats(&format!("{name}.actions"), &buffer.actions);
        self.floats(&format!("{name}.rewards"), &buffer.rewards);
        self.store(&format!("{name}.nexts"), &buffer.nexts);
        let terminated = buffer.terminated.iter().map(|&t| u8::from(t)).collect();
        self.tensors
            .insert(format!("{name}.terminated"), (Dtype::U8, terminated));
    }

    pub(crate) fn actor(
        &mut self,
        actor: &Actor,
        notes: &BTreeMap<String, String>,
    ) -> Result<(), RlError> {
        self.floats("actor.parameters", actor.network.parameters());
        let encoder = match &actor.perception {
            Perception::Scaled(normalizer) => {
                self.floats("actor.shift", &normalizer.shift);
                self.floats("actor.scale", &normalizer.scale);
                None
            }
            Perception::Encoded(encoder) => {
                self.floats("actor.encoder", encoder.parameters());
                Some(EncoderHeader {
                    architecture: encoder.architecture(),
                    picture: encoder.picture(),
                })
            }
        };
        let header = PolicyHeader {
            format: FORMAT.to_owned(),
            sizes: actor.network.sizes().to_vec(),
            encoder,
            log_std_bounds: actor.log_std_bounds,
            notes: notes.clone(),
        };
        self.header("policy", &header)
    }
}

impl Reader<'_> {
    pub(crate) fn buffer(
        &self,
        name: &str,
        header: &BufferHeader,
    ) -> Result<ReplayBuffer, RlError> {
        let BufferHeader {
            capacity,
            head,
            action_len,
            ..
        } = *header;
        let (form, len) = (header.form(), header.form().len());
        if len != header.observation_len {
            return Err(wrong(format!("its {name} has pictures of another size")));
        }
        let mut buffer = ReplayBuffer::new(capacity, form, action_len)?;
        let part = |part: &str| self.floats(&format!("{name}.{part}"));
        buffer.rewards = part("rewards")?;
        let n = buffer.rewards.len();
        if n > capacity || head >= n.max(1) {
            return Err(wrong(format!(
                "its {name} has {n} transitions of {capacity}"
            )));
        }
        buffer.head = head;
        let store = |part: &str| {
            let name = format!("{name}.{part}");
            let (store, expected, found) = match form {
                ObservationForm::Numbers(_) => {
                    let numbers = self.floats(&name)?;
                    let found = numbers.len();
                    (Store::Numbers(numbers), n * len, found)
                }
                ObservationForm::Bits(_) => {
                    let bytes = self.bytes(&name, Dtype::U8)?.to_vec();
                    let found = bytes.len();
                    (Store::Bits(bytes), n * len.div_ceil(8), found)
                }
            };
            check_len(&name, expected, found)?;
            Ok(store)
        };
        buffer.observations = store("observations")?;
        buffer.nexts = store("nexts")?;
        buffer.actions = part("actions")?;
        let terminated = self.bytes(&format!("{name}.terminated"), Dtype::U8)?;
        buffer.terminated = terminated.iter().map(|&t| t != 0).collect();
        for (part, expected, found) in [
            ("actions", n * action_len, buffer.actions.len()),
            ("terminated", n, buffer.terminated.len()),
        ] {
            check_len(&format!("{name}.{part}"), expected, found)?;
        }
        Ok(buffer)
    }

    pub(crate) fn actor(&mut self) -> Result<(Actor, BTreeMap<String, String>), RlError> {
        let header: PolicyHeader = self.header("policy")?;
        if header.format != FORMAT {
            let found = header.format;
            return Err(wrong(format!("its format is {found}, expected {FORMAT}")));
        }
        let parameters = self.floats("actor.parameters")?;
        let sizes = &header.sizes;
        let is_policy = !sizes.contains(&0) && sizes.last().is_some_and(|n| n.is_multiple_of(2));
        let network = Mlp::from_parameters(sizes, parameters).filter(|_| is_policy);
        let network = network.ok_or_else(|| wrong("its policy does not fit its layer sizes"))?;
        let n_features = network.sizes()[0];
        let perception = match header.encoder {
            Some(EncoderHeader {
                architecture,
                picture,
            }) => {
                let parameters = self.floats("actor.encoder")?;
                let encoder = ConvNet::from_parameters(architecture, picture, parameters)
                    .filter(|encoder| encoder.n_features() == n_features);
                let encoder =
                    encoder.ok_or_else(|| wrong("its encoder does not fit its policy"))?;
                Perception::Encoded(encoder)
            }
            None => {
                let mut normalizer = Normalizer::identity(n_features);
                self.fill("actor.shift", &mut normalizer.shift)?;
                self.fill("actor.scale", &mut normalizer.scale)?;
                Perception::Scaled(normalizer)
            }
        };
        let [lowest, highest] = header.log_std_bounds;
        if lowest >= highest {
            return Err(wrong("its bounds of the standard deviation are reversed"));
        }
        let actor = Actor {
            perception,
            network,
            log_std_bounds: header.log_std_bounds,
        };
        Ok((actor, header.notes))
    }
}
