//! Scene generation: traffic on a given map, optionally from a prompt and constraints.
//!
//! Start with [`GenerateRequest`] and [`generate`]. Constraints on single objects are in
//! [`constraint`], scenes that satisfy a prompt in [`pipeline`]. `gump_engine::placement` decides
//! which positions on a map are valid.
//!
//! Objects are generated one after another in canonical order, the ego first: a key is appended,
//! one pass of the network reads it (earlier slots stay in the cache), and the decoder draws the
//! fields of its state one by one; later objects see that state. The number of objects is given, or
//! decided by the network.
//!
//! Source: GUMP's scene generation, in full autoregression ([`GenerateConfig::paper`]); masks,
//! rejection, deconvolved and stratified draws, and counts decided by the network are our
//! additions.

mod advance;
pub mod baseline;
pub mod check;
pub mod constraint;
mod drive;
mod futures;
mod latin_hypercube;
mod partial_scene;
pub mod pipeline;
mod prepared;
mod prompt;
mod reason;
mod request;
mod roadside;
mod search;
mod site;
#[cfg(test)]
mod tests;

pub use request::{
    Counts, EgoStart, GenerateConfig, GenerateError, GenerateRequest, GeneratedScene, Placement,
    generate,
};
