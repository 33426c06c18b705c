//! Closed-loop rollouts of the learned world models.
//!
//! * Worlds driven by a network: [`TransformerWorld`], [`relative::RelativeWorld`].
//! * Partial autoregression: `partial_ar`, one step of all futures in `session`. The KV cache:
//!   `cpu::KvCache`.
//! * CPU implementations of the networks without a tensor library: `cpu`, `relative`.
//! * Sampling (`draw`, `nucleus`), and corrections of draws: `rejection`, `kinematic_limits`.
//! * Agents that enter and leave: `spawning`.
//!
//! The networks are in `gump-model`, training is in `gump-train`.
//!
//! Without the feature `tensors` (on by default in the workspace's drivers) only the relative
//! network from plain weights is available, and the crate builds for `wasm32-unknown-unknown`.
//!
//! # Terms
//! * **surrogate**: a provisional state from earlier chunks, which allows all objects of a frame to
//!   be decoded in one pass (partial autoregression).
//! * **temporal ensemble**: the average of the predictions of several chunks for the same instant.
//! * **predictive samples**: an agent's possible next states, as draws from its distribution.
//!
//! ```
//! # #[cfg(feature = "tensors")] {
//! use gump_engine::{SamplingConfig, TransformerWorld};
//! use gump_model::{Device, ModelConfig, Network};
//! use gump_rollout::{SimulateConfig, Start, simulate};
//! use gump_scene::Seed;
//!
//! let scenario = gump_scene::fixture::scenario(
//!     "lane 1: 0,0 200,0 speed 15
//!      ego vehicle 0: 10,0 velocity 8,0",
//! )?;
//! // Untrained; `checkpoint::load` reads the shipped weights or one's own.
//! let network = Network::random(ModelConfig::tiny(), Seed(0), &Device::Cpu)?;
//! let world = TransformerWorld::new(network, SamplingConfig::default());
//! let start = Start { scene: scenario.present(), n_futures: 2, seed: Seed(0) };
//! let config = SimulateConfig { seconds: 1.0, ..SimulateConfig::default() };
//! let futures = simulate(&world, &[start], None, &config)?;
//! assert_eq!((futures.len(), futures[0].steps()), (2, 10));
//! # }
//! # Ok::<(), gump_rollout::BoxError>(())
//! ```

#[cfg(feature = "tensors")]
mod agreement;
#[cfg(feature = "tensors")]
mod counters;
#[cfg(feature = "tensors")]
pub mod cpu;
#[cfg(feature = "tensors")]
mod deconvolution;
#[cfg(feature = "tensors")]
mod draw;
mod error;
mod expressible;
pub mod kinematic_limits;
pub mod nucleus;
#[cfg(feature = "tensors")]
mod partial_ar;
#[cfg(feature = "tensors")]
pub mod placement;
#[cfg(feature = "tensors")]
mod predictive_samples;
#[cfg(feature = "tensors")]
mod redraw;
#[cfg(feature = "tensors")]
mod reference;
mod rejection;
pub mod relative;
#[cfg(feature = "tensors")]
pub mod request;
#[cfg(feature = "tensors")]
mod rollout_state;
mod sampling;
#[cfg(feature = "tensors")]
pub mod scene;
#[cfg(feature = "tensors")]
mod session;
#[cfg(feature = "tensors")]
mod spawning;
#[cfg(feature = "tensors")]
pub mod temporal_ensemble;
#[cfg(test)]
#[cfg(feature = "tensors")]
mod tests;
#[cfg(feature = "tensors")]
mod trajectories;
#[cfg(feature = "tensors")]
pub mod world;

pub use error::EngineError;
pub use gump_kernels::panels::Precision;
pub use gump_rollout::{PredictiveSamples, ProbeConfig};
pub use sampling::{CacheMode, LightSource, Mode, RateScale, Routes, SamplingConfig, Surrogate};
#[cfg(feature = "tensors")]
pub use trajectories::{AgentTrajectories, TrajectoryMode};
#[cfg(feature = "tensors")]
pub use world::TransformerWorld;
