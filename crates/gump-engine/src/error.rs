//! Errors of this crate.

use gump_model::ModelError;

/// An error of a rollout of a learned world.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EngineError {
    /// The time step of a scene does not divide that of the network.
    #[error("scene: a time step of {dt} s does not divide {expected} s")]
    TimeStep {
        /// Of the scene, seconds.
        dt: f64,
        /// Of the network, seconds.
        expected: f64,
    },
    /// The tokens of a scene are not of the grammar.
    #[cfg(feature = "tensors")]
    #[error("scene: {0}")]
    Grammar(gump_tokenizer::GrammarError),
    /// A session was given states of another number of egos than it has futures.
    #[error("scene: {found} ego states for {futures} futures")]
    EgoStates {
        /// Number of states.
        found: usize,
        /// Number of futures.
        futures: usize,
    },
    /// The network has no trajectory heads.
    #[error("scene: the network has no trajectory heads")]
    NoTrajectoryHeads,
    /// The request needs the CPU implementation of the network, which a world on another device lacks.
    #[error("scene: {what} on a CPU only, and this world is elsewhere")]
    NotOnCpu {
        /// The request, as the beginning of a sentence: "traffic lives".
        what: &'static str,
    },
    /// The network failed, or its weights do not fit.
    #[error(transparent)]
    Model(#[from] ModelError),
}

#[cfg(feature = "tensors")]
impl From<candle_core::Error> for EngineError {
    fn from(error: candle_core::Error) -> Self {
        Self::Model(error.into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_of_the_network_is_told_as_it_is() {
        let error = EngineError::from(ModelError::Config {
            key: "heads",
            reason: "no heads".into(),
        });
        assert_eq!(error.to_string(), "configuration: no heads");
        let error = EngineError::TimeStep {
            dt: 0.3,
            expected: 0.5,
        };
        assert!(error.to_string().starts_with("scene: a time step of 0.3 s"));
    }
}
