//! Errors of this crate.

use gump_engine::EngineError;
use gump_model::{ModelConfig, ModelError};
use gump_rollout::BoxError;

/// An error of a training run.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TrainError {
    /// A value of the configuration is out of its range.
    #[error("configuration: {reason}")]
    Config {
        /// The key at fault, with those of its tables.
        key: &'static str,
        /// What is wrong with it.
        reason: String,
    },
    /// A configuration cannot be read from TOML.
    #[error("configuration: {0}")]
    Toml(toml::de::Error),
    /// A configuration cannot be written as JSON.
    #[error("configuration: {0}")]
    Json(serde_json::Error),
    /// A preset of the model that does not exist.
    #[error(
        "configuration: unknown model \"{name}\", expected one of {}",
        ModelConfig::PRESETS.join(", ")
    )]
    UnknownPreset {
        /// The name given.
        name: String,
    },
    /// No scene can be compared with its log, as rewards of realism need.
    #[error(
        "configuration: realism: no scene has the second of past and the eight seconds of future \
         at 10 Hz, the road edges and the agents that its rollouts are compared with, or none of \
         those has the lights that lit asks for"
    )]
    NoComparableScene,
    /// Training diverged.
    #[error(
        "the loss is not a number at step {step} (field {field}); the last checkpoint is intact"
    )]
    LossNotFinite {
        /// Optimiser step.
        step: usize,
        /// First loss that is not finite.
        field: String,
    },
    /// The loss is finite and its gradient is not.
    #[error("the gradient is not a number at step {step}; the last checkpoint is intact")]
    GradientNotFinite {
        /// Optimiser step.
        step: usize,
    },
    /// The network has moved further from that at the start of the run than it may.
    #[error(
        "the divergence from the network at the start of the run is {divergence:.4} nats a move at \
         step {step}, above kl_bound {bound}; the last checkpoint is intact"
    )]
    TooFar {
        /// Optimiser step.
        step: usize,
        /// Mean over the rewarded moves of the step, nats.
        divergence: f64,
        /// The bound of the configuration.
        bound: f64,
    },
    /// There is nothing to train on.
    #[error("no scenario offers {frames} consecutive frames at 2 Hz to train on")]
    NoData {
        /// Frames a sample needs.
        frames: usize,
    },
    /// A run is resumed with other scenarios than it began with.
    #[error("the run to resume began with other data: {begun}, found {found}")]
    OtherData {
        /// [`identity`](crate::ScenarioSource::identity) of those it began with.
        begun: String,
        /// That of the scenarios given.
        found: String,
    },
    /// Processes cannot train together, or one of them failed.
    #[error("processes that train together: {0}")]
    ProcessGroup(#[from] ProcessGroupError),
    /// A scenario has no frames at the rate of samples.
    #[error("scene: {id} has a frame every {dt} s, expected a time step that divides {expected} s")]
    TimeStep {
        /// The scenario's id.
        id: String,
        /// Its time step, seconds.
        dt: f64,
        /// That of samples, seconds.
        expected: f64,
    },
    /// A source of scenarios cannot read one.
    #[error("scene: {0}")]
    Source(BoxError),
    /// A rollout that samples are made of failed.
    #[error("scene: {0}")]
    Rollout(BoxError),
    /// A world in training failed.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// The network failed, or a checkpoint cannot be read or written.
    #[error(transparent)]
    Model(#[from] ModelError),
}

/// Why processes do not train together.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ProcessGroupError {
    /// This process has joined the others before.
    #[error("MPI can be joined once by a process, and was before")]
    AlreadyJoined,
    /// Another process could not draw its samples, so this one stops, too.
    #[error("another one could not draw its samples")]
    NoSamples,
    /// The connection to another process failed.
    #[error("{0}")]
    Connection(BoxError),
}

impl From<candle_core::Error> for TrainError {
    fn from(error: candle_core::Error) -> Self {
        Self::Model(error.into())
    }
}

impl From<gump_nn::NnError> for TrainError {
    fn from(error: gump_nn::NnError) -> Self {
        Self::Model(error.into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_from_below_are_told_as_they_are() {
        let error = TrainError::from(gump_nn::NnError::Config {
            key: "drop",
            reason: "odd".into(),
        });
        assert_eq!(error.to_string(), "configuration: odd");
        let error = TrainError::Source("rotten".into());
        assert_eq!(error.to_string(), "scene: rotten");
        assert!(std::error::Error::source(&error).is_none());
    }
}
