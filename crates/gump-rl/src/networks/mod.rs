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

pub use adam::{Adam, clip};
pub use conv_net::{Architecture, ConvNet, ConvPass, Picture};
pub use mlp::{Mlp, Pass};
pub use normalizer::Normalizer;

use gump_scene::Rng;
use rand::Rng as _;

/// A number from the standard normal distribution.
///
/// Source: Box and Muller 1958.
pub(crate) fn standard_normal(rng: &mut Rng) -> f64 {
    let radius = (-2.0 * (1.0 - rng.random::<f64>()).ln()).sqrt();
    radius * (std::f64::consts::TAU * rng.random::<f64>()).cos()
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_scene::Seed;

    #[test]
    fn normal_numbers_have_their_moments() {
        let mut rng = Seed(1).rng();
        let drawn: Vec<f64> = (0..20_000).map(|_| standard_normal(&mut rng)).collect();
        let moment = |k: i32| drawn.iter().map(|x| x.powi(k)).sum::<f64>() / drawn.len() as f64;
        // Four standard errors each: 1, sqrt(2), sqrt(96) over sqrt(20000).
        assert!(moment(1).abs() < 0.028, "{}", moment(1));
        assert!((moment(2) - 1.0).abs() < 0.04, "{}", moment(2));
        assert!((moment(4) - 3.0).abs() < 0.28, "{}", moment(4));
    }
}
