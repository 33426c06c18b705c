//! The closed-loop engine, the traits [`WorldModel`] and [`Policy`], vehicle dynamics and
//! rule-based worlds.
//!
//! Start with [`simulate`]. Nothing here scores a rollout and nothing here knows of tensors: the
//! learned world implements [`WorldModel`] from above.
//!
//! # Terms
//! * **world model**: imagines how traffic goes on. **Session**: its futures in progress.
//! * **policy**: decides for the ego. **Command**: what it decides.
//! * **future**: one of several rollouts of the same scene; future *k* depends on its start and
//!   `seed.fork(k)` alone.
//! * **knot**: a frame of a world that steps more slowly than the scene.
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
mod resample;
mod scripted;
mod simulate;
mod world;
pub mod worlds;

pub use error::RolloutError;
pub use policy::{Command, Policy};
pub use scripted::Scripted;
pub use simulate::{Interpolation, SimulateConfig, fill, simulate};
pub use world::{BoxError, Session, Start, WorldModel};
