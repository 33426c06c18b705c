//! What can go wrong in this crate.

use std::path::PathBuf;

/// An error of the model: a configuration, a checkpoint, an input or the arithmetic below.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// The tensor library failed.
    #[cfg(feature = "tensors")]
    #[error("tensor operation failed: {0}")]
    Tensor(#[from] candle_core::Error),
    /// A configuration contradicts itself.
    #[error("configuration: {0}")]
    Config(String),
    /// A checkpoint lacks a tensor that the configuration asks for.
    #[error("tensor \"{name}\" is missing")]
    MissingTensor {
        /// Its name.
        name: String,
    },
    /// A tensor of a checkpoint has another shape than the configuration asks for.
    #[error("tensor \"{name}\" has shape {found:?}, expected {expected:?}")]
    TensorShape {
        /// Its name.
        name: String,
        /// What the configuration asks for.
        expected: Vec<usize>,
        /// What the file holds.
        found: Vec<usize>,
    },
    /// A kernel that this processor does not have, or that multiplies wrongly.
    #[error(transparent)]
    Kernel(#[from] gump_kernels::KernelError),
    /// Bytes that hold no weights, or those of another network.
    #[error("weights: {0}")]
    Weights(String),
    /// A weight cannot be written in the form that is asked for.
    #[error("tensor \"{name}\" holds {number}, which {form} cannot express")]
    WeightNotFinite {
        /// Its name.
        name: String,
        /// The first number at fault.
        number: f32,
        /// "bfloat16" or "8 bits".
        form: &'static str,
    },
    /// A file is not a checkpoint of this crate, or of another vocabulary.
    #[error("{what}: {path}")]
    Checkpoint {
        /// What was expected and what was found.
        what: String,
        /// The file.
        path: PathBuf,
    },
    /// A file could not be read or written.
    #[error("{action}: {cause}: {path}")]
    Io {
        /// What was being done.
        action: &'static str,
        /// The system's word.
        cause: std::io::Error,
        /// The file.
        path: PathBuf,
    },
    /// Training diverged.
    #[error(
        "the loss is not a number at step {step} (field {field}); the last checkpoint is intact"
    )]
    LossNotFinite {
        /// Optimiser step.
        step: usize,
        /// First loss that is not finite.
        field: String,
    },
    /// There is nothing to train on.
    #[error("no scenario offers {frames} consecutive frames at 2 Hz to train on")]
    NoData {
        /// Frames a sample needs.
        frames: usize,
    },
    /// Processes that train together lost each other.
    #[error("processes that train together: {0}")]
    Peers(String),
    /// A scene cannot be imagined by this model.
    #[error("scene: {0}")]
    Scene(String),
}

#[cfg(feature = "tensors")]
impl From<gump_nn::NnError> for ModelError {
    fn from(error: gump_nn::NnError) -> Self {
        use gump_nn::NnError;
        match error {
            NnError::Tensor(error) => Self::Tensor(error),
            NnError::Config(what) => Self::Config(what),
            NnError::MissingTensor { name } => Self::MissingTensor { name },
            NnError::TensorShape {
                name,
                expected,
                found,
            } => Self::TensorShape {
                name,
                expected,
                found,
            },
        }
    }
}
