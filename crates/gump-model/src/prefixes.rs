//! Prefixes of the names of tensors that a training run stores beside the weights.

/// Of the optimizer's moments.
pub const OPTIMIZER: &str = "optimizer.";
/// Of the weights that drove the scenes of closed-loop training.
pub const DRIVER: &str = "driver.";
/// Of the weights in training, where their moving average is the result.
pub const TRAINED: &str = "trained.";
/// All of them.
pub(crate) const PREFIXES: [&str; 3] = [OPTIMIZER, DRIVER, TRAINED];
