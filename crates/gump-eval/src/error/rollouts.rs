//! Files of rollouts or predictions that do not fit the scenarios.

use std::path::PathBuf;

use gump_data::Problem;

/// Why rollouts or predictions of files cannot be scored.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RolloutFileError {
    /// A file or folder has no rollouts.
    #[error("expected rollouts in files named *.binproto*, found none: {}", path.display())]
    NoFiles {
        /// The file or folder.
        path: PathBuf,
    },
    /// There are no rollouts of a scenario.
    #[error("expected rollouts of it, found none: {}", path.display())]
    NoRollouts {
        /// Id of the scenario.
        scenario: String,
        /// The file or folder.
        path: PathBuf,
    },
    /// There are no predictions of a scenario.
    #[error("expected predictions of scenario {scenario}, found none: {}", path.display())]
    NoPredictions {
        /// Id of the scenario.
        scenario: String,
        /// The file or folder.
        path: PathBuf,
    },
    /// There are two sets of rollouts of a scenario.
    #[error(
        "expected rollouts of scenario {scenario} once, found them in {} and {}",
        first.display(),
        second.display()
    )]
    RepeatedRollouts {
        /// Id of the scenario.
        scenario: String,
        /// A file that has some.
        first: PathBuf,
        /// Another one, or the same.
        second: PathBuf,
    },
    /// There are two sets of predictions of a scenario.
    #[error("expected scenario {scenario} once, found it twice: {}", path.display())]
    RepeatedPredictions {
        /// Id of the scenario.
        scenario: String,
        /// The file of the second.
        path: PathBuf,
    },
    /// There are predictions of a scenario that is not among those to be scored.
    #[error(
        "found predictions of \"{scenario}\", which is not among the scenarios: {}",
        path.display()
    )]
    UnknownScenario {
        /// Id of the scenario.
        scenario: String,
        /// The file or folder.
        path: PathBuf,
    },
    /// Rollouts or predictions of a scenario contradict themselves, or do not fit the scenario.
    #[error("scenario {scenario} of {}: {problem}", path.display())]
    Unusable {
        /// Id of the scenario.
        scenario: String,
        /// The file or folder.
        path: PathBuf,
        /// What is wrong with them.
        problem: Problem,
    },
    /// A file no longer has the rollouts that it had before.
    #[error("the file has changed: {}", path.display())]
    Changed {
        /// The file.
        path: PathBuf,
    },
}
