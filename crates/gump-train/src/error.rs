//! Errors of this crate.

use gump_engine::EngineError;
use gump_model::ModelError;
use gump_rollout::BoxError;

/// An error of a training run.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TrainError {
    /// A number of the configuration is out of its range, or a key is unknown.
    #[error("configuration: {0}")]
    Config(String),
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
    /// There is nothing to train on.
    #[error("no scenario offers {frames} consecutive frames at 2 Hz to train on")]
    NoData {
        /// Frames a sample needs.
        frames: usize,
    },
    /// Processes that train together lost their connection.
    #[error("processes that train together: {0}")]
    Peers(String),
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
        let error = TrainError::from(gump_nn::NnError::Config("odd".into()));
        assert_eq!(error.to_string(), "configuration: odd");
        let error = TrainError::Source("rotten".into());
        assert_eq!(error.to_string(), "scene: rotten");
        assert!(std::error::Error::source(&error).is_none());
    }
}
