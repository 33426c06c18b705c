//! One future in progress: its window, its agents' chunks, and the update of its present from
//! decoded states.

use std::collections::BTreeMap;
use std::sync::Arc;

use gump_geometry::Pose;
use gump_model::config::KEEP_RANGE_M;
use gump_model::decoder::{Bins, STEPS};
use gump_model::exact::ExactFrames;
use gump_model::local_frame::LocalFrame;
use gump_model::steps::TOKEN_DT;
use gump_scene::{Agent, AgentState, Frame, Seed};
use gump_tokenizer::{Identities, QuantizedState, TokenAgent, TokenFrame};

use crate::cpu::KvCache;
use crate::kinematic_limits::Limits;
use crate::partial_ar::Window;
use crate::request::{Request, set_pose};
use crate::sampling::{CacheMode, SamplingConfig, Surrogate};
use crate::scene::SceneContext;
use crate::spawning::Phases;
use crate::temporal_ensemble::ChunkBuffer;
use crate::world::TransformerWorld;

/// Maximum distance of a sampled position from its surrogate (released code), metres.
const GUARD_M: f64 = 5.0;

/// One future in progress.
#[derive(Clone, Debug)]
pub(crate) struct RolloutState {
    pub(crate) scene: usize,
    pub(crate) seed: Seed,
    /// The last token frames: at most `history` of them, or as many as a growing window holds.
    /// Those of the start are shared by all futures of the scene.
    pub(crate) frames: Vec<Arc<TokenFrame>>,
    /// Index of the last frame.
    pub(crate) index: usize,
    /// Its value at the start.
    pub(crate) begun: usize,
    pub(crate) rings: BTreeMap<u16, ChunkBuffer>,
    /// The same frames in world coordinates, at least `history` of them where there are as many;
    /// the last is the present.
    pub(crate) recent: Vec<Frame>,
    /// The keys of agents, including those that entered in this future.
    pub(crate) identities: Identities,
    /// The time for which lights have shown their colour, with spawning.
    pub(crate) phases: Phases,
    /// The engine's cache of its window.
    pub(crate) kv_cache: KvCache,
}

impl RolloutState {
    /// The window of one future: its history and the next frame with provisional states.
    pub(crate) fn window(
        &self,
        scene: &SceneContext,
        world: &TransformerWorld,
        ego: Option<AgentState>,
    ) -> Window {
        let sampling = world.sampling();
        let index = self.index + 1;
        let last = self.frames.last().expect("a future has history");
        let mut next = TokenFrame {
            lights: last.lights.clone(),
            tracked: Vec::new(),
            newborn: Vec::new(),
        };
        let mut requests = Vec::new();
        // Newborn agents of the last frame are tracked now, in their place of the canonical order.
        let mut agents: Vec<&TokenAgent> = last.agents().collect();
        agents.sort_by_key(|agent| agent.key.order());
        for agent in agents {
            let id = agent.key.id;
            let surrogate = match (id, ego) {
                (0, Some(state)) => scene.quantize(state, agent.state),
                _ => self.surrogate(agent, index, sampling),
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
            let local_frame = self.local_frame(agent, scene, world);
            let is = match (id, ego) {
                (0, Some(state)) => scene.local(state),
                _ => surrogate.to_agent_state(),
            };
            requests.push(Request {
                local_frame,
                forced: given(local_frame, &surrogate, is, driven),
                stream: stream(self.seed, index, id),
                near: Some((position, GUARD_M)),
                // A driven object was put where it is; what it once foresaw does not count.
                ring: if driven {
                    ChunkBuffer::default()
                } else {
                    self.rings.get(&id).cloned().unwrap_or_default()
                },
                limits: self.limits(agent, scene, sampling).filter(|_| !driven),
                frame: index,
                guide: None,
            });
        }
        Window {
            scene: self.scene,
            history: self.frames.clone(),
            exact: self.exact(scene),
            next,
            requests,
            lane_map: Arc::clone(&scene.lane_map),
        }
    }

    /// The objects of the window's frames, not quantised.
    pub(crate) fn exact(&self, scene: &SceneContext) -> ExactFrames {
        let n = self.frames.len();
        ExactFrames::last(n, &self.recent, &self.identities, scene.world_from_scene)
    }

    /// The frame in which the next chunk of `agent`, a token of the last frame, is expressed: its
    /// pose, not quantised.
    fn local_frame(
        &self,
        agent: &TokenAgent,
        scene: &SceneContext,
        world: &TransformerWorld,
    ) -> LocalFrame {
        if world.network().config().local_frame {
            LocalFrame::at(self.pose(agent, scene))
        } else {
            LocalFrame::SCENE
        }
    }

    /// The pose of `agent`, a token of the last frame, and its kinematic limits.
    fn limits(
        &self,
        agent: &TokenAgent,
        scene: &SceneContext,
        sampling: &SamplingConfig,
    ) -> Option<(Pose, Limits)> {
        let limits = Limits::of(agent.key.kind).filter(|_| sampling.limits)?;
        Some((self.pose(agent, scene), limits))
    }

    /// The pose of `agent`, a token of the last frame, not quantised; scene frame.
    fn pose(&self, agent: &TokenAgent, scene: &SceneContext) -> Pose {
        let id = self.identities.agent(agent.key.id);
        let present = self.recent.last().expect("a future has a present");
        let known = id.and_then(|id| present.agent(id));
        known.map_or(agent.state.pose(), |known| scene.local(known.state).pose)
    }

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
        let predicted = match sampling.surrogate {
            Surrogate::Chunk => self
                .rings
                .get(&agent.key.id)
                .and_then(|ring| ring.surrogate(index, sampling.decay)),
            Surrogate::Copy => Some(pose),
            Surrogate::ConstantVelocity => None,
        };
        // No agent deviates farther from a straight line in half a second: that would be noise.
        let predicted =
            predicted.filter(|predicted| predicted.position.distance(moved.position) <= GUARD_M);
        set_pose(agent.state, predicted.unwrap_or(moved))
    }

    /// Makes the decoded states the present and returns it in world coordinates.
    pub(crate) fn commit(
        &mut self,
        window: Window,
        decoded: &[Bins],
        scene: &SceneContext,
        world: &TransformerWorld,
        ego: Option<AgentState>,
    ) -> Frame {
        let sampling = world.sampling();
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
            ring.push(self.index, request.local_frame.poses(bins));
            let settled = request.resolve(bins, sampling);
            agent.state = request.settled_state(bins, settled);
            let state = AgentState {
                pose: scene.world_from_scene * settled.pose,
                velocity: scene.world_from_scene.rotate(settled.velocity),
            };
            moved.insert(id, if driven { ego.unwrap_or(state) } else { state });
        }
        let now = self.recent.last().expect("a future has a present");
        let agents = now.agents().iter().map(|agent| {
            let token = self.identities.key(agent.id).and_then(|id| moved.get(&id));
            let driven = ego.filter(|_| agent.id == scene.ego);
            agent.with_state(driven.or(token.copied()).unwrap_or_else(|| drift(agent)))
        });
        // Lights keep the colour they were seen in.
        let frame = Frame::new(agents.collect(), now.lights().to_vec());
        let (before, longest) = (self.last_frame(), world.longest_frame());
        next.newborn = scene.arrivals(&frame, &next, before, longest, &self.identities);
        self.recent.push(frame.clone());
        self.frames.push(Arc::new(next));
        let history = sampling.history.max(1);
        if sampling.cache != CacheMode::Growing || self.overflows(world) {
            self.frames
                .drain(..self.frames.len().saturating_sub(history));
        }
        let kept = history.max(self.frames.len());
        self.recent.drain(..self.recent.len().saturating_sub(kept));
        self.rings.retain(|id, _| moved.contains_key(id));
        make_first(&mut self.frames[0]);
        frame
    }

    /// The tokens of the present.
    pub(crate) fn last_frame(&self) -> Option<&TokenFrame> {
        self.frames.last().map(|frame| &**frame)
    }

    /// Whether the window with a next frame like the last would be longer than a block.
    fn overflows(&self, world: &TransformerWorld) -> bool {
        let last = self.last_frame().map_or(0, TokenFrame::len_slots);
        let all: usize = self.frames.iter().map(|frame| frame.len_slots()).sum();
        all + last > world.network().config().block_size
    }

    /// Returns the distance of the ego from the origin of its scene frame along the farther axis,
    /// metres.
    pub(crate) fn ego_reach(&self) -> f64 {
        let ego = self.frames.last().and_then(|frame| frame.tracked.first());
        ego.map_or(0.0, |ego| ego.state.pose().position.abs().max_element())
    }

    /// Changes to another scene of the same traffic: tokens and chunks are expressed in its frame.
    pub(crate) fn enter(&mut self, index: usize, from: &SceneContext, to: &SceneContext) {
        let to_from_from = to.world_from_scene.inverse() * from.world_from_scene;
        self.scene = index;
        self.frames = to.history.clone();
        self.kv_cache.clear();
        self.rings
            .values_mut()
            .for_each(|ring| ring.transform(to_from_from));
    }
}

/// Makes a frame the first of a window, in which no agent is newborn: those that were count as
/// tracked. A frame that is as it should be stays shared.
fn make_first(frame: &mut Arc<TokenFrame>) {
    if frame.newborn.is_empty() && frame.tracked.is_sorted_by_key(|agent| agent.key) {
        return;
    }
    let frame = Arc::make_mut(frame);
    *frame = std::mem::take(frame).into_first();
}

/// The random stream of one object in one frame of one future, independent of the batch.
pub(crate) fn stream(seed: Seed, frame: usize, id: u16) -> Seed {
    seed.fork(frame as u64).fork(u64::from(id))
}

/// Sizes never change; the state `is` of a driven object is given completely.
fn given(
    local_frame: LocalFrame,
    like: &QuantizedState,
    is: AgentState,
    driven: bool,
) -> [Option<u16>; STEPS.len()] {
    let state = driven.then_some(is);
    local_frame.bins(*like, [state, None, None, None])
}

/// Half a second of constant velocity.
fn drift(agent: &Agent) -> AgentState {
    let mut state = agent.state;
    state.pose.position += state.velocity * TOKEN_DT;
    state
}
