//! Building blocks of evaluations, independent of the command line.
//!
//! * [`worlds`]: worlds by name (`log`, `idm`, `constant-velocity`, `model:WEIGHTS`), loaded once.
//! * [`planners`]: planners by name, the worlds that they roll out and drive in, and timing.
//! * [`recordings`]: recordings to drive in, from any readable file, including nuPlan's logs.
//! * [`results`]: results by scenario, in a file from which interrupted runs resume and shards of
//!   one evaluation are merged; [`shard`]: the assignment of scenarios to shards.
//! * [`rollout_files`]: files of futures given by path.
//!
//! Metrics, worlds and planners are in their own crates; arguments, progress and reports are in
//! `xtask`.
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

mod error;
mod nuplan_recordings;
pub mod planners;
pub mod recordings;
pub mod results;
pub mod rollout_files;
pub mod shard;
pub mod worlds;

pub use error::EvalError;
