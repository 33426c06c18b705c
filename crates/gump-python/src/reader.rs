//! Files and messages as scenarios, one at a time.

use std::collections::VecDeque;
use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};

use gump_data::tfrecord::TfRecordReader;
use gump_data::womd::{decode_scenario, scenario_from_proto};
use gump_data::{DataError, Problem, ReadOptions, list_files, open_files};
use gump_wosac::realism::{Log, N_HISTORY, N_STEPS};
use pyo3::prelude::*;

use crate::errors;
use crate::scenario::{Scenario, Scene};

/// Realism is judged by the lights that were recorded.
const OPTIONS: ReadOptions = ReadOptions {
    infer_light_gaps: false,
    ..ReadOptions::ALL
};

/// Iterates over the scenarios of a file or folder.
///
/// Holds one scenario in memory. A damaged record raises `DataError`; the next call continues after
/// it.
#[pyclass(frozen, module = "gump")]
pub(crate) struct Reader {
    /// `None` once it is closed.
    queue: Mutex<Option<FileQueue>>,
}

/// Files that are still to be read, and the one being read.
struct FileQueue {
    files: VecDeque<PathBuf>,
    open: Open,
}

enum Open {
    Nothing,
    /// Waymo's messages, whose logs are scored as they stand.
    Waymo(Box<TfRecordReader>),
    Other(Box<gump_data::Reader>),
}

#[pymethods]
impl Reader {
    #[new]
    fn new(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        py.detach(|| {
            // A file or folder without scenarios is an error at once, not an empty iterator.
            drop(gump_data::open_with(&path, OPTIONS)?);
            let files = list_files(&path)?.into();
            let open = Open::Nothing;
            let queue = Mutex::new(Some(FileQueue { files, open }));
            Ok(Self { queue })
        })
        .map_err(|error| errors::data(&error))
    }

    fn __iter__(slf: PyRef<'_, Self>) -> PyRef<'_, Self> {
        slf
    }

    fn __next__(&self, py: Python<'_>) -> PyResult<Option<Scenario>> {
        let next = py.detach(|| {
            let mut queue = self.queue.lock().unwrap_or_else(PoisonError::into_inner);
            queue.as_mut().map(FileQueue::next)
        });
        match next {
            None => Err(errors::value(
                "expected a reader that is open, found one that was closed",
            )),
            Some(None) => Ok(None),
            Some(Some(Ok(scene))) => Ok(Some(Scenario::new(scene))),
            Some(Some(Err(error))) => Err(errors::data(&error)),
        }
    }

    /// Closes the file being read; `next()` raises `ValueError` from then on.
    fn close(&self, py: Python<'_>) {
        py.detach(|| {
            let mut queue = self.queue.lock().unwrap_or_else(PoisonError::into_inner);
            *queue = None;
        });
    }

    fn __enter__(slf: PyRef<'_, Self>) -> PyRef<'_, Self> {
        slf
    }

    #[pyo3(signature = (*_error))]
    fn __exit__(&self, py: Python<'_>, _error: &Bound<'_, pyo3::types::PyTuple>) {
        self.close(py);
    }
}

impl FileQueue {
    fn next(&mut self) -> Option<Result<Scene, DataError>> {
        loop {
            let next = match &mut self.open {
                Open::Nothing => None,
                Open::Waymo(records) => records.next().map(|payload| {
                    let payload = payload?;
                    waymo(&payload.bytes).map_err(|problem| DataError::Scenario {
                        id: problem.0,
                        problem: problem.1,
                        place: payload.place,
                    })
                }),
                Open::Other(reader) => reader.next().map(|record| Ok(Scene::of(record?.scenario))),
            };
            if next.is_some() {
                return next;
            }
            let file = self.files.pop_front()?;
            match open(file) {
                Ok(open) => self.open = open,
                Err(error) => {
                    self.open = Open::Nothing;
                    return Some(Err(error));
                }
            }
        }
    }
}

fn open(file: PathBuf) -> Result<Open, DataError> {
    let mut first = TfRecordReader::open(file.clone())?;
    if matches!(first.next(), Some(Ok(_))) {
        return Ok(Open::Waymo(Box::new(TfRecordReader::open(file)?)));
    }
    Ok(Open::Other(Box::new(open_files(vec![file], OPTIONS))))
}

/// A scenario of Waymo's, or its id (empty if unknown) and what is wrong with it.
fn waymo(bytes: &[u8]) -> Result<Scene, (String, Problem)> {
    let message = decode_scenario(bytes).map_err(|problem| (String::new(), problem))?;
    let (scenario, _) = scenario_from_proto(&message, ReadOptions::ALL)
        .map_err(|problem| (message.scenario_id().to_owned(), problem))?;
    // The metric is defined on Waymo's own clock.
    let is_waymos = (scenario.now + 1, scenario.log.len()) == (N_HISTORY, N_STEPS);
    let log = is_waymos.then(|| Log {
        ego: Some(scenario.ego),
        targets: scenario.targets.clone(),
        ..Log::of_message(&message)
    });
    Ok(Scene::with_log(scenario, log))
}

/// The scenario of a serialized `waymo.open_dataset.Scenario` message.
#[pyfunction]
pub(crate) fn read(py: Python<'_>, message: &[u8]) -> PyResult<Scenario> {
    let scene = py.detach(|| waymo(message)).map_err(|(id, problem)| {
        let of = if id.is_empty() {
            String::new()
        } else {
            format!("scenario {id}: ")
        };
        errors::DataError::new_err(format!("{of}{problem}"))
    })?;
    Ok(Scenario::new(scene))
}

/// One scenario by name: `PATH`, `PATH#INDEX` or `PATH#SCENARIO_ID`.
#[pyfunction]
pub(crate) fn find(py: Python<'_>, name: &str) -> PyResult<Scenario> {
    let scene = py.detach(|| {
        let record = gump_data::find_record(name)?;
        let path = record.path.as_ref().clone();
        if !matches!(open(path.clone())?, Open::Waymo(_)) {
            return Ok(Scene::of(record.scenario));
        }
        // Its message, for the log.
        for payload in TfRecordReader::open(path)? {
            let payload = payload?;
            if payload.place.offset == record.offset
                && let Ok(scene) = waymo(&payload.bytes)
            {
                return Ok(scene);
            }
        }
        Ok(Scene::of(record.scenario))
    });
    scene
        .map(Scenario::new)
        .map_err(|error| errors::data(&error))
}
