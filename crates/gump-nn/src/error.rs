//! Errors of this crate.

/// An error of parameters, of the optimizer's configuration, or of the tensor library below.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum NnError {
    /// The tensor library failed.
    #[error("tensor operation failed: {0}")]
    Tensor(#[from] candle_core::Error),
    /// A configuration contradicts itself.
    #[error("configuration: {reason}")]
    Config {
        /// The key at fault.
        key: &'static str,
        /// What is wrong with it.
        reason: String,
    },
    /// The tensors that parameters are loaded from lack one.
    #[error("tensor \"{name}\" is missing")]
    MissingTensor {
        /// Its name.
        name: String,
    },
    /// A tensor has another shape than requested.
    #[error("tensor \"{name}\" has shape {found:?}, expected {expected:?}")]
    TensorShape {
        /// Its name.
        name: String,
        /// The requested shape.
        expected: Vec<usize>,
        /// The shape found.
        found: Vec<usize>,
    },
}
