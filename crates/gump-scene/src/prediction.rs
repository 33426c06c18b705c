//! Predictions: a few paths with confidences per agent, the form that motion prediction metrics
//! score.

use gump_geometry::DVec2;

use crate::AgentId;

/// A prediction for one agent, or jointly for several agents.
///
/// Plain data, like a [`Rollout`](crate::Rollout), so that a metric can score a file without
/// knowing how it was made.
#[derive(Clone, Debug, PartialEq)]
pub struct Prediction {
    /// The predicted agents; several agents are predicted jointly.
    pub agents: Vec<AgentId>,
    /// The possible modes, in the order of the predictor.
    pub modes: Vec<PredictedMode>,
}

/// One possible outcome.
#[derive(Clone, Debug, PartialEq)]
pub struct PredictedMode {
    /// The predictor's confidence; compared across scenes, not normalized.
    pub confidence: f64,
    /// A path per agent in the order of [`Prediction::agents`]: world-frame positions in metres,
    /// at even times after the present.
    pub paths: Vec<Vec<DVec2>>,
}
