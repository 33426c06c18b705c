//! Opening a file or a directory by content, and finding one scenario by name.

use std::collections::VecDeque;
use std::fs;
use std::path::{Path, PathBuf};

use gump_scene::Scenario;

use crate::stream::{self, io_error};
use crate::{DataError, ReadOptions, ScenarioRecord, sumo, womd};

/// A format that content can be recognised as. A new format is one line in [`FORMATS`].
pub(crate) struct Format {
    /// Its name in reports and errors.
    pub(crate) name: &'static str,
    /// True if content that starts with these (up to [`HEAD_BYTES`], uncompressed) bytes is of
    /// this format.
    pub(crate) recognises: fn(&[u8]) -> bool,
    /// Starts reading a file.
    pub(crate) open: fn(&Path, ReadOptions) -> Result<BoxedSource, DataError>,
}

/// How a format hands over its scenarios.
pub(crate) type BoxedSource = Box<dyn Source>;

/// The scenarios of one file, in order.
pub(crate) trait Source: Send {
    /// The next scenario whose id is `wanted`; the others are skipped at less cost. `wanted` is
    /// asked exactly once per record whose id can be read. After an error the next call goes on
    /// with the next record where that is possible; `None` is the end.
    fn next_wanted(
        &mut self,
        wanted: &mut dyn FnMut(&str) -> bool,
    ) -> Option<Result<ScenarioRecord, DataError>>;
}

const FORMATS: [Format; 2] = [womd::FORMAT, sumo::FORMAT];

/// How much of the content a recogniser sees.
const HEAD_BYTES: u64 = 4096;

/// Opens a file, or all `*.tfrecord*` files of a directory in order of their names, filling gaps
/// with [`ReadOptions::ALL`].
///
/// # Errors
/// As [`open_with`].
pub fn open(path: &Path) -> Result<Reader, DataError> {
    open_with(path, ReadOptions::ALL)
}

/// Opens a file, or all `*.tfrecord*` files of a directory in order of their names.
///
/// # Errors
/// [`DataError::Missing`], [`DataError::NoFiles`], and for a single file [`DataError::Empty`],
/// [`DataError::UnknownFormat`] and [`DataError::Io`]; of several files the reader tells them.
pub fn open_with(path: &Path, options: ReadOptions) -> Result<Reader, DataError> {
    let mut files = if path.is_dir() {
        files_in(path)?
    } else {
        VecDeque::from([path.to_path_buf()])
    };
    let Some(first) = files.pop_front() else {
        return Err(DataError::NoFiles { path: path.into() });
    };
    let mut reader = Reader {
        source: Some(Box::new(NoRecords)),
        format: "unknown",
        unopened: None,
        files,
        options,
    };
    match reader.start(&first) {
        // With more files to come, the first is one broken file among others.
        Err(error) if !reader.files.is_empty() => reader.unopened = Some(error),
        started => started?,
    }
    Ok(reader)
}

/// An iterator over the scenarios of a file or directory; holds one record at a time.
///
/// After an error it goes on with the next record, or the next file, where that is possible.
pub struct Reader {
    source: Option<BoxedSource>,
    format: &'static str,
    /// Why the first of several files could not be opened, until it is told.
    unopened: Option<DataError>,
    files: VecDeque<PathBuf>,
    options: ReadOptions,
}

impl Reader {
    /// The format of the file being read.
    pub fn format(&self) -> &'static str {
        self.format
    }

    fn next_wanted(
        &mut self,
        wanted: &mut dyn FnMut(&str) -> bool,
    ) -> Option<Result<ScenarioRecord, DataError>> {
        if let Some(error) = self.unopened.take() {
            return Some(Err(error));
        }
        loop {
            let source = self.source.as_mut()?;
            if let Some(record) = source.next_wanted(wanted) {
                return Some(record);
            }
            self.source = None;
            let file = self.files.pop_front()?;
            if let Err(error) = self.start(&file) {
                // A source without records keeps the reader going with the files after it.
                self.source = Some(Box::new(NoRecords));
                return Some(Err(error));
            }
        }
    }

    /// Makes `file` the one being read.
    fn start(&mut self, file: &Path) -> Result<(), DataError> {
        let format = recognise(file)?;
        self.source = Some((format.open)(file, self.options)?);
        self.format = format.name;
        Ok(())
    }
}

impl Iterator for Reader {
    type Item = Result<ScenarioRecord, DataError>;

    fn next(&mut self) -> Option<Self::Item> {
        self.next_wanted(&mut |_| true)
    }
}

struct NoRecords;

impl Source for NoRecords {
    fn next_wanted(
        &mut self,
        _: &mut dyn FnMut(&str) -> bool,
    ) -> Option<Result<ScenarioRecord, DataError>> {
        None
    }
}

/// Reads one scenario by name: `PATH` (the first), `PATH#INDEX` (from 0) or `PATH#SCENARIO_ID`.
///
/// An index wins over an id of the same digits. A path that itself contains `#` is taken whole if
/// it exists.
///
/// # Errors
/// [`DataError::NoSuchScenario`], those of [`open`], and those of the record asked for.
pub fn find(source: &str) -> Result<Scenario, DataError> {
    let (path, wanted) = match source.rsplit_once('#') {
        Some((path, wanted)) if !Path::new(source).exists() => (Path::new(path), wanted),
        _ => (Path::new(source), "0"),
    };
    if let Ok(index) = wanted.parse()
        && let Some(record) = find_index(path, index)?
    {
        return Ok(record.scenario);
    }
    find_id(path, wanted).map(|record| record.scenario)
}

fn find_index(path: &Path, index: usize) -> Result<Option<ScenarioRecord>, DataError> {
    let mut reader = open(path)?;
    let (mut position, mut hit) = (0, false);
    while let Some(next) = reader.next_wanted(&mut |_| {
        hit = position == index;
        position += 1;
        hit
    }) {
        match next {
            Ok(record) => return Ok(Some(record)),
            // A record too broken to tell its id has not been counted above.
            Err(error) if hit || position == index => return Err(error),
            Err(_) => position += 1,
        }
    }
    Ok(None)
}

fn find_id(path: &Path, wanted: &str) -> Result<ScenarioRecord, DataError> {
    let mut reader = open(path)?;
    let (mut found, mut hit, mut first_error) = (0, false, None);
    while let Some(next) = reader.next_wanted(&mut |id| {
        found += 1;
        hit = id == wanted;
        hit
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

fn recognise(path: &Path) -> Result<Format, DataError> {
    let head = stream::head(path, HEAD_BYTES)?;
    let known = FORMATS.into_iter().find(|f| (f.recognises)(&head));
    known.ok_or_else(|| DataError::UnknownFormat {
        expected: FORMATS.map(|f| f.name).join(" or "),
        found: head[..head.len().min(12)].escape_ascii().to_string(),
        path: path.into(),
    })
}

fn files_in(folder: &Path) -> Result<VecDeque<PathBuf>, DataError> {
    let mut files = Vec::new();
    for entry in fs::read_dir(folder).map_err(|e| io_error("list", e, folder))? {
        let path = entry.map_err(|e| io_error("list", e, folder))?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        if name.contains(".tfrecord") && !name.ends_with(".partial") && path.is_file() {
            files.push(path);
        }
    }
    files.sort();
    Ok(files.into())
}
