//! Processes that train one network together: each learns from its share of every batch, and what
//! they found is summed.

use gump_model::ModelError;

/// The processes of a run, as one of them sees them.
///
/// All call [`ProcessGroup::sum`] equally often and in the same order.
pub trait ProcessGroup {
    /// Which one this is, from 0; the first one writes what the run writes.
    fn rank(&self) -> usize;

    /// How many there are.
    fn size(&self) -> usize;

    /// Replaces every number by its sum over all processes, equal to the bit on each.
    ///
    /// # Errors
    /// [`ModelError::Peers`] if another one is gone.
    fn sum(&self, numbers: &mut [f32]) -> Result<(), ModelError>;
}

/// A run of one process.
#[derive(Clone, Debug)]
pub struct SingleProcess;

impl ProcessGroup for SingleProcess {
    fn rank(&self) -> usize {
        0
    }

    fn size(&self) -> usize {
        1
    }

    fn sum(&self, _: &mut [f32]) -> Result<(), ModelError> {
        Ok(())
    }
}
