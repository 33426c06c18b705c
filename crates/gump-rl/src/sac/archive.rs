//! Policies and runs as bytes: safetensors with everything else as JSON in the header.
//!
//! Where the bytes are kept is the caller's business.

use std::collections::{BTreeMap, HashMap};

use gump_scene::Seed;
use safetensors::SafeTensors;
use safetensors::tensor::{Dtype, TensorView};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::replay_buffer::ReplayBuffer;
use super::training::{Algorithm, Training};
use super::{Learner, SacConfig};
use crate::networks::{Adam, Mlp, Normalizer};
use crate::{Actor, RlError};

/// The header entry that everything but tensors is in.
const HEADER: &str = "gump";

/// Version of the layout.
const FORMAT: &str = "gump-rl-1";

/// What a policy is beside its numbers.
#[derive(Debug, Serialize, Deserialize)]
struct PolicyHeader {
    format: String,
    /// Layer sizes of the network, input first.
    sizes: Vec<usize>,
    log_std_bounds: [f64; 2],
    /// What the caller wants to find again.
    notes: BTreeMap<String, String>,
}

/// What a run is beside its numbers.
#[derive(Debug, Serialize, Deserialize)]
struct RunHeader {
    algorithm: Algorithm,
    seed: u64,
    /// As TOML, which gives every float back as it was; JSON is read to the last digit but one.
    config: String,
    steps: usize,
    env_steps: u64,
    optimizer_steps: [u64; 4],
    buffers: [BufferHeader; 2],
}

#[derive(Debug, Serialize, Deserialize)]
struct BufferHeader {
    capacity: usize,
    head: usize,
    observation_len: usize,
    action_len: usize,
}

impl Actor {
    /// The policy alone, with notes of the caller.
    ///
    /// # Errors
    /// [`RlError::Archive`] if it cannot be encoded.
    pub fn to_bytes(&self, notes: &BTreeMap<String, String>) -> Result<Vec<u8>, RlError> {
        let mut writer = Writer::default();
        writer.actor(self, notes)?;
        writer.finish()
    }

    /// The policy that bytes hold, of a policy or of a run, and the notes it was given.
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
    /// [`RlError::Archive`] if it cannot be encoded.
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
        let buffer = |buffer: &ReplayBuffer| BufferHeader {
            capacity: buffer.capacity,
            head: buffer.head,
            observation_len: buffer.observation_len,
            action_len: buffer.action_len,
        };
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
                buffers: [buffer(&self.replay), buffer(&self.expert)],
            },
        )?;
        writer.finish()
    }

    /// The run that bytes hold, to go on with, and the notes it was given.
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
        let (o, a) = (actor.observation_len(), actor.action_len());
        let fits = |b: &ReplayBuffer| (b.observation_len, b.action_len) == (o, a);
        if !buffers.iter().all(fits) {
            return Err(wrong("its buffers do not fit its policy"));
        }
        let mut learner = Learner::new(config, o, a, Seed(0));
        if learner.actor.network.sizes() != actor.network.sizes() {
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
        reader.fill("log_alpha", std::slice::from_mut(&mut learner.log_alpha))?;
        reader.adam("log_alpha", &mut learner.alpha_optimizer, of_alpha)?;
        let origin = (header.algorithm, Seed(header.seed));
        let training = Self::restored(origin, learner, buffers, header.env_steps);
        Ok((training, notes))
    }
}

fn wrong(what: impl Into<String>) -> RlError {
    RlError::Archive { what: what.into() }
}

/// Tensors and header entries to be written.
#[derive(Default)]
struct Writer {
    tensors: BTreeMap<String, (Dtype, Vec<u8>)>,
    /// One JSON object, so that the bytes do not depend on the order of a hash map.
    header: serde_json::Map<String, serde_json::Value>,
}

impl Writer {
    fn floats(&mut self, name: &str, values: &[f32]) {
        let bytes = values.iter().flat_map(|x| x.to_le_bytes()).collect();
        self.tensors.insert(name.to_owned(), (Dtype::F32, bytes));
    }

    fn adam(&mut self, name: &str, adam: &Adam) {
        self.floats(&format!("{name}.adam.mean"), &adam.mean);
        self.floats(&format!("{name}.adam.square"), &adam.square);
    }

    fn buffer(&mut self, name: &str, buffer: &ReplayBuffer) {
        self.floats(&format!("{name}.observations"), &buffer.observations);
        self.floats(&format!("{name}.actions"), &buffer.actions);
        self.floats(&format!("{name}.rewards"), &buffer.rewards);
        self.floats(&format!("{name}.nexts"), &buffer.nexts);
        let terminated = buffer.terminated.iter().map(|&t| u8::from(t)).collect();
        self.tensors
            .insert(format!("{name}.terminated"), (Dtype::U8, terminated));
    }

    fn header(&mut self, name: &str, value: &impl Serialize) -> Result<(), RlError> {
        let value = serde_json::to_value(value).map_err(|error| wrong(error.to_string()))?;
        self.header.insert(name.to_owned(), value);
        Ok(())
    }

    fn actor(&mut self, actor: &Actor, notes: &BTreeMap<String, String>) -> Result<(), RlError> {
        self.floats("actor.parameters", actor.network.parameters());
        self.floats("actor.shift", &actor.normalizer.shift);
        self.floats("actor.scale", &actor.normalizer.scale);
        let header = PolicyHeader {
            format: FORMAT.to_owned(),
            sizes: actor.network.sizes().to_vec(),
            log_std_bounds: actor.log_std_bounds,
            notes: notes.clone(),
        };
        self.header("policy", &header)
    }

    fn finish(self) -> Result<Vec<u8>, RlError> {
        let mut views = Vec::with_capacity(self.tensors.len());
        for (name, (kind, bytes)) in &self.tensors {
            let width = if *kind == Dtype::F32 { 4 } else { 1 };
            let view = TensorView::new(*kind, vec![bytes.len() / width], bytes);
            views.push((name, view.map_err(|error| wrong(error.to_string()))?));
        }
        let header = serde_json::Value::Object(self.header).to_string();
        let header = HashMap::from([(HEADER.to_owned(), header)]);
        safetensors::serialize(views, Some(header)).map_err(|error| wrong(error.to_string()))
    }
}

/// A file being read.
struct Reader<'a> {
    tensors: SafeTensors<'a>,
    header: serde_json::Map<String, serde_json::Value>,
}

impl<'a> Reader<'a> {
    fn new(bytes: &'a [u8]) -> Result<Self, RlError> {
        let tensors = SafeTensors::deserialize(bytes).map_err(|error| {
            wrong(format!(
                "expected a safetensors file, found something else ({error})"
            ))
        })?;
        let (_, metadata) =
            SafeTensors::read_metadata(bytes).map_err(|error| wrong(error.to_string()))?;
        let header = metadata.metadata().as_ref().and_then(|m| m.get(HEADER));
        let header = header.ok_or_else(|| wrong(format!("its header has no \"{HEADER}\"")))?;
        let header = serde_json::from_str(header)
            .map_err(|error| wrong(format!("its header is not valid ({error})")))?;
        Ok(Self { tensors, header })
    }

    fn header<T: DeserializeOwned>(&mut self, name: &str) -> Result<T, RlError> {
        let value = self.header.remove(name);
        let value = value.ok_or_else(|| wrong(format!("it holds no {name}")))?;
        serde_json::from_value(value)
            .map_err(|error| wrong(format!("its {name} is not valid ({error})")))
    }

    fn bytes(&self, name: &str, kind: Dtype) -> Result<&'a [u8], RlError> {
        let tensor = self.tensors.tensor(name);
        let tensor = tensor.map_err(|_| wrong(format!("it has no tensor \"{name}\"")))?;
        if tensor.dtype() == kind {
            Ok(tensor.data())
        } else {
            let found = tensor.dtype();
            let what = format!("tensor \"{name}\" has type {found:?}, expected {kind:?}");
            Err(wrong(what))
        }
    }

    fn floats(&self, name: &str) -> Result<Vec<f32>, RlError> {
        let bytes = self.bytes(name, Dtype::F32)?.chunks_exact(4);
        Ok(bytes
            .map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]))
            .collect())
    }

    /// As many numbers as there is room for.
    fn fill(&self, name: &str, room: &mut [f32]) -> Result<(), RlError> {
        let values = self.floats(name)?;
        check_len(name, room.len(), values.len())?;
        room.copy_from_slice(&values);
        Ok(())
    }

    fn adam(&self, name: &str, adam: &mut Adam, steps: u64) -> Result<(), RlError> {
        adam.steps = steps;
        self.fill(&format!("{name}.adam.mean"), &mut adam.mean)?;
        self.fill(&format!("{name}.adam.square"), &mut adam.square)
    }

    fn buffer(&self, name: &str, header: &BufferHeader) -> Result<ReplayBuffer, RlError> {
        let BufferHeader {
            capacity,
            head,
            observation_len,
            action_len,
        } = *header;
        let mut buffer = ReplayBuffer::new(capacity, observation_len, action_len)?;
        let part = |part: &str| self.floats(&format!("{name}.{part}"));
        buffer.rewards = part("rewards")?;
        let n = buffer.rewards.len();
        if n > capacity || head >= n.max(1) {
            return Err(wrong(format!(
                "its {name} has {n} transitions of {capacity}"
            )));
        }
        buffer.head = head;
        buffer.observations = part("observations")?;
        buffer.actions = part("actions")?;
        buffer.nexts = part("nexts")?;
        let terminated = self.bytes(&format!("{name}.terminated"), Dtype::U8)?;
        buffer.terminated = terminated.iter().map(|&t| t != 0).collect();
        for (part, expected, found) in [
            (
                "observations",
                n * observation_len,
                buffer.observations.len(),
            ),
            ("actions", n * action_len, buffer.actions.len()),
            ("nexts", n * observation_len, buffer.nexts.len()),
            ("terminated", n, buffer.terminated.len()),
        ] {
            check_len(&format!("{name}.{part}"), expected, found)?;
        }
        Ok(buffer)
    }

    fn actor(&mut self) -> Result<(Actor, BTreeMap<String, String>), RlError> {
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
        let mut normalizer = Normalizer::identity(network.sizes()[0]);
        self.fill("actor.shift", &mut normalizer.shift)?;
        self.fill("actor.scale", &mut normalizer.scale)?;
        let [lowest, highest] = header.log_std_bounds;
        if lowest >= highest {
            return Err(wrong("its bounds of the standard deviation are reversed"));
        }
        let actor = Actor {
            normalizer,
            network,
            log_std_bounds: header.log_std_bounds,
        };
        Ok((actor, header.notes))
    }
}

fn check_len(name: &str, expected: usize, found: usize) -> Result<(), RlError> {
    if expected == found {
        Ok(())
    } else {
        Err(wrong(format!(
            "tensor \"{name}\" has {found} numbers, expected {expected}"
        )))
    }
}
