//! Errors of this crate.

use std::path::{Path, PathBuf};

use gump_data::DataError;
use gump_engine::EngineError;
use gump_model::ModelError;
use gump_planner::PlanError;
use gump_rollout::{BoxError, RolloutError};
use gump_wosac::motion::MotionError;
use gump_wosac::realism::WosacError;

/// An error of an evaluation's inputs or of its results.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EvalError {
    /// The request does not exist or contradicts itself.
    #[error("{0}")]
    Argument(String),
    /// A file of scenarios cannot be read.
    #[error(transparent)]
    Data(#[from] DataError),
    /// Weights cannot be read or do not fit the network.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// A learned world cannot be built or simulated.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// A recording cannot be driven through.
    #[error(transparent)]
    Drive(#[from] RolloutError),
    /// A planner cannot be built.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// A recording lacks information that driving requires.
    #[error("{0}")]
    Recording(String),
    /// Stored results are incomplete, or of different evaluations.
    #[error("{0}")]
    Results(String),
    /// A data set's manifest cannot be understood.
    #[error("{0}")]
    Dataset(String),
    /// A file is not a list of scenes, or scenes are missing or differ from the list.
    #[error("{0}")]
    Benchmark(String),
    /// Rollouts in files are missing, or there twice.
    #[error("{0}")]
    Rollouts(String),
    /// A log or rollouts that the realism metric is not defined on.
    #[error(transparent)]
    Realism(#[from] WosacError),
    /// Predictions that the motion metrics are not defined on.
    #[error(transparent)]
    Motion(#[from] MotionError),
    /// A world or a driver failed in a simulation.
    #[error(transparent)]
    Simulation(BoxError),
    /// The monitor wanted the work to end.
    #[error("stopped by Ctrl-C")]
    Stopped,
    /// As [`EvalError::Stopped`], with a store that the same evaluation resumes from.
    #[error("stopped by Ctrl-C; the same command resumes {from}")]
    StoppedAndStored {
        /// The place from which it resumes: "after scenario 7".
        from: String,
    },
    /// SUMO is missing, of another version than expected, or failed.
    #[error("{0}")]
    Sumo(String),
    /// An error with the place at which it occurred.
    #[error("{place}: {error}")]
    At {
        /// The file, record or scenario, or what could not be done.
        place: String,
        /// The error there.
        error: Box<EvalError>,
    },
    /// An input or output error of the operating system.
    #[error("cannot {doing} {}: {cause}", path.display())]
    Io {
        /// The operation: "list", "create", "write".
        doing: &'static str,
        /// The file or folder.
        path: PathBuf,
        /// The error of the system.
        cause: std::io::Error,
    },
}

impl EvalError {
    pub(crate) fn io(doing: &'static str, path: &Path, cause: std::io::Error) -> Self {
        Self::Io {
            doing,
            path: path.to_owned(),
            cause,
        }
    }

    /// The same error with its place.
    pub(crate) fn at(self, place: &impl std::fmt::Display) -> Self {
        Self::At {
            place: place.to_string(),
            error: Box::new(self),
        }
    }

    /// An error of a simulation, which may be one of this crate's that went through it.
    pub(crate) fn of_simulation(error: BoxError) -> Self {
        match error.downcast::<Self>() {
            Ok(own) => *own,
            Err(other) => Self::Simulation(other),
        }
    }

    /// The error itself, without the places around it.
    pub fn cause(&self) -> &Self {
        match self {
            Self::At { error, .. } => error.cause(),
            error => error,
        }
    }

    /// The error and what caused it, as one sentence.
    pub fn sentence(&self) -> String {
        sentence(self)
    }

    /// Whether a different argument, rather than a different file, would help.
    pub fn is_argument(&self) -> bool {
        matches!(
            self.cause(),
            Self::Argument(_)
                | Self::Data(DataError::NoSuchScenario { .. } | DataError::SeveralFiles { .. })
        )
    }
}

/// An error and what caused it, as one sentence.
pub(crate) fn sentence(error: &dyn std::error::Error) -> String {
    let mut sentence = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        sentence += &format!(": {error}");
        cause = error.source();
    }
    sentence
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sentence_names_the_cause_once() {
        let io = std::io::Error::other("disk full");
        let error = EvalError::io("write", Path::new("a"), io);
        assert_eq!(sentence(&error), "cannot write a: disk full");
        let error = EvalError::Stopped.at(&"scenario 3");
        assert_eq!(sentence(&error), "scenario 3: stopped by Ctrl-C");
        assert!(matches!(error.cause(), EvalError::Stopped));
    }
}
