//! Errors of this crate.

use std::path::{Path, PathBuf};

use gump_data::DataError;
use gump_model::ModelError;
use gump_planner::PlanError;
use gump_rollout::RolloutError;

/// An error of an evaluation's inputs or of its results.
#[derive(Debug, thiserror::Error)]
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

    /// Whether a different argument, rather than a different file, would help.
    pub fn is_argument(&self) -> bool {
        matches!(
            self,
            Self::Argument(_)
                | Self::Data(DataError::NoSuchScenario { .. } | DataError::SeveralFiles { .. })
        )
    }
}
