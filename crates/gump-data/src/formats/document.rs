//! Formats with one scenario per file, read as a whole.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use gump_scene::Scenario;

use crate::source::{BoxedSource, RecordSource};
use crate::{DataError, Problem, ReadOptions, ReadReport, RecordLocation, ScenarioRecord};

/// A file that was read and understood, but not yet turned into a scenario.
pub(crate) trait Document: Sized + Send + 'static {
    /// Its description in errors.
    const WHAT: &'static str;

    /// Reads the file.
    fn read(path: &Path) -> Result<Self, DataError>;

    /// The scenario's id.
    fn id(&self, path: &Path) -> String;

    /// The scenario, validated.
    fn scenario(
        self,
        id: String,
        options: ReadOptions,
        report: &mut ReadReport,
    ) -> Result<Scenario, Problem>;
}

/// Opens a file of this kind; it is read when its scenario is asked for.
pub(crate) fn open<D: Document>(
    path: &Path,
    options: ReadOptions,
) -> Result<BoxedSource, DataError> {
    Ok(Box::new(OneScenario::<D> {
        path: Some(path.to_path_buf()),
        options,
        kind: std::marker::PhantomData,
    }))
}

/// The file's name without folders and endings.
pub(crate) fn stem(path: &Path) -> String {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    name.split('.').next().unwrap_or_default().to_owned()
}

struct OneScenario<D> {
    /// The file, until it has been read.
    path: Option<PathBuf>,
    options: ReadOptions,
    kind: std::marker::PhantomData<fn() -> D>,
}

impl<D: Document> RecordSource for OneScenario<D> {
    fn skip(&mut self) -> Option<Result<(), DataError>> {
        self.path.take().map(|_| Ok(()))
    }

    fn next_wanted(
        &mut self,
        wanted: &mut dyn FnMut(&str) -> bool,
    ) -> Option<Result<ScenarioRecord, DataError>> {
        let path = self.path.take()?;
        let document = match D::read(&path) {
            Ok(document) => document,
            Err(error) => return Some(Err(error)),
        };
        let id = document.id(&path);
        wanted(&id).then(|| record(document, id, path, self.options))
    }
}

fn record<D: Document>(
    document: D,
    id: String,
    path: PathBuf,
    options: ReadOptions,
) -> Result<ScenarioRecord, DataError> {
    let mut report = ReadReport::default();
    match document.scenario(id.clone(), options, &mut report) {
        Ok(scenario) => Ok(ScenarioRecord {
            scenario,
            report,
            offset: 0,
            path: Arc::new(path),
        }),
        Err(problem) => Err(DataError::Scenario {
            id,
            problem,
            place: RecordLocation {
                record: 0,
                offset: 0,
                path,
            },
        }),
    }
}
