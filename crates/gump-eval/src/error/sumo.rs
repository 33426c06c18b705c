//! SUMO: missing, of another version, failing, or without a network.

use std::path::PathBuf;
use std::process::ExitStatus;

/// Why SUMO made no scenes.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SumoError {
    /// SUMO is not installed.
    #[error(
        "--kind sumo needs SUMO and found none in SUMO_HOME, on the PATH or in Python: \
         install it with `pip install eclipse-sumo` or `apt-get install sumo`; \
         --kind procedural needs nothing"
    )]
    NotInstalled,
    /// A list expects another version of SUMO, of which its scenes would be others.
    #[error(
        "the part {part} of {} expects SUMO {expected} \
         (`pip install eclipse-sumo=={expected}`), found \"{found}\"",
        list.display()
    )]
    Version {
        /// Name of the list's part.
        part: String,
        /// Path of the list.
        list: PathBuf,
        /// The version.
        expected: String,
        /// What SUMO says of its version.
        found: String,
    },
    /// A network is not there.
    #[error("expected a network, found none: {}", path.display())]
    NoNetwork {
        /// The missing file or folder.
        path: PathBuf,
    },
    /// A folder has no networks.
    #[error("expected *.net.xml or *.net.xml.gz, found none: {}", folder.display())]
    NoNetworks {
        /// The folder.
        folder: PathBuf,
    },
    /// A program of SUMO failed.
    #[error("{program} failed ({status}): {stderr}")]
    Failed {
        /// The program.
        program: String,
        /// Its exit status.
        status: ExitStatus,
        /// The lines of its output that tell errors.
        stderr: String,
    },
    /// All runs together gave too few scenes.
    #[error(
        "{runs} runs of SUMO gave {found} scenes of the {expected} of part {part}: \
         is there room to drive?"
    )]
    TooFewScenes {
        /// Number of runs.
        runs: u64,
        /// Number of their scenes.
        found: usize,
        /// Number of scenes that the part should have.
        expected: usize,
        /// Name of the list's part.
        part: String,
    },
}
