//! The network as a world: scenes in, futures out, through the traits of `gump-rollout`.
//!
//! A session keeps, per scene, the frame of reference, the identities and the visual memory, which
//! all its futures share; and per future, the last token frames, the chunks of every agent and the
//! present in world coordinates. `decode` turns windows into new states; this file does the
//! bookkeeping around it.
//!
//! Agents outside the token window, of no predicted kind, or beyond the vocabulary move on with
//! constant velocity, so that every agent that is there now stays for the whole future; one that
//! comes into the window is the network's from then on.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use candle_core::Tensor;
use gump_geometry::Pose;
use gump_raster::rasterize;
use gump_rollout::{BoxError, Session, Start, WorldModel};
use gump_scene::{Agent, AgentId, AgentState, Frame, MapGraph, Route, SceneState, Seed};
use gump_tokenizer::{
    Identities, Key, QuantizedState, Slot, TokenAgent, TokenFrame, TokenSequence, Tokenizer,
    TokenizerConfig,
};

use crate::ModelError;
use crate::aggregation::Ring;
use crate::batch::place;
use crate::decode::{Passes, Window, decode};
use crate::decoder::STEPS;
use crate::mct::VisualMemory;
use crate::network::Network;
use crate::sample::TOKEN_DT;
use crate::sampling::{
    Bins, Request, SamplingConfig, Surrogate, poses, sample_states, set_pose, settled_state,
};

/// An agent whose surrogate leaves this range gets no tokens any more (released code), metres.
const KEEP_RANGE_M: f64 = 96.0;
/// An ego farther than this from the origin of its scene gets a new scene around it, metres. Training
/// shows windows up to 85 m away.
const RECENTRE_M: f64 = 60.0;
/// How far a sampled position may lie from its surrogate (released code), metres.
const GUARD_M: f64 = 5.0;

/// A trained network that imagines traffic.
#[derive(Debug)]
pub struct TransformerWorld {
    network: Network,
    sampling: SamplingConfig,
    tokenizer: Tokenizer,
    passes: AtomicU64,
}

impl TransformerWorld {
    /// A world that decodes as `sampling` says.
    pub fn new(network: Network, sampling: SamplingConfig) -> Self {
        let tokenizer = Tokenizer::new(TokenizerConfig::default());
        Self {
            network,
            sampling,
            tokenizer,
            passes: AtomicU64::new(0),
        }
    }

    /// Transformer passes made so far, whatever their batch; the first of a session reads history.
    pub fn passes(&self) -> u64 {
        self.passes.load(Ordering::Relaxed)
    }

    /// The network.
    pub fn network(&self) -> &Network {
        &self.network
    }

    /// How it decodes.
    pub fn sampling(&self) -> &SamplingConfig {
        &self.sampling
    }

    /// Slots a frame may take, so that it and the one before it fit the block.
    fn longest_frame(&self) -> usize {
        self.network.config().block_size / 2
    }

    fn scene(&self, scene: SceneState<'_>) -> Result<Scene, ModelError> {
        let world_from_scene = scene.ego_now().state.pose;
        let stride = (TOKEN_DT / scene.dt).round().max(1.0) as usize;
        if (stride as f64 * scene.dt - TOKEN_DT).abs() > 1e-3 {
            let what = format!("a time step of {} s does not divide {TOKEN_DT} s", scene.dt);
            return Err(ModelError::Scene(what));
        }
        let frames = scene.strided_history(stride, self.sampling.history.max(1));
        // The ego must be in every frame of the window: start after the last one it is missing in.
        let first = frames
            .iter()
            .rposition(|frame| frame.agent(scene.ego).is_none())
            .map_or(0, |i| i + 1);
        let frames = &frames[first..];
        let identities = Identities::ranked(frames, scene.ego, world_from_scene);
        let recent = frames.iter().copied().cloned().collect();
        let map = Arc::clone(scene.map);
        let route = scene.route.map(Arc::clone);
        self.scene_of(map, route, recent, scene.ego, identities)
    }

    /// What a window of frames half a second apart shows, in the frame of the ego in its last.
    fn scene_of(
        &self,
        map: Arc<MapGraph>,
        route: Option<Arc<Route>>,
        recent: Vec<Frame>,
        ego: AgentId,
        identities: Identities,
    ) -> Result<Scene, ModelError> {
        let view = SceneState {
            map: &map,
            route: route.as_ref(),
            history: &recent,
            ego,
            dt: TOKEN_DT,
        };
        let world_from_scene = view.ego_now().state.pose;
        let frames: Vec<&Frame> = recent.iter().collect();
        let encoded = self
            .tokenizer
            .encode(&map, &frames, ego, world_from_scene, &identities);
        let (sequence, _) = encoded.sequence.fit(self.longest_frame());
        let raster = rasterize(self.network.raster_spec(), &view, world_from_scene);
        Ok(Scene {
            world_from_scene,
            ego,
            identities,
            memory: self.network.look(std::slice::from_ref(&raster))?,
            history: sequence.frames().to_vec(),
            recent,
            map,
            route,
        })
    }

    fn futures(
        &self,
        scene: usize,
        shared: &Scene,
        n: usize,
        seed: Seed,
    ) -> Result<Vec<Future>, ModelError> {
        let chunks = self.first_chunks(shared, n, seed)?;
        let last = shared
            .history
            .last()
            .map_or(0, |_| shared.history.len() - 1);
        let future = |(k, rings): (usize, Vec<(u16, Bins)>)| {
            let mut future = Future {
                scene,
                seed: seed.fork(k as u64),
                frames: shared.history.clone(),
                index: last,
                rings: BTreeMap::new(),
                recent: shared.recent.clone(),
            };
            for (id, bins) in rings {
                future.rings.entry(id).or_default().push(last, poses(&bins));
            }
            future
        };
        Ok(chunks.into_iter().enumerate().map(future).collect())
    }

    /// One pass over the history, shared by all futures, and per future a draw of what the last
    /// frame's keys foresee: the chunks that the first surrogates come from.
    fn first_chunks(
        &self,
        scene: &Scene,
        n: usize,
        seed: Seed,
    ) -> Result<Vec<Vec<(u16, Bins)>>, ModelError> {
        let network = &self.network;
        let sequence = TokenSequence::new(Vec::new(), scene.history.clone())
            .map_err(|error| ModelError::Scene(error.to_string()))?;
        let slots = place(&sequence);
        let last = scene.history.len() - 1;
        let keys: Vec<(usize, u16, QuantizedState)> = slots
            .windows(2)
            .enumerate()
            .filter_map(|(i, pair)| match (pair[0].slot, pair[1].slot) {
                (Slot::Key(key), Slot::Value(state)) if pair[0].frame == last => {
                    Some((i, key.id, state))
                }
                _ => None,
            })
            .collect();
        let batch = network.pack(&[&slots])?;
        let features = network.mct.forward(&batch, &scene.memory, None, None)?;
        self.passes.fetch_add(1, Ordering::Relaxed);
        let rows: Vec<u32> = (0..n)
            .flat_map(|_| keys.iter().map(|(i, ..)| *i as u32))
            .collect();
        let hidden = features
            .hidden
            .squeeze(0)?
            .index_select(&Tensor::new(rows, network.device())?, 0)?;
        let requests: Vec<Request> = (0..n)
            .flat_map(|k| keys.iter().map(move |key| (k, key)))
            .map(|(k, (_, id, state))| {
                let mut forced = [None; STEPS.len()];
                for (step, field) in STEPS.iter().enumerate().take(7) {
                    forced[step] = Some(state.get(*field));
                }
                Request {
                    forced,
                    stream: stream(seed.fork(k as u64), last, *id),
                    near: None,
                    ring: Ring::default(),
                    frame: last,
                }
            })
            .collect();
        let bins = sample_states(network, &hidden, &requests, &self.sampling)?;
        let per_future = |bins: &[Bins]| {
            keys.iter()
                .zip(bins)
                .map(|((_, id, _), b)| (*id, *b))
                .collect()
        };
        Ok(bins.chunks(keys.len().max(1)).map(per_future).collect())
    }
}

/// The randomness of one object in one frame of one future, whatever the batch.
fn stream(seed: Seed, frame: usize, id: u16) -> Seed {
    seed.fork(frame as u64).fork(u64::from(id))
}

impl WorldModel for TransformerWorld {
    fn name(&self) -> &str {
        "model"
    }

    fn open(&self, starts: &[Start<'_>]) -> Result<Box<dyn Session + '_>, BoxError> {
        let mut session = TransformerSession {
            world: self,
            scenes: Vec::new(),
            futures: Vec::new(),
        };
        for (i, start) in starts.iter().enumerate() {
            let scene = self.scene(start.scene)?;
            session
                .futures
                .extend(self.futures(i, &scene, start.n_futures, start.seed)?);
            session.scenes.push(scene);
        }
        Ok(Box::new(session))
    }
}

/// What all futures of a start share.
struct Scene {
    world_from_scene: Pose,
    ego: AgentId,
    identities: Identities,
    memory: VisualMemory,
    history: Vec<TokenFrame>,
    /// The same frames in world coordinates; the last is the present.
    recent: Vec<Frame>,
    map: Arc<MapGraph>,
    route: Option<Arc<Route>>,
}

/// One future in progress.
struct Future {
    scene: usize,
    seed: Seed,
    /// The last token frames, at most `history` of them.
    frames: Vec<TokenFrame>,
    /// Number of the last frame.
    index: usize,
    rings: BTreeMap<u16, Ring>,
    /// The same frames in world coordinates; the last is the present.
    recent: Vec<Frame>,
}

struct TransformerSession<'a> {
    world: &'a TransformerWorld,
    scenes: Vec<Scene>,
    futures: Vec<Future>,
}

impl Session for TransformerSession<'_> {
    fn dt(&self) -> f64 {
        TOKEN_DT
    }

    fn step(&mut self, ego: Option<&[AgentState]>) -> Result<Vec<Frame>, BoxError> {
        if let Some(states) = ego
            && states.len() != self.futures.len()
        {
            let what = format!(
                "{} ego states for {} futures",
                states.len(),
                self.futures.len()
            );
            return Err(ModelError::Scene(what).into());
        }
        self.recentre()?;
        let windows: Vec<Window> = self
            .futures
            .iter()
            .enumerate()
            .map(|(i, future)| self.window(future, ego.map(|states| states[i])))
            .collect();
        let memories: Vec<&VisualMemory> = self.scenes.iter().map(|scene| &scene.memory).collect();
        let passes = Passes::new(
            &self.world.network,
            &self.world.sampling,
            &memories,
            &self.world.passes,
        );
        let decoded = decode(&passes, &windows)?;
        let mut frames = Vec::with_capacity(self.futures.len());
        for (i, (window, bins)) in windows.into_iter().zip(decoded).enumerate() {
            let scene = &self.scenes[self.futures[i].scene];
            let ego = ego.map(|states| states[i]);
            frames.push(self.futures[i].commit(window, &bins, scene, self.world, ego));
        }
        Ok(frames)
    }

    fn replace(&mut self, future: usize, start: Start<'_>) -> Result<(), BoxError> {
        let index = self.scenes.len();
        let scene = self.world.scene(start.scene)?;
        let mut fresh = self.world.futures(index, &scene, 1, start.seed)?;
        self.scenes.push(scene);
        self.futures[future] = fresh.pop().expect("one future was asked for");
        self.forget_unused_scenes();
        Ok(())
    }
}

impl TransformerSession<'_> {
    /// Gives every future whose ego nears the edge of its window a scene around the ego's present,
    /// map and tokens alike; such a future shares its visual memory with no other any more.
    fn recentre(&mut self) -> Result<(), ModelError> {
        for i in 0..self.futures.len() {
            if self.futures[i].ego_reach() < RECENTRE_M {
                continue;
            }
            let from = &self.scenes[self.futures[i].scene];
            let to = self.world.scene_of(
                Arc::clone(&from.map),
                from.route.clone(),
                self.futures[i].recent.clone(),
                from.ego,
                from.identities.clone(),
            )?;
            self.futures[i].enter(self.scenes.len(), from, &to);
            self.scenes.push(to);
        }
        self.forget_unused_scenes();
        Ok(())
    }

    /// Drops scenes that no future is in.
    fn forget_unused_scenes(&mut self) {
        let used = |scene: usize| self.futures.iter().any(|future| future.scene == scene);
        let mut places = Vec::with_capacity(self.scenes.len());
        let mut n = 0;
        for scene in 0..self.scenes.len() {
            places.push(used(scene).then_some(n));
            n += usize::from(used(scene));
        }
        let mut kept = places.iter().map(Option::is_some);
        self.scenes.retain(|_| kept.next().unwrap_or(false));
        for future in &mut self.futures {
            future.scene = places[future.scene].expect("the scene of a future is in use");
        }
    }

    /// The window of one future: its history and the next frame with provisional states.
    fn window(&self, future: &Future, ego: Option<AgentState>) -> Window {
        let scene = &self.scenes[future.scene];
        let sampling = &self.world.sampling;
        let index = future.index + 1;
        let last = future.frames.last().expect("a future has history");
        let mut next = TokenFrame {
            lights: last.lights.clone(),
            tracked: Vec::new(),
            newborn: Vec::new(),
        };
        let mut requests = Vec::new();
        // Who was newborn is tracked now, and takes its place in the canonical order.
        let mut agents: Vec<&TokenAgent> = last.agents().collect();
        agents.sort_by_key(|agent| agent.key.order());
        for agent in agents {
            let id = agent.key.id;
            let surrogate = match (id, ego) {
                (0, Some(state)) => scene.quantize(state, agent.state),
                _ => future.surrogate(agent, index, sampling),
            };
            let position = surrogate.pose().position;
            if id != 0 && position.abs().max_element() >= KEEP_RANGE_M {
                continue;
            }
            let driven = id == 0 && ego.is_some();
            next.tracked.push(TokenAgent {
                key: agent.key,
                state: surrogate,
            });
            requests.push(Request {
                forced: forced_fields(&surrogate, driven),
                stream: stream(future.seed, index, id),
                near: Some((position, GUARD_M)),
                // A driven object was put where it is; what it once foresaw does not count.
                ring: if driven {
                    Ring::default()
                } else {
                    future.rings.get(&id).cloned().unwrap_or_default()
                },
                frame: index,
            });
        }
        Window {
            scene: future.scene,
            history: future.frames.clone(),
            next,
            requests,
        }
    }
}

/// Sizes never drift; a driven object's state is given entirely.
fn forced_fields(state: &QuantizedState, driven: bool) -> [Option<u16>; STEPS.len()] {
    let mut forced = [None; STEPS.len()];
    let given = if driven { 7 } else { 2 };
    for (step, field) in STEPS.iter().enumerate().take(given) {
        forced[step] = Some(state.get(*field));
    }
    forced
}

impl Scene {
    /// A world state in tokens, with the size of `like`.
    fn quantize(&self, state: AgentState, like: QuantizedState) -> QuantizedState {
        like.with_motion(&self.local(state))
    }

    /// A world state in the scene frame.
    fn local(&self, state: AgentState) -> AgentState {
        let scene_from_world = self.world_from_scene.inverse();
        AgentState {
            pose: scene_from_world * state.pose,
            velocity: scene_from_world.rotate(state.velocity),
        }
    }

    /// Agents of `frame` inside the window that neither `tokens` nor the frame before knows, because
    /// they drifted in; as many as fit a frame of `longest` slots. One that has just left waits a
    /// frame before it can be newborn.
    fn arrivals(
        &self,
        frame: &Frame,
        tokens: &TokenFrame,
        before: Option<&TokenFrame>,
        longest: usize,
    ) -> Vec<TokenAgent> {
        let present = tokens
            .agents()
            .chain(before.into_iter().flat_map(TokenFrame::agents));
        let known: BTreeSet<u16> = present.map(|agent| agent.key.id).collect();
        let mut arrivals: Vec<TokenAgent> = frame
            .agents()
            .iter()
            .filter(|agent| agent.kind.is_moving())
            .filter_map(|agent| {
                let id = self
                    .identities
                    .key(agent.id)
                    .filter(|id| !known.contains(id))?;
                let local = self.local(agent.state);
                let inside = local.pose.position.abs().max_element() < KEEP_RANGE_M;
                let (state, _) = QuantizedState::new(&local, agent.length, agent.width);
                let kind = agent.kind;
                inside.then_some(TokenAgent {
                    key: Key { id, kind },
                    state,
                })
            })
            .collect();
        arrivals.sort_by_key(|agent| agent.key.order());
        arrivals.truncate(longest.saturating_sub(tokens.len_slots()) / 2);
        arrivals
    }
}

impl Future {
    /// A provisional state of `agent` for frame `index`.
    fn surrogate(
        &self,
        agent: &TokenAgent,
        index: usize,
        sampling: &SamplingConfig,
    ) -> QuantizedState {
        let (pose, velocity) = (agent.state.pose(), agent.state.velocity());
        let moved = Pose {
            position: pose.position + velocity * TOKEN_DT,
            ..pose
        };
        let said = match sampling.surrogate {
            Surrogate::Chunk => self
                .rings
                .get(&agent.key.id)
                .and_then(|ring| ring.surrogate(index, sampling.decay)),
            Surrogate::Copy => Some(pose),
            Surrogate::ConstantVelocity => None,
        };
        // Half a second moves nobody farther from a straight line: such a word is noise.
        let said = said.filter(|said| said.position.distance(moved.position) <= GUARD_M);
        set_pose(agent.state, said.unwrap_or(moved))
    }

    /// Makes the decoded states the present and returns it in world coordinates.
    fn commit(
        &mut self,
        window: Window,
        decoded: &[Bins],
        scene: &Scene,
        world: &TransformerWorld,
        ego: Option<AgentState>,
    ) -> Frame {
        let sampling = &world.sampling;
        self.index += 1;
        let mut next = window.next;
        let mut moved = BTreeMap::new();
        for ((agent, request), bins) in next.tracked.iter_mut().zip(&window.requests).zip(decoded) {
            let id = agent.key.id;
            let driven = id == 0 && ego.is_some();
            let ring = self.rings.entry(id).or_default();
            if driven {
                ring.clear();
            }
            ring.push(self.index, poses(bins));
            let pose = request.settle(bins, sampling);
            agent.state = settled_state(bins, pose);
            let state = AgentState {
                pose: scene.world_from_scene * pose,
                velocity: scene.world_from_scene.rotate(agent.state.velocity()),
            };
            moved.insert(id, if driven { ego.unwrap_or(state) } else { state });
        }
        let now = self.recent.last().expect("a future has a present");
        let agents = now.agents().iter().map(|agent| {
            let token = scene.identities.key(agent.id).and_then(|id| moved.get(&id));
            let driven = ego.filter(|_| agent.id == scene.ego);
            agent.with_state(driven.or(token.copied()).unwrap_or_else(|| drift(agent)))
        });
        // Lights keep the colour they were seen in.
        let frame = Frame::new(agents.collect(), now.lights().to_vec());
        next.newborn = scene.arrivals(&frame, &next, self.frames.last(), world.longest_frame());
        self.recent.push(frame.clone());
        self.frames.push(next);
        let history = sampling.history.max(1);
        self.recent
            .drain(..self.recent.len().saturating_sub(history));
        self.frames
            .drain(..self.frames.len().saturating_sub(history));
        self.rings.retain(|id, _| moved.contains_key(id));
        // In the first frame of a window nobody is newborn: who was, counts as tracked.
        let first = std::mem::take(&mut self.frames[0]);
        self.frames[0] = first.into_first();
        frame
    }

    /// How far the ego is from the origin of its scene frame along either axis, metres.
    fn ego_reach(&self) -> f64 {
        let ego = self.frames.last().and_then(|frame| frame.tracked.first());
        ego.map_or(0.0, |ego| ego.state.pose().position.abs().max_element())
    }

    /// Moves into another scene of the same traffic: tokens and chunks are expressed in its frame.
    fn enter(&mut self, index: usize, from: &Scene, to: &Scene) {
        let to_from_from = to.world_from_scene.inverse() * from.world_from_scene;
        self.scene = index;
        self.frames = to.history.clone();
        self.rings
            .values_mut()
            .for_each(|ring| ring.transform(to_from_from));
    }
}

/// Half a second of constant velocity.
fn drift(agent: &Agent) -> AgentState {
    let mut state = agent.state;
    state.pose.position += state.velocity * TOKEN_DT;
    state
}
