//! The part of a scenario that a world or policy may see.

use std::sync::Arc;

use crate::{Agent, AgentId, Frame, MapGraph, Route};

/// A copyable view of map, route and history; the last frame is the present. It contains no future.
#[derive(Clone, Copy, Debug)]
pub struct SceneState<'a> {
    /// The map.
    pub map: &'a Arc<MapGraph>,
    /// The ego's route, if one is known; see [`SceneState::unguided`].
    pub route: Option<&'a Arc<Route>>,
    /// Frames up to now, oldest first, `dt` seconds apart, never empty.
    pub history: &'a [Frame],
    /// The id of the ego, which is in the present frame.
    pub ego: AgentId,
    /// Seconds between frames.
    pub dt: f64,
}

impl<'a> SceneState<'a> {
    /// The present frame.
    pub fn now(&self) -> &'a Frame {
        self.history
            .last()
            .expect("the history of a scene is never empty")
    }

    /// Whether both are views of one scene: of the same map and route, and of frames that are clones
    /// of each other. Worlds read the scene of several starts once by it.
    ///
    /// Equal frames that were made separately are different scenes.
    pub fn is_same_scene(&self, other: &SceneState<'_>) -> bool {
        let route = |scene: &SceneState<'_>| scene.route.map(Arc::as_ptr);
        let frames = self.history.iter().zip(other.history);
        Arc::ptr_eq(self.map, other.map)
            && route(self) == route(other)
            && (self.ego, self.dt) == (other.ego, other.dt)
            && self.history.len() == other.history.len()
            && frames.into_iter().all(|(a, b)| a.is_clone_of(b))
    }

    /// The same scene without the ego's route: the input of a world whose realism is scored.
    ///
    /// Few recordings state a route. Readers derive it from where the ego drives *after* the
    /// present, and files store it without its origin; a route therefore reveals which way the ego
    /// turns at the next fork. For planners it is the task; for predictors it is a leak of the
    /// future.
    #[must_use]
    pub fn unguided(self) -> Self {
        Self {
            route: None,
            ..self
        }
    }

    /// The ego now.
    pub fn ego_now(&self) -> &'a Agent {
        self.now().agent(self.ego).expect("the ego is present now")
    }

    /// The history thinned to one frame every `stride`, ending now, at most `n` frames, oldest
    /// first.
    pub fn strided_history(&self, stride: usize, n: usize) -> Vec<&'a Frame> {
        let mut frames: Vec<_> = self
            .history
            .iter()
            .rev()
            .step_by(stride.max(1))
            .take(n)
            .collect();
        frames.reverse();
        frames
    }
}

#[cfg(test)]
mod tests {
    use crate::fixture;

    #[test]
    fn clones_of_a_scenario_are_one_scene_and_equal_ones_are_not() {
        let text = "lane 1: 0,0 100,0\nego vehicle 0: 10,0 velocity 5,0";
        let scenario = fixture::scenario(text).unwrap();
        let clone = scenario.clone();
        assert!(scenario.present().is_same_scene(&clone.present()));
        let again = fixture::scenario(text).unwrap();
        assert!(!scenario.present().is_same_scene(&again.present()));
        let mut shorter = scenario.present();
        shorter.history = &shorter.history[1..];
        assert!(!scenario.present().is_same_scene(&shorter));
    }
}
