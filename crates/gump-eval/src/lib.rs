//! Building blocks of evaluations, independent of the command line.
//!
//! * [`worlds`]: worlds by name (`log`, `idm`, `constant-velocity`, `model:WEIGHTS`), loaded once.
//! * [`planners`]: planners by name, the worlds that they roll out and drive in, and timing.
//! * [`datasets`]: data sets with splits; [`benchmarks`]: frozen sets, found and held to their
//!   checksums.
//! * [`imagine`]: futures of one scene, with their cost; [`decoding`]: ways to make them;
//!   [`digest`]: whether two runs made the same.
//! * [`realism`]: Waymo's realism of recorded scenarios; [`motion`]: predictions of their agents.
//! * [`annotations`]: how plausible the futures of agents are, and what the metric measures of them.
//! * [`recordings`]: recordings to drive in, from any readable file, including nuPlan's logs.
//! * [`results`]: results by scenario, in a file from which interrupted runs resume and shards of
//!   one evaluation are merged; [`shard`]: the assignment of scenarios to shards.
//! * [`rollout_files`]: files of futures given by path.
//!
//! Metrics, worlds and planners are in their own crates; arguments, progress and reports are in
//! `xtask`, which hears of long work through a [`Monitor`].
//!
//! ```
//! use gump_engine::SamplingConfig;
//! use gump_eval::worlds::{World, WorldName};
//! use gump_model::Device;
//!
//! let name: WorldName = "idm".parse()?;
//! let world = World::without_log(&Device::Cpu, &name, &SamplingConfig::default())?;
//! assert_eq!(world.model().name(), "idm");
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

pub mod annotations;
pub mod benchmarks;
pub mod datasets;
pub mod decoding;
pub mod digest;
mod error;
pub mod imagine;
mod monitor;
pub mod motion;
mod nuplan_recordings;
pub mod planners;
pub mod realism;
pub mod recordings;
pub mod results;
pub mod rollout_files;
pub mod shard;
pub mod worlds;

pub use error::EvalError;
pub use monitor::Monitor;
