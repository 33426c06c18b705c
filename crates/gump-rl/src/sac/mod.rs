//! Soft actor-critic: a policy that earns much and stays as random as it can afford.
//!
//! Start with [`Training`], which collects and learns; [`Learner`] is one gradient step,
//! [`SacConfig`] every number of it, [`Squashed`] the distribution of an action.

mod archive;
mod batch;
mod config;
mod critics;
mod learner;
mod replay_buffer;
mod squashed;
mod tensors;
mod training;
mod vision;

#[cfg(test)]
mod learning_tests;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod toys;
#[cfg(test)]
mod vision_tests;

pub use batch::Batch;
pub use config::SacConfig;
pub use critics::{Critic, critic_loss, soft_target};
pub use learner::{Learner, UpdateReport};
pub use replay_buffer::{ReplayBuffer, Transition};
pub use squashed::{Draw, Squashed};
pub use training::{Algorithm, Episode, StepReport, Training};
