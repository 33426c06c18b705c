//! Motion prediction by the trajectory heads: several whole futures of every agent at once, without
//! a rollout.

use std::sync::Arc;

use candle_core::Tensor;
use gump_geometry::{DVec2, dvec2};
use gump_model::steps::TOKEN_DT;
use gump_model::trajectory_head::{FUTURE, MODES, POSE};
use gump_raster::rasterize;
use gump_scene::{AgentId, SceneState};
use gump_tokenizer::Slot;

use crate::EngineError;
use crate::scene::SceneContext;
use crate::world::TransformerWorld;

/// The predicted futures of an agent.
#[derive(Clone, Debug, PartialEq)]
pub struct AgentTrajectories {
    /// The agent.
    pub agent: AgentId,
    /// The modes in the order of the head.
    pub modes: Vec<TrajectoryMode>,
}

/// One possible future of an agent.
#[derive(Clone, Debug, PartialEq)]
pub struct TrajectoryMode {
    /// 0 to 1; those of an agent add up to 1.
    pub probability: f64,
    /// Box centres in the world frame, metres, half a second apart, the first half a second after
    /// the present.
    pub positions: Vec<DVec2>,
}

impl TransformerWorld {
    /// Futures of 8 s of all agents in the token window, from the deepest trajectory head.
    ///
    /// Agents outside the window, of kinds that are not predicted, or beyond the vocabulary are
    /// missing. Source: GUMP (ECCV 2024), appendix G.
    ///
    /// # Errors
    /// A network without trajectory heads, a scene that cannot be tokenised, or errors of the tensor
    /// library.
    pub fn predict_trajectories(
        &self,
        scene: SceneState<'_>,
    ) -> Result<Vec<AgentTrajectories>, EngineError> {
        let network = self.network();
        let Some(head) = network.trajectory_heads.last() else {
            return Err(EngineError::NoTrajectoryHeads);
        };
        let scene = SceneContext::new(self, scene)?;
        let slots = scene.slots()?;
        let last = scene.history.len() - 1;
        let agents: Vec<Present> = slots
            .windows(2)
            .enumerate()
            .filter_map(|(i, pair)| match (pair[0].slot, pair[1].slot) {
                (Slot::Key(key), Slot::Value(state)) if pair[0].frame == last => {
                    let is = scene.present(key.id).unwrap_or(state.to_agent_state());
                    Some((i as u32, scene.identities.agent(key.id)?, is.pose.position))
                }
                _ => None,
            })
            .collect();
        // The engine keeps the map in another form, without the features that heads read.
        let encoded;
        let memory = match scene.memory.reference() {
            Some(memory) => memory,
            None => {
                let view = SceneState {
                    map: &scene.map,
                    route: scene.route.as_ref(),
                    history: &scene.recent,
                    ego: scene.ego,
                    dt: TOKEN_DT,
                };
                let raster = rasterize(network.raster_spec(), &view, scene.world_from_scene);
                encoded = network.look(&[raster], vec![Arc::clone(&scene.lane_map)])?;
                &encoded
            }
        };
        let batch = network.pack(&[&slots], 0, memory)?;
        let features = network.mct.forward(&batch, memory, None, None)?;
        let level = features.levels.last();
        let level = level.expect("a level for every head").squeeze(0)?; // [T, C]
        let at = |offset: u32| {
            let rows: Vec<u32> = agents.iter().map(|(key, ..)| key + offset).collect();
            level.index_select(&Tensor::new(rows, level.device())?, 0)
        };
        let predicted = head.forward(&Tensor::cat(&[at(0)?, at(1)?], 1)?)?;
        let logits: Vec<f32> = predicted.modes.flatten_all()?.to_vec1()?;
        let poses: Vec<f32> = predicted.future.flatten_all()?.to_vec1()?;
        let rows = logits
            .chunks(MODES)
            .zip(poses.chunks(MODES * FUTURE * POSE));
        let of = |(&(_, agent, from), (logits, poses)): (&Present, (&[f32], &[f32]))| {
            let place = |pose: &[f32]| {
                let moved = dvec2(f64::from(pose[0]), f64::from(pose[1]));
                scene.world_from_scene * (from + moved)
            };
            let modes = softmax(logits).into_iter().zip(poses.chunks(FUTURE * POSE));
            let mode = |(probability, poses): (f64, &[f32])| TrajectoryMode {
                probability,
                positions: poses.chunks(POSE).map(place).collect(),
            };
            AgentTrajectories {
                agent,
                modes: modes.map(mode).collect(),
            }
        };
        Ok(agents.iter().zip(rows).map(of).collect())
    }
}

/// The slot of an agent's key in the present, the agent, and its position in the scene frame.
type Present = (u32, AgentId, DVec2);

fn softmax(logits: &[f32]) -> Vec<f64> {
    let most = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let weights = logits.iter().map(|&x| f64::from(x - most).exp());
    let weights: Vec<f64> = weights.collect();
    let sum: f64 = weights.iter().sum();
    weights.into_iter().map(|weight| weight / sum).collect()
}
