//! Recordings to drive through, from any readable file.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Context as _;
use gump_nuplan::closed_loop::{Recording, derive_roadblocks};
use gump_scene::{EgoState, MapGraph, Scenario};

use crate::nuplan_recordings;

/// A recording with what judging it takes besides.
pub(crate) struct Case {
    /// What is driven through.
    pub(crate) recording: Recording,
    /// What drives are judged on: the map as it was stated.
    pub(crate) map: Arc<MapGraph>,
    /// What was driven after the recording's end, if that is known.
    pub(crate) after: Vec<EgoState>,
    /// nuPlan's name of the map; empty for other formats.
    #[cfg_attr(
        not(feature = "grpc"),
        expect(dead_code, reason = "planners in other processes are told it")
    )]
    pub(crate) map_name: String,
}

/// A case or why there is none, by the name of its scenario.
pub(crate) struct Named {
    /// The scenario's id; where it cannot be read, where it was.
    pub(crate) id: String,
    /// The log it is of: the name of its file, without endings.
    pub(crate) log_name: String,
    /// nuPlan's type of scenario; "unknown" for other formats.
    pub(crate) scenario_type: String,
    /// The case.
    pub(crate) case: anyhow::Result<Case>,
}

/// Every scenario of a file or folder, read one by one.
///
/// Error: nothing there to read.
pub(crate) fn open(path: &Path) -> anyhow::Result<Box<dyn Iterator<Item = Named> + Send>> {
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
/// Error: nothing to read at the first; what is wrong with the others is told where it is.
pub(crate) fn open_all(
    paths: &[PathBuf],
) -> anyhow::Result<Box<dyn Iterator<Item = Named> + Send + '_>> {
    let (first, others) = paths
        .split_first()
        .context("expected scenarios, found none")?;
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

/// A file's name without its endings.
pub(crate) fn log_name(path: &Path) -> String {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    name.split('.').next().unwrap_or_default().into()
}

/// One scenario: `PATH`, `PATH#INDEX` or `PATH#ID`.
///
/// Error: no such scenario, or one that cannot be driven through.
pub(crate) fn find(source: &str) -> anyhow::Result<Case> {
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
        let (_, named) = found.with_context(|| format!("no scenario {wanted} in {path}"))?;
        return named.case;
    }
    of_boxes(gump_data::find(source)?)
}

/// A case of a scenario that knows boxes alone.
///
/// Error: no lanes, or a scenario that cannot be driven through.
fn of_boxes(mut scenario: Scenario) -> anyhow::Result<Case> {
    anyhow::ensure!(
        !scenario.map.lanes().is_empty(),
        "scenario {}: expected a map with lanes to plan on, found none",
        scenario.id
    );
    let map = Arc::clone(&scenario.map);
    derive_roadblocks(&mut scenario);
    Ok(Case {
        recording: Recording::of_boxes(scenario)?,
        map,
        after: Vec::new(),
        map_name: String::new(),
    })
}
