//! Detection of formats from content.
//!
//! The table of formats: a new one is one line in [`FORMATS`]. Files that belong to a format
//! without containing scenarios (maps, calibrations, recordings of lights) are in [`COMPANIONS`].
//! Each format reads its own files.

use std::path::Path;

#[cfg(feature = "argoverse2")]
use super::argoverse2;
#[cfg(feature = "commonroad")]
use super::commonroad;
#[cfg(feature = "nuplan")]
use super::nuplan;
#[cfg(feature = "sumo")]
use super::sumo;
#[cfg(feature = "taf-bw")]
use super::taf_bw;
use super::{cache, gpudrive, scenario_json, womd};
use crate::DataError;
use crate::io::stream;
use crate::source::{Companion, Format, HEAD_BYTES};

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

/// Parts of the names of scenario files with binary content: such a file that is not recognised is
/// damaged rather than something else.
const BINARY_NAMES: [&str; 4] = [".tfrecord", ".parquet", ".feather", ".db"];

/// The kind of a file.
pub(crate) enum Role {
    /// It contains scenarios.
    Scenarios(&'static Format),
    /// It belongs to a format but contains no scenarios.
    Companion(&'static str),
    /// It is of no known kind: a description, and the error for opening it.
    Unknown(&'static str, DataError),
}

/// Examines the beginning of a file.
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
