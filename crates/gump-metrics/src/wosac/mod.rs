//! Realism as the Waymo Sim Agents Challenge (WOSAC) measures it, equal to the official numbers of
//! 2023 (leaderboards V0 and V1), 2024, 2025 and the scenario-generation challenge of 2025.
//!
//! How likely is what really happened under the distribution of what a world imagines? Features of
//! the logged future (speed, distance to the nearest agent, ...) are scored under histograms of the
//! same features in many rollouts; the likelihoods of ten components make one number.
//!
//! Start with [`score`] on plain arrays, or with [`Log::of`] and [`Rollouts::of`] on scenes.
//! [`Reference`] keeps what rollouts are compared with, [`Evaluation`] what the comparison found,
//! [`Evaluation::explain`] says what lowered the score and when; [`Scores::mean`] averages over
//! scenarios, [`crate::interval`] says how sure an average is. A year is a [`Config`], which is a TOML file.
//! Reading Waymo's messages is the business of `gump-data`, checking a submission too.
//!
//! ```
//! use gump_metrics::wosac::{Config, Log, Rollouts, State, Track, Trajectory, Year, score};
//! use gump_scene::{AgentId, AgentKind};
//!
//! // One car of 4.8 x 2 m drives along x at 10 m/s: 91 steps of 0.1 s, the present is step 10.
//! let at = |step| State::new([step as f32, 0.0, 0.0], 0.0, [4.8, 2.0, 1.5]);
//! let car = Track::new(AgentId(7), AgentKind::Vehicle, (0..91).map(at).collect());
//! let edge = vec![[-50.0, -4.0, 0.0], [150.0, -4.0, 0.0]];
//! let log = Log::new("my scene", vec![car]).ego(AgentId(7))?.road_edges(vec![edge]);
//! // A world that drives 5 % too fast, 32 times alike: x, y, z and heading of 80 steps.
//! let x = (1..=80).map(|step| 10.0 + 1.05 * step as f32).collect();
//! let drive = Trajectory::new(AgentId(7), x, vec![0.0; 80], vec![0.0; 80], vec![0.0; 80]);
//! let rollouts = Rollouts::new("my scene", vec![vec![drive]]).repeated(32);
//! let scores = score(&log, &rollouts, &Config::of(Year::Y2025))?;
//! assert!(0.8 < scores.metametric && scores.metametric < 1.0);
//! # Ok::<(), gump_metrics::wosac::WosacError>(())
//! ```
//!
//! # Numbers
//! The reference computes in f32 at world coordinates of thousands of metres; its rounding is part
//! of its results. So here, too, features are f32 and in its order of operations.
//!
//! Source: the official evaluator, its git history and its quirks; goldens in `tests/golden`.

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
mod lights;
mod reference;
mod road_edge;
mod scores;

pub use config::{Algorithm, Component, Config, Estimator, FeatureConfig, Group, Mode, Year};
pub use error::WosacError;
pub use estimate::{Shape, log_likelihoods};
pub use explain::Blame;
pub use features::Features;
pub use input::{
    Log, N_FUTURE, N_HISTORY, N_STEPS, Rollouts, Signal, SignalLane, State, Track, Trajectory,
};
pub use reference::{Evaluation, Reference, score};
pub use scores::Scores;

#[cfg(test)]
mod tests;
