//! Errors of reading and writing, as one enum; messages begin with the context and end with the
//! path.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

use gump_scene::{AgentId, MapError, ScenarioError};

/// The location of a record: its file, index and offset.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RecordLocation {
    /// Index of the record in its file, from 0.
    pub record: usize,
    /// Start of the record, bytes from the start of the (uncompressed) content.
    pub offset: u64,
    /// The file.
    pub path: PathBuf,
}

impl fmt::Display for RecordLocation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (record, offset) = (self.record, self.offset);
        write!(
            f,
            "record {record} at byte {offset} of {}",
            self.path.display()
        )
    }
}

/// Name of the file that marks a folder whose creation has not finished: its files are valid but
/// not complete. Readers refuse such a folder.
pub const INCOMPLETE: &str = "CACHE-INCOMPLETE";

/// Why data could not be read or written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DataError {
    /// An error of the operating system.
    #[error("could not {doing}: {source}: {}", path.display())]
    Io {
        /// The operation: "open", "read", "create", ...
        doing: &'static str,
        /// The error of the system.
        source: io::Error,
        /// The file.
        path: PathBuf,
    },
    /// There is no such file.
    #[error("{}: {}", missing(path), path.display())]
    Missing {
        /// The file.
        path: PathBuf,
    },
    /// The file is empty.
    #[error("expected at least one record, found an empty file: {}", path.display())]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// A directory contains no file of a known kind.
    #[error(
        "expected scenario files, found {others} files of other kinds in the directory {}",
        path.display()
    )]
    NoFiles {
        /// Number of files without scenarios.
        others: usize,
        /// The directory.
        path: PathBuf,
    },
    /// A file is of a known kind without scenarios.
    #[error("expected scenarios, found {what}: {}", path.display())]
    NotScenarios {
        /// Its kind.
        what: &'static str,
        /// The file.
        path: PathBuf,
    },
    /// A document is longer than the limit for reading it as a whole.
    #[error("expected at most {limit} bytes of {what}, found more: {}", path.display())]
    TooLarge {
        /// Its content.
        what: &'static str,
        /// The limit, bytes after decompression.
        limit: u64,
        /// The file.
        path: PathBuf,
    },
    /// A document is not JSON, or has the wrong structure.
    #[error("expected {what}: {source}: {}", path.display())]
    Json {
        /// The expectation.
        what: &'static str,
        /// The parser's message, with line and column.
        source: serde_json::Error,
        /// The file.
        path: PathBuf,
    },
    /// A table is damaged or lacks a column.
    #[error("expected {expected}, found {found}: {}", path.display())]
    Table {
        /// The expectation.
        expected: String,
        /// The content found.
        found: String,
        /// The file.
        path: PathBuf,
    },
    /// A file that is needed beside another one is missing.
    #[error("expected {expected} beside it, found none: {}", path.display())]
    NoCompanion {
        /// The missing file.
        expected: String,
        /// The file that needs it.
        path: PathBuf,
    },
    /// A valid file contains nothing that a scenario can be made from.
    #[error("expected {expected}, found {found}: {}", path.display())]
    NoScenarios {
        /// The content that scenarios are made from.
        expected: &'static str,
        /// The content found.
        found: String,
        /// The file.
        path: PathBuf,
    },
    /// A database cannot be read, or has a value of another type.
    #[cfg(feature = "nuplan")]
    #[error("could not {doing}: {source}: {}", path.display())]
    Sqlite {
        /// The operation.
        doing: &'static str,
        /// SQLite's message.
        source: rusqlite::Error,
        /// The file.
        path: PathBuf,
    },
    /// The content is of no known format.
    #[error("expected {expected}, found a file that starts with {found}: {}", path.display())]
    UnknownFormat {
        /// The supported formats.
        expected: String,
        /// The first bytes found.
        found: String,
        /// The file.
        path: PathBuf,
    },
    /// The file ends inside a record.
    #[error("expected {expected} more bytes of {part}, found {found} before the end: {place}")]
    Truncated {
        /// The part being read.
        part: &'static str,
        /// Bytes required.
        expected: u64,
        /// Bytes present.
        found: u64,
        /// The record.
        place: RecordLocation,
    },
    /// A checksum does not match.
    #[error("expected checksum {expected:#010x} of {part}, found {found:#010x}: {place}")]
    Checksum {
        /// The checked part.
        part: &'static str,
        /// The stored checksum.
        expected: u32,
        /// The computed checksum.
        found: u32,
        /// The record.
        place: RecordLocation,
    },
    /// A record has an implausible length.
    #[error("expected a record of at most {limit} bytes, found a length of {length}: {place}")]
    TooLong {
        /// The limit, bytes.
        limit: u64,
        /// The length found, bytes.
        length: u64,
        /// The record.
        place: RecordLocation,
    },
    /// A file of the cache is damaged, truncated or of another version.
    #[error("expected {expected}, found {found}: at byte {offset} of {}", path.display())]
    Cache {
        /// The expectation.
        expected: String,
        /// The content found.
        found: String,
        /// Position of the problem, bytes from the start of the file.
        offset: u64,
        /// The file.
        path: PathBuf,
    },
    /// An XML file is not well formed, or has unexpected content.
    #[error("{problem}: at byte {offset} of {}", path.display())]
    Xml {
        /// The problem.
        problem: String,
        /// Position of the problem, bytes from the start of the (uncompressed) content.
        offset: u64,
        /// The file.
        path: PathBuf,
    },
    /// A SUMO recording has no network beside it.
    #[error("expected a network (net.xml) beside the recording, found none: {}", path.display())]
    NoNetwork {
        /// The recording.
        path: PathBuf,
    },
    /// A record is not a valid message.
    #[error("expected a {message} message: {source}: {place}")]
    Proto {
        /// The message's name.
        message: &'static str,
        /// The decoder's message.
        source: prost::DecodeError,
        /// The record.
        place: RecordLocation,
    },
    /// A message contains an invalid value.
    #[error("expected {expected}, found {found}: {place}")]
    Field {
        /// The expectation.
        expected: &'static str,
        /// The content found.
        found: String,
        /// The record.
        place: RecordLocation,
    },
    /// A record can be decoded but is not a usable scenario.
    #[error("scenario {id}: {problem}: {place}")]
    Scenario {
        /// The scenario's own id.
        id: String,
        /// The problem.
        problem: Problem,
        /// The record.
        place: RecordLocation,
    },
    /// A scenario cannot be expressed in the format to be written.
    #[error("scenario {id} cannot be written: {problem}")]
    Unwritable {
        /// The scenario's id.
        id: String,
        /// The reason.
        problem: String,
    },
    /// A name like `FILE#ID` without a matching scenario.
    #[error("{}: {}", no_such_scenario(wanted, *found), path.display())]
    NoSuchScenario {
        /// The requested index or id.
        wanted: String,
        /// Number of scenarios.
        found: usize,
        /// The file or directory.
        path: PathBuf,
    },
    /// A folder with several files where one scenario is expected.
    #[error(
        "expected one scenario, found a folder with {files} files of scenarios: name a file such \
         as {}, or a scenario by its number or id as in {}#0",
        first.display(),
        path.display()
    )]
    SeveralFiles {
        /// Number of its files with scenarios.
        files: usize,
        /// The first of them.
        first: PathBuf,
        /// The folder.
        path: PathBuf,
    },
    /// A folder whose creation was interrupted.
    #[error(
        "expected a finished data set, found {} in {}: the conversion that made it was stopped; \
         the same command finishes it",
        INCOMPLETE,
        path.display()
    )]
    Incomplete {
        /// The folder.
        path: PathBuf,
    },
}

/// Returns the expectation for a missing path: the name of one scenario may stand for a file.
fn missing(path: &Path) -> &'static str {
    let names_one = |text: &str| {
        text.rsplit_once('#')
            .is_some_and(|(file, _)| Path::new(file).exists())
    };
    match path.to_str().is_some_and(names_one) {
        true => "expected a whole file or directory, found the name of one scenario",
        false => "expected a file or directory, found none",
    }
}

/// Returns the message for a request after `#` that no scenario matches.
fn no_such_scenario(wanted: &str, found: usize) -> String {
    let is_number = wanted.parse::<usize>().is_ok();
    match found {
        1 if is_number => format!("expected #0, the only scenario there is, found #{wanted}"),
        n if is_number && n > 1 => {
            format!(
                "expected one of its {n} scenarios, #0 to #{}, found #{wanted}",
                n - 1
            )
        }
        n => format!(
            "expected a scenario \"{wanted}\", found {n} {}",
            if n == 1 {
                "of another id"
            } else {
                "of other ids"
            }
        ),
    }
}

/// The largest magnitude accepted in a state or a map, in SI units.
///
/// Map projections stay below 2e7 m (half the circumference of the Earth); larger values are
/// damage.
pub(crate) const MAX_COORDINATE: f64 = 1e8;

/// Why a decoded record is not a usable scenario.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Problem {
    /// Bytes are not a valid message.
    #[error("expected a {message} message, found bytes that are none: {source}")]
    Message {
        /// The message's name.
        message: &'static str,
        /// The decoder's message.
        source: prost::DecodeError,
    },
    /// It has no map.
    #[error("expected a map, found no map feature")]
    NoMap,
    /// It has no agents.
    #[error("expected at least one track, found a map alone or nothing")]
    NoAgents,
    /// The ego is not stated.
    #[error("expected the index of the ego's track, found none")]
    NoEgo,
    /// An index points past the end of its list.
    #[error("expected {what} below {len}, found {index}")]
    Index {
        /// The name of the index.
        what: &'static str,
        /// Length of the list.
        len: usize,
        /// The index found.
        index: i64,
    },
    /// A track has too few or too many states.
    #[error("expected {expected} states in track {track}, one per time stamp, found {found}")]
    StateCount {
        /// The track's id.
        track: i64,
        /// Number of time stamps.
        expected: usize,
        /// Number of states.
        found: usize,
    },
    /// Traffic lights have another number of steps than the scenario.
    #[error("expected traffic lights for {expected} steps or none, found {found}")]
    LightCount {
        /// Number of time stamps.
        expected: usize,
        /// Number of steps with lights.
        found: usize,
    },
    /// Two tracks have the same id.
    #[error("expected unique track ids, found {0} twice")]
    DuplicateTrack(i64),
    /// A state marked valid is not finite, or beyond any place on Earth.
    #[error(
        "expected numbers within {MAX_COORDINATE} in track {track} at step {step}, \
         found {field} = {value}"
    )]
    State {
        /// The track's id.
        track: i64,
        /// The step.
        step: usize,
        /// The first invalid field.
        field: &'static str,
        /// Its value.
        value: f64,
    },
    /// A map coordinate is not finite, or beyond any place on Earth.
    #[error(
        "expected coordinates within {MAX_COORDINATE} m in map feature {feature}, \
         found {value} at point {point}"
    )]
    MapPoint {
        /// The feature's id.
        feature: i64,
        /// Index of the point.
        point: usize,
        /// Its value.
        value: f64,
    },
    /// The time stamps are not one time step apart.
    #[error("expected time stamps {expected} s apart, found {found} s before step {step}")]
    TimeStep {
        /// The nominal step, seconds.
        expected: f64,
        /// The step found, seconds.
        found: f64,
        /// The later step.
        step: usize,
    },
    /// A value violates the format.
    #[error("expected {expected}, found {found} in {place}")]
    Unexpected {
        /// The expectation.
        expected: &'static str,
        /// The content found.
        found: Box<str>,
        /// The part of the record.
        place: Box<str>,
    },
    /// Rollouts are of another scenario.
    #[error("expected rollouts of scenario {expected}, found {found}")]
    OtherScenario {
        /// Id of the scenario.
        expected: Box<str>,
        /// Id in the message.
        found: Box<str>,
    },
    /// A future does not fit its scenario.
    #[error("future {future}: {problem}")]
    Future {
        /// Index of the future.
        future: usize,
        /// The first problem with it.
        problem: Box<str>,
    },
    /// A message of predictions has none.
    #[error("expected single or joint predictions, found none")]
    NoPredictions,
    /// Modes of a joint prediction are of different agents.
    #[error("mode {mode} is of other agents than mode 0, or of one agent twice")]
    MixedAgents {
        /// Index of the mode.
        mode: usize,
    },
    /// A mode of a prediction lacks the trajectory of an agent.
    #[error("mode {mode} of agent {agent} has no trajectory")]
    NoTrajectory {
        /// Index of the mode.
        mode: usize,
        /// The agent.
        agent: AgentId,
    },
    /// A predicted trajectory has more positions in one direction than in the other.
    #[error("mode {mode} of agent {agent} has {x} numbers center_x and {y} center_y")]
    UnequalPositions {
        /// Index of the mode.
        mode: usize,
        /// The agent.
        agent: AgentId,
        /// Positions along x.
        x: usize,
        /// Positions along y.
        y: usize,
    },
    /// The map is inconsistent.
    #[error(transparent)]
    Map(#[from] MapError),
    /// The result violates an invariant of scenarios.
    #[error(transparent)]
    Scenario(#[from] ScenarioError),
}
