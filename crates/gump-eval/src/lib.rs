//! What evaluations are made of, below any command line.
//!
//! * [`worlds`]: worlds by name (`log`, `idm`, `constant-velocity`, `model:WEIGHTS`), loaded once.
//! * [`planners`]: planners by name, their imagination and their traffic, and a stopwatch.
//! * [`recordings`]: recordings to drive through, from any readable file, nuPlan's logs among them.
//! * [`results`]: what each scenario got, in a file that an interrupted run goes on with and that
//!   shards of one evaluation are merged from; [`shard`]: which scenarios are whose.
//! * [`rollout_files`]: files of futures given by path.
//!
//! What does not live here: metrics, worlds and planners themselves; arguments, progress and reports.
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
