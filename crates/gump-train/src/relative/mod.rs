//! Training of the relative network: drives, rewards from realism, and the trainer.

mod crowd;
mod drives;
mod faults;
mod pace;
mod rewards;
#[cfg(test)]
mod tests;
mod train;

pub use self::crowd::Crowd;
pub use self::drives::RelativeDrives;
pub use self::rewards::{RelativeRewards, RewardExclusions};
pub use self::train::{RelativeStep, RelativeTrainConfig, RelativeTrainer};
pub use gump_model::relative::RelativeSampleConfig;
