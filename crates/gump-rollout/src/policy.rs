//! Policies, which control the ego.

use gump_scene::{AgentState, SceneState};

use crate::BoxError;

/// Controls the ego in a batch of scenes.
///
/// The batch keeps its order over the calls of one simulation, so a policy may keep state per row.
pub trait Policy {
    /// A short name for tables and reports.
    fn name(&self) -> &str;

    /// One command per scene.
    ///
    /// # Errors
    /// Any reason for which the policy cannot decide.
    fn act(&mut self, scenes: &[SceneState<'_>]) -> Result<Vec<Command>, BoxError>;
}

/// A command for the ego.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum Command {
    /// Follow these states; the first is `dt` seconds ahead, the others `dt` apart.
    Follow {
        /// Seconds between the states.
        dt: f64,
        /// Box-centre states in the world frame.
        states: Vec<AgentState>,
    },
    /// Constant acceleration and curvature until the next command.
    Drive {
        /// Along the heading, metres per second squared.
        acceleration: f64,
        /// Turn per metre driven, radians per metre, positive to the left.
        curvature: f64,
    },
}
