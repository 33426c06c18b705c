//! The processes that train together: those that `mpirun` started, or this one alone.

#[cfg(feature = "mpi")]
pub(crate) use gump_train::Mpi as Processes;
#[cfg(not(feature = "mpi"))]
pub(crate) use gump_train::SingleProcess as Processes;

/// Joins the other processes and works with them; one that fails makes `mpirun` stop the others.
///
/// Error: that of the work, or that the processes cannot be joined.
pub(crate) fn together<T>(work: impl FnOnce(&Processes) -> anyhow::Result<T>) -> anyhow::Result<T> {
    let processes = join()?;
    let done = work(&processes);
    #[cfg(feature = "mpi")]
    if done.is_err() {
        processes.abort();
    }
    done
}

#[cfg(feature = "mpi")]
fn join() -> anyhow::Result<Processes> {
    Ok(Processes::join()?)
}

/// Error: several processes were started, which would all write the same files.
#[cfg(not(feature = "mpi"))]
fn join() -> anyhow::Result<Processes> {
    use crate::cli::WrongArguments;
    // Set by Open MPI, and by MPICH and its derivatives.
    for name in ["OMPI_COMM_WORLD_SIZE", "PMI_SIZE"] {
        let size = std::env::var(name).ok().and_then(|size| size.parse().ok());
        if let Some(size) = size.filter(|&size: &usize| size > 1) {
            let why = format!(
                "{size} processes were started by MPI, this build knows nothing of it: \
                 build with `--features mpi`"
            );
            return Err(WrongArguments(why).into());
        }
    }
    Ok(Processes)
}
