//! The metrics of Waymo's challenges, equal to the official implementations: realism of simulated
//! agents and of generated scenes, and motion prediction.
//!
//! [`realism`] scores rollouts given as plain arrays, as Waymo's messages or as scenes; [`motion`]
//! scores predictions. The crate reads no files.
//!
//! Realism of plain arrays by the rules of the Waymo Sim Agents Challenge:
//!
//! ```
//! use gump_wosac::realism::{Config, Log, Rollouts, State, Track, Trajectory, Year, score};
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
//! # Ok::<(), gump_wosac::realism::WosacError>(())
//! ```

mod from_message;
pub mod motion;
pub mod realism;
mod to_scene;
