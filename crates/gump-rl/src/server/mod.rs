//! Environments for other processes, over a Unix socket; only on Unix.
//!
//! [`Server::bind`], then [`Server::run`]. Every client gets its own environment; scenarios and world
//! are shared. Invalid requests are answered with an error and at worst close that connection; the
//! server and other clients are not affected. `python/gump_env.py` is a client, and
//! `python/gump_sb3.py` adapts it to Stable-Baselines3.
//!
//! # Protocol, version 1
//! Client and server take turns: one request, one answer. A frame is
//!
//! | bytes | content |
//! |---|---|
//! | 4 | `n`, the length of the body, `u32` |
//! | 1 | the kind of the frame |
//! | `n` | the body |
//!
//! All numbers are little-endian. `N` is the number of rows, `A` the numbers in an action. A flag is
//! a byte that is 0 or 1. An *observation* is `f32` numbers or, where the server says so, bytes of
//! packed bits: `[layer, row, column]`, eight columns to a byte, the first in its lowest bit.
//!
//! Requests:
//!
//! | kind | body |
//! |---|---|
//! | 1 hello, the first | the letters `GUMP`; version `u16`; autoreset mode `u8`: 0 next step, 1 same step, 2 disabled; observation `u8`: 0 vector, 1 raster; dynamics `u8`: 0 bicycle, 1 next pose, 2 trajectory; rows `u32` |
//! | 2 reset | `u8`: bit 0 seeds follow, bit 1 a mask follows; then `N` seeds, `u64`; then `N` flags: the rows meant, all without a mask. Without seeds a row goes on to its next episode |
//! | 3 step | `N * A` numbers in [-1, 1], `f32`, row by row |
//! | 4 goodbye | empty; there is no answer |
//!
//! Answers:
//!
//! | kind | body |
//! |---|---|
//! | 65 ready, to hello | rows `u32`; `A` `u32`; seconds per step `f64`; number of scenarios `u32`; packed `u8` flag; number of axes of an observation `u8`; their lengths, `u32` each |
//! | 66 observations, to reset | `N` observations |
//! | 67 stepped, to step | `N` observations; `N` rewards, `f32`; `N` flags each: terminated, truncated, restarted (the observation is the first of an episode); the number of episodes that ended, `u32`; for each: row `u32`, scenario `u32`, steps `u32`, sum of rewards `f32`, metres of progress `f32`, three flags: collided, off the road, uncomfortable, and the observation it ended with |
//! | 127 error | code `u8`; a sentence, UTF-8. 1: the request made no sense, the server hangs up; 2: it was refused and changed nothing; 3: the world failed, reset before the next step |

mod connection;
mod error;
mod frame;

use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use crate::{EnvConfig, PreparedScenario, TrafficSource};

pub use connection::{Connection, Farewell};
pub use error::ServerError;

/// An event between the server and a client.
#[derive(Debug)]
#[non_exhaustive]
pub enum Event {
    /// A client has connected.
    Came {
        /// Its number, from 0.
        client: usize,
    },
    /// A client has disconnected.
    Left {
        /// Its number.
        client: usize,
        /// Its progress, including unfinished episodes.
        farewell: Farewell,
    },
}

/// Provides environments to clients.
#[derive(Debug)]
pub struct Server {
    listener: UnixListener,
    path: PathBuf,
    stopped: AtomicBool,
    n_clients: AtomicUsize,
    /// The connected clients, which are disconnected when it stops.
    clients: Mutex<Vec<(usize, UnixStream)>>,
}

impl Server {
    /// Listens at `path`. A stale socket of a server that has ended is replaced.
    ///
    /// # Errors
    /// [`ServerError::InUse`] where a server listens already, [`ServerError::Listen`].
    pub fn bind(path: &Path) -> Result<Self, ServerError> {
        let failed = |source| ServerError::Listen {
            source,
            path: path.to_owned(),
        };
        if UnixStream::connect(path).is_ok() {
            return Err(ServerError::InUse(path.to_owned()));
        }
        let is_socket = std::fs::symlink_metadata(path).is_ok_and(|meta| {
            use std::os::unix::fs::FileTypeExt as _;
            meta.file_type().is_socket()
        });
        if is_socket {
            std::fs::remove_file(path).map_err(failed)?;
        }
        Ok(Self {
            listener: UnixListener::bind(path).map_err(failed)?,
            path: path.to_owned(),
            stopped: AtomicBool::new(false),
            n_clients: AtomicUsize::new(0),
            clients: Mutex::default(),
        })
    }

    /// The path of the socket.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Serves until [`Server::stop`]. Clients choose the number of rows, the autoreset mode, the
    /// observations and the kind of dynamics; everything else is as in `config`.
    ///
    /// # Errors
    /// [`ServerError::Listen`] if no client can be accepted any more.
    pub fn run(
        &self,
        prepared: &Arc<[PreparedScenario]>,
        traffic: TrafficSource<'_>,
        config: &EnvConfig,
        report: &(dyn Fn(Event) + Sync),
    ) -> Result<(), ServerError> {
        std::thread::scope(|scope| {
            loop {
                let accepted = self.listener.accept();
                if self.stopped.load(Ordering::SeqCst) {
                    self.hang_up();
                    return Ok(());
                }
                let (stream, _) = match accepted {
                    Ok(accepted) => accepted,
                    // A client that was gone before it was let in.
                    Err(e) if e.kind() == std::io::ErrorKind::ConnectionAborted => continue,
                    Err(source) => {
                        self.hang_up();
                        let path = self.path.clone();
                        return Err(ServerError::Listen { source, path });
                    }
                };
                let client = self.n_clients.fetch_add(1, Ordering::SeqCst);
                if let Ok(copy) = stream.try_clone() {
                    self.lock().push((client, copy));
                }
                scope.spawn(move || {
                    report(Event::Came { client });
                    let connection = Connection::new(stream, prepared, traffic, config);
                    let farewell = connection.serve();
                    self.lock().retain(|(other, _)| *other != client);
                    report(Event::Left { client, farewell });
                });
            }
        })
    }

    /// Disconnects all clients and lets [`Server::run`] return.
    pub fn stop(&self) {
        self.stopped.store(true, Ordering::SeqCst);
        // Wakes it up; if that fails, it no longer listens.
        drop(UnixStream::connect(&self.path));
    }

    fn hang_up(&self) {
        for (_, stream) in self.lock().iter() {
            // A client that is gone already needs no goodbye.
            drop(stream.shutdown(std::net::Shutdown::Both));
        }
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Vec<(usize, UnixStream)>> {
        // The list holds finished values only, so a panic elsewhere cannot have broken it.
        self.clients.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        // It is no error if the socket is already gone.
        drop(std::fs::remove_file(&self.path));
    }
}
