//! Errors of this crate.

use std::path::PathBuf;

/// An error of the model: a configuration, a checkpoint, an input or the arithmetic below.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ModelError {
    /// The tensor library failed.
    #[cfg(feature = "tensors")]
    #[error("tensor operation failed: {0}")]
    Tensor(#[from] candle_core::Error),
    /// Another error of parameters or layers.
    #[cfg(feature = "tensors")]
    #[error(transparent)]
    Network(gump_nn::NnError),
    /// A configuration contradicts itself.
    #[error("configuration: {reason}")]
    Config {
        /// The key at fault.
        key: &'static str,
        /// What is wrong with it.
        reason: String,
    },
    /// A configuration cannot be written as JSON.
    #[error("configuration: {0}")]
    Json(serde_json::Error),
    /// A checkpoint has a tensor that its network does not.
    #[error("configuration: the checkpoint's tensor \"{name}\" has no place in it")]
    UnusedTensor {
        /// Its name.
        name: String,
    },
    /// A checkpoint lacks a tensor that the configuration requires.
    #[error("tensor \"{name}\" is missing")]
    MissingTensor {
        /// Its name.
        name: String,
    },
    /// A tensor of a checkpoint has another shape than the configuration requires.
    #[error("tensor \"{name}\" has shape {found:?}, expected {expected:?}")]
    TensorShape {
        /// Its name.
        name: String,
        /// The required shape.
        expected: Vec<usize>,
        /// The shape in the file.
        found: Vec<usize>,
    },
    /// A kernel that this processor does not support, or that computes wrong results.
    #[error(transparent)]
    Kernel(#[from] gump_kernels::KernelError),
    /// Bytes that are not weights, or those of another network.
    #[error("weights: {0}")]
    Weights(#[from] WeightsError),
    /// A weight cannot be represented in the requested form.
    #[error("tensor \"{name}\" holds {number}, which {form} cannot express")]
    WeightNotFinite {
        /// Its name.
        name: String,
        /// The first invalid number.
        number: f32,
        /// "bfloat16" or "8 bits".
        form: &'static str,
    },
    /// A file that is not a checkpoint of this crate, or has another vocabulary.
    #[error("{what}: {path}")]
    Checkpoint {
        /// The expectation and the content found.
        what: String,
        /// The file.
        path: PathBuf,
    },
    /// A file could not be read or written.
    #[error("{action}: {cause}: {path}")]
    Io {
        /// The operation.
        action: &'static str,
        /// The error of the system.
        cause: std::io::Error,
        /// The file.
        path: PathBuf,
    },
}

/// Why bytes are not the weights of a network.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WeightsError {
    /// The header cannot be read.
    #[error("expected a safetensors file ({0})")]
    NotSafetensors(safetensors::SafeTensorError),
    /// The weights are of another network.
    #[error("expected weights of the {expected} network")]
    OtherNetwork {
        /// The network that was expected.
        expected: &'static str,
    },
    /// The network reads another number of properties than this version computes.
    #[error("the network reads {found} properties of a place, expected {expected}")]
    OtherInputs {
        /// Number that this version computes.
        expected: usize,
        /// Number that the network reads.
        found: usize,
    },
    /// The header has no configuration.
    #[error("the header has no \"config\"")]
    NoConfig,
    /// The configuration in the header cannot be read.
    #[error("its configuration is not valid ({0})")]
    InvalidConfig(serde_json::Error),
    /// The tensors cannot be read.
    #[error("damaged weights ({0})")]
    Damaged(safetensors::SafeTensorError),
    /// The numbers of a tensor have another type.
    #[error("tensor \"{name}\" has type {found:?}, expected F16 or F32")]
    TensorType {
        /// Its name.
        name: String,
        /// The type of its numbers.
        found: safetensors::Dtype,
    },
}

#[cfg(feature = "tensors")]
impl From<gump_nn::NnError> for ModelError {
    fn from(error: gump_nn::NnError) -> Self {
        use gump_nn::NnError;
        match error {
            NnError::Tensor(error) => Self::Tensor(error),
            NnError::Config { key, reason } => Self::Config { key, reason },
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
            other => Self::Network(other),
        }
    }
}
