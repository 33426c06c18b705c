//! A vectorised environment over any world, and policies that learn to drive in it.
//!
//! Start with [`Env`]: many episodes side by side, one batched call of the world per step. What an
//! agent sees is [`Observation`], what it does [`Action`].
//! Everyone but the ego is the world's business, what is good a reward's. Learners know a
//! [`VectorEnv`] alone: [`sac`] learns from rewards and from experts, and gives an [`Actor`].
//!
//! # Terms
//! * **slot**: a place in the batch. **Episode**: what happens in a slot from a start to an end.
//! * **terminated**: ended by failure, nothing comes after. **Truncated**: cut off, more would
//!   have come, so a value must be bootstrapped.
//!
//! ```
//! use gump_rl::{Action, Env, EnvConfig};
//! use gump_rollout::worlds::Idm;
//! use gump_scene::Seed;
//!
//! let scenario = gump_scene::fixture::scenario(
//!     "lane 1: 0,0 300,0 speed 15\nroute 1\nego vehicle 0: 10,0 velocity 8,0",
//! ).unwrap();
//! let world = Idm::default();
//! let scenarios = [scenario];
//! let config = EnvConfig { n_slots: 4, ..EnvConfig::default() };
//! let mut env = Env::new(&world, &scenarios, config).unwrap();
//! let observations = env.reset(Seed(0)).unwrap();
//! assert_eq!(observations.len(), 4);
//! let steps = env.step(&[Action { acceleration: 1.0, curvature: 0.0 }; 4]).unwrap();
//! assert!(steps.iter().all(|step| step.end.is_none() && step.reward > 0.0));
//! ```

mod action;
mod actor;
mod env;
mod error;
pub mod networks;
mod observation;
pub mod sac;
mod vector_env;

pub use action::{Action, ActionLimits};
pub use actor::Actor;
pub use env::{End, Env, EnvConfig, Failure, Step};
pub use error::RlError;
pub use observation::{Observation, ObservationSpec, observe};
pub use vector_env::VectorEnv;
