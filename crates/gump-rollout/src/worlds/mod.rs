//! Worlds that follow rules: the log itself, constant velocity, and reactive traffic.
//!
//! They step at the time step of the scene they start from.

mod constant_velocity;
mod idm;
mod independent;
mod replay;

pub use constant_velocity::ConstantVelocity;
pub use idm::{Idm, IdmConfig, idm_acceleration, idm_euler_step};
pub use replay::LogReplay;
