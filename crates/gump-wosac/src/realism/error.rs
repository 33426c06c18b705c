//! Errors in logs and rollouts; every message names scenario, agent and field.

use gump_scene::AgentId;

/// Why rollouts cannot be scored.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[allow(missing_docs, reason = "the sentences name the fields")]
#[non_exhaustive]
pub enum WosacError {
    /// A track of the log has another number of steps.
    #[error(
        "scenario {scenario}: expected {expected} logged steps of agent {agent}, found {found}"
    )]
    LoggedSteps {
        scenario: String,
        agent: AgentId,
        expected: usize,
        found: usize,
    },
    /// The log is too short around its present, or of another rate.
    #[error("scenario {scenario}: expected {expected}, found {found}")]
    Clock {
        scenario: String,
        expected: &'static str,
        found: String,
    },
    /// A logged state marked valid is not a number, or has no extent.
    #[error(
        "scenario {scenario}: expected {expected} as {field} of agent {agent} \
         at logged step {step}, found {value}"
    )]
    LoggedState {
        scenario: String,
        agent: AgentId,
        field: &'static str,
        expected: &'static str,
        step: usize,
        value: f32,
    },
    /// Two tracks of the log have the same id.
    #[error("scenario {scenario}: expected every agent once in the log, found {agent} twice")]
    LoggedTwice { scenario: String, agent: AgentId },
    /// The ego or a target has no track.
    #[error("scenario {scenario}: expected a track of {role} {agent}, found none")]
    NoTrack {
        scenario: String,
        role: &'static str,
        agent: AgentId,
    },
    /// No ego was given.
    #[error("scenario {scenario}: expected an ego, found none")]
    NoEgo { scenario: String },
    /// An agent to be scored is absent at the present step.
    #[error(
        "scenario {scenario}: expected agent {agent}, which is to be scored, to be valid at the \
         present step, found it invalid"
    )]
    AbsentNow { scenario: String, agent: AgentId },
    /// A map without road edges; the reference fails on it too.
    #[error(
        "scenario {scenario}: expected at least one road edge of two points, found none in the map"
    )]
    NoRoadEdges { scenario: String },
    /// A coordinate of the map is not a number.
    #[error("scenario {scenario}: expected finite points in {feature}, found {value}")]
    Map {
        scenario: String,
        feature: &'static str,
        value: f32,
    },
    /// Rollouts of another scenario.
    #[error("expected rollouts of scenario {expected}, found those of {found}")]
    OtherScenario { expected: String, found: String },
    /// Nothing to score.
    #[error("scenario {scenario}: expected at least one rollout, found none")]
    NoRollouts { scenario: String },
    /// An agent that must be simulated is not.
    #[error("scenario {scenario}, rollout {rollout}: agent {agent} is missing")]
    Missing {
        scenario: String,
        rollout: usize,
        agent: AgentId,
    },
    /// An agent that is absent at the present step.
    #[error(
        "scenario {scenario}, rollout {rollout}: agent {agent} is not valid at the present step \
         of the log"
    )]
    Extra {
        scenario: String,
        rollout: usize,
        agent: AgentId,
    },
    /// An agent is simulated twice.
    #[error("scenario {scenario}, rollout {rollout}: expected agent {agent} once, found it twice")]
    Twice {
        scenario: String,
        rollout: usize,
        agent: AgentId,
    },
    /// A trajectory of the wrong length.
    #[error(
        "scenario {scenario}, rollout {rollout}: expected {expected} steps in {field} of agent \
         {agent}, found {found}"
    )]
    Steps {
        scenario: String,
        rollout: usize,
        agent: AgentId,
        field: &'static str,
        expected: usize,
        found: usize,
    },
    /// A simulated number is not finite.
    #[error(
        "scenario {scenario}, rollout {rollout}: expected a number in {field} of agent {agent} at \
         step {step}, found {value}"
    )]
    NotFinite {
        scenario: String,
        rollout: usize,
        agent: AgentId,
        field: &'static str,
        step: usize,
        value: f32,
    },
}
