//! Data shared by all scenes of a request: the encoded map, the constraints, valid positions, and a
//! check that the constraints are consistent.

use std::collections::BTreeMap;
use std::sync::Arc;

use gump_engine::cpu::SceneMemory;
use gump_engine::placement::network::PlacementScorer;
use gump_engine::placement::object_spec::{ObjectSpec, agent_of};
use gump_engine::placement::places::Places;
use gump_engine::placement::rules::{Manner, Rules};
use gump_engine::placement::spawn_map::SpawnMap;
use gump_engine::scene::SceneContext;
use gump_engine::{EngineError, SamplingConfig, TransformerWorld};
use gump_geometry::OrientedBox;
use gump_model::placed_slot::{PlacedSlot, place};
use gump_scene::{AgentId, AgentKind, AgentState, Frame, LaneId, ScenarioTag};
use gump_tokenizer::{
    AGENT_KEYS, Identities, Key, QuantizedState, TokenAgent, TokenFrame, TokenSequence,
};

use crate::constraint::ConstraintError;
use crate::constraint::EGO;
use crate::{GenerateError, GenerateRequest, Placement, constraint};

/// Data shared by all scenes of a request.
pub(crate) struct Prepared<'a> {
    pub(super) request: &'a GenerateRequest,
    pub(super) scene: SceneContext,
    prompts: Vec<Option<ScenarioTag>>,
    /// With relations stored on both sides.
    pub(super) objects: Vec<ObjectSpec>,
    grounds: BTreeMap<AgentKind, Arc<SpawnMap>>,
    lanes: BTreeMap<i64, Arc<SpawnMap>>,
    /// The places of vehicles, where the placement network draws them.
    pub(super) places: Option<(Arc<Places>, Arc<[bool]>)>,
    /// Boxes of static objects, scene frame.
    pub(super) fixtures: Vec<OrientedBox>,
    pub(super) sampling: SamplingConfig,
    manner: Manner,
}

impl<'a> Prepared<'a> {
    pub(crate) fn new(
        world: &TransformerWorld,
        request: &'a GenerateRequest,
    ) -> Result<Self, GenerateError> {
        if request.config.tries == 0 {
            return Err(GenerateError::NoTries);
        }
        let mut objects = request.objects.clone();
        constraint::check(&objects)?;
        constraint::mutual(&mut objects);
        let pose = request.ego.pose;
        let of_class = |kind| {
            let ground = SpawnMap::of_class(&request.map, pose, kind);
            (kind, Arc::new(ground))
        };
        let grounds: BTreeMap<_, _> = AgentKind::MOVING.into_iter().map(of_class).collect();
        if grounds[&AgentKind::Vehicle].is_closed() {
            return Err(GenerateError::NoLane);
        }
        let lanes = lane_grounds(request)?;
        let read = request
            .prompts
            .iter()
            .filter(|_| request.config.prompt_tokens);
        let prompts = read.copied().map(Some).collect();
        let scene = scene_of_ego(world, request)?;
        let scene_from_world = scene.world_from_scene.inverse();
        let fixtures = request.fixtures.iter().map(|agent| {
            let mut own = agent.oriented_box();
            own.pose = scene_from_world * own.pose;
            own
        });
        let fixtures = fixtures.collect();
        let config = &request.config;
        let prepared = Self {
            manner: Manner {
                size_boldness: config.size_boldness,
                place_boldness: config.place_boldness,
                smoothing_bins: Some(config.smoothing_bins as f32).filter(|bins| *bins > 0.0),
                smoothed_sizes: config.smoothed_sizes,
                numbers: None,
            },
            request,
            scene,
            fixtures,
            prompts,
            objects,
            grounds,
            lanes,
            places: (config.placement_network && config.placement == Placement::Guided).then(
                || {
                    let places = Places::new(&request.map, pose, &request.lights);
                    let likely = PlacementScorer::shipped().likely(&places);
                    (Arc::new(places), likely)
                },
            ),
            sampling: SamplingConfig {
                temperature: Some(config.temperature),
                top_k: config.top_k,
                ..world.sampling().clone()
            },
        };
        prepared.check_counts(world)?;
        prepared.check_places()?;
        // Prompts that do not go together show here, before anything is drawn.
        prepared.slots(&[], None)?;
        Ok(prepared)
    }

    fn check_counts(&self, world: &TransformerWorld) -> Result<(), GenerateError> {
        let wished = |kind: AgentKind| {
            let objects = self.objects.iter();
            objects.filter(move |o| o.id != EGO && o.class.kind() == kind)
        };
        let config = &self.request.config;
        let requested = match &self.request.counts {
            None => {
                let n: usize = AgentKind::MOVING
                    .map(|kind| wished(kind).count())
                    .iter()
                    .sum();
                n.max(config.max_agents)
            }
            Some(counts) => {
                for kind in AgentKind::MOVING {
                    let (described, requested) = (wished(kind).count(), counts.of(kind));
                    if described > requested {
                        let error = ConstraintError::TooManyDescribed {
                            kind,
                            described,
                            requested,
                        };
                        return Err(error.into());
                    }
                }
                counts.total()
            }
        };
        let fixed = 3 + 2 + self.prompts.len() + self.scene.history[0].lights.len();
        let room = world.longest_frame().saturating_sub(fixed) / 2;
        let max = room.min(*AGENT_KEYS.end() as usize);
        if requested > max {
            return Err(GenerateError::TooMany { requested, max });
        }
        Ok(())
    }

    /// Checks that every object with its own constraints has some valid cell.
    fn check_places(&self) -> Result<(), GenerateError> {
        for object in self.objects.iter().filter(|object| object.id != EGO) {
            let rules = self.rules(object.class.kind(), object, &[], &BTreeMap::new());
            let in_row = object.behind.is_some() || object.ahead_of.is_some();
            if !in_row && !rules.has_place() {
                let error = ConstraintError::NoPoint {
                    id: object.id.clone(),
                    lane: object.lane,
                };
                return Err(error.into());
            }
        }
        Ok(())
    }

    /// The constraints of an object among those already placed.
    pub(super) fn rules(
        &self,
        kind: AgentKind,
        spec: &ObjectSpec,
        taken: &[OrientedBox],
        named: &BTreeMap<String, usize>,
    ) -> Rules {
        let is_guided = self.request.config.placement == Placement::Guided;
        let rows = [(false, &spec.behind), (true, &spec.ahead_of)];
        let rows = rows.into_iter().filter_map(|(is_ahead, relation)| {
            let relation = relation.as_ref()?;
            let other = taken[*named.get(&relation.object)?];
            Some((is_ahead, other, relation.metres))
        });
        let rows: Vec<_> = rows.collect();
        let fixed = spec.x.is_some_and(|x| x.high - x.low < 1.0)
            && spec.y.is_some_and(|y| y.high - y.low < 1.0);
        let of_class = || {
            let ground = &self.grounds[&kind];
            let guides = is_guided && rows.is_empty() && !fixed && !ground.is_closed();
            guides.then(|| Arc::clone(ground))
        };
        let of_lane = spec.lane.and_then(|lane| self.lanes.get(&lane)).cloned();
        Rules {
            kind,
            spec: spec.clone(),
            ground: of_lane.or_else(of_class),
            taken: taken.to_vec(),
            rows,
            comes_to: None,
            is_guided,
            manner: self.manner.clone(),
            places: None,
        }
    }

    /// The slots of a frame up to its last agent's value, or up to the key of one more agent.
    pub(super) fn slots(
        &self,
        agents: &[TokenAgent],
        next: Option<Key>,
    ) -> Result<Vec<PlacedSlot>, EngineError> {
        let mut tracked = agents.to_vec();
        tracked.extend(next.map(|key| TokenAgent {
            key,
            state: QuantizedState::default(),
        }));
        if tracked.is_empty() {
            tracked = self.scene.history[0].tracked[..1].to_vec();
        }
        let frame = TokenFrame {
            lights: self.scene.history[0].lights.clone(),
            tracked,
            newborn: Vec::new(),
        };
        let sequence =
            TokenSequence::new(self.prompts.clone(), vec![frame]).map_err(EngineError::Grammar)?;
        let mut slots = place(&sequence);
        // NEWBORN decides nothing yet, nor does the value that is still to come.
        slots.truncate(slots.len() - 1 - usize::from(next.is_some()));
        Ok(slots)
    }

    pub(super) fn memory(&self) -> &SceneMemory {
        let memory = self.scene.memory.packed();
        memory.expect("a scene of a world with an engine has the engine's memory")
    }
}

/// The map with only the ego, as the network sees it.
fn scene_of_ego(
    world: &TransformerWorld,
    request: &GenerateRequest,
) -> Result<SceneContext, EngineError> {
    if world.engine().is_none() {
        let what = "scenes are generated";
        return Err(EngineError::NotOnCpu { what });
    }
    let start = request.ego;
    let state = AgentState {
        pose: start.pose,
        velocity: start.velocity.unwrap_or_default(),
    };
    let id = AgentId(0);
    let size = [start.length, start.width];
    let mut agents = request.fixtures.clone();
    agents.push(agent_of(id, AgentKind::Vehicle, size, state, &request.map));
    let frame = Frame::new(agents, request.lights.clone());
    let identities = Identities::ranked(&[&frame], id, start.pose);
    let map = Arc::clone(&request.map);
    SceneContext::of_window(world, map, None, vec![frame], id, identities)
}

/// Valid positions on every lane that constraints name.
fn lane_grounds(request: &GenerateRequest) -> Result<BTreeMap<i64, Arc<SpawnMap>>, GenerateError> {
    let lanes = request.objects.iter().filter_map(ObjectSpec::lane);
    let ground = |lane: LaneId| {
        let ground = SpawnMap::of_lane(&request.map, request.ego.pose, lane)
            .ok_or(ConstraintError::NoSuchLane { lane })?;
        if ground.is_closed() {
            return Err(ConstraintError::LaneTooFar { lane }.into());
        }
        Ok((lane.0, Arc::new(ground)))
    };
    lanes.map(ground).collect()
}
