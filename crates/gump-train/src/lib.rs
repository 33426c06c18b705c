//! Training of the learned world models.
//!
//! For the sequence network: samples ([`sample`]), losses ([`loss`]), closed-loop training
//! ([`closed_loop`]) and the trainer ([`Trainer`]). For the relative network: its own rollouts as
//! training data, rewards, and the trainer ([`relative`]). Runs resume exactly, and the same seed
//! gives the same result for any number of threads. The networks are in `gump-model`; command line,
//! progress and output files are in `xtask`.

pub mod closed_loop;
mod config;
mod error;
mod gradients;
mod learner;
pub mod loss;
#[cfg(feature = "mpi")]
mod mpi;
mod peers;
mod perturbation;
pub mod relative;
pub mod sample;
pub mod scenes;
mod source;
#[cfg(test)]
mod tests;
mod trainer;

pub use closed_loop::ClosedLoopConfig;
pub use config::{ModelChoice, RunConfig, TrainConfig};
pub use error::TrainError;
pub use gump_nn::OptimizerConfig;
pub use loss::{LossConfig, LossParts};
#[cfg(feature = "mpi")]
pub use mpi::Mpi;
pub use peers::{ProcessGroup, SingleProcess};
pub use sample::SampleConfig;
pub use scenes::ScenarioSource;
pub use trainer::{Batch, StepReport, Trainer};
