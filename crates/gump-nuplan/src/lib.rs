//! nuPlan's benchmark, equal to its devkit.
//!
//! [`metrics`] measures and scores drives, in closed loop and open loop, and has the paper's variants
//! for reinforcement learning. Nothing here steps a simulation or reads a file.

pub mod metrics;
