//! Recorded scenarios one at a time, as worlds see them and as the metric does.
//!
//! Of Waymo's messages the metric reads more than a scenario keeps: what invalid states hold,
//! which signals flash and when they were not seen, the order of the map. Other formats are scored
//! as scenarios, with the lights as recorded.

use std::cell::Cell;
use std::path::{Path, PathBuf};
use std::rc::Rc;

use gump_data::ReadOptions;
use gump_data::tfrecord::TfRecordReader;
use gump_data::womd::{decode_scenario, scenario_from_proto};
use gump_scene::Scenario;
use gump_wosac::realism::{Log, N_HISTORY, N_STEPS};

use crate::{ErrorContext, EvalError, RecordingError};

/// A recorded scenario.
pub struct Recorded {
    /// Position among all scenarios of the paths.
    pub index: usize,
    /// As worlds see it.
    pub scenario: Scenario,
    /// As the metric sees it.
    pub log: Log,
}

/// The `wanted` scenarios of files or directories in order; holds one at a time. Their indices go on
/// from one path to the next.
///
/// Gaps of Waymo's messages are filled as `options` say, those of other formats as far as possible:
/// some have no ego, no agents to predict or no road edges.
///
/// # Errors
/// A first path without scenarios. Errors of later paths and of single scenarios are items.
pub fn recordings<'a>(
    paths: &'a [PathBuf],
    options: ReadOptions,
    wanted: impl Fn(usize) -> bool + 'a,
) -> Result<Recordings<'a>, EvalError> {
    let (next, wanted): (_, Rc<dyn Fn(usize) -> bool>) = (Rc::default(), Rc::new(wanted));
    let open = move |path: &PathBuf| of_path(path, options, Rc::clone(&wanted), Rc::clone(&next));
    let (first, others) = paths.split_first().ok_or(RecordingError::NoScenarios)?;
    // A single path that holds none is an error at once; others are opened as they are reached.
    let first = open(first)?;
    Ok(Box::new(first.chain(others.iter().flat_map(
        move |path| match open(path) {
            Ok(recordings) => recordings,
            Err(error) => Box::new(std::iter::once(Err(error))),
        },
    ))))
}

/// Recorded scenarios, one at a time.
pub type Recordings<'a> = Box<dyn Iterator<Item = Result<Recorded, EvalError>> + 'a>;

/// The scenarios of one path, numbered from `next` on.
fn of_path<'a>(
    path: &Path,
    options: ReadOptions,
    wanted: Rc<dyn Fn(usize) -> bool + 'a>,
    next: Rc<Cell<usize>>,
) -> Result<Recordings<'a>, EvalError> {
    let files = waymo_files(path)?;
    let number = move || next.replace(next.get() + 1);
    if files.is_empty() {
        let recorded_lights = ReadOptions {
            infer_light_gaps: false,
            ..ReadOptions::ALL
        };
        let records = gump_data::open_with(path, recorded_lights)?;
        let records = records.map(move |record| (number(), record));
        let records = records.filter(move |(index, _)| wanted(*index));
        return Ok(Box::new(records.map(|(index, record)| {
            let scenario = record?.scenario;
            let log = Log::of(&scenario)?;
            Ok(Recorded {
                index,
                scenario,
                log,
            })
        })));
    }
    // Opened one after the other, as they are reached.
    let payloads = files.into_iter().flat_map(|file| {
        let (reader, error) = match TfRecordReader::open(file) {
            Ok(reader) => (Some(reader), None),
            Err(error) => (None, Some(Err(error))),
        };
        error.into_iter().chain(reader.into_iter().flatten())
    });
    let payloads =
        payloads
            .map(move |payload| (number(), payload))
            .filter(move |(index, payload)| {
                // What is broken is always reported.
                wanted(*index) || payload.is_err()
            });
    Ok(Box::new(payloads.map(move |(index, payload)| {
        let payload = payload?;
        recorded(index, &payload.bytes, options)
            .map_err(|error| error.at(ErrorContext::Record(payload.place)))
    })))
}

/// The TFRecord files at a path in order of their names; none if it holds another format.
fn waymo_files(path: &Path) -> Result<Vec<PathBuf>, EvalError> {
    if !path.is_dir() {
        let first = TfRecordReader::open(path.to_owned())?.next();
        let is_waymo = matches!(first, Some(Ok(_)));
        return Ok(is_waymo.then(|| path.to_owned()).into_iter().collect());
    }
    let mut files = Vec::new();
    let cannot = |cause| EvalError::io("list", path, cause);
    for entry in std::fs::read_dir(path).map_err(cannot)? {
        let file = entry.map_err(cannot)?.path();
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        if name.contains(".tfrecord") && !name.ends_with(".partial") && file.is_file() {
            files.push(file);
        }
    }
    files.sort();
    Ok(files)
}

fn recorded(index: usize, bytes: &[u8], options: ReadOptions) -> Result<Recorded, EvalError> {
    let message = decode_scenario(bytes).map_err(RecordingError::Unusable)?;
    let (scenario, _) = scenario_from_proto(&message, options).map_err(|problem| {
        let id = message.scenario_id().into();
        EvalError::from(RecordingError::Unusable(problem)).at(ErrorContext::Scenario { id })
    })?;
    // Waymo's own messages all have this clock; others are scored as scenarios.
    let log = match (scenario.now + 1, scenario.log.len()) {
        (N_HISTORY, N_STEPS) => Log {
            ego: Some(scenario.ego),
            targets: scenario.targets.clone(),
            ..Log::of_message(&message)
        },
        _ => Log::of(&scenario)?,
    };
    Ok(Recorded {
        index,
        scenario,
        log,
    })
}
