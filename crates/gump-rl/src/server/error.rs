//! What can go wrong between a server and its clients.

use std::io;
use std::path::PathBuf;

use crate::RlError;

/// Why a server or a connection ended, or a request was refused.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// Another server listens there.
    #[error("a server listens already at {}", .0.display())]
    InUse(PathBuf),
    /// The socket cannot be listened at.
    #[error("cannot listen: {source}: {}", path.display())]
    Listen {
        /// What the system says.
        source: io::Error,
        /// The socket.
        path: PathBuf,
    },
    /// The client hung up without a goodbye.
    #[error("the client hung up {during}")]
    Disconnected {
        /// What it was about to say.
        during: &'static str,
    },
    /// The connection broke.
    #[error("the connection broke: {0}")]
    Broken(io::Error),
    /// The client speaks another language.
    #[error("a connection begins with the letters GUMP and version {version}")]
    Greeting {
        /// The version spoken here.
        version: u16,
    },
    /// A request of no known kind, or out of turn.
    #[error("expected a {expected}, found a frame of kind {found}")]
    Kind {
        /// What may come now.
        expected: &'static str,
        /// What came.
        found: u8,
    },
    /// A body of another length than its kind has.
    #[error("a {what} has {expected} bytes, found {found}")]
    Length {
        /// The request.
        what: &'static str,
        /// What it needs.
        expected: usize,
        /// What the frame says.
        found: usize,
    },
    /// A byte that stands for nothing.
    #[error("the {what} is {found}, expected at most {most}")]
    Choice {
        /// What was to be chosen.
        what: &'static str,
        /// The largest number that stands for something.
        most: u32,
        /// What came.
        found: u32,
    },
    /// The environment refuses or has failed.
    #[error(transparent)]
    Env(#[from] RlError),
}

impl ServerError {
    /// The code of the protocol's error frame; `None` where nobody listens any more.
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
