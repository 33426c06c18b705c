//! Process groups started by `mpirun`, with sums by MPI.

use std::rc::Rc;

use mpi::Threading;
use mpi::collective::{CommunicatorCollectives as _, SystemOperation};
use mpi::environment::Universe;
use mpi::traits::Communicator as _;

use super::process_group::ProcessGroup;
use crate::{ProcessGroupError, TrainError};

/// The processes started by `mpirun`.
#[derive(Clone)]
pub struct Mpi {
    universe: Rc<Universe>,
}

impl Mpi {
    /// Joins the group; a process that `mpirun` did not start is alone.
    ///
    /// # Errors
    /// [`TrainError::ProcessGroup`] if this process has joined before.
    pub fn join() -> Result<Self, TrainError> {
        // Other threads compute; only this one talks.
        let joined = mpi::initialize_with_threading(Threading::Funneled);
        let (universe, _) =
            joined.ok_or_else(|| TrainError::from(ProcessGroupError::AlreadyJoined))?;
        Ok(Self {
            universe: universe.into(),
        })
    }

    /// Skips MPI's finalization, so that `mpirun` stops the other processes when this one ends: for
    /// a process that failed while others may not have.
    pub fn abort(&self) {
        std::mem::forget(self.clone());
    }
}

impl ProcessGroup for Mpi {
    fn rank(&self) -> usize {
        usize::try_from(self.universe.world().rank()).expect("ranks count from 0")
    }

    fn size(&self) -> usize {
        usize::try_from(self.universe.world().size()).expect("sizes count from 1")
    }

    fn sum(&self, numbers: &mut [f32]) -> Result<(), TrainError> {
        let own = numbers.to_vec();
        let world = self.universe.world();
        world.all_reduce_into(&own[..], numbers, SystemOperation::sum());
        Ok(())
    }
}
