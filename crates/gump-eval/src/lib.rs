//! Evaluations and their building blocks, independent of the command line.
//!
//! Evaluations, each from a scenario to results that can be stored and merged:
//!
//! * [`behaviour`]: implausible actions in worlds and in the log; [`reactions`]: who runs into an ego
//!   that leaves its log.
//! * [`closed_loop`] and [`open_loop`]: planners, with nuPlan's scores.
//! * [`realism`]: Waymo's realism of recorded scenarios; [`motion`]: predictions of their agents.
//! * [`generation`]: generated scenes beside recorded ones.
//!
//! Building blocks:
//!
//! * [`worlds`]: worlds by name (`log`, `idm`, `constant-velocity`, `model:WEIGHTS`), loaded once.
//! * [`planners`]: planners by name, the worlds that they roll out and drive in, and timing.
//! * [`datasets`]: data sets with splits; [`training_set`]: scenarios to train on, in memory, in a
//!   cache or made by [`fresh`].
//! * [`benchmarks`]: frozen sets, found, made, drawn and held to their checksums; [`sumo`]: SUMO's
//!   programs, which make some of them.
//! * [`imagine`]: futures of one scene, with their cost; [`decoding`]: ways to make them;
//!   [`digest`]: whether two runs made the same.
//! * [`annotations`]: how plausible the futures of agents are, and what the metric measures of them.
//! * [`recordings`]: recordings to drive in, from any readable file, including nuPlan's logs.
//! * [`results`]: results by scenario, in a file from which interrupted runs resume and shards of
//!   one evaluation are merged; [`shard`]: the assignment of scenarios to shards.
//! * [`Exclusions`]: scenarios that a benchmark is not defined on; [`Notes`]: what a scene lacks for
//!   signals and arrivals; [`rollout_files`]: files of futures given by path.
//!
//! Metrics, worlds and planners are in their own crates; arguments, progress, tables and charts are
//! in `xtask`, which follows long work through a [`Monitor`].
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
pub mod behaviour;
pub mod benchmarks;
pub mod closed_loop;
pub mod datasets;
pub mod decoding;
pub mod digest;
mod error;
mod exclusions;
pub mod fresh;
pub mod generation;
pub mod imagine;
mod monitor;
pub mod motion;
mod nuplan_recordings;
pub mod open_loop;
pub mod planners;
pub mod reactions;
pub mod realism;
pub mod recordings;
pub mod results;
pub mod rollout_files;
pub mod shard;
pub mod sumo;
pub mod training_set;
pub mod worlds;

pub use error::{
    ArgumentError, BenchmarkError, ErrorContext, EvalError, HeadlessNetwork, LanePurpose,
    PartProblem, RecordingError, ResultsError, ResumePoint, RolloutFileError, ShardError,
    SumoError,
};
pub use exclusions::Exclusions;
pub use gump_traffic::{Note, NoteCount, Notes};
pub use monitor::Monitor;
