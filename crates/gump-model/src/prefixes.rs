//! Prefixes of the names of tensors that a training run stores beside the weights.

/// Prefix of the optimizer's moments.
pub const OPTIMIZER: &str = "optimizer.";
/// Prefix of the weights that drove the scenes of closed-loop training.
pub const DRIVER: &str = "driver.";
/// Prefix of the weights in training, where their moving average is the result.
pub const TRAINED: &str = "trained.";
/// All prefixes.
pub(crate) const PREFIXES: [&str; 3] = [OPTIMIZER, DRIVER, TRAINED];
