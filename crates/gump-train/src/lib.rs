//! Training of the learned world models.
//!
//! What lives here: the sequence network's samples ([`sample`]), losses ([`loss`]), closed loop
//! ([`closed_loop`]) and trainer ([`Trainer`]), and the relative network's drives, rewards and
//! trainer ([`relative`]). Runs resume exactly, and one seed gives one result for any number of
//! threads. What does not: the networks, and how runs are driven, shown and stored.

pub mod closed_loop;
mod config;
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
pub use gump_nn::OptimizerConfig;
pub use loss::{LossConfig, LossParts};
#[cfg(feature = "mpi")]
pub use mpi::Mpi;
pub use peers::{ProcessGroup, SingleProcess};
pub use sample::SampleConfig;
pub use scenes::ScenarioSource;
pub use trainer::{StepReport, Trainer};
