//! The multimodal causal transformer (MCT) world model: network, training, inference, checkpoints.
//!
//! The network reads a scene as tokens and a raster, and says what comes next. Read
//! [`config::ModelConfig`] for its shape, `mct.rs` for the network in one sitting, `decoder.rs` for
//! how a hidden vector becomes a state, [`train::Trainer`] for learning and
//! [`world::TransformerWorld`] for imagining, whose arithmetic on a CPU is `engine`.
//!
//! # Terms
//! * **key, value**: the two tokens of an object; the hidden vector at the key says the state.
//! * **chunk**: the four poses decoded at a key, half a second apart; the first is the frame's own.
//! * **anchor**: the pose in whose frame a chunk is said: the object's last one, or the scene's.
//! * **surroundings**: what an object sees of map and traffic in its own frame.
//! * **surrogate**: a provisional state, from earlier chunks, that lets all objects of a frame be
//!   decoded in one pass (partial autoregression).
//! * **aggregation**: averaging what several chunks say of the same instant.
//! * **outlook**: what an agent might have done next, as draws from its distribution.
//! * **visual memory**: keys and values of the map, computed once per scene.
//!
//! ```
//! use gump_model::{Device, ModelConfig, Network, SamplingConfig, world::TransformerWorld};
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
//! # Ok::<(), gump_rollout::BoxError>(())
//! ```

mod aggregation;
mod agreement;
mod anchor;
mod batch;
pub mod checkpoint;
mod clearance;
mod closed_loop;
pub mod config;
mod decode;
mod decoder;
mod draw;
mod drift;
mod embedding;
mod engine;
mod error;
mod exact;
mod future;
pub mod generation;
mod life;
mod limits;
mod loss;
mod mct;
mod network;
pub mod ops;
mod optimizer;
mod outlook;
mod parameters;
mod plain;
pub mod relative;
mod sample;
mod sampling;
mod scene;
mod scenes;
mod session;
mod surroundings;
#[cfg(test)]
mod tests;
pub mod train;
mod trajectory;
mod unsmooth;
mod visual;
pub mod world;

/// Where tensors live, so that users need not name the tensor library.
pub use candle_core::Device;
pub use closed_loop::ClosedLoopConfig;
pub use config::ModelConfig;
pub use error::ModelError;
pub use loss::{LossConfig, LossParts};
pub use network::Network;
pub use ops::panels::Precision;
pub use optimizer::OptimizerConfig;
pub use outlook::{Outlook, Watch};
pub use parameters::Parameters;
pub use sample::SampleConfig;
pub use sampling::{CacheMode, Mode, Pace, SamplingConfig, Surrogate};
pub use scenes::Scenes;
pub use train::{RunConfig, TrainConfig, Trainer};
