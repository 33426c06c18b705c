//! The network of the game, which the game takes only from here.

pub(crate) use gump_engine::relative::{LiveFuture, RelativeWorld};

use gump_engine::SamplingConfig;
use gump_engine::relative::RelativeSampling;
use gump_kernels::{Choice, Kernel, KernelError};
use gump_model::relative::RelativeWeights;

/// The world of some weights, with the rules that the driver's worlds have.
///
/// Error: the reason, as a sentence.
pub(crate) fn world(weights: &[u8]) -> Result<RelativeWorld, String> {
    let sampling = RelativeSampling::from(&SamplingConfig::default());
    let weights = RelativeWeights::read(weights).map_err(|error| error.to_string())?;
    RelativeWorld::of_weights(&weights, sampling).map_err(|error| error.to_string())
}

/// Makes this process multiply with the portable kernel, as the engine in a browser does. Must be
/// called before any game is opened.
///
/// # Errors
/// If another kernel has been at work.
pub fn compute_as_browsers_do() -> Result<(), KernelError> {
    Choice::force(Kernel::Portable).map(drop)
}
