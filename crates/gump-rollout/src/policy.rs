//! What decides for the ego.

use gump_scene::{AgentState, SceneState};

use crate::BoxError;

/// Decides for the ego, a batch of scenes at a time.
///
/// The batch keeps its order over the calls of one simulation, so a policy may remember per row.
pub trait Policy {
    /// A short name for tables and reports.
    fn name(&self) -> &str;

    /// One command per scene.
    ///
    /// # Errors
    /// Whatever keeps the policy from deciding.
    fn act(&mut self, scenes: &[SceneState<'_>]) -> Result<Vec<Command>, BoxError>;
}

/// What the ego should do next.
#[derive(Clone, Debug, PartialEq)]
pub enum Command {
    /// Follow these states; the first is `dt` seconds ahead, the others `dt` apart.
    Follow {
        /// Seconds between the states.
        dt: f64,
        /// Box-centre states in the world frame.
        states: Vec<AgentState>,
    },
    /// Hold these until the next command.
    Drive {
        /// Along the heading, metres per second squared.
        acceleration: f64,
        /// Turn per metre driven, radians per metre, positive to the left.
        curvature: f64,
    },
}
