//! Small networks with hand-written gradients, their optimizer, and normalization of inputs.
//!
//! A learner's step is a dozen products of matrices with a few hundred rows; recording a graph for
//! each would cost more than some of them. [`Mlp`] is a dense network, [`Pass`] the values of one
//! batch, [`Adam`] the optimizer, [`Normalizer`] scales inputs, [`ConvNet`] encodes images.

mod adam;
mod conv_layers;
mod conv_net;
mod convolution;
mod group_norm;
mod mlp;
mod normalizer;
mod product;

#[cfg(test)]
mod conv_net_tests;

pub use adam::{Adam, clip, norm};
pub use conv_net::{Architecture, ConvNet, ConvPass, Picture};
pub use mlp::{Mlp, Pass};
pub use normalizer::Normalizer;
