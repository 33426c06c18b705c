//! Sources of training scenarios: memory, or files larger than memory.

use std::borrow::Cow;
use std::sync::Arc;

use gump_scene::{Frame, Scenario};

use crate::TrainError;

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

    /// Scenario `index`, which is below [`ScenarioSource::len`] or was returned by `pick`.
    ///
    /// # Errors
    /// [`TrainError::Source`] for one that cannot be read.
    fn get(&self, index: usize) -> Result<Cow<'_, Scenario>, TrainError>;
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
}
