//! Scene generation: traffic on a given map, optionally from a prompt and constraints.
//!
//! Start with [`GenerateRequest`] and [`generate`]. Constraints on single objects are in
//! [`constraint`], scenes that satisfy a prompt in [`pipeline`]; `prompt_search` finds the
//! place on the map at which a prompt can hold. `gump_engine::placement` decides which positions on a
//! map are valid.
//!
//! Objects are generated one after another in canonical order, the ego first: a key is appended,
//! one pass of the network reads it (earlier slots stay in the cache), and the decoder draws the
//! fields of its state one by one; later objects see that state. The number of objects is given, or
//! decided by the network.
//!
//! Source: GUMP's scene generation, in full autoregression ([`GenerateConfig::paper`]); masks,
//! rejection, deconvolved and stratified draws, and counts decided by the network are our
//! additions.
//!
//! ```
//! use gump_engine::{SamplingConfig, TransformerWorld};
//! use gump_generate::{Counts, GenerateRequest, generate};
//! use gump_model::{Device, ModelConfig, Network};
//! use gump_scene::Seed;
//!
//! // A scene in place of another: its map and its ego's pose.
//! let recorded = gump_scene::fixture::scenario(
//!     "lane 1: -100,0 100,0 width 3.6
//!      drivable: -100,-2 100,-2 100,2 -100,2
//!      ego vehicle 0: 0,0 velocity 8,0",
//! )?;
//! let mut request = GenerateRequest::in_place_of(&recorded);
//! request.counts = Some(Counts { vehicles: 2, ..Counts::default() });
//! // Untrained; `gump_model::checkpoint::load` reads weights.
//! let network = Network::random(ModelConfig::tiny(), Seed(5), &Device::Cpu)?;
//! let world = TransformerWorld::new(network, SamplingConfig::default());
//! for scene in generate(&world, &request, &[Seed(0), Seed(1)])? {
//!     assert_eq!(scene?.frame.agents().len(), 3);
//! }
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod advance;
pub mod baseline;
pub mod check;
pub mod constraint;
mod drive;
mod futures;
mod headway;
mod latin_hypercube;
mod object_check;
mod partial_scene;
pub mod pipeline;
mod prepared;
mod prompt;
mod prompt_search;
mod reason;
mod request;
mod roadside;
mod site;
#[cfg(test)]
mod tests;

pub use request::{
    Counts, EgoStart, GenerateConfig, GenerateError, GenerateRequest, GeneratedScene, Placement,
    generate,
};
