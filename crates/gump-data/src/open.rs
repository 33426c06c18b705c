//! Opening a file or a directory by content, and finding one scenario by name.

use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};

use gump_scene::Scenario;

use crate::formats::cache::{Cache, is_shard};
use crate::formats::registry::{self, Role};
#[cfg(feature = "sumo")]
use crate::formats::sumo;
use crate::io::files;
use crate::source::{BoxedSource, RecordSource};
use crate::{DataError, ReadOptions, ScenarioRecord};

/// Opens a file, or every file of a directory that holds scenarios, in order of their paths and
/// whatever their formats, filling gaps with [`ReadOptions::ALL`].
///
/// # Errors
/// As [`open_with`].
pub fn open(path: &Path) -> Result<Reader, DataError> {
    open_with(path, ReadOptions::ALL)
}

/// Opens a file, or every file of a directory and its subdirectories that holds scenarios, or one
/// scenario named as in [`find`]: `PATH#INDEX` or `PATH#SCENARIO_ID`.
///
/// In a directory, files of other kinds are skipped and counted in [`Reader::skipped`]; files that
/// should contain scenarios by their name or beginning but cannot be opened are errors of the
/// reader, which continues with the next.
///
/// # Errors
/// [`DataError::Missing`], [`DataError::NoFiles`], and for a single file [`DataError::Empty`],
/// [`DataError::UnknownFormat`], [`DataError::NotScenarios`] and [`DataError::Io`]; of several
/// files the reader reports them.
pub fn open_with(path: &Path, options: ReadOptions) -> Result<Reader, DataError> {
    if let Some(one) = one_of_a_file(path, options) {
        return one;
    }
    let is_folder = path.is_dir();
    let files = if is_folder {
        files::list(path)?
    } else {
        vec![path.to_path_buf()]
    };
    let mut reader = Reader {
        is_folder,
        ..open_files(files, options)
    };
    match reader.start_next() {
        Some(Ok(())) => Ok(reader),
        // With more files to come, the first is one broken file among others.
        Some(Err(error)) if !reader.files.is_empty() => {
            reader.unopened = Some(error);
            Ok(reader)
        }
        Some(Err(error)) => Err(error),
        None => Err(DataError::NoFiles {
            others: reader.skipped.values().sum(),
            path: path.into(),
        }),
    }
}

/// The one scenario that a path with `#` names; `None` for a path that exists as it is, or without.
fn one_of_a_file(path: &Path, options: ReadOptions) -> Option<Result<Reader, DataError>> {
    let (file, _) = path.to_str()?.rsplit_once('#')?;
    if path.exists() {
        return None;
    }
    let one = find_with(path.to_str()?, options).and_then(|record| {
        let reader = open_with(Path::new(file), options)?;
        Ok(Reader {
            source: Box::new(OneRecord(Some(record))),
            files: VecDeque::new(),
            unopened: None,
            ..reader
        })
    });
    Some(one)
}

/// Reads files one after another like those of a directory: files without scenarios are skipped and
/// counted, files that cannot be opened are errors of the reader.
pub fn open_files(files: Vec<PathBuf>, options: ReadOptions) -> Reader {
    Reader {
        source: Box::new(NoRecords),
        format: "unknown",
        unopened: None,
        files: files.into(),
        is_folder: true,
        skipped: BTreeMap::new(),
        options,
    }
}

/// An iterator over the scenarios of a file or directory; holds one record at a time.
///
/// After an error it continues with the next record, or the next file, where that is possible.
pub struct Reader {
    source: BoxedSource,
    format: &'static str,
    /// The error from opening the first of several files, until it has been returned.
    unopened: Option<DataError>,
    files: VecDeque<PathBuf>,
    is_folder: bool,
    skipped: BTreeMap<&'static str, usize>,
    options: ReadOptions,
}

impl Reader {
    /// The format of the file being read.
    pub fn format(&self) -> &'static str {
        self.format
    }

    /// Files of a directory skipped so far, by kind.
    pub fn skipped(&self) -> &BTreeMap<&'static str, usize> {
        &self.skipped
    }

    /// Returns the first answer to `ask` from the file being read or the files after it, or the
    /// error of opening one of them.
    fn first_of<T>(
        &mut self,
        mut ask: impl FnMut(&mut dyn RecordSource) -> Option<Result<T, DataError>>,
    ) -> Option<Result<T, DataError>> {
        if let Some(error) = self.unopened.take() {
            return Some(Err(error));
        }
        loop {
            if let Some(answer) = ask(self.source.as_mut()) {
                return Some(answer);
            }
            // A source without records keeps the reader going with the files after a broken one.
            self.source = Box::new(NoRecords);
            if let Err(error) = self.start_next()? {
                return Some(Err(error));
            }
        }
    }

    /// Makes the next file that holds scenarios the one being read; `None` if there is none.
    fn start_next(&mut self) -> Option<Result<(), DataError>> {
        loop {
            let file = self.files.pop_front()?;
            let format = match registry::role(&file) {
                Ok(Role::Scenarios(format)) => format,
                Ok(Role::Companion(what) | Role::Unknown(what, _)) if self.is_folder => {
                    *self.skipped.entry(what).or_default() += 1;
                    continue;
                }
                Ok(Role::Companion(what)) => {
                    return Some(Err(DataError::NotScenarios { what, path: file }));
                }
                Ok(Role::Unknown(_, error)) => return Some(Err(error)),
                Err(error) => return Some(Err(error)),
            };
            return Some((format.open)(&file, self.options).map(|source| {
                self.source = source;
                self.format = format.name;
            }));
        }
    }
}

impl Iterator for Reader {
    type Item = Result<ScenarioRecord, DataError>;

    fn next(&mut self) -> Option<Self::Item> {
        self.first_of(|source| source.next_wanted(&mut |_| true))
    }
}

/// A record that has been read.
struct OneRecord(Option<ScenarioRecord>);

impl RecordSource for OneRecord {
    fn next_wanted(
        &mut self,
        wanted: &mut dyn FnMut(&str) -> bool,
    ) -> Option<Result<ScenarioRecord, DataError>> {
        self.0
            .take()
            .filter(|record| wanted(&record.scenario.id))
            .map(Ok)
    }
}

struct NoRecords;

impl RecordSource for NoRecords {
    fn next_wanted(
        &mut self,
        _: &mut dyn FnMut(&str) -> bool,
    ) -> Option<Result<ScenarioRecord, DataError>> {
        None
    }
}

/// Reads one scenario by name: `PATH` (the first of a file, the one file of a folder), `PATH#INDEX`
/// (from 0) or `PATH#SCENARIO_ID`.
///
/// An index takes precedence over an id of the same digits. A path that itself contains `#` is used
/// as a whole if it exists.
///
/// # Errors
/// [`DataError::NoSuchScenario`], [`DataError::SeveralFiles`] for a folder of several files of
/// scenarios without an index, the errors of [`open`], and those of the requested record.
pub fn find(source: &str) -> Result<Scenario, DataError> {
    find_record(source).map(|record| record.scenario)
}

/// As [`find`], with the report of dropped and inferred items.
///
/// # Errors
/// As [`find`].
pub fn find_record(source: &str) -> Result<ScenarioRecord, DataError> {
    find_with(source, ReadOptions::ALL)
}

/// As [`find`], for callers that need only the map: a recording without agents, or a SUMO network,
/// gets a parked ego on its longest lane.
///
/// # Errors
/// As [`find`].
pub fn find_map(source: &str) -> Result<Scenario, DataError> {
    let options = ReadOptions {
        park_an_ego: true,
        ..ReadOptions::ALL
    };
    #[cfg(feature = "sumo")]
    {
        let path = Path::new(source);
        if path.is_file() && matches!(registry::role(path)?, Role::Companion(sumo::NETWORK)) {
            return sumo::map_alone(path, options);
        }
    }
    find_with(source, options).map(|record| record.scenario)
}

fn find_with(source: &str, options: ReadOptions) -> Result<ScenarioRecord, DataError> {
    let (path, wanted) = match source.rsplit_once('#') {
        Some((path, wanted)) if !Path::new(source).exists() => (Path::new(path), wanted),
        _ => {
            let path = Path::new(source);
            refuse_several(path)?;
            (path, "0")
        }
    };
    if let Ok(index) = wanted.parse()
        && let Some(record) = find_index(path, index, options)?
    {
        return Ok(record);
    }
    find_id(path, wanted, options)
}

/// Refuses a folder of which it is not clear which file is meant.
fn refuse_several(path: &Path) -> Result<(), DataError> {
    if !path.is_dir() {
        return Ok(());
    }
    let mut files = files::list(path)?;
    files.retain(|file| matches!(registry::role(file), Ok(Role::Scenarios(_))));
    if files.len() < 2 {
        return Ok(());
    }
    Err(DataError::SeveralFiles {
        files: files.len(),
        first: files.swap_remove(0),
        path: path.into(),
    })
}

/// Records too broken to read count, so that a record keeps its index.
fn find_index(
    path: &Path,
    index: usize,
    options: ReadOptions,
) -> Result<Option<ScenarioRecord>, DataError> {
    let mut reader = open_with(path, options)?;
    for _ in 0..index {
        if reader.first_of(|source| source.skip()).is_none() {
            return Ok(None);
        }
    }
    reader.next().transpose()
}

fn find_id(path: &Path, wanted: &str, options: ReadOptions) -> Result<ScenarioRecord, DataError> {
    let mut reader = open_with(path, options)?;
    let (mut found, mut hit, mut first_error) = (0, false, None);
    while let Some(next) = reader.first_of(|source| {
        source.next_wanted(&mut |id| {
            found += 1;
            hit = id == wanted;
            hit
        })
    }) {
        match next {
            Ok(record) => return Ok(record),
            Err(error) if hit => return Err(error),
            Err(error) => first_error = first_error.or(Some(error)),
        }
    }
    Err(first_error.unwrap_or(DataError::NoSuchScenario {
        wanted: wanted.into(),
        found,
        path: path.into(),
    }))
}

// Here rather than beside the cache: recognising the other files of a directory takes every format.
impl Cache {
    /// True for a shard, and for a directory with shards and no scenarios in other formats.
    ///
    /// # Errors
    /// [`DataError::Missing`], [`DataError::Io`].
    pub fn is_at(path: &Path) -> Result<bool, DataError> {
        let files = files::list(path)?;
        let (shards, others): (Vec<_>, Vec<_>) = files.iter().partition(|file| is_shard(file));
        let is_other = |file: &&PathBuf| matches!(registry::role(file), Ok(Role::Scenarios(_)));
        Ok(!shards.is_empty() && !others.iter().any(is_other))
    }
}
