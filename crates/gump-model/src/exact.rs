//! Exact states of objects, beside the bins of their tokens.
//!
//! A token rounds a position to 20 cm and a heading to 1.8 degrees. Chunks are expressed relative
//! to the exact pose (`local_frame`), so the local context must be computed from it as well: the
//! slots of a window carry both.

use std::collections::BTreeMap;

use gump_geometry::{DVec2, Pose, dvec2};
use gump_scene::{Agent, AgentState, Frame};
use gump_tokenizer::Identities;

/// An object at one instant, scene frame, metres, radians and metres per second.
///
/// f32 resolves micrometres within a scene, and gives the same numbers whether or not a state went
/// through the world frame, so that caches recognise a slot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Exact {
    place: [f32; 3],
    velocity: [f32; 2],
    size: [f32; 2],
    /// False if the source does not state the size.
    pub has_size: bool,
}

impl Exact {
    /// A state in the scene frame of an agent of this size.
    pub(crate) fn new(state: AgentState, agent: &Agent) -> Self {
        let Pose { position, heading } = state.pose;
        Self {
            place: [position.x as f32, position.y as f32, heading as f32],
            velocity: state.velocity.as_vec2().to_array(),
            size: [agent.length as f32, agent.width as f32],
            has_size: !agent.has_usual_size(),
        }
    }

    /// The same object in another state.
    pub fn with_state(self, state: AgentState) -> Self {
        let Pose { position, heading } = state.pose;
        Self {
            place: [position.x as f32, position.y as f32, heading as f32],
            velocity: state.velocity.as_vec2().to_array(),
            ..self
        }
    }

    pub(crate) fn pose(&self) -> Pose {
        let [x, y, heading] = self.place.map(f64::from);
        Pose::new(x, y, heading)
    }

    pub(crate) fn velocity(&self) -> DVec2 {
        let [x, y] = self.velocity.map(f64::from);
        dvec2(x, y)
    }

    /// Length and width.
    pub(crate) fn size(&self) -> [f64; 2] {
        self.size.map(f64::from)
    }
}

/// The objects of consecutive frames by the ids of their keys.
#[derive(Clone, Debug, Default)]
pub struct ExactFrames(Vec<BTreeMap<u16, Exact>>);

impl ExactFrames {
    /// The last `n` of these frames of the world; missing ones are empty.
    pub fn last(
        n: usize,
        frames: &[Frame],
        identities: &Identities,
        world_from_scene: Pose,
    ) -> Self {
        let scene_from_world = world_from_scene.inverse();
        let exact = |agent: &Agent| {
            let state = AgentState {
                pose: scene_from_world * agent.state.pose,
                velocity: scene_from_world.rotate(agent.state.velocity),
            };
            Some((identities.key(agent.id)?, Exact::new(state, agent)))
        };
        let of = |frame: &Frame| frame.agents().iter().filter_map(exact).collect();
        let known = frames.len().min(n);
        let unknown = std::iter::repeat_with(BTreeMap::new).take(n - known);
        Self(
            unknown
                .chain(frames[frames.len() - known..].iter().map(of))
                .collect(),
        )
    }

    /// The exact state of the object with this id in a frame.
    pub fn of(&self, frame: usize, id: u16) -> Option<Exact> {
        self.0.get(frame)?.get(&id).copied()
    }
}
