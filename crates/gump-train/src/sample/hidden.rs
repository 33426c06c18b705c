//! Hiding of inputs that a scene states, so that the network learns to work without them.
//!
//! Formats differ in what they state; a network that only saw maps with limits and signs would take
//! their absence for a fact. Some samples are therefore presented as from a source without limits,
//! stop signs, lights or sizes: map, raster, tokens and local contexts alike. Motion and targets
//! are not changed.

use std::sync::Arc;

use gump_scene::{Agent, Frame, MapGraph, Rng};
use rand::Rng as _;

use super::SampleConfig;

/// The inputs hidden in one sample.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Hidden {
    limits: bool,
    stop_signs: bool,
    lights: bool,
    /// Whether every object gets the usual size of its kind.
    pub(super) sizes: bool,
}

impl Hidden {
    /// Draws which inputs to hide.
    pub(super) fn draw(config: &SampleConfig, rng: &mut Rng) -> Self {
        Self {
            limits: rng.random_bool(config.hide_limits),
            stop_signs: rng.random_bool(config.hide_stop_signs),
            lights: rng.random_bool(config.hide_lights),
            sizes: rng.random_bool(config.hide_sizes),
        }
    }

    /// The map without the hidden inputs.
    pub(super) fn map(self, map: &Arc<MapGraph>) -> Arc<MapGraph> {
        let hides_limits = self.limits && map.lanes().iter().any(|l| l.speed_limit.is_some());
        let unstated = map.unstated();
        let hides_rest =
            (self.stop_signs && !unstated.stop_signs) || (self.lights && !unstated.lights);
        if !hides_limits && !hides_rest {
            return Arc::clone(map);
        }
        let mut parts = map.parts().clone();
        if self.limits {
            parts.lanes.iter_mut().for_each(|l| l.speed_limit = None);
        }
        if self.stop_signs {
            parts.stop_signs.clear();
            parts.unstated.stop_signs = true;
        }
        parts.unstated.lights |= self.lights;
        // Nothing was added, so that what was a map stays one.
        Arc::new(MapGraph::new(parts).expect("a map with less on it"))
    }

    /// The frame without the hidden inputs.
    pub(super) fn frame(self, frame: &Frame) -> Frame {
        let lights = match self.lights {
            true => Vec::new(),
            false => frame.lights().to_vec(),
        };
        let agents = frame.agents().iter().map(|agent| self.agent(*agent));
        Frame::new(agents.collect(), lights)
    }

    /// True if frames are not changed.
    pub(super) fn shows_frames(self) -> bool {
        !self.lights && !self.sizes
    }

    fn agent(self, agent: Agent) -> Agent {
        if !self.sizes {
            return agent;
        }
        let [length, width, height] = agent.kind.usual_size();
        Agent {
            length,
            width,
            height,
            ..agent
        }
    }
}
