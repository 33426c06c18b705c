//! The sequence network as a world model, through the traits of `gump-rollout`.
//!
//! A session stores, per scene, the frame of reference, the identities and the visual memory, which
//! all its futures share (`scene`); and per future, the token frames of its window, the chunks of
//! every agent and the present in world coordinates (`rollout_state`). `partial_ar` turns windows
//! into new states; `session` advances step by step.
//!
//! Agents outside the token window, of kinds that are not predicted, or beyond the vocabulary
//! continue with constant velocity, so that every agent of the present stays for the whole future;
//! one that moves into the window is controlled by the network from then on.

use std::collections::BTreeMap;

use candle_core::Tensor;
use gump_model::Network;
use gump_model::decoder::{Bins, STEPS};
use gump_model::local_frame::LocalFrame;
use gump_model::placed_slot::PlacedSlot;
use gump_rollout::{BoxError, ProbeConfig, Session, Start, WorldModel};
use gump_scene::{SceneState, Seed};
use gump_tokenizer::{QuantizedState, Slot, Tokenizer, TokenizerConfig};
use rayon::prelude::*;

use crate::EngineError;
use crate::counters::{CountedEngine, Counters};
use crate::cpu::{Engine, Job};
use crate::reference::sample_states;
use crate::request::Request;
use crate::rollout_state::{RolloutState, stream};
use crate::sampling::SamplingConfig;
use crate::scene::{Memory, SceneContext};
use crate::session::TransformerSession;
use crate::spawning::Phases;
use crate::temporal_ensemble::{Chunk, ChunkBuffer};

/// A trained sequence network as a world model.
#[derive(Debug)]
pub struct TransformerWorld {
    network: Network,
    sampling: SamplingConfig,
    tokenizer: Tokenizer,
    /// On a CPU, unless the tensor library was requested.
    engine: Option<Engine>,
}

impl TransformerWorld {
    /// A world with these sampling settings: computed by the engine on a CPU, by the tensor library
    /// elsewhere.
    pub fn new(network: Network, sampling: SamplingConfig) -> Self {
        let engine = network.device().is_cpu().then(|| {
            Engine::new(&network, sampling.precision)
                .expect("a network on a CPU has all its parameters in main memory as f32")
        });
        Self {
            engine,
            ..Self::reference(network, sampling)
        }
    }

    /// A world that always uses the tensor library's operations: slower on a CPU, and the reference
    /// for tests of the engine.
    pub fn reference(network: Network, sampling: SamplingConfig) -> Self {
        Self {
            network,
            sampling,
            tokenizer: Tokenizer::new(TokenizerConfig::default()),
            engine: None,
        }
    }

    /// Bytes of the matrices that the engine multiplies; 0 without it.
    pub fn weight_bytes(&self) -> usize {
        self.engine.as_ref().map_or(0, Engine::weight_bytes)
    }

    /// The network.
    pub fn network(&self) -> &Network {
        &self.network
    }

    /// Its sampling settings.
    pub fn sampling(&self) -> &SamplingConfig {
        &self.sampling
    }

    pub(crate) fn tokenizer(&self) -> &Tokenizer {
        &self.tokenizer
    }

    /// The CPU engine; `None` where the network is on another device.
    pub fn engine(&self) -> Option<&Engine> {
        self.engine.as_ref()
    }

    /// The CPU engine as a session with these counters uses it.
    pub(crate) fn counted_engine(&self, counters: &Counters) -> Option<CountedEngine<'_>> {
        let counters = counters.clone();
        self.engine()
            .map(|engine| CountedEngine { engine, counters })
    }

    /// Slots a frame may take, so that it and the one before it fit the block.
    pub fn longest_frame(&self) -> usize {
        self.network.config().block_size / 2
    }

    /// A session over all futures of all starts.
    ///
    /// Starts from the same scene share it: its map is encoded and its history computed once;
    /// starts that also have the same seed begin with equal futures.
    pub(crate) fn open_session(
        &self,
        starts: &[Start<'_>],
    ) -> Result<TransformerSession<'_>, EngineError> {
        let mut distinct: Vec<SceneState<'_>> = Vec::new();
        let mut scene_of = Vec::with_capacity(starts.len());
        for start in starts {
            let known = distinct
                .iter()
                .position(|seen: &SceneState<'_>| seen.is_same_scene(&start.scene));
            scene_of.push(known.unwrap_or(distinct.len()));
            if known.is_none() {
                distinct.push(start.scene);
            }
        }
        let scenes = distinct
            .par_iter()
            .map(|scene| SceneContext::new(self, *scene));
        let mut scenes: Vec<SceneContext> = scenes.collect::<Result<_, _>>()?;
        let counters = Counters::default();
        let mut futures: Vec<Vec<RolloutState>> = Vec::with_capacity(starts.len());
        for (i, start) in starts.iter().enumerate() {
            let (scene, n) = (scene_of[i], start.n_futures);
            let like = |j: &usize| {
                let other = &starts[*j];
                scene_of[*j] == scene && other.seed == start.seed && other.n_futures == n
            };
            futures.push(match (0..i).find(like) {
                Some(twin) => futures[twin].clone(),
                None => self.futures(scene, &mut scenes[scene], n, start.seed, &counters)?,
            });
        }
        Ok(TransformerSession {
            world: self,
            scenes,
            futures: futures.into_iter().flatten().collect(),
            probe: ProbeConfig::default(),
            samples: Vec::new(),
            counters,
        })
    }

    /// `n` futures of scene number `scene`.
    pub(crate) fn futures(
        &self,
        scene: usize,
        shared: &mut SceneContext,
        n: usize,
        seed: Seed,
        counters: &Counters,
    ) -> Result<Vec<RolloutState>, EngineError> {
        let chunks = self.first_chunks(shared, n, seed, counters)?;
        let last = shared
            .history
            .last()
            .map_or(0, |_| shared.history.len() - 1);
        let phases = Phases::of(&shared.recent);
        let future = |(k, rings): (usize, Vec<(u16, Chunk)>)| {
            let mut future = RolloutState {
                scene,
                seed: seed.fork(k as u64),
                frames: shared.history.clone(),
                index: last,
                begun: last,
                rings: BTreeMap::new(),
                recent: shared.recent.clone(),
                identities: shared.identities.clone(),
                phases: phases.clone(),
                kv_cache: shared.prefix.clone(),
            };
            for (id, chunk) in rings {
                future.rings.entry(id).or_default().push(last, chunk);
            }
            future
        };
        Ok(chunks.into_iter().enumerate().map(future).collect())
    }

    /// One pass over the history, shared by all futures, and per future a draw of what the last
    /// frame's keys foresee: the chunks that the first surrogates come from.
    fn first_chunks(
        &self,
        scene: &mut SceneContext,
        n: usize,
        seed: Seed,
        counters: &Counters,
    ) -> Result<Vec<Vec<(u16, Chunk)>>, EngineError> {
        let network = &self.network;
        let slots = scene.slots()?;
        let last = scene.history.len() - 1;
        let keys: Vec<(usize, u16, QuantizedState, LocalFrame)> = slots
            .windows(2)
            .enumerate()
            .filter_map(|(i, pair)| match (pair[0].slot, pair[1].slot) {
                (Slot::Key(key), Slot::Value(state)) if pair[0].frame == last => Some((
                    i,
                    key.id,
                    state,
                    scene.local_frame(&pair[0], network.config()),
                )),
                _ => None,
            })
            .collect();
        let requests: Vec<Request> = (0..n)
            .flat_map(|k| keys.iter().map(move |key| (k, key)))
            .map(|(k, (_, id, state, local_frame))| {
                let is = scene.present(*id).unwrap_or(state.to_agent_state());
                Request {
                    local_frame: *local_frame,
                    forced: local_frame.bins(*state, [Some(is), None, None, None]),
                    stream: stream(seed.fork(k as u64), last, *id),
                    near: None,
                    ring: ChunkBuffer::default(),
                    limits: None,
                    frame: last,
                    guide: None,
                }
            })
            .collect();
        let places: Vec<usize> = keys.iter().map(|(i, ..)| *i).collect();
        let hidden = self
            .read_history(scene, &slots, places, counters)?
            .repeat(n);
        let bins = match self.counted_engine(counters) {
            Some(engine) => {
                let requests: Vec<&Request> = requests.iter().collect();
                engine.sample(&hidden, &requests, &self.sampling)
            }
            None => {
                let shape = (requests.len(), network.config().width);
                let hidden = Tensor::from_vec(hidden, shape, network.device())?;
                sample_states(network, &hidden, &requests, &self.sampling)?
            }
        };
        let per_future = |bins: &[Bins]| {
            keys.iter()
                .zip(bins)
                .map(|((_, id, _, local_frame), b)| (*id, local_frame.poses(b)))
                .collect()
        };
        Ok(bins.chunks(keys.len().max(1)).map(per_future).collect())
    }

    /// Hidden vectors `[places, C]` of the history of a scene, in one pass; the engine keeps the
    /// cache that futures continue from.
    fn read_history(
        &self,
        scene: &mut SceneContext,
        slots: &[PlacedSlot],
        places: Vec<usize>,
        counters: &Counters,
    ) -> Result<Vec<f32>, EngineError> {
        let engine = self.counted_engine(counters);
        if let (Some(engine), Memory::Packed(memory)) = (engine, &scene.memory) {
            return Ok(engine.run(&mut [Job {
                slots,
                wanted: places,
                memory,
                kv_cache: &mut scene.prefix,
                keep: true,
            }]));
        }
        let memory = scene.memory.reference();
        let memory = memory.expect("without an engine the memory is the tensor library's");
        counters.count_passes(1);
        let batch = self.network.pack(&[slots], 0, memory)?;
        let features = self.network.mct.forward(&batch, memory, None, None)?;
        let places: Vec<u32> = places.into_iter().map(|i| i as u32).collect();
        let places = Tensor::new(places, self.network.device())?;
        let hidden = features.hidden.squeeze(0)?.index_select(&places, 0)?;
        Ok(hidden.flatten_all()?.to_vec1::<f32>()?)
    }

    /// The network's output for the last agent of a scene's present: its hidden vector, then the
    /// logits of the first field. For comparing devices and implementations.
    ///
    /// # Errors
    /// A scene that cannot be tokenised, or errors of the tensor library.
    pub fn probe(&self, scene: SceneState<'_>) -> Result<Vec<f32>, EngineError> {
        let mut scene = SceneContext::new(self, scene)?;
        let slots = scene.slots()?;
        let key = slots.iter().rposition(|p| matches!(p.slot, Slot::Key(_)));
        let key = key.expect("the ego is in every frame of the window");
        let mut values = self.read_history(&mut scene, &slots, vec![key], &Counters::default())?;
        let network = &self.network;
        let hidden = Tensor::from_slice(&values, (1, values.len()), network.device())?;
        let decoder = &network.decoder;
        let table = decoder.input_table(&network.mct.token_table()?)?;
        let output = decoder.step(&table, &mut decoder.begin(&hidden), 0, None)?;
        let logits = decoder.logits(&output, STEPS[0])?;
        values.extend(logits.flatten_all()?.to_vec1::<f32>()?);
        Ok(values)
    }
}

impl WorldModel for TransformerWorld {
    fn name(&self) -> &str {
        "model"
    }

    fn open(&self, starts: &[Start<'_>]) -> Result<Box<dyn Session + '_>, BoxError> {
        Ok(Box::new(self.open_session(starts)?))
    }
}
