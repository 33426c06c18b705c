//! Where agents may go: a few paths with confidences, the form motion prediction is judged in.

use gump_geometry::DVec2;

use crate::AgentId;

/// A forecast for one agent, or for several agents together.
///
/// Plain data, like a [`Rollout`](crate::Rollout), so that a metric can score a file without
/// knowing how it was made.
#[derive(Clone, Debug, PartialEq)]
pub struct Prediction {
    /// Whose forecast; several agents are forecast jointly.
    pub agents: Vec<AgentId>,
    /// What may happen, in the order of the forecaster.
    pub modes: Vec<PredictedMode>,
}

/// One way things may go.
#[derive(Clone, Debug, PartialEq)]
pub struct PredictedMode {
    /// How sure the forecaster is; compared across scenes, not normalized.
    pub confidence: f64,
    /// A path per agent in the order of [`Prediction::agents`]: world-frame positions in metres,
    /// at even times after the present.
    pub paths: Vec<Vec<DVec2>>,
}
