//! Realism as the Waymo Sim Agents Challenge (WOSAC) measures it, equal to the official numbers of
//! 2023 (leaderboards V0 and V1), 2024, 2025 and the scenario-generation challenge of 2025.
//!
//! How likely is what really happened under the distribution of what a world imagines? Features of
//! the logged future (speed, distance to the nearest agent, ...) are scored under histograms of the
//! same features in many rollouts; the likelihoods of ten components make one number.
//!
//! Start with [`score`] on plain arrays, with [`Log::of_message`] and [`Rollouts::of_message`] on
//! Waymo's messages, or with [`Log::of`] and [`Rollouts::of`] on scenes.
//! [`Reference`] keeps what rollouts are compared with, [`Evaluation`] what the comparison found,
//! [`Evaluation::explain`] says what lowered the score and when, [`Evaluation::realism`] whose futures
//! are like the log, [`Evaluation::leave_one_out`] what each rollout adds, as a reward to learn
//! from; [`Scores::mean`] averages over
//! scenarios; `gump_metrics::interval` says how sure an average is. A year is a [`Config`], which is a TOML file.
//! Reading files is the business of `gump-data`, checking a submission too.
//!
//! The front page of the crate scores a scene of one's own in a dozen lines.
//!
//! # Numbers
//! The reference computes in f32 at world coordinates of thousands of metres; its rounding is part
//! of its results. So here, too, features are f32 and in its order of operations.
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

pub use config::{Algorithm, Component, Config, Estimator, FeatureConfig, Group, Mode, Year};
pub use error::WosacError;
pub use estimate::{Shape, log_likelihoods};
pub use explain::{AgentRealism, Blame};
pub use features::Features;
pub use input::{
    Log, N_FUTURE, N_HISTORY, N_STEPS, Rollouts, Signal, SignalLane, State, Track, Trajectory,
};
pub use leave_one_out::LeaveOneOut;
pub use reference::{Evaluation, Reference, score};
pub use scores::Scores;

#[cfg(test)]
mod tests;
