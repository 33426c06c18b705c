//! Process groups: processes that train one network together. Each processes its share of every
//! batch, and results are summed.

use crate::TrainError;

/// The group of processes of a run, as seen by one of them.
///
/// All processes must call [`ProcessGroup::sum`] equally often and in the same order.
pub trait ProcessGroup {
    /// Rank of this process, from 0; rank 0 writes the files of the run.
    fn rank(&self) -> usize;

    /// Number of processes.
    fn size(&self) -> usize;

    /// Replaces every number by its sum over all processes, with equal bits on each.
    ///
    /// # Errors
    /// [`TrainError::ProcessGroup`] if the connection to another process is lost.
    fn sum(&self, numbers: &mut [f32]) -> Result<(), TrainError>;
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

    fn sum(&self, _: &mut [f32]) -> Result<(), TrainError> {
        Ok(())
    }
}
