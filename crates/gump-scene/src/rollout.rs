//! History plus imagined frames.

use std::sync::Arc;

use crate::{AgentId, Frame, MapGraph, Route, SceneState};

/// Imagined traffic: the history it started from, then one frame per step.
///
/// Plain data: any metric, policy or drawing that works on a [`SceneState`] works on the log and
/// on imagination alike.
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
    /// Starts from what a scene has seen.
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

    /// Appends the next imagined frame, `dt` after the last.
    pub fn push(&mut self, frame: Frame) {
        self.frames.push(frame);
    }

    /// The scene after `step` imagined frames; step 0 is the start.
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

    /// The scene after the last imagined frame.
    pub fn last(&self) -> SceneState<'_> {
        self.at(self.steps())
    }

    /// The frame the rollout started from.
    pub fn start(&self) -> &Frame {
        &self.frames[self.n_history - 1]
    }

    /// Number of imagined frames.
    pub fn steps(&self) -> usize {
        self.frames.len() - self.n_history
    }

    /// The history it started from, oldest first, the start included.
    pub fn history(&self) -> &[Frame] {
        &self.frames[..self.n_history]
    }

    /// The imagined frames in order.
    pub fn imagined(&self) -> &[Frame] {
        &self.frames[self.n_history..]
    }

    /// The road.
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
