//! The threads that do the work: a pool per process, created on first use.
//!
//! The child of a process that forks (data loaders do) does not have its threads, and work given to
//! them would never be done; so a child creates its own pool.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use pyo3::prelude::*;
use rayon::{ThreadPool, ThreadPoolBuilder};

use crate::errors;

/// The pool of a process, and the requested number of threads (0 for all cores).
struct Current {
    process: u32,
    requested: usize,
    pool: Option<Arc<ThreadPool>>,
}

static CURRENT: Mutex<Current> = Mutex::new(Current {
    process: 0,
    requested: 0,
    pool: None,
});

/// The pool of this process.
///
/// Error: threads cannot be started.
pub(crate) fn pool() -> PyResult<Arc<ThreadPool>> {
    let mut current = CURRENT.lock().unwrap_or_else(PoisonError::into_inner);
    let process = std::process::id();
    if current.process != process {
        // The threads of the parent do not exist in a forked process, so they cannot be joined.
        std::mem::forget(current.pool.take());
        current.process = process;
    }
    if let Some(pool) = &current.pool {
        return Ok(Arc::clone(pool));
    }
    let builder = ThreadPoolBuilder::new().num_threads(current.requested);
    let pool = builder.thread_name(|i| format!("gump {i}")).build();
    let pool = Arc::new(pool.map_err(errors::runtime)?);
    current.pool = Some(Arc::clone(&pool));
    Ok(pool)
}

/// Does work on the pool, while other Python threads continue.
///
/// Error: threads cannot be started.
pub(crate) fn work<T: Send>(py: Python<'_>, work: impl FnOnce() -> T + Send) -> PyResult<T> {
    let pool = pool()?;
    Ok(py.detach(|| pool.install(work)))
}

/// Uses so many threads from now on; 0 for one per core.
#[pyfunction]
pub(crate) fn set_threads(n: usize) -> PyResult<()> {
    let old = {
        let mut current = CURRENT.lock().unwrap_or_else(PoisonError::into_inner);
        current.requested = n;
        current.pool.take()
    };
    drop(old);
    pool().map(drop)
}

/// Number of threads that do the work.
#[pyfunction]
pub(crate) fn n_threads() -> PyResult<usize> {
    Ok(pool()?.current_num_threads())
}

/// A job for a thread that does nothing else meanwhile.
type Job = Box<dyn FnOnce() + Send>;

/// Threads with a pool each that wait for a job: how large the pool is, and where jobs go.
struct Idle {
    process: u32,
    threads: Vec<(usize, Sender<Job>)>,
}

static IDLE: Mutex<Idle> = Mutex::new(Idle {
    process: 0,
    threads: Vec::new(),
});

/// The idle threads of this process, locked.
fn idle() -> MutexGuard<'static, Idle> {
    let mut idle = IDLE.lock().unwrap_or_else(PoisonError::into_inner);
    let process = std::process::id();
    if idle.process != process {
        // The threads of the parent do not exist in a forked process.
        std::mem::forget(std::mem::take(&mut idle.threads));
        idle.process = process;
    }
    idle
}

/// Does a long job on a separate thread, with a separate pool of the same size as the shared one.
///
/// For values that cannot move between threads, such as the session of a world. Threads are reused,
/// since a pool that includes the thread that built it can never be dropped.
///
/// Error: threads cannot be started.
pub(crate) fn alone(job: impl FnOnce() + Send + 'static) -> PyResult<()> {
    let size = n_threads()?;
    let mut job: Job = Box::new(job);
    let mut idle = idle();
    while let Some(i) = idle.threads.iter().position(|(n, _)| *n == size) {
        let (_, jobs) = idle.threads.swap_remove(i);
        match jobs.send(job) {
            Ok(()) => return Ok(()),
            Err(refused) => job = refused.0,
        }
    }
    drop(idle);
    let (jobs, waiting) = channel();
    let (sender, receiver) = channel();
    let builder = std::thread::Builder::new().name("gump session".into());
    let own = jobs.clone();
    let thread = builder.spawn(move || {
        // This thread takes part in the pool: what it does in parallel is done there.
        let pool = ThreadPoolBuilder::new().num_threads(size);
        let pool = pool.use_current_thread().build();
        let problem = pool.as_ref().err().map(ToString::to_string);
        if sender.send(problem).is_ok() && pool.is_ok() {
            serve(size, &own, &waiting);
        }
    });
    thread.map_err(errors::runtime)?;
    if let Some(problem) = receiver.recv().map_err(errors::runtime)? {
        return Err(errors::runtime(problem));
    }
    jobs.send(job).map_err(errors::runtime)
}

/// Does one job after another, waiting among the idle between them.
fn serve(size: usize, jobs: &Sender<Job>, waiting: &Receiver<Job>) {
    while let Ok(job) = waiting.recv() {
        // A panic of the job drops its channel, which its caller notices.
        drop(catch_unwind(AssertUnwindSafe(job)));
        idle().threads.push((size, jobs.clone()));
    }
}
