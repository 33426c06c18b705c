//! Which files there are and what each of them is, told from content.
//!
//! The table of formats is here: a new one is one line in [`FORMATS`]. Files that belong to a
//! format without holding scenarios (maps, calibrations, recordings of lights) are in
//! [`COMPANIONS`]. How a file is read is its format's affair.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

#[cfg(feature = "argoverse2")]
use crate::argoverse2;
#[cfg(feature = "commonroad")]
use crate::commonroad;
#[cfg(feature = "nuplan")]
use crate::nuplan;
use crate::open::BoxedSource;
use crate::stream::{self, io_error};
#[cfg(feature = "sumo")]
use crate::sumo;
#[cfg(feature = "taf-bw")]
use crate::taf_bw;
use crate::{DataError, ReadOptions, cache, gpudrive, scenario_json, womd};

// ANCHOR: format
/// A format that content can be recognised as.
pub(crate) struct Format {
    /// Its name in reports and errors.
    pub(crate) name: &'static str,
    /// True if content that starts with these (up to [`HEAD_BYTES`], uncompressed) bytes is of
    /// this format.
    pub(crate) recognises: fn(&[u8]) -> bool,
    /// Starts reading a file.
    pub(crate) open: fn(&Path, ReadOptions) -> Result<BoxedSource, DataError>,
}
// ANCHOR_END: format

/// The formats that hold scenarios; the first that recognises a file has it.
static FORMATS: &[Format] = &[
    cache::FORMAT,
    womd::FORMAT,
    gpudrive::FORMAT,
    #[cfg(feature = "argoverse2")]
    argoverse2::FORECASTING,
    #[cfg(feature = "argoverse2")]
    argoverse2::SENSOR_LOG,
    #[cfg(feature = "commonroad")]
    commonroad::FORMAT,
    scenario_json::FORMAT,
    #[cfg(feature = "sumo")]
    sumo::FORMAT,
    #[cfg(feature = "nuplan")]
    nuplan::FORMAT,
    #[cfg(feature = "taf-bw")]
    taf_bw::FORMAT,
];

/// A kind of file without scenarios of its own.
pub(crate) struct Companion {
    /// What it is, in reports.
    pub(crate) what: &'static str,
    /// As [`Format::recognises`].
    pub(crate) recognises: fn(&[u8]) -> bool,
}

/// Files that belong to some format but hold no scenarios.
static COMPANIONS: &[Companion] = &[
    #[cfg(feature = "argoverse2")]
    Companion {
        what: "Argoverse 2 map",
        recognises: argoverse2::is_map,
    },
    #[cfg(feature = "argoverse2")]
    Companion {
        what: "Feather table beside an Argoverse 2 log",
        recognises: argoverse2::is_feather,
    },
    #[cfg(feature = "sumo")]
    Companion {
        what: sumo::NETWORK,
        recognises: sumo::is_network,
    },
    #[cfg(feature = "sumo")]
    Companion {
        what: "other SUMO file",
        recognises: sumo::is_other,
    },
    #[cfg(feature = "nuplan")]
    nuplan::MAP,
    #[cfg(feature = "nuplan")]
    nuplan::OTHER,
    #[cfg(feature = "taf-bw")]
    taf_bw::MAP,
];

/// How much of the content a recogniser sees.
const HEAD_BYTES: u64 = 64 << 10;

/// What the name of a file of scenarios contains, where its content is binary: such a file that
/// is not recognised is damaged rather than something else.
const BINARY_NAMES: [&str; 4] = [".tfrecord", ".parquet", ".feather", ".db"];

/// Name of the file that marks a folder whose making was begun and not finished: what is there is
/// sound, but it is not all. No reader takes such a folder.
pub const INCOMPLETE: &str = "CACHE-INCOMPLETE";

/// What a file is.
pub(crate) enum Role {
    /// It holds scenarios.
    Scenarios(&'static Format),
    /// It belongs to a format but holds no scenarios.
    Companion(&'static str),
    /// It is of no known kind: what can be said of it, and the error if it is asked for.
    Unknown(&'static str, DataError),
}

/// Every file that `open` would look at: the file itself, or those of a directory and its
/// subdirectories in order of their paths. Files being written (`*.partial`) and hidden ones are
/// left out; links are followed, but into no directory twice.
///
/// # Errors
/// [`DataError::Missing`], [`DataError::Incomplete`] for a directory with a file [`INCOMPLETE`] in
/// it, and [`DataError::Io`] for one that cannot be listed.
pub fn list(path: &Path) -> Result<Vec<PathBuf>, DataError> {
    let files = list_unfinished(path)?;
    let mark = files.iter().find(|file| is_mark(file));
    match mark.and_then(|mark| mark.parent()) {
        Some(folder) if path.is_dir() => Err(DataError::Incomplete {
            path: folder.into(),
        }),
        _ => Ok(files),
    }
}

fn is_mark(file: &Path) -> bool {
    file.file_name().is_some_and(|name| name == INCOMPLETE)
}

/// As [`list`], in folders that are being made too: for who makes them. The mark is among the
/// files.
///
/// # Errors
/// [`DataError::Missing`], and [`DataError::Io`] for a directory that cannot be listed.
pub fn list_unfinished(path: &Path) -> Result<Vec<PathBuf>, DataError> {
    if !path.exists() {
        return Err(DataError::Missing { path: path.into() });
    }
    if !path.is_dir() {
        return Ok(vec![path.into()]);
    }
    let (mut files, mut seen) = (Vec::new(), BTreeSet::new());
    let mut folders = vec![path.to_path_buf()];
    while let Some(folder) = folders.pop() {
        let real = fs::canonicalize(&folder).map_err(|e| io_error("list", e, &folder))?;
        if !seen.insert(real) {
            continue;
        }
        for entry in fs::read_dir(&folder).map_err(|e| io_error("list", e, &folder))? {
            let path = entry.map_err(|e| io_error("list", e, &folder))?.path();
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            if name.starts_with('.') || name.ends_with(".partial") {
                continue;
            }
            if path.is_dir() {
                folders.push(path);
            } else {
                files.push(path);
            }
        }
    }
    files.sort();
    Ok(files)
}

/// Looks at the beginning of a file.
///
/// Error: those of opening it, [`DataError::Empty`], and [`DataError::UnknownFormat`] for content
/// of no known kind under a name that promises scenarios, or for bytes that are no text.
pub(crate) fn role(path: &Path) -> Result<Role, DataError> {
    let head = stream::head(path, HEAD_BYTES)?;
    if let Some(format) = FORMATS.iter().find(|f| (f.recognises)(&head)) {
        return Ok(Role::Scenarios(format));
    }
    if let Some(companion) = COMPANIONS.iter().find(|c| (c.recognises)(&head)) {
        return Ok(Role::Companion(companion.what));
    }
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let promised = BINARY_NAMES.iter().any(|part| name.contains(part));
    let text = is_text(&head);
    if promised || (!text && is_document(&name)) {
        return Err(unknown(&head, path));
    }
    let what = if text { "other text" } else { "other data" };
    Ok(Role::Unknown(what, unknown(&head, path)))
}

/// True if the content is UTF-8 without control characters as far as one can see.
fn is_text(head: &[u8]) -> bool {
    let valid = match std::str::from_utf8(head) {
        Ok(text) => text,
        // The head may end inside a character.
        Err(error) if error.error_len().is_none() => return !head.contains(&0),
        Err(_) => return false,
    };
    !valid.contains('\0')
}

/// True for names of documents that would hold scenarios or belong to them.
fn is_document(name: &str) -> bool {
    [".json", ".xml", ".csv", ".osm"]
        .iter()
        .any(|part| name.contains(part))
}

fn unknown(head: &[u8], path: &Path) -> DataError {
    DataError::UnknownFormat {
        expected: FORMATS
            .iter()
            .map(|f| f.name)
            .collect::<Vec<_>>()
            .join(" or "),
        found: head[..head.len().min(12)].escape_ascii().to_string(),
        path: path.into(),
    }
}
