//! Conversion from any readable format to any writable one, file by file.
//!
//! Start with [`convert`]; [`groups`] divides many files into groups for it. Records that cannot be
//! read or written are listed, and the rest is converted.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fmt;
use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use gump_scene::Scenario;
use prost::Message as _;
use serde::de::IntoDeserializer as _;
use serde::de::value::Error as NameError;
use serde::{Deserialize, Serialize};

use crate::formats::cache::ShardWriter;
use crate::formats::{scenario_json, womd};
use crate::io::stream::io_error;
use crate::io::tfrecord;
#[cfg(feature = "parquet")]
use crate::tracks::TrackTable;
use crate::{DataError, ReadOptions, ReadReport, Reader, open_files, write_atomically};

/// The output format.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum OutputFormat {
    /// The cache that training reads: everything, bit for bit.
    Cache,
    /// Waymo's `Scenario` messages as TFRecord.
    Waymo,
    /// JSON for other programs, compressed, a file per scenario.
    ScenarioJson,
    /// Tables of tracks, without maps.
    #[cfg(feature = "parquet")]
    Parquet,
}

impl OutputFormat {
    /// All of them, in the order of declaration.
    pub const ALL: &'static [Self] = &[
        Self::Cache,
        Self::Waymo,
        Self::ScenarioJson,
        #[cfg(feature = "parquet")]
        Self::Parquet,
    ];
}

impl fmt::Display for OutputFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

impl FromStr for OutputFormat {
    type Err = NameError;

    /// Finds a value by the name that it is stored and displayed under.
    ///
    /// # Errors
    /// A sentence with the unknown name and the known ones.
    fn from_str(name: &str) -> Result<Self, NameError> {
        Self::deserialize(name.into_deserializer())
    }
}

/// The result of a conversion.
#[derive(Debug, Default)]
pub struct Converted {
    /// Scenarios written.
    pub scenarios: usize,
    /// Files written.
    pub files: Vec<PathBuf>,
    /// Their bytes.
    pub bytes: u64,
    /// Records that could not be read or written, with their places.
    pub refused: Vec<DataError>,
    /// Files without scenarios, by kind.
    pub skipped: BTreeMap<&'static str, usize>,
    /// Dropped and inferred items, in reading and in writing.
    pub report: ReadReport,
}

/// Input bytes that make an output file: large enough to read in one go, small enough to lose.
const GROUP_BYTES: u64 = 64 << 20;
/// Minimum number of groups, if there are as many files: work for many threads.
const MIN_GROUPS: u64 = 16;

/// Divides files into consecutive groups, one for each output file.
///
/// Depends only on the files and their sizes, so that a conversion can be resumed.
pub fn groups(files: &[PathBuf]) -> Vec<Range<usize>> {
    let size = |file: &PathBuf| fs::metadata(file).map_or(0, |metadata| metadata.len());
    let sizes: Vec<u64> = files.iter().map(size).collect();
    let enough = (sizes.iter().sum::<u64>() / MIN_GROUPS).clamp(1, GROUP_BYTES);
    let (mut groups, mut start, mut bytes) = (Vec::new(), 0, 0);
    for (i, size) in sizes.iter().enumerate() {
        bytes += size;
        if bytes >= enough || i + 1 == sizes.len() {
            groups.push(start..i + 1);
            (start, bytes) = (i + 1, 0);
        }
    }
    groups
}

/// Converts files into one file `STEM.ENDING` (of [`OutputFormat::ScenarioJson`]: one per scenario,
/// `STEM-00000.json.gz` and so on), which appears when it is complete; no scenarios make no file.
///
/// `each` is called for every scenario written and may stop the conversion with an error. Waymo's
/// messages contain the lights as observed, without [`ReadOptions::infer_light_gaps`].
///
/// # Errors
/// Errors of `each`, and [`DataError::Io`] for the output. Errors of the input are in
/// [`Converted::refused`].
pub fn convert<E: From<DataError>>(
    files: &[PathBuf],
    options: ReadOptions,
    format: OutputFormat,
    stem: &Path,
    each: impl FnMut(&Scenario) -> Result<(), E>,
) -> Result<Converted, E> {
    let options = ReadOptions {
        // Messages state what was observed; readers fill the gaps again.
        infer_light_gaps: options.infer_light_gaps && format != OutputFormat::Waymo,
        ..options
    };
    let mut conversion = Conversion {
        reader: open_files(files.to_vec(), options),
        result: Converted::default(),
        each,
    };
    match format {
        OutputFormat::Cache => conversion.write_file(&with_ending(stem, ".cache"), new_shard),
        OutputFormat::Waymo => conversion.write_file(&with_ending(stem, ".tfrecord"), new_messages),
        #[cfg(feature = "parquet")]
        OutputFormat::Parquet => conversion.write_file(&with_ending(stem, ".parquet"), new_table),
        OutputFormat::ScenarioJson => conversion.write_documents(stem),
    }?;
    let mut result = conversion.result;
    result.skipped = conversion.reader.skipped().clone();
    for file in &result.files {
        let metadata = fs::metadata(file).map_err(|e| io_error("read", e, file))?;
        result.bytes += metadata.len();
    }
    Ok(result)
}

fn with_ending(stem: &Path, ending: &str) -> PathBuf {
    let mut name = stem.file_name().map(OsString::from).unwrap_or_default();
    name.push(ending);
    stem.with_file_name(name)
}

/// A file that takes scenarios one by one.
trait Sink {
    /// Adds a scenario; returns what the format cannot represent.
    ///
    /// Error: [`DataError::Unwritable`], after which others can be added, or [`DataError::Io`].
    fn add(&mut self, scenario: &Scenario) -> Result<ReadReport, DataError>;

    /// Completes the file.
    fn close(self: Box<Self>) -> Result<(), DataError>;
}

/// A file for scenarios, or why there is none.
type Begun<'f> = Result<Box<dyn Sink + 'f>, DataError>;

fn new_shard<'f>(file: &'f mut BufWriter<File>, path: &'f Path) -> Begun<'f> {
    Ok(Box::new(ShardWriter::begin(file, path)?))
}

fn new_messages<'f>(file: &'f mut BufWriter<File>, path: &'f Path) -> Begun<'f> {
    Ok(Box::new(Messages { file, path }))
}

#[cfg(feature = "parquet")]
fn new_table<'f>(file: &'f mut BufWriter<File>, path: &'f Path) -> Begun<'f> {
    Ok(Box::new(TrackTable::begin(file, path)?))
}

impl<W: Write> Sink for ShardWriter<'_, W> {
    fn add(&mut self, scenario: &Scenario) -> Result<ReadReport, DataError> {
        self.write(scenario).map(|()| ReadReport::default())
    }

    fn close(self: Box<Self>) -> Result<(), DataError> {
        self.finish().map(drop)
    }
}

#[cfg(feature = "parquet")]
impl<W: Write + Send> Sink for TrackTable<'_, W> {
    fn add(&mut self, scenario: &Scenario) -> Result<ReadReport, DataError> {
        self.write(scenario).map(|()| ReadReport::default())
    }

    fn close(self: Box<Self>) -> Result<(), DataError> {
        self.finish()
    }
}

struct Messages<'a, W> {
    file: W,
    path: &'a Path,
}

impl<W: Write> Sink for Messages<'_, W> {
    fn add(&mut self, scenario: &Scenario) -> Result<ReadReport, DataError> {
        let (message, report) = womd::scenario_to_proto(scenario)?;
        tfrecord::write_record(&mut self.file, &message.encode_to_vec())
            .map_err(|e| io_error("write", e, self.path))?;
        Ok(report)
    }

    fn close(self: Box<Self>) -> Result<(), DataError> {
        Ok(())
    }
}

struct Conversion<F> {
    reader: Reader,
    result: Converted,
    each: F,
}

impl<F> Conversion<F> {
    /// The next scenario that can be read.
    fn next(&mut self) -> Option<Scenario> {
        loop {
            match self.reader.next()? {
                Ok(record) => {
                    self.result.report.merge(&record.report);
                    return Some(record.scenario);
                }
                Err(error) => self.result.refused.push(error),
            }
        }
    }

    /// Records the result of writing a scenario.
    fn note<E: From<DataError>>(
        &mut self,
        scenario: &Scenario,
        written: Result<ReadReport, DataError>,
    ) -> Result<(), E>
    where
        F: FnMut(&Scenario) -> Result<(), E>,
    {
        match written {
            Ok(report) => {
                self.result.report.merge(&report);
                self.result.scenarios += 1;
                (self.each)(scenario)
            }
            Err(error @ DataError::Unwritable { .. }) => {
                self.result.refused.push(error);
                Ok(())
            }
            Err(error) => Err(error.into()),
        }
    }

    fn write_file<E: From<DataError>>(
        &mut self,
        path: &Path,
        begin: for<'f> fn(&'f mut BufWriter<File>, &'f Path) -> Begun<'f>,
    ) -> Result<(), E>
    where
        F: FnMut(&Scenario) -> Result<(), E>,
    {
        let Some(first) = self.next() else {
            return Ok(());
        };
        write_atomically(path, |file| {
            let mut sink = begin(file, path)?;
            let mut next = Some(first);
            while let Some(scenario) = next {
                let written = sink.add(&scenario);
                self.note(&scenario, written)?;
                next = self.next();
            }
            sink.close().map_err(E::from)
        })?;
        if self.result.scenarios == 0 {
            fs::remove_file(path).map_err(|e| io_error("remove", e, path))?;
        } else {
            self.result.files.push(path.into());
        }
        Ok(())
    }

    fn write_documents<E: From<DataError>>(&mut self, stem: &Path) -> Result<(), E>
    where
        F: FnMut(&Scenario) -> Result<(), E>,
    {
        while let Some(scenario) = self.next() {
            let path = with_ending(stem, &format!("-{:05}.json.gz", self.result.scenarios));
            let written = scenario_json::write_scenario(&path, &scenario);
            self.note(&scenario, written.map(|()| ReadReport::default()))?;
            self.result.files.push(path);
        }
        Ok(())
    }
}
