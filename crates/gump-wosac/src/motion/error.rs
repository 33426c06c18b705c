//! Errors in the predictions of a scenario.

use gump_scene::AgentId;

/// Predictions that do not fit their scenario.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("scenario {scenario}: {problem}")]
pub struct MotionError {
    /// The scenario's id.
    pub scenario: String,
    /// The mismatch.
    pub problem: MotionProblem,
}

/// A mismatch between predictions and scenario.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum MotionProblem {
    /// Positions of a path do not fall on recorded frames.
    #[error("expected frames that divide the {expected} s between positions, found {found} s")]
    TimeStep {
        /// Seconds between positions.
        expected: f64,
        /// Seconds between frames.
        found: f64,
    },
    /// The recording ends too early.
    #[error("expected {expected} recorded frames after the present, found {found}")]
    ShortLog {
        /// Frames needed.
        expected: usize,
        /// Frames present.
        found: usize,
    },
    /// An agent that should be predicted is not.
    #[error("expected a prediction of agent {0}, found none")]
    Missing(AgentId),
    /// A predicted agent is not a target.
    #[error("found a prediction of agent {0}, which is not to be predicted")]
    Unexpected(AgentId),
    /// An agent is predicted more than once.
    #[error("expected one prediction of agent {0}, found several")]
    Duplicate(AgentId),
    /// An agent is in no frame of the recording, so its kind is not known.
    #[error("agent {0} is to be predicted but is in no recorded frame")]
    NeverPresent(AgentId),
    /// An agent to be predicted is absent at the present.
    #[error("agent {0} is to be predicted but is absent in the present frame")]
    AbsentNow(AgentId),
    /// A prediction without agents.
    #[error("expected at least one agent in prediction {0}, found none")]
    NoAgents(usize),
    /// A prediction without modes.
    #[error("expected at least one mode for agent {0}, found none")]
    NoModes(AgentId),
    /// A mode does not have one path per agent.
    #[error(
        "expected {expected} paths in mode {mode} of the prediction of agent {agent}, found {found}"
    )]
    PathCount {
        /// The prediction's first agent.
        agent: AgentId,
        /// Index of the mode.
        mode: usize,
        /// Agents of the prediction.
        expected: usize,
        /// Paths of the mode.
        found: usize,
    },
    /// A path is too short or too long.
    #[error("expected {expected} positions in mode {mode} of agent {agent}, found {found}")]
    PathLength {
        /// The agent of the path.
        agent: AgentId,
        /// Index of the mode.
        mode: usize,
        /// Positions expected.
        expected: usize,
        /// Positions present.
        found: usize,
    },
    /// A position is NaN or infinite.
    #[error("position {step} in mode {mode} of agent {agent} is not a number")]
    Position {
        /// The agent of the path.
        agent: AgentId,
        /// Index of the mode.
        mode: usize,
        /// Index of the position.
        step: usize,
    },
    /// A confidence is NaN or infinite.
    #[error("the confidence of mode {mode} of agent {agent} is not a number")]
    Confidence {
        /// The prediction's first agent.
        agent: AgentId,
        /// Index of the mode.
        mode: usize,
    },
}
