//! Closed-loop simulation: the traits [`WorldModel`] and [`Policy`], vehicle dynamics and
//! rule-based worlds.
//!
//! Start with [`simulate`]. The crate does not score rollouts and does not depend on tensors; the
//! learned worlds in `gump-engine` implement [`WorldModel`].
//!
//! # Terms
//! * **world model**: determines how traffic continues. **Session**: its futures in progress.
//! * **policy**: controls the ego. **Command**: its output for one step.
//! * **future**: one of several rollouts of the same scene; future *k* depends only on its start
//!   and `seed.fork(k)`.
//! * **knot**: a frame of a world whose time step is longer than the scene's.
//!
//! ```
//! use gump_rollout::{SimulateConfig, Start, simulate, worlds::ConstantVelocity};
//! use gump_scene::Seed;
//!
//! let scenario = gump_scene::fixture::scenario("ego vehicle 0: 0,0 velocity 8,0").unwrap();
//! let start = Start { scene: scenario.present(), n_futures: 4, seed: Seed(0) };
//! let rollouts = simulate(&ConstantVelocity, &[start], None, &SimulateConfig::default()).unwrap();
//! assert_eq!((rollouts.len(), rollouts[0].steps()), (4, 80));
//! let ego = rollouts[0].last().ego_now().state.pose.position;
//! assert!((ego.x - 64.0).abs() < 1e-9);
//! ```

pub mod dynamics;
mod error;
mod policy;
mod predictive_samples;
mod resample;
mod scripted;
mod simulate;
mod world;
pub mod worlds;

pub use error::{RecordingDefect, RolloutError};
pub use policy::{Command, Policy};
pub use predictive_samples::{PredictiveSamples, ProbeConfig};
pub use scripted::Scripted;
pub use simulate::{Interpolation, SimulateConfig, fill, simulate};
pub use world::{BoxError, Session, SessionStats, Start, WorldModel};
