//! Errors of this crate: [`EvalError`], and what its kinds say in detail.
//!
//! A cause that is part of a sentence is a field of its error and not its `source()`, so that it is
//! there once where an error is printed with everything that caused it.

mod argument;
mod benchmark;
mod recording;
mod results;
mod rollouts;
mod sumo;

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

use gump_data::{DataError, RecordLocation};
use gump_engine::EngineError;
use gump_model::ModelError;
use gump_planner::PlanError;
use gump_rollout::{BoxError, RolloutError};
use gump_synthesis::GENERATOR_VERSION;
use gump_wosac::motion::MotionError;
use gump_wosac::realism::WosacError;

pub use argument::{ArgumentError, HeadlessNetwork, ShardError};
pub use benchmark::{BenchmarkError, PartProblem};
pub use recording::{LanePurpose, RecordingError};
pub use results::ResultsError;
pub use rollouts::RolloutFileError;
pub use sumo::SumoError;

/// An error of an evaluation's inputs or of its results.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EvalError {
    /// The request does not exist or contradicts itself.
    #[error(transparent)]
    Argument(#[from] ArgumentError),
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
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// Stored results are incomplete, or of different evaluations.
    #[error(transparent)]
    Results(#[from] ResultsError),
    /// A data set's manifest cannot be understood.
    #[error("{}: {}", path.display(), cause.message())]
    Dataset {
        /// The manifest.
        path: PathBuf,
        /// The parser's error.
        cause: Box<toml::de::Error>,
    },
    /// A file is not a list of scenes, or scenes are missing or differ from the list.
    #[error(transparent)]
    Benchmark(#[from] BenchmarkError),
    /// Rollouts or predictions in files are missing, there twice, or do not fit their scenarios.
    #[error(transparent)]
    Rollouts(#[from] RolloutFileError),
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
        /// The place from which it resumes.
        from: ResumePoint,
    },
    /// SUMO is missing, of another version than expected, or failed.
    #[error(transparent)]
    Sumo(#[from] SumoError),
    /// An error with the place at which it occurred.
    #[error("{place}: {error}")]
    At {
        /// The record or scenario, or what could not be done.
        place: ErrorContext,
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
        cause: io::Error,
    },
}

/// Where an evaluation that was stopped resumes; the position is that among all scenarios.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum ResumePoint {
    /// After the scenario of this position, which is done.
    After(usize),
    /// From the scenario of this position on.
    From(usize),
    /// With the scenarios that are not done; several are worked on at a time.
    Remaining,
}

impl fmt::Display for ResumePoint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::After(index) => write!(f, "after scenario {index}"),
            Self::From(index) => write!(f, "from scenario {index} on"),
            Self::Remaining => f.write_str("where this one stopped"),
        }
    }
}

/// The place at which an error occurred, or the work that it ended.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum ErrorContext {
    /// A record of a file.
    Record(RecordLocation),
    /// A scenario.
    Scenario {
        /// Its id.
        id: String,
    },
    /// The evaluation of a scenario.
    Evaluation {
        /// Id of the scenario.
        id: String,
    },
    /// A file in which predictions or rollouts are expected.
    Predictions,
    /// The making of a part of a list.
    Making {
        /// Name of the part.
        part: String,
    },
    /// The comparison of scenes that were made again with the checksums of their list.
    Remaking {
        /// The generator, with its version.
        generator: String,
    },
}

impl fmt::Display for ErrorContext {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Record(location) => location.fmt(f),
            Self::Scenario { id } => write!(f, "scenario {id}"),
            Self::Evaluation { id } => write!(f, "cannot evaluate scenario {id}"),
            Self::Predictions => f.write_str(
                "expected a MotionChallengeSubmission, a ScenarioRollouts or a \
                 SimAgentsChallengeSubmission",
            ),
            Self::Making { part } => write!(f, "cannot make the part {part}"),
            Self::Remaking { generator } => write!(
                f,
                "scenes of {generator} come out otherwise than they were frozen (newest version: \
                 {GENERATOR_VERSION})"
            ),
        }
    }
}

impl EvalError {
    pub(crate) fn io(doing: &'static str, path: &Path, cause: io::Error) -> Self {
        Self::Io {
            doing,
            path: path.to_owned(),
            cause,
        }
    }

    /// The same error with its place.
    pub(crate) fn at(self, place: ErrorContext) -> Self {
        Self::At {
            place,
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

    /// Whether a different argument, rather than a different file, would help: there is no file of
    /// the name either.
    pub fn is_argument(&self) -> bool {
        let is_missing = |cause: &io::Error| cause.kind() == io::ErrorKind::NotFound;
        match self.cause() {
            Self::Argument(_)
            | Self::Benchmark(BenchmarkError::NoSuchSplit { .. })
            | Self::Data(
                DataError::NoSuchScenario { .. }
                | DataError::SeveralFiles { .. }
                | DataError::Missing { .. },
            ) => true,
            Self::Io { cause, .. } | Self::Model(ModelError::Io { cause, .. }) => is_missing(cause),
            _ => false,
        }
    }
}

/// An error and what caused it, as one sentence. Causes that many errors quote are there once.
pub(crate) fn sentence(error: &dyn std::error::Error) -> String {
    let mut sentence = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        let text = error.to_string();
        if !sentence.contains(&text) {
            sentence = format!("{sentence}: {text}");
        }
        cause = error.source();
    }
    sentence
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sentence_names_the_cause_once() {
        let io = io::Error::other("disk full");
        let error = EvalError::io("write", Path::new("a"), io);
        assert_eq!(sentence(&error), "cannot write a: disk full");
        let scenario = ErrorContext::Scenario { id: "3".into() };
        let error = EvalError::Stopped.at(scenario);
        assert_eq!(sentence(&error), "scenario 3: stopped by Ctrl-C");
        assert!(matches!(error.cause(), EvalError::Stopped));
    }

    #[test]
    fn parts_of_an_error_are_read_without_its_sentence() {
        let error = "tram".parse::<crate::worlds::WorldName>().unwrap_err();
        assert!(error.is_argument());
        let EvalError::Argument(ArgumentError::NoSuchWorld { found, is_path }) = &error else {
            panic!("{error:?}");
        };
        assert_eq!((&**found, *is_path), ("tram", false));
        let expected = "expected log, idm, constant-velocity or model:WEIGHTS";
        assert_eq!(error.to_string(), expected);

        let missing = io::Error::from(io::ErrorKind::NotFound);
        assert!(EvalError::io("read the list", Path::new("a"), missing).is_argument());
        let missing = DataError::Missing { path: "a".into() };
        assert!(EvalError::from(missing).is_argument());

        let error = EvalError::from(ResultsError::Unfinished {
            path: "out/scenarios.toml".into(),
            cause: io::Error::other("not there"),
        });
        let error = error.at(ErrorContext::Making { part: "a".into() });
        assert!(!error.is_argument());
        assert_eq!(
            sentence(&error),
            "cannot make the part a: expected a finished evaluation, cannot read \
             out/scenarios.toml: not there"
        );

        let problem = PartProblem::Density { found: 5.0 };
        let found = "expected a density from 0.1 to 3, found Some(5.0)";
        assert_eq!(problem.to_string(), found);
        let split = |found: Option<&str>| BenchmarkError::NoSuchSplit {
            list: "l.toml".into(),
            expected: crate::datasets::Split::ALL[..2].to_vec(),
            found: found.map(str::to_owned),
        };
        let expected = "expected l.toml#SPLIT with train or tune, found l.toml";
        assert_eq!(split(None).to_string(), expected);
        assert_eq!(split(Some("x")).to_string(), format!("{expected}#x"));
    }
}
