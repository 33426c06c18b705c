//! Recordings that lack information.

use std::fmt;
use std::path::PathBuf;

use gump_data::Problem;
use gump_data::nuplan::Token;

/// What a recording lacks for an evaluation.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RecordingError {
    /// There is no path to read scenarios from.
    #[error("expected scenarios, found none")]
    NoScenarios,
    /// The logs have no tagged scenario.
    #[error("expected tagged scenarios, found none in the logs")]
    NoTaggedScenarios {
        /// The logs.
        logs: Vec<PathBuf>,
    },
    /// A message of Waymo's is not a usable scenario.
    #[error("{0}")]
    Unusable(Problem),
    /// A scenario of a nuPlan log is not usable.
    #[error("{}, scenario {token}: {problem}", log.display())]
    UnusableInLog {
        /// The log.
        log: PathBuf,
        /// Token of the scenario.
        token: Token,
        /// What is wrong with it.
        problem: Problem,
    },
    /// The map has no lanes.
    #[error("scenario {scenario}: expected a map with lanes to {purpose} on, found none")]
    NoLanes {
        /// Id of the scenario.
        scenario: String,
        /// What the lanes are needed for.
        purpose: LanePurpose,
    },
    /// Predictive samples are requested of a world that follows rules.
    #[error("a world that follows rules draws nothing")]
    NoPredictiveSamples,
}

/// What the lanes of a map are needed for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum LanePurpose {
    /// A world whose traffic follows lanes.
    Drive,
    /// Planners, and the scores of their drives.
    Plan,
}

impl fmt::Display for LanePurpose {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Drive => "drive",
            Self::Plan => "plan",
        })
    }
}
