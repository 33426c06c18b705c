//! The formats: a file or a folder for each, and their registry.
//!
//! A format reads what a file states. `complete` fills gaps, `io` reads bytes. Start with
//! `registry`; `womd` is the reference for most others.

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
