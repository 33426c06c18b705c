//! Training of the relative network: drives, rewards from realism, and the trainer.

mod advantages;
mod batches;
mod crowd;
mod divergence;
mod drives;
mod faults;
mod pace;
mod rewards;
mod settings;
#[cfg(test)]
mod tests;
mod train;

pub use self::crowd::Crowd;
pub use self::drives::RelativeDrives;
pub use self::rewards::RewardExclusions;
pub use self::settings::{Advantage, RelativeRewards};
pub use self::train::{RelativeStep, RelativeTrainConfig, RelativeTrainer};
pub use gump_model::relative::RelativeSampleConfig;
