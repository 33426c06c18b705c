//! Sources of training scenarios: memory, or files larger than memory.

use std::borrow::Cow;
use std::sync::Arc;

use gump_model::checkpoint::Archive;
use gump_scene::{Frame, Scenario, Seed};

use crate::TrainError;

/// The entry of a checkpoint's header for what the run is trained on.
pub(crate) const DATA: &str = "data";

/// Scenarios by index, read from many threads at once.
///
/// The scenario of an index must not change: samples are drawn by index, in resumed runs as well.
pub trait ScenarioSource: Send + Sync {
    /// Number of scenarios.
    fn len(&self) -> usize;

    /// True if there are none.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The index of the scenario for a sample of a training step, from a random number.
    ///
    /// Collections that change over time answer for the time of the step; [`ScenarioSource::get`]
    /// must accept every index ever returned, however long ago the step was.
    fn pick(&self, step: usize, draw: u64) -> usize {
        let _ = step;
        (draw % self.len() as u64) as usize
    }

    /// Scenario `index`, which `pick` returned; other numbers need not name one.
    ///
    /// # Errors
    /// [`TrainError::Source`] for one that cannot be read.
    fn get(&self, index: usize) -> Result<Cow<'_, Scenario>, TrainError>;

    /// A text that differs where scenarios, their order or their shares do: a checkpoint holds it, and a
    /// run is resumed with the same. Empty where it is unknown; then nothing is compared.
    fn identity(&self) -> String {
        String::new()
    }
}

/// The [`ScenarioSource::identity`] of scenarios with these ids in this order.
pub fn identity_of<'a>(ids: impl Iterator<Item = &'a str>) -> String {
    let (mut hash, mut n) = (Seed(0), 0);
    for id in ids {
        hash = id.bytes().fold(hash, |hash, byte| hash.fork(byte.into()));
        // No byte of an id.
        hash = hash.fork(256);
        n += 1;
    }
    let scenarios = if n == 1 { "scenario" } else { "scenarios" };
    format!("{n} {scenarios} ({:016x})", hash.0)
}

/// Checks that a run is resumed with the scenarios that it began with.
pub(crate) fn check_data(
    archive: &Archive,
    scenarios: &dyn ScenarioSource,
) -> Result<(), TrainError> {
    // Checkpoints of earlier versions do not have it.
    let begun = archive.entry(DATA).unwrap_or_default();
    let found = scenarios.identity();
    if begun.is_empty() || found.is_empty() || begun == found {
        return Ok(());
    }
    Err(TrainError::OtherData {
        begun: begun.to_owned(),
        found,
    })
}

/// The scenario with another log, of which nothing is copied before.
pub(crate) fn with_log(scenario: &Scenario, log: Vec<Frame>) -> Scenario {
    Scenario {
        id: scenario.id.clone(),
        map: Arc::clone(&scenario.map),
        route: scenario.route.clone(),
        log,
        targets: scenario.targets.clone(),
        objects_of_interest: scenario.objects_of_interest.clone(),
        tags: scenario.tags.clone(),
        ..*scenario
    }
}

impl ScenarioSource for Vec<Scenario> {
    fn len(&self) -> usize {
        Self::len(self)
    }

    fn get(&self, index: usize) -> Result<Cow<'_, Scenario>, TrainError> {
        Ok(Cow::Borrowed(&self[index]))
    }

    fn identity(&self) -> String {
        identity_of(self.iter().map(|scenario| scenario.id.as_str()))
    }
}
