//! Neural networks on candle: fused operations with gradients, layers, parameters, an optimizer.
//!
//! What lives here: operations that candle composes from many passes over memory, as one pass forward
//! and one backward ([`ops`]); linear layers and normalisation ([`layers`]); tensors by name, drawn
//! from a seed or loaded ([`parameters`]); AdamW ([`optimizer`]). What does not: any network, and
//! anything that knows traffic. The arithmetic on a processor is `gump-kernels`'s.
//!
//! ```
//! use gump_nn::layers::Linear;
//! use gump_nn::parameters::Parameters;
//! use gump_nn::{Device, Tensor};
//! use gump_seed::Seed;
//!
//! let mut parameters = Parameters::random(Seed(0), &Device::Cpu);
//! let layer = Linear::new(&mut parameters.root(), "layer", 3, 2)?;
//! let y = layer.forward(&Tensor::new(&[[1.0f32, 2.0, 3.0]], &Device::Cpu)?)?;
//! assert_eq!(y.dims(), [1, 2]);
//! assert_eq!(parameters.count(), 3 * 2 + 2);
//! # Ok::<(), gump_nn::NnError>(())
//! ```

mod error;
pub mod layers;
pub mod ops;
pub mod optimizer;
pub mod parameters;

/// The device and tensor types, so that users need not name the tensor library.
pub use candle_core::{Device, Tensor};
pub use error::NnError;
pub use optimizer::{AdamW, Gradients, OptimizerConfig};
pub use parameters::Parameters;
