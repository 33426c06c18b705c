//! Training of the learned world models.
//!
//! For the sequence network: samples ([`sample`]), losses ([`loss`]), closed-loop training
//! ([`closed_loop_samples`]) and the trainer ([`Trainer`]). For the relative network: its own
//! rollouts as training data, rewards, and the trainer ([`relative`]). The network that places
//! vehicles in generated scenes has its own ([`placement`]). Runs resume exactly, and the same seed
//! gives the same result for any number of threads. The networks are in `gump-model`; command line,
//! progress and output files are in `xtask`.
//!
//! ```
//! use gump_model::{Device, ModelConfig};
//! use gump_train::{SampleConfig, TrainConfig, Trainer};
//!
//! let scenario = gump_scene::fixture::scenario(
//!     "lane 1: -100,0 200,0 speed 15
//!      ego vehicle 0: 0,0 velocity 8,0
//!      agent vehicle 1: 20,0 velocity 5,0",
//! )?;
//! let mut config = TrainConfig { steps: 1, batch: 1, ..TrainConfig::default() };
//! config.sample = SampleConfig::plain(4);
//! let mut trainer = Trainer::new(ModelConfig::tiny(), config, vec![scenario], &Device::Cpu)?;
//! let report = trainer.step()?;
//! assert!(report.loss.total.is_finite());
//! assert_eq!(trainer.steps_done(), 1);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

pub mod closed_loop_samples;
mod config;
mod error;
mod gradients;
mod learner;
pub mod loss;
#[cfg(feature = "mpi")]
mod mpi;
mod perturbation;
pub mod placement;
mod process_group;
pub mod relative;
pub mod sample;
pub mod scenes;
mod source;
#[cfg(test)]
mod tests;
mod trainer;

pub use closed_loop_samples::ClosedLoopConfig;
pub use config::{ModelChoice, RunConfig, TrainConfig};
pub use error::{ProcessGroupError, TrainError};
pub use gump_nn::OptimizerConfig;
pub use loss::{LossConfig, LossParts};
#[cfg(feature = "mpi")]
pub use mpi::Mpi;
pub use process_group::{ProcessGroup, SingleProcess};
pub use sample::SampleConfig;
pub use scenes::{ScenarioSource, identity_of};
pub use trainer::{Batch, StepReport, Trainer};
