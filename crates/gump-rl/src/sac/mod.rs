//! Soft actor-critic: maximizes reward and policy entropy.
//!
//! Start with [`Training`], which collects transitions and learns; [`Learner`] is one gradient
//! step, [`SacConfig`] the hyperparameters, [`Squashed`] the distribution of an action.

pub(crate) mod archive;
mod batch;
mod config;
mod critics;
mod learner;
pub(crate) mod replay_buffer;
mod squashed;
pub(crate) mod tensors;
mod training;
mod vision;

#[cfg(test)]
mod learning_tests;
#[cfg(test)]
pub(crate) mod test_envs;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod vision_tests;

pub use batch::Batch;
pub use config::SacConfig;
pub use critics::{Critic, critic_loss, soft_target};
pub use learner::{Learner, UpdateReport};
pub use replay_buffer::{ReplayBuffer, Transition};
pub use squashed::{Draw, Squashed};
pub use training::{Episode, StepReport, Training};
