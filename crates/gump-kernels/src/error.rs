//! Errors of this crate.

/// A kernel that this processor does not have, or that multiplies wrongly.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct KernelError(pub(crate) String);
