//! Rollouts of the relative network: CPU implementation, memory of agents, sampling rules, and the
//! world.

pub mod approach;
pub mod engine;
mod intent;
pub mod keep_clear;
pub mod right_of_way;
pub mod rules;
pub mod seen;
mod turning_in;
mod waiting;
mod world;

pub use self::world::{LiveFuture, MAP_M, RelativeSampling, RelativeWorld};
