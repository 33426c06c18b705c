//! A history and the simulated frames after it.

use std::sync::Arc;

use crate::{AgentId, Frame, MapGraph, Route, SceneState};

/// Simulated traffic: the history it started from, then one frame per step.
///
/// Plain data: any metric, policy or drawing that works on a [`SceneState`] works on logs and
/// rollouts alike.
#[derive(Clone, Debug)]
pub struct Rollout {
    map: Arc<MapGraph>,
    route: Option<Arc<Route>>,
    ego: AgentId,
    dt: f64,
    n_history: usize,
    frames: Vec<Frame>,
}

impl Rollout {
    /// Starts from the visible part of a scene.
    pub fn begin(scene: SceneState<'_>) -> Self {
        Self {
            map: Arc::clone(scene.map),
            route: scene.route.map(Arc::clone),
            ego: scene.ego,
            dt: scene.dt,
            n_history: scene.history.len(),
            frames: scene.history.to_vec(),
        }
    }

    /// Appends the next simulated frame, `dt` after the last.
    pub fn push(&mut self, frame: Frame) {
        self.frames.push(frame);
    }

    /// The scene after `step` simulated frames; step 0 is the start.
    ///
    /// # Panics
    /// If the rollout is shorter.
    pub fn at(&self, step: usize) -> SceneState<'_> {
        SceneState {
            map: &self.map,
            route: self.route.as_ref(),
            history: &self.frames[..self.n_history + step],
            ego: self.ego,
            dt: self.dt,
        }
    }

    /// The scene after the last simulated frame.
    pub fn last(&self) -> SceneState<'_> {
        self.at(self.steps())
    }

    /// The frame the rollout started from.
    pub fn start(&self) -> &Frame {
        &self.frames[self.n_history - 1]
    }

    /// Number of simulated frames.
    pub fn steps(&self) -> usize {
        self.frames.len() - self.n_history
    }

    /// The history it started from, oldest first, including the start.
    pub fn history(&self) -> &[Frame] {
        &self.frames[..self.n_history]
    }

    /// The simulated frames in order.
    pub fn imagined(&self) -> &[Frame] {
        &self.frames[self.n_history..]
    }

    /// The map.
    pub fn map(&self) -> &Arc<MapGraph> {
        &self.map
    }

    /// The ego.
    pub fn ego(&self) -> AgentId {
        self.ego
    }

    /// Seconds between frames.
    pub fn dt(&self) -> f64 {
        self.dt
    }
}
