//! How the names of tensors begin that a training run keeps beside the weights.

/// Before the names of the optimiser's moments.
pub const OPTIMIZER: &str = "optimizer.";
/// Before the names of the weights that drove the scenes of closed-loop training.
pub const DRIVER: &str = "driver.";
/// Before the names of the weights being trained, where their moving average is what is shipped.
pub const TRAINED: &str = "trained.";
/// What a run's checkpoint holds beside the weights.
pub(crate) const PREFIXES: [&str; 3] = [OPTIMIZER, DRIVER, TRAINED];
