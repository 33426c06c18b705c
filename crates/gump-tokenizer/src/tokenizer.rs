//! Scenes to tokens.

use std::collections::BTreeMap;

use gump_geometry::Pose;
use gump_scene::{Agent, AgentId, AgentKind, AgentState, Frame, LaneId, LightState, MapGraph};

use crate::{
    Field, Identities, Key, MAX_LIGHTS, QuantizedState, TokenAgent, TokenFrame, TokenLight,
    TokenSequence,
};

/// What becomes a token.
#[derive(Clone, Debug, PartialEq)]
pub struct TokenizerConfig {
    /// Agents beyond this along either axis have no tokens, metres (paper: 100).
    pub position_range_m: f64,
    /// The same for pedestrians, metres (released code: 40; the paper has no such rule).
    pub pedestrian_range_m: f64,
    /// Lights whose lane starts within this distance of the centre have tokens, metres (released
    /// code: 50).
    pub light_radius_m: f64,
}

impl Default for TokenizerConfig {
    fn default() -> Self {
        Self {
            position_range_m: 100.0,
            pedestrian_range_m: 100.0,
            light_radius_m: 50.0,
        }
    }
}

/// Turns scenes into [`TokenSequence`]s.
#[derive(Clone, Debug, Default)]
pub struct Tokenizer {
    config: TokenizerConfig,
}

/// A sequence and what could not be said exactly.
#[derive(Clone, Debug, PartialEq)]
pub struct Encoded {
    /// The tokens.
    pub sequence: TokenSequence,
    /// What was lost.
    pub report: EncodeReport,
}

/// What an encoding lost.
#[derive(Clone, Debug, PartialEq, Eq, Default)]
pub struct EncodeReport {
    /// States per field whose value was beyond the grid.
    pub clamped: BTreeMap<Field, usize>,
    /// Agent-frames outside the position range.
    pub out_of_range: usize,
    /// Agent-frames of agents that have no id.
    pub over_capacity: usize,
    /// Lights beyond the 63rd.
    pub lights_over_capacity: usize,
}

impl Tokenizer {
    /// A tokenizer.
    pub fn new(config: TokenizerConfig) -> Self {
        Self { config }
    }

    /// Encodes frames half a second apart, oldest first, in the frame of reference
    /// `world_from_scene`. Frames without the ego are left out from the oldest on.
    pub fn encode(
        &self,
        map: &MapGraph,
        frames: &[&Frame],
        ego: AgentId,
        world_from_scene: Pose,
        identities: &Identities,
    ) -> Encoded {
        let mut report = EncodeReport::default();
        let first = frames
            .iter()
            .rposition(|frame| frame.agent(ego).is_none())
            .map_or(0, |i| i + 1);
        let frames = &frames[first..];
        let lights = self.light_places(map, frames, world_from_scene, &mut report);
        let mut encoded: Vec<TokenFrame> = Vec::with_capacity(frames.len());
        for frame in frames {
            let mut agents: Vec<TokenAgent> = frame
                .agents()
                .iter()
                .filter_map(|agent| {
                    self.agent(agent, ego, world_from_scene, identities, &mut report)
                })
                .collect();
            agents.sort_by_key(|agent| agent.key.order());
            let before = encoded.last();
            let (tracked, newborn) = agents.into_iter().partition(|agent: &TokenAgent| {
                before.is_none_or(|before| before.agents().any(|old| old.key == agent.key))
            });
            let lights = lights.iter().map(|(lane, light)| {
                let state = frame
                    .light(*lane)
                    .map_or(LightState::Unknown, |light| light.state);
                TokenLight { state, ..*light }
            });
            encoded.push(TokenFrame {
                lights: lights.collect(),
                tracked,
                newborn,
            });
        }
        let sequence =
            TokenSequence::new(Vec::new(), encoded).expect("the encoder obeys the grammar");
        Encoded { sequence, report }
    }

    fn agent(
        &self,
        agent: &Agent,
        ego: AgentId,
        world_from_scene: Pose,
        identities: &Identities,
        report: &mut EncodeReport,
    ) -> Option<TokenAgent> {
        if agent.kind == AgentKind::Other && agent.id != ego {
            return None;
        }
        let state = in_scene(agent.state, world_from_scene);
        let range = match agent.kind {
            AgentKind::Pedestrian => self.config.pedestrian_range_m,
            _ => self.config.position_range_m,
        };
        if agent.id != ego && state.pose.position.abs().max_element() > range {
            report.out_of_range += 1;
            return None;
        }
        let Some(id) = identities.key(agent.id) else {
            report.over_capacity += 1;
            return None;
        };
        // An ego of no predicted kind is treated as the vehicle it most likely is.
        let kind = if agent.kind == AgentKind::Other {
            AgentKind::Vehicle
        } else {
            agent.kind
        };
        let (state, clamped) = QuantizedState::new(&state, agent.length, agent.width);
        for field in clamped {
            *report.clamped.entry(field).or_default() += 1;
        }
        Some(TokenAgent {
            key: Key { id, kind },
            state,
        })
    }

    /// Lights of the window by distance of their lane's start, with their fixed index and place.
    fn light_places(
        &self,
        map: &MapGraph,
        frames: &[&Frame],
        world_from_scene: Pose,
        report: &mut EncodeReport,
    ) -> Vec<(LaneId, TokenLight)> {
        let scene_from_world = world_from_scene.inverse();
        let mut lanes: Vec<LaneId> = frames
            .iter()
            .flat_map(|frame| frame.lights().iter().map(|light| light.lane))
            .collect();
        lanes.sort();
        lanes.dedup();
        let mut places: Vec<(f64, LaneId, Pose)> = lanes
            .into_iter()
            .filter_map(|id| {
                let start = map.lane(id)?.centerline.pose_at(0.0);
                let distance = start.position.distance(world_from_scene.position);
                (distance <= self.config.light_radius_m)
                    .then(|| (distance, id, scene_from_world * start))
            })
            .collect();
        places.sort_by(|a, b| a.0.total_cmp(&b.0));
        report.lights_over_capacity += places.len().saturating_sub(MAX_LIGHTS);
        let numbered = places.into_iter().take(MAX_LIGHTS).enumerate();
        numbered
            .map(|(i, (_, lane, pose))| {
                let light = TokenLight {
                    index: i as u16 + 1,
                    x: Field::X.quantize(pose.position.x).bin,
                    y: Field::Y.quantize(pose.position.y).bin,
                    heading: Field::Heading.quantize(pose.heading).bin,
                    state: LightState::Unknown,
                };
                (lane, light)
            })
            .collect()
    }
}

/// A world state in the scene frame.
fn in_scene(state: AgentState, world_from_scene: Pose) -> AgentState {
    let scene_from_world = world_from_scene.inverse();
    AgentState {
        pose: scene_from_world * state.pose,
        velocity: scene_from_world.rotate(state.velocity),
    }
}
