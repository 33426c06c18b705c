//! Worlds that follow rules: the log itself, constant velocity, and reactive traffic.
//!
//! They step at the time step of the scene they start from.

mod constant_velocity;
mod independent;
mod replay;

pub use constant_velocity::ConstantVelocity;
pub use replay::LogReplay;
