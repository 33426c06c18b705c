//! Errors of servers and connections.

use std::io;
use std::path::PathBuf;

use crate::RlError;

/// Why a server or a connection ended, or a request was refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ServerError {
    /// Another server listens there.
    #[error("a server listens already at {}", .0.display())]
    InUse(PathBuf),
    /// The socket cannot be listened on.
    #[error("cannot listen: {source}: {}", path.display())]
    Listen {
        /// The error of the system.
        source: io::Error,
        /// The socket.
        path: PathBuf,
    },
    /// The client closed the connection without a goodbye.
    #[error("the client hung up {during}")]
    Disconnected {
        /// The moment, for instance "between requests".
        during: &'static str,
    },
    /// The connection failed.
    #[error("the connection broke: {0}")]
    Broken(io::Error),
    /// The client uses another protocol or version.
    #[error("a connection begins with the letters GUMP and version {version}")]
    Greeting {
        /// The version of this server.
        version: u16,
    },
    /// A request of an unknown kind, or out of turn.
    #[error("expected a {expected}, found a frame of kind {found}")]
    Kind {
        /// The requests allowed now.
        expected: &'static str,
        /// The kind received.
        found: u8,
    },
    /// A body of the wrong length.
    #[error("a {what} has {expected} bytes, found {found}")]
    Length {
        /// The request.
        what: &'static str,
        /// The required length.
        expected: usize,
        /// The length in the frame.
        found: usize,
    },
    /// An invalid byte.
    #[error("the {what} is {found}, expected at most {most}")]
    Choice {
        /// Name of the setting that the byte selects.
        what: &'static str,
        /// The largest valid value.
        most: u32,
        /// The value received.
        found: u32,
    },
    /// The environment refuses or has failed.
    #[error(transparent)]
    Env(#[from] RlError),
}

impl ServerError {
    /// The code of the protocol's error frame; `None` where the client is gone.
    pub(super) fn code(&self) -> Option<u8> {
        match self {
            Self::InUse(_) | Self::Listen { .. } | Self::Disconnected { .. } | Self::Broken(_) => {
                None
            }
            Self::Greeting { .. }
            | Self::Kind { .. }
            | Self::Length { .. }
            | Self::Choice { .. } => Some(1),
            Self::Env(
                RlError::World { .. } | RlError::EgoVanished { .. } | RlError::TimeStep { .. },
            ) => Some(3),
            Self::Env(RlError::Count {
                who: "the world", ..
            }) => Some(3),
            Self::Env(_) => Some(2),
        }
    }
}
