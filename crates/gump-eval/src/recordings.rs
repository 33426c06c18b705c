//! Recordings to drive in, from any readable file.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use gump_nuplan::closed_loop::{Recording, derive_roadblocks};
use gump_scene::{EgoState, MapGraph, Scenario};

use crate::{ArgumentError, EvalError, LanePurpose, RecordingError, nuplan_recordings};

/// A recording with the additional data that scoring needs.
pub struct Case {
    /// The recording to drive in.
    pub recording: Recording,
    /// The map as it was stated, which drives are scored on.
    pub map: Arc<MapGraph>,
    /// The logged drive after the recording's end, if it is known.
    pub after: Vec<EgoState>,
    /// nuPlan's name of the map; empty for other formats.
    pub map_name: String,
}

/// A case, or why there is none, with the name of its scenario.
pub struct Named {
    /// The scenario's id; where it cannot be read, its position.
    pub id: String,
    /// The log it belongs to: the file name without extensions.
    pub log_name: String,
    /// nuPlan's type of scenario; "unknown" for other formats.
    pub scenario_type: String,
    /// The case.
    pub case: Result<Case, EvalError>,
}

/// Every scenario of a file or folder, read one by one.
///
/// Error: the path contains nothing to read.
pub fn open(path: &Path) -> Result<Box<dyn Iterator<Item = Named> + Send>, EvalError> {
    let logs = nuplan_recordings::logs_of(path);
    if !logs.is_empty() {
        return nuplan_recordings::open(&logs);
    }
    let place: PathBuf = path.into();
    let records = gump_data::open(path)?.enumerate();
    Ok(Box::new(records.map(move |(i, record)| {
        let (id, case) = match record {
            Ok(record) => (record.scenario.id.clone(), of_boxes(record.scenario)),
            Err(error) => (format!("{}#{i}", place.display()), Err(error.into())),
        };
        Named {
            id,
            log_name: log_name(&place),
            scenario_type: "unknown".into(),
            case,
        }
    })))
}

/// Every scenario of some files or folders, read one by one.
///
/// Error: the first path contains nothing to read. Errors of later paths are reported at their
/// position.
pub fn open_all(
    paths: &[PathBuf],
) -> Result<Box<dyn Iterator<Item = Named> + Send + '_>, EvalError> {
    let (first, others) = paths.split_first().ok_or(ArgumentError::NoScenarios)?;
    let others = others.iter().flat_map(|path| match open(path) {
        Ok(cases) => cases,
        Err(error) => Box::new(std::iter::once(Named {
            id: path.display().to_string(),
            log_name: log_name(path),
            scenario_type: "unknown".into(),
            case: Err(error),
        })) as Box<dyn Iterator<Item = Named> + Send>,
    });
    Ok(Box::new(open(first)?.chain(others)))
}

/// The ids of the first `limit` scenarios of some files or folders, in the order of [`open_all`] and
/// without what driving needs. A scenario that cannot be read is named by its position.
///
/// Error: the first path contains nothing to read.
pub fn ids(paths: &[PathBuf], limit: usize) -> Result<Vec<String>, EvalError> {
    let mut ids = Vec::new();
    for (n, path) in paths.iter().enumerate() {
        if ids.len() >= limit {
            break;
        }
        match ids_of_path(path, limit - ids.len()) {
            Ok(found) => ids.extend(found),
            Err(error) if n == 0 => return Err(error),
            Err(_) => ids.push(format!("#{}", ids.len())),
        }
    }
    Ok(ids)
}

fn ids_of_path(path: &Path, limit: usize) -> Result<Vec<String>, EvalError> {
    let logs = nuplan_recordings::logs_of(path);
    if !logs.is_empty() {
        let mut ids = nuplan_recordings::ids(&logs)?;
        ids.truncate(limit);
        return Ok(ids);
    }
    let records = gump_data::open(path)?.take(limit).enumerate();
    let ids = records.map(|(i, record)| match record {
        Ok(record) => record.scenario.id,
        Err(_) => format!("#{i}"),
    });
    Ok(ids.collect())
}

/// A file name without its extensions.
pub fn log_name(path: &Path) -> String {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    name.split('.').next().unwrap_or_default().into()
}

/// One scenario: `PATH`, `PATH#INDEX` or `PATH#ID`.
///
/// Error: no such scenario, or one that cannot be driven through.
pub fn find(source: &str) -> Result<Case, EvalError> {
    let (path, wanted) = source.split_once('#').unwrap_or((source, "0"));
    let logs = nuplan_recordings::logs_of(Path::new(path));
    if !logs.is_empty() {
        if logs.len() > 1 && !source.contains('#') {
            let several = gump_data::DataError::SeveralFiles {
                files: logs.len(),
                first: logs[0].clone(),
                path: path.into(),
            };
            return Err(several.into());
        }
        let mut all = nuplan_recordings::open(&logs)?.enumerate();
        let found = all.find(|(i, named)| named.id == wanted || i.to_string() == wanted);
        let none = || ArgumentError::NoSuchScenario {
            wanted: wanted.into(),
            path: path.into(),
        };
        let (_, named) = found.ok_or_else(none)?;
        return named.case;
    }
    of_boxes(gump_data::find(source)?)
}

/// A case of a scenario that has boxes only.
///
/// # Errors
/// No lanes, or a scenario that cannot be driven through.
pub fn of_boxes(mut scenario: Scenario) -> Result<Case, EvalError> {
    if scenario.map.lanes().is_empty() {
        return Err(RecordingError::NoLanes {
            scenario: scenario.id,
            purpose: LanePurpose::Plan,
        }
        .into());
    }
    let map = Arc::clone(&scenario.map);
    derive_roadblocks(&mut scenario);
    Ok(Case {
        recording: Recording::of_boxes(scenario)?,
        map,
        after: Vec::new(),
        map_name: String::new(),
    })
}
