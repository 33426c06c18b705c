//! The formats: a file or a folder for each, and the table of them.
//!
//! A format tells what a file states. What it leaves out is filled in by `complete`, bytes come
//! from `io`. Start with `registry`; `womd` is the format that most others are measured by.

#[cfg(feature = "argoverse2")]
pub(crate) mod argoverse2;
pub mod cache;
#[cfg(feature = "commonroad")]
pub(crate) mod commonroad;
pub(crate) mod document;
pub(crate) mod gpudrive;
#[cfg(any(feature = "argoverse2", feature = "commonroad", feature = "taf-bw"))]
pub(crate) mod lanelet;
#[cfg(feature = "nuplan")]
pub mod nuplan;
pub(crate) mod registry;
pub mod scenario_json;
#[cfg(feature = "sumo")]
pub mod sumo;
#[cfg(feature = "taf-bw")]
pub(crate) mod taf_bw;
pub mod womd;
