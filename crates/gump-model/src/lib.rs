//! The learned world models: what they see, their networks, and checkpoints.
//!
//! Two networks say what comes next in a scene. The sequence network is the paper's: the scene as
//! tokens and a raster, a causal transformer, a decoder of states. Read [`config::ModelConfig`] for
//! its shape, `mct.rs` for the network in one sitting, `decoder.rs` for how a hidden vector becomes
//! a state. The relative network sees agents and map pieces by their relative poses ([`relative`]).
//! Rolling them out is `gump-engine`'s, training them `gump-train`'s.
//!
//! Without the feature `tensors` (on by default) the networks themselves are left out; what remains
//! needs no tensor library: inputs, outputs, and weights as plain numbers
//! ([`relative::RelativeWeights`]).
//!
//! # Terms
//! * **key, value**: the two tokens of an object; the hidden vector at the key says the state.
//! * **chunk**: the four poses decoded at a key, half a second apart; the first is the frame's own.
//! * **local frame**: the pose in whose frame a chunk is said: the object's last one, or the scene's.
//! * **local context**: what an object sees of map and traffic in its own frame.
//! * **visual memory**: keys and values of the map, computed once per scene.
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
pub use error::ModelError;
#[cfg(feature = "tensors")]
pub use gump_nn::{Device, Parameters};
#[cfg(feature = "tensors")]
pub use network::Network;
