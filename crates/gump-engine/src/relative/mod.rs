//! The relative network rolled out: its arithmetic, what is kept of agents, rules, the world.

pub mod engine;
pub mod rules;
pub mod seen;
mod world;

pub use self::world::{LiveFuture, MAP_M, RelativeSampling, RelativeWorld};
