//! House rules that a machine can check; each is also a test of this crate.

pub(crate) mod layers;
pub(crate) mod rust_version;
pub(crate) mod tidy;
