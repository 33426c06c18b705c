//! Prefixes of the names of tensors that a training run stores beside the weights.

/// Prefix of the optimizer's moments.
pub const OPTIMIZER: &str = "optimizer.";
/// Prefix of the weights that drove the scenes of closed-loop training.
pub const DRIVER: &str = "driver.";
/// Prefix of the weights at the start of a run, near which its divergence keeps it.
pub const REFERENCE: &str = "reference.";
/// Prefix of the weights in training, where their moving average is the result.
pub const TRAINED: &str = "trained.";
/// All prefixes.
pub(crate) const PREFIXES: [&str; 4] = [OPTIMIZER, DRIVER, REFERENCE, TRAINED];
