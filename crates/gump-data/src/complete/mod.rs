//! From what a format states to a whole scenario: gaps of tracks and maps filled by one set of
//! rules for all formats. Start with `recording`.

pub(crate) mod features;
pub(crate) mod infer;
pub(crate) mod motion;
pub(crate) mod recording;
pub(crate) mod track;
