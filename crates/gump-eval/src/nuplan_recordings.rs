//! Recordings of nuPlan logs: exact clocks, the ego at its rear axle, the expert beyond the end.

use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use gump_data::ReadOptions;
use gump_data::nuplan::{Extraction, Log, Maps, NuplanScenario, ScenarioFilter, Selected};
use gump_nuplan::closed_loop::Recording;
use gump_scene::VehicleParameters;

use crate::recordings::{Case, Named};
use crate::{EvalError, RecordingError};

/// First bytes of an SQLite file.
const MAGIC: &[u8] = b"SQLite format 3\0";

/// The nuPlan logs of a path, if it is one or a folder of some.
pub(crate) fn logs_of(path: &Path) -> Vec<PathBuf> {
    let is_log = |path: &PathBuf| {
        let mut head = [0; MAGIC.len()];
        let named = path.extension().is_some_and(|extension| extension == "db");
        let mut read = || File::open(path)?.read_exact(&mut head);
        let complete = read().is_ok();
        named && complete && head == MAGIC
    };
    if path.is_dir() {
        let entries = std::fs::read_dir(path).into_iter().flatten();
        let mut logs: Vec<PathBuf> = entries
            .filter_map(|entry| Some(entry.ok()?.path()))
            .filter(is_log)
            .collect();
        logs.sort();
        return logs;
    }
    let path = path.to_owned();
    if is_log(&path) {
        vec![path]
    } else {
        Vec::new()
    }
}

/// Every tagged scenario of some logs, read one by one.
pub(crate) fn open(paths: &[PathBuf]) -> Result<Box<dyn Iterator<Item = Named> + Send>, EvalError> {
    let (logs, selected) = select(paths)?;
    let mut maps = Maps::default();
    Ok(Box::new(selected.into_iter().map(move |selected| Named {
        id: selected.event.token.to_string(),
        // The name of a log itself contains dots.
        log_name: stem(logs[selected.log].path()),
        scenario_type: selected.scenario_type.clone(),
        case: case(&logs[selected.log], &selected, &mut maps),
    })))
}

/// The ids of [`open`], without the scenarios.
pub(crate) fn ids(paths: &[PathBuf]) -> Result<Vec<String>, EvalError> {
    let (_, selected) = select(paths)?;
    let ids = selected.iter().map(|selected| selected.event.token);
    Ok(ids.map(|token| token.to_string()).collect())
}

/// Some logs and their tagged scenarios.
fn select(paths: &[PathBuf]) -> Result<(Vec<Log>, Vec<Selected>), EvalError> {
    let logs: Vec<Log> = paths
        .iter()
        .map(|path| Log::open(path))
        .collect::<Result<_, _>>()?;
    let selected = ScenarioFilter::default().select(&logs)?;
    if selected.is_empty() {
        let logs = paths.to_vec();
        return Err(RecordingError::NoTaggedScenarios { logs }.into());
    }
    Ok((logs, selected))
}

fn stem(path: &Path) -> String {
    let stem = path.file_stem().unwrap_or_default();
    stem.to_string_lossy().into_owned()
}

fn case(log: &Log, selected: &Selected, maps: &mut Maps) -> Result<Case, EvalError> {
    let map = Arc::clone(&maps.of(log)?.graph);
    let (event, kind) = (&selected.event, &selected.scenario_type);
    let read = NuplanScenario::read(log, event, kind, &map, &Extraction::default())?;
    let unusable = |problem| RecordingError::UnusableInLog {
        log: log.path().to_owned(),
        token: event.token,
        problem,
    };
    let (scenario, _) = read.to_scenario(ReadOptions::ALL).map_err(unusable)?;
    let frames = read.history.iter().chain(&read.iterations);
    let ego = frames.map(|frame| frame.ego).collect();
    Ok(Case {
        recording: Recording::new(scenario, ego, VehicleParameters::PACIFICA, read.goal)?,
        map,
        after: read.ego_after,
        map_name: log.map_name().into(),
    })
}
