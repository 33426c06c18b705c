//! The networks of the learned world models: inputs, layers and checkpoints.
//!
//! There are two networks, and both predict the next frame of a scene. The sequence network is the
//! paper's: the scene as tokens and a raster, a causal transformer, and a decoder of states.
//! [`config::ModelConfig`] describes its shape, `mct.rs` contains the transformer, and `decoder.rs`
//! turns a hidden vector into a state. The relative network ([`relative`]) sees agents and pieces
//! of map by their relative poses. A third, small one ([`placement`]) places the vehicles of
//! generated scenes. `gump-engine` rolls the networks out, `gump-train` trains them.
//!
//! Without the feature `tensors` (on by default) the networks are left out and no tensor library is
//! needed; inputs, outputs and weights as plain numbers ([`relative::RelativeWeights`]) remain.
//!
//! # Terms
//! * **key, value**: the two tokens of an object; its state is decoded from the hidden vector at
//!   the key.
//! * **chunk**: the four poses decoded at a key, half a second apart; the first belongs to the
//!   frame.
//! * **local frame**: the pose relative to which a chunk is expressed: the object's last, or the
//!   scene's.
//! * **local context**: an object's view of map and traffic in its own frame.
//! * **visual memory**: attention keys and values of the map, computed once per scene.
//!
//! ```
//! # #[cfg(feature = "tensors")] {
//! use gump_model::{Device, ModelConfig, Network};
//! use gump_scene::Seed;
//!
//! // Untrained; `checkpoint::load` reads weights.
//! let network = Network::random(ModelConfig::tiny(), Seed(0), &Device::Cpu)?;
//! assert!(network.parameters().count() > 100_000);
//! # }
//! # Ok::<(), gump_model::ModelError>(())
//! ```

#[cfg(feature = "tensors")]
pub mod batch;
#[cfg(feature = "tensors")]
pub mod checkpoint;
pub mod config;
#[cfg(feature = "tensors")]
pub mod decoder;
#[cfg(feature = "tensors")]
pub mod embedding;
mod error;
pub mod exact;
pub mod local_context;
#[cfg(feature = "tensors")]
pub mod local_frame;
#[cfg(feature = "tensors")]
pub mod mct;
#[cfg(feature = "tensors")]
mod network;
pub mod placed_slot;
pub mod placement;
pub mod prefixes;
pub mod relative;
pub mod steps;
#[cfg(feature = "tensors")]
#[doc(hidden)]
pub mod testing;
#[cfg(feature = "tensors")]
pub mod trajectory_head;
#[cfg(feature = "tensors")]
pub mod visual;

pub use config::ModelConfig;
pub use error::{ModelError, WeightsError};
#[cfg(feature = "tensors")]
pub use gump_nn::{Device, Parameters};
#[cfg(feature = "tensors")]
pub use network::Network;
