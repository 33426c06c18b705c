//! Conversion of scenes to tokens and back.
//!
//! `identity` assigns ids beforehand; `grammar` defines valid sequences.

use std::collections::BTreeMap;
use std::ops::Range;

use gump_geometry::Pose;
use gump_scene::{Agent, AgentId, AgentKind, AgentState, Frame, LaneId, Light, MapGraph};

use crate::field::SLACK;
use crate::lights::Lights;
use crate::{
    AGENT_KEYS, Field, GrammarError, Identities, Key, MAX_LIGHTS, QuantizedState, TokenAgent,
    TokenFrame, TokenSequence,
};

/// The parts of a scene that become tokens.
#[derive(Clone, Debug, PartialEq)]
pub struct TokenizerConfig {
    /// An agent farther than this from the scene's origin along either axis has no token in that
    /// frame; metres, at most the grid's 100. Source: the paper's window of ±100 m.
    pub position_range_m: f64,
    /// The same for pedestrians, metres. The released code has 40, a rule that is not in the paper;
    /// the default is no such rule.
    pub pedestrian_range_m: f64,
    /// Maximum number of agents of a frame besides the ego, 0..=320, nearest to the scene's origin
    /// first. Source: the released code has 320 ids.
    pub max_agents: usize,
    /// Lights have tokens if their lane starts within this distance of the scene's origin, metres:
    /// by default all within the grid. The released code has 50, which an ego that keeps the frame
    /// of its start may leave.
    pub light_radius_m: f64,
    /// Maximum number of lights, 0..=63, nearest first. Source: 64 in the released code, 0 being
    /// "no light".
    pub max_lights: usize,
}

impl Default for TokenizerConfig {
    fn default() -> Self {
        Self {
            position_range_m: 100.0,
            pedestrian_range_m: 100.0,
            max_agents: *AGENT_KEYS.end() as usize,
            light_radius_m: 100.0,
            max_lights: MAX_LIGHTS,
        }
    }
}

/// Turns scenes into [`TokenSequence`]s and token frames into frames.
#[derive(Clone, Debug, Default)]
pub struct Tokenizer {
    config: TokenizerConfig,
}

/// A sequence, the lanes of its light indices, and what the encoding lost.
#[derive(Clone, Debug, PartialEq)]
pub struct Encoded {
    /// The tokens, without prompts.
    pub sequence: TokenSequence,
    /// The lane that each light controls; light index 1 first.
    pub lights: Vec<LaneId>,
    /// Losses.
    pub report: EncodeReport,
}

/// Losses of an encoding. An agent-frame is one agent in one frame.
#[derive(Clone, Debug, PartialEq, Eq, Default)]
pub struct EncodeReport {
    /// The range of the given frames that was encoded: the last run with the ego throughout.
    pub frames: Range<usize>,
    /// Per field, values outside its range, which went to its nearest end.
    pub clamped: BTreeMap<Field, usize>,
    /// Agent-frames left out for being outside the position range.
    pub out_of_range: usize,
    /// Agent-frames left out for lack of an id, or beyond the maximum number of agents of a frame.
    pub over_capacity: usize,
    /// Agent-frames left out because one of their numbers is NaN or infinite.
    pub not_finite: usize,
    /// Lights left out beyond the maximum number of lights.
    pub lights_over_capacity: usize,
}

impl Tokenizer {
    /// A tokenizer with this configuration.
    pub fn new(config: TokenizerConfig) -> Self {
        Self { config }
    }

    /// Its configuration.
    pub fn config(&self) -> &TokenizerConfig {
        &self.config
    }

    /// Encodes frames of which the last is the present; see [`Self::encode_around`].
    pub fn encode(
        &self,
        map: &MapGraph,
        frames: &[&Frame],
        ego: AgentId,
        world_from_scene: Pose,
        identities: &Identities,
    ) -> Encoded {
        let now = frames.len().saturating_sub(1);
        self.encode_around(map, frames, now, ego, world_from_scene, identities)
    }

    /// Encodes frames half a second apart, oldest first; `now` is the index of the present one.
    ///
    /// The present frame determines the numbers of the lights, as in the raster of that frame;
    /// lights of other frames follow. Frames from the last gap in the ego's track on are encoded.
    /// The ego is never left out; its values are clamped and counted instead. Agents of kinds that
    /// do not move have no tokens; an ego of such a kind counts as a vehicle. An agent keeps its
    /// first kind.
    ///
    /// # Panics
    /// If `identities` were not made for this ego.
    pub fn encode_around(
        &self,
        map: &MapGraph,
        frames: &[&Frame],
        now: usize,
        ego: AgentId,
        world_from_scene: Pose,
        identities: &Identities,
    ) -> Encoded {
        assert_eq!(identities.agent(0), Some(ego), "id 0 is the ego's");
        let range = last_run(frames, ego);
        let lights = Lights::number(
            map,
            frames,
            now,
            world_from_scene,
            self.config.light_radius_m,
            self.config.max_lights.min(MAX_LIGHTS),
        );
        let frames = &frames[range.clone()];
        let mut report = EncodeReport {
            frames: range,
            lights_over_capacity: lights.n_over,
            ..EncodeReport::default()
        };
        let mut kinds = BTreeMap::new();
        let mut encoded: Vec<TokenFrame> = Vec::with_capacity(frames.len());
        for frame in frames {
            let view = View {
                ego,
                world_from_scene,
                identities,
            };
            let agents = self.agents(frame, &view, &mut kinds, &mut report);
            let before = encoded.last();
            let (tracked, newborn) = agents.into_iter().partition(|agent| {
                before.is_none_or(|before| before.agents().any(|old| old.key == agent.key))
            });
            encoded.push(TokenFrame {
                lights: lights.tokens(frame),
                tracked,
                newborn,
            });
        }
        let sequence = TokenSequence::new(Vec::new(), encoded);
        Encoded {
            sequence: sequence.expect("the encoder obeys the grammar"),
            lights: lights.lanes,
            report,
        }
    }

    /// The frame of some tokens, with the agents and lights they contain and no others.
    ///
    /// An agent that is in `previous` keeps its kind, size, height and elevation. Any other takes
    /// kind and size from its tokens (at least half a step, so that a box has an extent) and the
    /// elevation of the map; its height is unknown: 0. The caller has to carry over agents without
    /// tokens, such as static objects.
    ///
    /// # Errors
    /// [`GrammarError::UnknownId`] and [`GrammarError::UnknownLight`] for ids and lights that are
    /// not in `identities` or `lights` (as in [`Encoded::lights`]).
    pub fn decode(
        &self,
        map: &MapGraph,
        frame: &TokenFrame,
        previous: &Frame,
        world_from_scene: Pose,
        identities: &Identities,
        lights: &[LaneId],
    ) -> Result<Frame, GrammarError> {
        let agents = frame.agents().map(|token| {
            let id = identities.agent(token.key.id);
            let id = id.ok_or(GrammarError::UnknownId(token.key.id))?;
            let state = in_frame(token.state.to_agent_state(), world_from_scene);
            let known = previous.agent(id).map(|agent| agent.with_state(state));
            Ok(known.unwrap_or_else(|| newborn(id, token, state, map)))
        });
        let agents = agents.collect::<Result<Vec<_>, _>>()?;
        let lights = frame.lights.iter().map(|token| {
            let lane = lights.get(usize::from(token.index).wrapping_sub(1));
            let lane = *lane.ok_or(GrammarError::UnknownLight(token.index))?;
            Ok(Light {
                lane,
                state: token.state,
                stop_point: previous.light(lane).and_then(|light| light.stop_point),
            })
        });
        Ok(Frame::new(agents, lights.collect::<Result<Vec<_>, _>>()?))
    }

    /// The agents of a frame that become tokens, in canonical order.
    fn agents(
        &self,
        frame: &Frame,
        view: &View<'_>,
        kinds: &mut BTreeMap<AgentId, AgentKind>,
        report: &mut EncodeReport,
    ) -> Vec<TokenAgent> {
        let mut agents: Vec<(f64, TokenAgent)> = Vec::new();
        for agent in frame.agents() {
            let is_ego = agent.id == view.ego;
            let kind = match agent.kind {
                moving if moving.is_moving() => moving,
                _ if is_ego => AgentKind::Vehicle,
                _ => continue,
            };
            if !is_usable(agent) {
                report.not_finite += 1;
                continue;
            }
            let state = in_frame(agent.state, view.world_from_scene.inverse());
            if !is_ego && state.pose.position.abs().max_element() > self.range(kind) {
                report.out_of_range += 1;
                continue;
            }
            let Some(id) = view.identities.key(agent.id) else {
                report.over_capacity += 1;
                continue;
            };
            let kind = *kinds.entry(agent.id).or_insert(kind);
            let (quantized, clamped) = QuantizedState::new(&state, agent.length, agent.width);
            for field in clamped {
                *report.clamped.entry(field).or_default() += 1;
            }
            let distance = if is_ego {
                -1.0
            } else {
                state.pose.position.length()
            };
            let key = Key { id, kind };
            agents.push((
                distance,
                TokenAgent {
                    key,
                    state: quantized,
                },
            ));
        }
        agents.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.key.cmp(&b.1.key)));
        report.over_capacity += agents.len().saturating_sub(self.config.max_agents + 1);
        agents.truncate(self.config.max_agents + 1);
        let mut agents: Vec<TokenAgent> = agents.into_iter().map(|(_, agent)| agent).collect();
        agents.sort_by_key(|agent| agent.key);
        agents
    }

    fn range(&self, kind: AgentKind) -> f64 {
        // A position on the edge of the grid must stay inside on its way through the world frame.
        let slack = SLACK * Field::X.step();
        match kind {
            AgentKind::Pedestrian => self.config.pedestrian_range_m + slack,
            _ => self.config.position_range_m + slack,
        }
    }
}

/// The ego and frame of reference of the tokens.
struct View<'a> {
    ego: AgentId,
    world_from_scene: Pose,
    identities: &'a Identities,
}

/// The last run of frames in which the ego is present.
fn last_run(frames: &[&Frame], ego: AgentId) -> Range<usize> {
    let has_ego = |frame: &&Frame| frame.agent(ego).is_some_and(is_usable);
    let end = frames.iter().rposition(has_ego).map_or(0, |last| last + 1);
    let gap = frames[..end].iter().rposition(|frame| !has_ego(frame));
    gap.map_or(0, |gap| gap + 1)..end
}

fn is_usable(agent: &Agent) -> bool {
    agent.state.is_finite() && agent.length.is_finite() && agent.width.is_finite()
}

/// A state in another frame of reference.
fn in_frame(state: AgentState, target_from_source: Pose) -> AgentState {
    AgentState {
        pose: target_from_source * state.pose,
        velocity: target_from_source.rotate(state.velocity),
    }
}

/// An agent of which only the tokens are known; `state` in the world frame.
fn newborn(id: AgentId, token: &TokenAgent, state: AgentState, map: &MapGraph) -> Agent {
    let [.., width, length] = token.state.values();
    Agent {
        id,
        kind: token.key.kind,
        length: length.max(Field::Length.step() / 2.0),
        width: width.max(Field::Width.step() / 2.0),
        height: 0.0,
        elevation: map.elevation_at(state.pose.position).unwrap_or(0.0),
        state,
    }
}
