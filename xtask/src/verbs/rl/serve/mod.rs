//! `rl serve`: environments for Python and others, over a Unix socket.

#[cfg(unix)]
mod server;

use std::path::PathBuf;

use gump_eval::benchmarks::ScenarioSetName;
use gump_eval::worlds::WorldName;
use serde::Serialize;

use crate::run::Common;

/// Arguments of `rl serve`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// Socket to listen on
    #[arg(long, value_name = "PATH")]
    socket: PathBuf,
    /// Scenarios to drive through: a file, a folder, or LIST.toml#SPLIT; of a list or a folder with
    /// a manifest.toml those of its train split
    #[arg(long, value_name = "SCENARIOS")]
    scenarios: ScenarioSetName,
    /// Traffic model: log, idm, constant-velocity or model:WEIGHTS
    #[arg(long, value_name = "W", default_value = "log")]
    world: WorldName,
    /// Maximum number of scenarios
    #[arg(long, value_name = "N")]
    limit: Option<usize>,
    /// Seconds until an episode is truncated
    #[arg(long, value_name = "S", default_value_t = 8.0)]
    horizon: f64,
    /// Sample recently failed scenarios more often
    #[arg(long)]
    prioritized: bool,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

#[cfg(not(unix))]
impl Args {
    /// Error: always; other systems have no Unix sockets.
    pub(crate) fn execute(&self, _run: &mut crate::run::Run) -> anyhow::Result<()> {
        anyhow::bail!("rl serve needs Unix, because it listens on a Unix socket")
    }
}
