//! Errors of environments, buffers and training.

use gump_rollout::BoxError;
use gump_scene::{AgentId, ScenarioError};

use crate::Algorithm;

/// Why an environment or a buffer could not do what was requested.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RlError {
    /// There are no scenarios to start an episode from.
    #[error("an environment needs at least one scenario")]
    NoScenario,
    /// A parameter outside its range.
    #[error("the parameter {name} is {value}, expected {expected}")]
    Parameter {
        /// Its name.
        name: &'static str,
        /// Its value.
        value: f64,
        /// The allowed range.
        expected: &'static str,
    },
    /// Stepping before the first reset, or after a step that failed.
    #[error("the environment has no episodes in progress, reset it first")]
    NotReset,
    /// A batch of another size than the environment's.
    #[error("{who} gave {found} values, expected {expected}")]
    Count {
        /// Name of the source of the values.
        who: &'static str,
        /// The required size.
        expected: usize,
        /// The given size.
        found: usize,
    },
    /// An action that is NaN or infinite.
    #[error("the action of row {row} is not a finite number")]
    NotFinite {
        /// The row.
        row: usize,
    },
    /// An action outside its box.
    #[error("number {dimension} of the action of row {row} is {value}, expected -1 to 1")]
    OutOfRange {
        /// The row.
        row: usize,
        /// The index within its action.
        dimension: usize,
        /// The value.
        value: f32,
    },
    /// Stepping an episode that has ended.
    #[error("the episode of row {row} has ended, reset the row first")]
    Finished {
        /// The row.
        row: usize,
    },
    /// A scenario that does not exist.
    #[error("row {row} asks for scenario {scenario}, but there are {n}")]
    NoSuchScenario {
        /// The row.
        row: usize,
        /// The requested scenario.
        scenario: usize,
        /// Number of scenarios.
        n: usize,
    },
    /// A scenario that cannot be driven in.
    #[error("the scenario {id} cannot be driven: {source}")]
    Scenario {
        /// Its id.
        id: String,
        /// The reason.
        source: ScenarioError,
    },
    /// The step is not a whole number of frames.
    #[error("a step takes {step} s, expected a multiple of the {frames} s between frames")]
    TimeStep {
        /// Seconds per step of the environment.
        step: f64,
        /// Seconds between the frames of the scenario or the world.
        frames: f64,
    },
    /// The world lost the ego.
    #[error("the world dropped the ego (agent {ego}) from row {row}")]
    EgoVanished {
        /// The ego.
        ego: AgentId,
        /// The row.
        row: usize,
    },
    /// The world failed.
    #[error("the world \"{world}\" failed: {source}")]
    World {
        /// Name of the world.
        world: String,
        /// Its error.
        source: BoxError,
    },
    /// Sampling from an empty buffer.
    #[error("cannot sample {requested} transitions from an empty buffer")]
    EmptyBuffer {
        /// The requested number.
        requested: usize,
    },
    /// An environment whose shapes differ from the policy's.
    #[error("the environment has {found} numbers in its {what}, the policy expects {expected}")]
    Shape {
        /// Observations or actions.
        what: &'static str,
        /// The policy's.
        expected: usize,
        /// The environment's.
        found: usize,
    },
    /// A convolutional encoder with observations that are not images.
    #[error("an encoder of pictures was asked for, but observations are {found} numbers")]
    NoPicture {
        /// Their length.
        found: usize,
    },
    /// An algorithm that another module implements.
    #[error("this run cannot learn by {algorithm}")]
    OtherAlgorithm {
        /// The algorithm.
        algorithm: Algorithm,
    },
    /// A number of a run is NaN or infinite.
    #[error("learning diverged at gradient step {step}: {what} is not finite")]
    Diverged {
        /// The gradient step, 0 before the first one; of PPO the round.
        step: usize,
        /// What is not finite.
        what: String,
    },
    /// Bytes that are not a stored policy or run.
    #[error("no policy or run of reinforcement learning: {what}")]
    Archive {
        /// The problem.
        what: String,
    },
}
