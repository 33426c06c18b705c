//! Scenes out of nothing: a map, perhaps a prompt and some constraints, and traffic appears.
//!
//! Objects come one after another in canonical order, the ego first: a key is appended, one pass
//! reads it (what came before stays in the cache), the decoder draws the fields of its state one by
//! one, and the state is what the next object sees. How many there are is given, or left to the
//! network. Start with [`GenerateRequest`] and [`generate`]; constraints on single objects are in
//! [`constraint`], scenes that hold a prompt in [`factory`]. What a draw may not do and where on a map
//! things belong is `gump_engine::placement`'s.
//!
//! Source: GUMP's scene generation, in full autoregression ([`GenerateConfig::paper`]); masks,
//! rejection, sharper and even draws, and counts left to the model are ours.

mod advance;
pub mod baseline;
pub mod constraint;
mod draft;
mod drive;
mod even;
pub mod factory;
mod prepared;
mod prompt;
mod reason;
mod request;
mod roadside;
mod search;
mod stage;
mod takes;
#[cfg(test)]
mod tests;
pub mod verdict;

pub use request::{
    Counts, EgoStart, GenerateConfig, GenerateError, GenerateRequest, GeneratedScene, Placement,
    generate,
};
