//! Lists of scenes that cannot be understood, and scenes that are not as a list says.

use std::path::PathBuf;

use gump_data::{Problem, RecordLocation};
use gump_synthesis::GENERATOR_VERSION;

use crate::benchmarks::RESERVED_SEEDS;
use crate::datasets::Split;

/// Why a list cannot be used, or scenes are not those of a list.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BenchmarkError {
    /// A file is not a list.
    #[error(
        "expected a list of scenes, found in line {line} of {}: {}",
        path.display(),
        cause.message().replace('\n', ", ")
    )]
    Malformed {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        /// The parser's error.
        cause: Box<toml::de::Error>,
    },
    /// A part of a list contradicts itself.
    #[error("part {part} of {}: {problem}", list.display())]
    Part {
        /// Name of the part.
        part: String,
        /// Path of the list.
        list: PathBuf,
        /// What is wrong with it.
        problem: PartProblem,
    },
    /// A recorded scene of a list is not `SHA256 FILE [ID]`.
    #[error("expected \"SHA256 FILE [ID]\", found \"{found}\"")]
    SceneLine {
        /// The line.
        found: String,
    },
    /// A list has no scenes of the requested split, or has several splits and none is requested.
    #[error(
        "expected {path}#SPLIT with {}, found {path}{}",
        expected.iter().map(|split| split.name()).collect::<Vec<_>>().join(" or "),
        found.as_ref().map(|split| format!("#{split}")).unwrap_or_default(),
        path = list.display()
    )]
    NoSuchSplit {
        /// Path of the list.
        list: PathBuf,
        /// The splits that it has.
        expected: Vec<Split>,
        /// The requested split.
        found: Option<String>,
    },
    /// A generator or a version that this build does not have.
    #[error(
        "expected the generator procedural/N or sumo/N with N from 1 to {GENERATOR_VERSION}, \
         found {found}"
    )]
    NoSuchGenerator {
        /// The name, with its version.
        found: String,
    },
    /// The generated scenes of a list have not been made.
    #[error(
        "expected scenes of the list {name} at {}, found none: \
         `cargo xtask data benchmark --list {}` makes them",
        path.display(),
        list.display()
    )]
    NotMade {
        /// Name of the list.
        name: String,
        /// The missing file.
        path: PathBuf,
        /// Path of the list.
        list: PathBuf,
    },
    /// A recorded scene of a list is not in the folder of recorded data.
    #[error(
        "expected the recorded scene {scene} of the list {name}, found no file {}; \
         GUMP_RECORDED names the folder of recorded data",
        path.display()
    )]
    NotRecorded {
        /// Its id, or its file where that holds several.
        scene: String,
        /// Name of the list.
        name: String,
        /// The missing file.
        path: PathBuf,
    },
    /// A list has no checksums of a part to verify.
    #[error(
        "expected sums of the part {part} in {}, found none: `data benchmark --freeze` writes \
         those of a new list",
        list.display()
    )]
    NoChecksums {
        /// Name of the part.
        part: String,
        /// Path of the list.
        list: PathBuf,
    },
    /// Scenes are to be drawn from a list without checksums.
    #[error("expected a list with sums, found a part without: `data benchmark --freeze`")]
    DrawWithoutChecksums {
        /// Name of the list.
        name: String,
    },
    /// No scene of a list satisfies the rule of a draw.
    #[error("no scene of {name} may be drawn")]
    NothingToDraw {
        /// Name of the list.
        name: String,
    },
    /// A network that scenes are made on has another checksum.
    #[error("expected a network of SHA-256 {expected}, found {found}: {}", path.display())]
    NetworkChecksum {
        /// SHA-256 of the list.
        expected: String,
        /// SHA-256 of the file.
        found: String,
        /// The file.
        path: PathBuf,
    },
    /// A file of recorded scenes has another checksum.
    #[error(
        "expected SHA-256 {expected} as {} says, found {found}: {}",
        list.display(),
        path.display()
    )]
    FileChecksum {
        /// SHA-256 of the list.
        expected: Box<str>,
        /// SHA-256 of the file.
        found: Box<str>,
        /// Path of the list.
        list: PathBuf,
        /// The file.
        path: PathBuf,
    },
    /// A generated scene has another checksum or id.
    #[error(
        "expected scene {index} of {part} to be \"{expected}\" as {} says, found \"{found}\": {}",
        list.display(),
        path.display()
    )]
    SceneChecksum {
        /// Name of the part.
        part: Box<str>,
        /// Position of the scene in its file.
        index: usize,
        /// Checksum and id of the list.
        expected: Box<str>,
        /// Checksum and id of the scene.
        found: Box<str>,
        /// Path of the list.
        list: PathBuf,
        /// The file.
        path: PathBuf,
    },
    /// A file has another number of scenes.
    #[error(
        "expected {expected} scenes as {} says, found {found}: {}",
        list.display(),
        path.display()
    )]
    SceneCount {
        /// Number of the list.
        expected: usize,
        /// Number in the file.
        found: usize,
        /// Path of the list.
        list: PathBuf,
        /// The file.
        path: PathBuf,
    },
    /// A scene to verify is not a valid message.
    #[error("{problem}: {place}")]
    Unreadable {
        /// What is wrong with it.
        problem: Problem,
        /// Its place.
        place: RecordLocation,
    },
}

/// What is wrong with a part of a list.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum PartProblem {
    /// The seed of a split that is not for training is outside [`RESERVED_SEEDS`].
    #[error(
        "expected a seed from {} to {}, which training never uses, found {found}",
        RESERVED_SEEDS.start,
        RESERVED_SEEDS.end - 1
    )]
    Seed {
        /// The seed.
        found: u64,
    },
    /// It has too few or too many checksums.
    #[error("expected {expected} scenes with their sums, found {found}")]
    ChecksumCount {
        /// Number of scenes that are kept.
        expected: usize,
        /// Number of checksums.
        found: usize,
    },
    /// Indices of scenes to keep are out of order, repeated, or beyond the last scene.
    #[error("expected the indices to keep in order, all below {count}")]
    Keep {
        /// Number of scenes that the generator makes.
        count: usize,
    },
    /// The density is out of its range.
    #[error("expected a density from 0.1 to 3, found {:?}", Some(found))]
    Density {
        /// The density.
        found: f64,
    },
    /// The name would not do as a file name.
    #[error("expected a name of letters, digits and -, found \"{found}\"")]
    Name {
        /// The name.
        found: String,
    },
}
