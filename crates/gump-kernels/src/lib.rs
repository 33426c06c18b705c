//! Matrix products and row arithmetic on a processor.
//!
//! What lives here: products of matrices over checked slices ([`gemm`]), the kernels among which one
//! is chosen for the processor at run time ([`Kernel`], [`Choice`]), weights packed once for many
//! products ([`panels`]), attention in bfloat16 ([`half_pages`]), sums in a fixed order ([`rows`]),
//! and the row-wise parts of layers that training and inference share ([`gelu`], [`gru`], [`norm`],
//! [`edge_attention`]). What does not: tensors, gradients and layers, which are `gump-nn`'s. All
//! `unsafe` of the workspace is in `gemm`, `fresh` and `kernels`.
//!
//! Results are bit-identical for any number of threads: work is cut by shape, and sums are added in
//! a fixed order.
//!
//! ```
//! use gump_kernels::panels::{Panels, Precision, Scratch};
//!
//! // Two outputs of three inputs, `[out, in]`, without a bias.
//! let weight = [1.0, 2.0, 3.0, 0.0, 0.0, 1.0];
//! let panels = Panels::new(&weight, 3, None, Precision::F32);
//! let mut y = [0.0; 2];
//! panels.apply(&[1.0, 1.0, 1.0], &mut y, &mut Scratch::default());
//! assert_eq!(y, [6.0, 1.0]);
//! ```

pub mod edge_attention;
mod error;
mod fresh;
pub mod gelu;
pub mod gemm;
pub mod gru;
#[cfg_attr(
    not(target_arch = "x86_64"),
    allow(dead_code, reason = "no other processor has a unit that reads them")
)]
pub mod half_pages;
mod kernels;
pub mod norm;
mod operands;
pub mod panels;
pub mod rows;
pub mod smoothing;
#[cfg(test)]
mod testing;

pub use error::KernelError;
pub use fresh::fresh_pieces;
pub use kernels::{Choice, Kernel, tile, wide};
pub use operands::Operands;
