//! Argoverse 2: motion-forecasting scenarios (Parquet with a map) and annotated sensor logs
//! (Feather with ego poses and a map).
//!
//! Neither states traffic lights or speed limits; forecasting scenarios have no sizes either. `map`
//! reads the map, `forecasting` and `sensor_log` the traffic, `columns` of the crate the tables of
//! both.
//!
//! Source: the formats' descriptions in the Argoverse 2 API documentation, checked on its samples.

mod forecasting;
mod map;
mod sensor_log;

use std::path::{Path, PathBuf};

use crate::DataError;
use crate::io::json;
use crate::io::stream::io_error;

pub(crate) use forecasting::FORMAT as FORECASTING;
pub(crate) use sensor_log::{FORMAT as SENSOR_LOG, is_feather};

/// Seconds between steps of all of Argoverse 2.
const DT: f64 = 0.1;

/// True for the JSON map that lies beside scenarios and logs.
pub(crate) fn is_map(head: &[u8]) -> bool {
    let keys = json::keys(head);
    let first = keys.first().map(String::as_str);
    matches!(
        first,
        Some("drivable_areas" | "lane_segments" | "pedestrian_crossings")
    )
}

/// The file beside `path` whose name starts and ends like this, the first by name.
///
/// Error: [`DataError::NoCompanion`], [`DataError::Io`].
fn beside(path: &Path, start: &str, end: &str) -> Result<PathBuf, DataError> {
    let folder = path
        .parent()
        .filter(|p| !p.as_os_str().is_empty())
        .unwrap_or(Path::new("."));
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(|e| io_error("list", e, folder))? {
        let entry = entry.map_err(|e| io_error("list", e, folder))?;
        let name = entry.file_name().to_string_lossy().into_owned();
        if name.starts_with(start) && name.ends_with(end) {
            found.push(entry.path());
        }
    }
    found.sort();
    found
        .into_iter()
        .next()
        .ok_or_else(|| DataError::NoCompanion {
            expected: format!("a file named {start}*{end}"),
            path: path.into(),
        })
}
