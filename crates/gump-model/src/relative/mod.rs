//! A traffic model with relative attention throughout.
//!
//! Each agent at each frame is one node. It attends to its own past, to its nearest neighbours and to
//! the nearest pieces of the map, by relative pose and time alone: no place of a scene's frame enters
//! anywhere, so nothing is re-centred, and what is kept of a node stays true for as long as it is
//! kept. What a node ends with says the next half second of its agent, in the agent's own frame.
//!
//! `map` cuts the map into pieces, `graph` makes nodes and edges, `grid` has the bins of a move,
//! `sample` what is learned from, `net` the network, `weights` its numbers without a tensor library,
//! `store` its files. Rolling it out is in `gump-engine`, training it in `gump-train`.

mod config;
pub mod graph;
pub mod grid;
pub mod map;
#[cfg(feature = "tensors")]
mod net;
pub mod sample;
#[cfg(feature = "tensors")]
mod store;
mod weights;

pub use self::config::RelativeConfig;
#[cfg(feature = "tensors")]
pub use self::net::RelativeNetwork;
pub use self::sample::SampleConfig as RelativeSampleConfig;
#[cfg(feature = "tensors")]
pub use self::store::{config, header, is_relative, load, save};
pub use self::weights::RelativeWeights;
