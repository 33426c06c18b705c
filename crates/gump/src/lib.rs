//! A generative world model for driving, in one crate.
//!
//! This crate contains nothing of its own: each module is a crate of the workspace under a short
//! name, and the [`prelude`] has what most programs need. A program with few needs may depend on
//! the crates themselves; the names are the same with `gump-` before them.
//!
//! ```
//! use gump::prelude::*;
//!
//! let scenario = gump::scene::fixture::scenario(
//!     "lane 1: -50,0 300,0 speed 15
//!      ego vehicle 0: 0,0 velocity 12,0
//!      agent vehicle 1: 50,0",
//! )?;
//! let start = Start { scene: scenario.present(), n_futures: 4, seed: Seed(0) };
//! let collisions = |world: &dyn WorldModel| {
//!     let futures = simulate(world, &[start], None, &SimulateConfig::default())?;
//!     Ok::<_, BoxError>(summarize(&futures, None).total().collision_rate())
//! };
//! // At a constant velocity the ego runs into the car that stands in its lane; IDM brakes.
//! assert!(collisions(&ConstantVelocity)? > Some(0.0));
//! assert_eq!(collisions(&Idm::default())?, Some(0.0));
//! # Ok::<(), BoxError>(())
//! ```
//!
//! # Features
//! The modules [`geometry`], [`seed`], [`scene`], [`rollout`] and [`metrics`] are always there. A feature adds
//! the module of its name, and those that it needs.
//!
//! | Feature | What it adds |
//! |---|---|
//! | `data` (default) | scenarios from Waymo's files, the cache and JSON |
//! | `formats` | every other format: nuPlan, Argoverse 2, CommonRoad, SUMO, TAF-BW, Parquet |
//! | `viz` | pictures, films, pages; with `rerun` recordings for its viewer |
//! | `wosac` | Waymo's realism and motion prediction metrics |
//! | `nuplan`, `planner` | nuPlan's closed loop and scores; planners |
//! | `grpc`, `proto` | planners in other processes; messages of Waymo and of nuPlan's protocol |
//! | `traffic`, `synthesis` | signals and agents that come and leave; made-up scenarios |
//! | `engine`, `tensors` | the learned worlds: from plain weights; on a tensor library, with `inputs` |
//! | `train`, `generate` | training; scenes from a prompt; with `cuda` on a GPU |
//! | `rl` | an environment for reinforcement learning, and learners |
//! | `eval` | worlds, planners, data sets and benchmarks by name |
//! | `full` | all of these but `cuda` and `rerun` |

#[cfg(feature = "data")]
pub use gump_data as data;
#[cfg(feature = "engine")]
pub use gump_engine as engine;
#[cfg(feature = "eval")]
pub use gump_eval as eval;
#[cfg(feature = "generate")]
pub use gump_generate as generate;
pub use gump_geometry as geometry;
#[cfg(feature = "grpc")]
pub use gump_grpc as grpc;
#[cfg(feature = "engine")]
pub use gump_kernels as kernels;
pub use gump_metrics as metrics;
#[cfg(feature = "engine")]
pub use gump_model as model;
#[cfg(feature = "tensors")]
pub use gump_nn as nn;
#[cfg(feature = "nuplan")]
pub use gump_nuplan as nuplan;
#[cfg(feature = "planner")]
pub use gump_planner as planner;
#[cfg(feature = "proto")]
pub use gump_proto as proto;
#[cfg(feature = "inputs")]
pub use gump_raster as raster;
#[cfg(feature = "rl")]
pub use gump_rl as rl;
pub use gump_rollout as rollout;
pub use gump_scene as scene;
pub use gump_seed as seed;
#[cfg(feature = "synthesis")]
pub use gump_synthesis as synthesis;
#[cfg(feature = "inputs")]
pub use gump_tokenizer as tokenizer;
#[cfg(feature = "traffic")]
pub use gump_traffic as traffic;
#[cfg(feature = "train")]
pub use gump_train as train;
#[cfg(feature = "viz")]
pub use gump_viz as viz;
#[cfg(feature = "wosac")]
pub use gump_wosac as wosac;

/// The items that most programs need: `use gump::prelude::*;`.
pub mod prelude {
    pub use crate::geometry::{DVec2, OrientedBox, Polyline, Pose, dvec2};
    pub use crate::metrics::summarize;
    pub use crate::rollout::worlds::{ConstantVelocity, Idm, LogReplay};
    pub use crate::rollout::{
        BoxError, Command, Policy, SimulateConfig, Start, WorldModel, simulate,
    };
    pub use crate::scene::{
        Agent, AgentId, AgentKind, AgentState, EgoState, Frame, Rollout, Scenario, SceneState, Seed,
    };

    #[cfg(feature = "engine")]
    pub use crate::engine::SamplingConfig;
    #[cfg(feature = "tensors")]
    pub use crate::engine::TransformerWorld;
    #[cfg(feature = "tensors")]
    pub use crate::model::{Device, checkpoint};
    #[cfg(feature = "nuplan")]
    pub use crate::nuplan::closed_loop::{
        DriveConfig, Driver, ImaginedTraffic, PlannerInput, Replayed, Traffic,
    };
    #[cfg(feature = "nuplan")]
    pub use crate::nuplan::{reactive_agents::NuplanIdm, tracking::Trajectory};
    #[cfg(feature = "planner")]
    pub use crate::planner::{
        InteractiveDriver, InteractiveDriverConfig, PdmClosed, closed_loop::drive_scenario,
    };
}
