//! Completion of scenarios: gaps of tracks and maps are filled by one set of rules for all formats.
//! Start with `recording`.

pub(crate) mod features;
pub(crate) mod infer;
pub(crate) mod motion;
pub(crate) mod recording;
pub(crate) mod track;
