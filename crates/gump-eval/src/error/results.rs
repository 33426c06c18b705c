//! Stored results that are incomplete, damaged, or of different evaluations.

use std::collections::BTreeSet;
use std::path::PathBuf;

use crate::results::{CHECKSUMS, Header};
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
    /// A folder already has another shard of the evaluation that is to be written to it.
    #[error(
        "expected a folder for shard {requested} alone, found shard {stored} of the same \
         evaluation in {}: give every shard its own --out",
        path.display()
    )]
    OtherShard {
        /// The file of its results.
        path: PathBuf,
        /// The shard whose results it has.
        stored: Shard,
        /// The shard that was to be written.
        requested: Shard,
    },
    /// A folder has a shard of another evaluation than the one that is to be written to it.
    #[error(
        "expected a folder without other results, found shard {} of another evaluation in {} ({}): \
         choose another --out",
        stored.shard,
        path.display(),
        differences(stored, requested)
    )]
    ForeignShard {
        /// The file of its results.
        path: PathBuf,
        /// The evaluation whose results it has.
        stored: Box<Header>,
        /// The evaluation that was to be written.
        requested: Box<Header>,
    },
    /// A scenario is in a shard twice.
    #[error("expected every scenario once, found scenario {index} twice in {}", folder.display())]
    RepeatedScenario {
        /// Position among all scenarios.
        index: usize,
        /// Folder of the shard.
        folder: PathBuf,
    },
    /// Shards have the same settings, but read other scenarios or weights under the same names.
    #[error(
        "expected shards that read the same, found {input} of checksum {expected} in {} but of \
         {found} in {}",
        expected_in.display(),
        found_in.display()
    )]
    DifferentInputs {
        /// What differs: "scenario_ids", or a world with its weights.
        input: String,
        /// Its checksum in the first folder that has one.
        expected: String,
        /// That folder.
        expected_in: PathBuf,
        /// Its checksum in another folder.
        found: String,
        /// That folder.
        found_in: PathBuf,
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
    #[error("expected all {n} shards, missing {}", listed(missing, *n))]
    MissingShards {
        /// Number of shards.
        n: usize,
        /// Those that are missing, from 1.
        missing: Vec<usize>,
    },
    /// Two folders have results of different evaluations.
    #[error(
        "expected shards of one evaluation, but {} and {} differ: {}",
        expected_in.display(),
        found_in.display(),
        differences(expected, found)
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
    #[error("expected a known measure and class in the results, found {measure} of {class}")]
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

/// Shards by their numbers: "shard 2/3", or "shards 2/3 and 3/3".
fn listed(missing: &[usize], n: usize) -> String {
    let names: Vec<String> = missing.iter().map(|k| format!("{k}/{n}")).collect();
    match names.as_slice() {
        [one] => format!("shard {one}"),
        [most @ .., last] => format!("shards {} and {last}", most.join(", ")),
        [] => "none".into(),
    }
}

/// What keeps two headers from being of one evaluation: names, and the values of both.
fn differences(a: &Header, b: &Header) -> String {
    let value = |header: &Header, name: &str| {
        let value = header.settings.get(name);
        value.map_or_else(|| "nothing".to_owned(), ToString::to_string)
    };
    let names: BTreeSet<&String> = a.settings.keys().chain(b.settings.keys()).collect();
    let settings = names.into_iter().filter(|name| *name != CHECKSUMS);
    let settings = settings.map(|name| (name.as_str(), value(a, name), value(b, name)));
    let [n, other_n] = [a, b].map(|header| header.shard.n.to_string());
    let all = [
        ("benchmark", a.benchmark.clone(), b.benchmark.clone()),
        ("number of shards", n, other_n),
    ];
    let differing = all.into_iter().chain(settings).filter(|(_, a, b)| a != b);
    let differing = differing.map(|(name, a, b)| format!("{name} {a} and {b}"));
    differing.collect::<Vec<_>>().join("; ")
}
