//! Stored results that are incomplete, damaged, or of different evaluations.

use std::path::PathBuf;

use crate::results::Header;
use crate::shard::Shard;

/// Why stored results cannot be written, read or merged.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ResultsError {
    /// Results contain something that TOML has no form for.
    #[error("results that TOML cannot hold: {0}")]
    Unwritable(toml::ser::Error),
    /// A folder has no finished results.
    #[error("expected a finished evaluation, cannot read {}: {cause}", path.display())]
    Unfinished {
        /// The file that they would be in.
        path: PathBuf,
        /// The error of the system.
        cause: std::io::Error,
    },
    /// A file is not TOML, or its tables are not those of the benchmark.
    #[error("expected the scenarios of an evaluation in {}: {cause}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// The parser's error, with the line.
        cause: Box<toml::de::Error>,
    },
    /// A file does not say which evaluation its results are of.
    #[error("expected a table evaluation in {}", path.display())]
    NoHeader {
        /// The file.
        path: PathBuf,
    },
    /// There is nothing to merge.
    #[error("expected at least one folder")]
    NoFolders,
    /// The results of a shard are there twice.
    #[error(
        "expected every shard once, found {shard} in {} and {}",
        first.display(),
        second.display()
    )]
    RepeatedShard {
        /// The shard.
        shard: Shard,
        /// A folder of its results.
        first: PathBuf,
        /// Another one.
        second: PathBuf,
    },
    /// A scenario belongs to another shard than that of its file.
    #[error("scenario {index} is not of shard {shard}: {}", folder.display())]
    ForeignScenario {
        /// Position among all scenarios.
        index: usize,
        /// The shard of the file.
        shard: Shard,
        /// Its folder.
        folder: PathBuf,
    },
    /// Not all shards are there.
    #[error("expected all {n} shards, missing are {missing:?}")]
    MissingShards {
        /// Number of shards.
        n: usize,
        /// Those that are missing, from 1.
        missing: Vec<usize>,
    },
    /// Two folders have results of different evaluations.
    #[error(
        "expected shards of one evaluation, found {} {} of {} in {} but {} {} of {} in {}",
        expected.benchmark,
        expected.settings,
        expected.shard.n,
        expected_in.display(),
        found.benchmark,
        found.settings,
        found.shard.n,
        found_in.display()
    )]
    DifferentEvaluations {
        /// The evaluation of the first folder.
        expected: Box<Header>,
        /// The first folder.
        expected_in: PathBuf,
        /// The evaluation of another folder.
        found: Box<Header>,
        /// That folder.
        found_in: PathBuf,
    },
    /// A count is of a measure or a class that is not known.
    #[error("expected a known measure and class in the ledger, found {measure} of {class}")]
    UnknownCount {
        /// Name of the measure.
        measure: String,
        /// Name of the class.
        class: String,
    },
    /// A score of predictions contains an unknown word.
    #[error("{found} is no {expected}")]
    UnknownWord {
        /// What it should name: "class", "shape" or "match".
        expected: &'static str,
        /// The word.
        found: String,
    },
    /// A score of predictions has too few or too many matches.
    #[error("expected {expected} matches, found {found}")]
    MatchCount {
        /// Number of modes.
        expected: usize,
        /// Number of matches.
        found: usize,
    },
    /// In no scenario can the ego leave its log.
    #[error(
        "expected a scenario in which the ego can leave its log, found none among {scenarios}: \
         most often {}",
        reason.as_deref().unwrap_or("there was nothing to try")
    )]
    NoManoeuvre {
        /// Number of scenarios.
        scenarios: usize,
        /// The most frequent reason.
        reason: Option<String>,
    },
}
