//! What can go wrong between an environment and who uses it.

use gump_rollout::BoxError;
use gump_scene::AgentId;

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
    /// More or fewer answers than slots.
    #[error("{who} gave {found} answers for {expected} slots")]
    Count {
        /// Who answered.
        who: &'static str,
        /// Slots in the environment.
        expected: usize,
        /// Answers received.
        found: usize,
    },
    /// An action that is NaN or infinite.
    #[error("the action of slot {slot} is not a finite number")]
    NotFinite {
        /// Which slot.
        slot: usize,
    },
    /// The world's time step cannot be divided into steps of the scenario.
    #[error("the world steps by {session} s, which is not a multiple of the scenario's {scene} s")]
    TimeStep {
        /// Seconds between the frames of the world.
        session: f64,
        /// Seconds between the frames of the scenario.
        scene: f64,
    },
    /// The world lost the ego.
    #[error("the world dropped the ego (agent {ego}) from slot {slot}")]
    EgoVanished {
        /// The ego.
        ego: AgentId,
        /// Which slot.
        slot: usize,
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
