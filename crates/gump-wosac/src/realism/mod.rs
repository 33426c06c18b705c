//! The realism metric of the Waymo Sim Agents Challenge (WOSAC), equal to the official numbers of
//! 2023 (leaderboards V0 and V1), 2024, 2025 and the scenario-generation challenge of 2025.
//!
//! The metric is the likelihood of the log under the distribution of a world's rollouts. Features
//! of the logged future (speed, distance to the nearest agent, ...) are scored under histograms of
//! the same features over many rollouts; the likelihoods of ten components are combined into one
//! number.
//!
//! Start with [`score`] on plain arrays, with [`Log::of_message`] and [`Rollouts::of_message`] on
//! Waymo's messages, or with [`Log::of`] and [`Rollouts::of`] on scenes. [`Reference`] is a log
//! prepared for comparison and [`Evaluation`] the result of one; [`Evaluation::explain`] lists the
//! largest penalties with their times, [`Evaluation::realism`] gives the realism of each agent, and
//! [`Evaluation::leave_one_out`] the contribution of each rollout, as a reward for training.
//! [`Scores::mean`] averages over scenarios; `gump_metrics::interval` computes confidence
//! intervals. A year is a [`Config`], stored as a TOML file. Files are read and submissions checked
//! by `gump-data`.
//!
//! The front page of the crate has a complete example on plain arrays.
//!
//! # Numbers
//! The reference computes in f32 at world coordinates of thousands of metres, and its rounding
//! affects its results. Features here are therefore also f32, in the same order of operations.
//!
//! Source: the official evaluator, its git history and its quirks; goldens in `tests/golden/realism`.

mod assemble;
mod blocks;
mod box_distance;
mod config;
mod error;
mod estimate;
mod explain;
mod features;
mod following;
mod from_scene;
mod input;
mod kinematics;
mod leave_one_out;
mod lights;
mod reference;
mod road_edge;
mod scores;

pub use config::{
    Algorithm, Component, Config, ConfigError, Estimator, FeatureConfig, Group, Mode, Year,
};
pub use error::WosacError;
pub use estimate::{FeatureShape, log_likelihoods};
pub use explain::{AgentRealism, Attribution};
pub use features::Features;
pub use input::{
    Log, N_FUTURE, N_HISTORY, N_STEPS, Rollouts, Signal, SignalLane, State, Track, Trajectory,
};
pub use leave_one_out::LeaveOneOut;
pub use reference::{Evaluation, Reference, score};
pub use scores::Scores;

#[cfg(test)]
mod tests;
