//! Rule-based worlds: log replay, constant velocity, and reactive traffic.
//!
//! Their time step is that of the scene they start from.

mod constant_velocity;
mod idm;
mod independent;
mod replay;

pub use constant_velocity::ConstantVelocity;
pub use idm::{Idm, IdmConfig, idm_acceleration, idm_euler_step};
pub use replay::LogReplay;
