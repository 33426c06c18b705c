//! Proximal policy optimization (PPO): many steps of many environments, and small steps of the
//! policy.
//!
//! Source: Schulman et al. 2017, "Proximal Policy Optimization Algorithms". It needs many more
//! environment steps than [`crate::sac`] and takes them where they are cheap. Start with
//! [`PpoTraining`]; [`PpoConfig`] are the hyperparameters.

mod archive;
mod config;
mod learner;
mod round;
mod training;

#[cfg(test)]
mod tests;

pub use config::PpoConfig;
pub use learner::PpoUpdate;
pub use training::{PpoReport, PpoTraining};
