//! Where training takes its scenarios from: memory, or files that are larger than memory.

use std::borrow::Cow;

use gump_model::ModelError;
use gump_scene::Scenario;

/// Scenarios by number, asked for from many threads at once.
///
/// What a number stands for must not change: samples are drawn by it, in a resumed run too.
pub trait ScenarioSource: Send + Sync {
    /// How many there are.
    fn len(&self) -> usize;

    /// True if there are none.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The scenario that a sample of a training step shows, told from a number drawn at random.
    ///
    /// Collections that change over time answer for the time of the step; [`ScenarioSource::get`] must know
    /// every answer, however long ago the step was.
    fn pick(&self, step: usize, draw: u64) -> usize {
        let _ = step;
        (draw % self.len() as u64) as usize
    }

    /// Scenario `index`, which is below [`ScenarioSource::len`] or was picked.
    ///
    /// # Errors
    /// [`ModelError::Scene`] for one that cannot be fetched.
    fn get(&self, index: usize) -> Result<Cow<'_, Scenario>, ModelError>;
}

impl ScenarioSource for Vec<Scenario> {
    fn len(&self) -> usize {
        Self::len(self)
    }

    fn get(&self, index: usize) -> Result<Cow<'_, Scenario>, ModelError> {
        Ok(Cow::Borrowed(&self[index]))
    }
}
