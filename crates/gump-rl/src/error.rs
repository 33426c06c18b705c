//! What can go wrong between an environment and who uses it.

use gump_rollout::BoxError;
use gump_scene::{AgentId, ScenarioError};

/// Why an environment or a buffer could not do what was asked.
#[derive(Debug, thiserror::Error)]
pub enum RlError {
    /// There is nothing to start an episode from.
    #[error("an environment needs at least one scenario")]
    NoScenario,
    /// A parameter outside its range.
    #[error("the parameter {name} is {value}, expected {expected}")]
    Parameter {
        /// Which one.
        name: &'static str,
        /// What was given.
        value: f64,
        /// What is allowed.
        expected: &'static str,
    },
    /// Stepping before the first reset, or after a step that failed.
    #[error("the environment has no episodes in progress, reset it first")]
    NotReset,
    /// A batch of another size than the environment's.
    #[error("{who} gave {found} values, expected {expected}")]
    Count {
        /// Who answered.
        who: &'static str,
        /// What the environment needs.
        expected: usize,
        /// What it got.
        found: usize,
    },
    /// An action that is NaN or infinite.
    #[error("the action of row {row} is not a finite number")]
    NotFinite {
        /// Which row.
        row: usize,
    },
    /// An action outside its box.
    #[error("number {dimension} of the action of row {row} is {value}, expected -1 to 1")]
    OutOfRange {
        /// Which row.
        row: usize,
        /// Which number of its action.
        dimension: usize,
        /// What was given.
        value: f32,
    },
    /// Stepping an episode that has ended.
    #[error("the episode of row {row} has ended, reset the row first")]
    Finished {
        /// Which row.
        row: usize,
    },
    /// A scenario that does not exist.
    #[error("row {row} asks for scenario {scenario}, but there are {n}")]
    NoSuchScenario {
        /// Which row.
        row: usize,
        /// What it asked for.
        scenario: usize,
        /// How many there are.
        n: usize,
    },
    /// A scenario that nobody can drive through.
    #[error("the scenario {id} cannot be driven: {source}")]
    Scenario {
        /// Its id.
        id: String,
        /// Why.
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
        /// Which row.
        row: usize,
    },
    /// The world failed.
    #[error("the world \"{world}\" failed: {source}")]
    World {
        /// Name of the world.
        world: String,
        /// What it reported.
        source: BoxError,
    },
    /// Sampling from a buffer that holds nothing.
    #[error("cannot sample {asked} transitions from an empty buffer")]
    EmptyBuffer {
        /// How many were asked for.
        asked: usize,
    },
    /// An environment of another shape than a policy.
    #[error("the environment has {found} numbers in its {what}, the policy expects {expected}")]
    Shape {
        /// Observations or actions.
        what: &'static str,
        /// The policy's.
        expected: usize,
        /// The environment's.
        found: usize,
    },
    /// A convolutional encoder over observations that are no pictures.
    #[error("an encoder of pictures was asked for, but observations are {found} numbers")]
    NoPicture {
        /// How many.
        found: usize,
    },
    /// Learning left the realm of numbers.
    #[error("learning diverged at gradient step {step}: a loss is not a finite number")]
    Diverged {
        /// Which gradient step.
        step: usize,
    },
    /// Bytes that are no stored policy or run.
    #[error("no policy or run of reinforcement learning: {what}")]
    Archive {
        /// What is wrong with them.
        what: String,
    },
}
