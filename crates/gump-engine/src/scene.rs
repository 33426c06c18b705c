//! Data shared by all futures of a start: the frame of reference, the identities, the map and its
//! encoding.

use std::collections::BTreeSet;
use std::sync::{Arc, OnceLock};

use gump_geometry::Pose;
use gump_model::ModelConfig;
use gump_model::config::KEEP_RANGE_M;
use gump_model::exact::ExactFrames;
use gump_model::local_context::LaneMap;
use gump_model::local_frame::LocalFrame;
use gump_model::mct::VisualMemory;
use gump_model::placed_slot::{PlacedSlot, place_exactly};
use gump_model::steps::TOKEN_DT;
use gump_raster::rasterize;
use gump_scene::{AgentId, AgentKind, AgentState, Frame, LaneId, MapGraph, Route, SceneState};
use gump_tokenizer::{
    Identities, Key, N_CLASSES, QuantizedState, TokenAgent, TokenFrame, TokenSequence, class_index,
};

use crate::EngineError;
use crate::cpu::{KvCache, SceneMemory};
use crate::placement::spawn_map::SpawnMap;
use crate::world::TransformerWorld;

/// The encoding of a map, in the form of the implementation that uses it.
#[derive(Debug)]
pub enum Memory {
    /// For the engine.
    Packed(SceneMemory),
    /// For the tensor library.
    Reference(VisualMemory),
}

impl Memory {
    /// The engine's form, if it is that.
    pub fn packed(&self) -> Option<&SceneMemory> {
        match self {
            Self::Packed(memory) => Some(memory),
            Self::Reference(_) => None,
        }
    }

    /// The tensor library's form, if it is that.
    pub(crate) fn reference(&self) -> Option<&VisualMemory> {
        match self {
            Self::Reference(memory) => Some(memory),
            Self::Packed(_) => None,
        }
    }
}

/// Data shared by all futures of a start.
#[derive(Debug)]
pub struct SceneContext {
    /// The scene frame in the world.
    pub world_from_scene: Pose,
    pub(crate) ego: AgentId,
    pub(crate) identities: Identities,
    /// The encoding of the map.
    pub memory: Memory,
    /// The history as computed by the engine, from which futures continue.
    pub(crate) prefix: KvCache,
    /// Frames before the start, scene frame; futures share them.
    pub history: Vec<Arc<TokenFrame>>,
    /// The lane that each light token controls, light 1 first.
    pub(crate) lights: Vec<LaneId>,
    /// The same frames in world coordinates; the last is the present.
    pub(crate) recent: Vec<Frame>,
    pub(crate) map: Arc<MapGraph>,
    /// The map prepared around the scene.
    pub lane_map: Arc<LaneMap>,
    pub(crate) route: Option<Arc<Route>>,
    /// Valid positions by class; computed on first use.
    grounds: [OnceLock<Arc<SpawnMap>>; N_CLASSES],
    /// The part of them where agents may enter the window.
    entries: [OnceLock<Arc<SpawnMap>>; N_CLASSES],
}

/// The sequence of shared frames.
pub(crate) fn sequence(frames: &[Arc<TokenFrame>]) -> Result<TokenSequence, EngineError> {
    let frames = frames.iter().map(|frame| TokenFrame::clone(frame));
    TokenSequence::new(Vec::new(), frames.collect()).map_err(EngineError::Grammar)
}

impl SceneContext {
    /// The content of the present of a scene.
    pub fn new(world: &TransformerWorld, scene: SceneState<'_>) -> Result<Self, EngineError> {
        let world_from_scene = scene.ego_now().state.pose;
        let stride = (TOKEN_DT / scene.dt).round().max(1.0) as usize;
        if (stride as f64 * scene.dt - TOKEN_DT).abs() > 1e-3 {
            return Err(EngineError::TimeStep {
                dt: scene.dt,
                expected: TOKEN_DT,
            });
        }
        let frames = scene.strided_history(stride, world.sampling().history.max(1));
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
        Self::of_window(world, map, route, recent, scene.ego, identities)
    }

    /// The content of a window of frames half a second apart, in the frame of the ego in its last.
    pub fn of_window(
        world: &TransformerWorld,
        map: Arc<MapGraph>,
        route: Option<Arc<Route>>,
        recent: Vec<Frame>,
        ego: AgentId,
        identities: Identities,
    ) -> Result<Self, EngineError> {
        let view = SceneState {
            map: &map,
            route: route.as_ref(),
            history: &recent,
            ego,
            dt: TOKEN_DT,
        };
        let world_from_scene = view.ego_now().state.pose;
        let frames: Vec<&Frame> = recent.iter().collect();
        let encoded = world
            .tokenizer()
            .encode(&map, &frames, ego, world_from_scene, &identities);
        let (sequence, _) = encoded.sequence.fit(world.longest_frame());
        let raster = rasterize(world.network().raster_spec(), &view, world_from_scene);
        let lane_map = Arc::new(LaneMap::new(&map, world_from_scene));
        let memory = world
            .network()
            .look(std::slice::from_ref(&raster), vec![Arc::clone(&lane_map)])?;
        Ok(Self {
            world_from_scene,
            ego,
            identities,
            memory: match world.engine() {
                Some(engine) => Memory::Packed(engine.remember(&memory)?),
                None => Memory::Reference(memory),
            },
            prefix: KvCache::default(),
            history: sequence.frames().iter().cloned().map(Arc::new).collect(),
            lights: encoded.lights,
            recent,
            map,
            lane_map,
            route,
            grounds: Default::default(),
            entries: Default::default(),
        })
    }

    /// The state of an object in the present, scene frame, not rounded.
    pub(crate) fn present(&self, id: u16) -> Option<AgentState> {
        let now = self.recent.last()?;
        Some(self.local(now.agent(self.identities.agent(id)?)?.state))
    }

    /// The frame in which the chunk at a key of the present is expressed.
    pub fn local_frame(&self, key: &PlacedSlot, config: &ModelConfig) -> LocalFrame {
        let last = key.last_pose().filter(|_| config.local_frame);
        last.map_or(LocalFrame::SCENE, LocalFrame::at)
    }

    /// The slots of its history.
    pub fn slots(&self) -> Result<Vec<PlacedSlot>, EngineError> {
        let sequence = sequence(&self.history)?;
        let n = self.history.len();
        let exact = ExactFrames::last(n, &self.recent, &self.identities, self.world_from_scene);
        Ok(place_exactly(&sequence, |frame, id| exact.of(frame, id)))
    }

    /// A world state in tokens, with the size of `like`.
    pub(crate) fn quantize(&self, state: AgentState, like: QuantizedState) -> QuantizedState {
        like.with_motion(&self.local(state))
    }

    /// Valid positions of agents of a class.
    pub(crate) fn ground(&self, kind: AgentKind) -> Arc<SpawnMap> {
        let ground = &self.grounds[class_index(kind)];
        let make = || Arc::new(SpawnMap::of_class(&self.map, self.world_from_scene, kind));
        Arc::clone(ground.get_or_init(make))
    }

    /// Positions where agents of a class may enter the window.
    pub(crate) fn entries(&self, kind: AgentKind) -> Arc<SpawnMap> {
        let make = || Arc::new(self.ground(kind).entries());
        Arc::clone(self.entries[class_index(kind)].get_or_init(make))
    }

    /// A world state in the scene frame.
    pub(crate) fn local(&self, state: AgentState) -> AgentState {
        let scene_from_world = self.world_from_scene.inverse();
        AgentState {
            pose: scene_from_world * state.pose,
            velocity: scene_from_world.rotate(state.velocity),
        }
    }

    /// Agents of `frame` inside the window that neither `tokens` nor the previous frame contains,
    /// because they moved into it; as many as fit a frame of `longest` slots. An agent that has
    /// just left has to wait a frame before it can be newborn.
    pub(crate) fn arrivals(
        &self,
        frame: &Frame,
        tokens: &TokenFrame,
        before: Option<&TokenFrame>,
        longest: usize,
        identities: &Identities,
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
                let id = identities.key(agent.id).filter(|id| !known.contains(id))?;
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
