//! The relative network: a traffic model with relative attention throughout.
//!
//! Each agent at each frame is one node. It attends to its own past, to its nearest neighbours and
//! to the nearest pieces of the map, by relative pose and time only. No coordinates of a scene
//! frame are used, so nothing has to be re-centred, and cached keys and values of a node stay
//! valid. The final vector of a node predicts the next half second of its agent, in the agent's own
//! frame.
//!
//! `map` cuts the map into pieces, `route` says which lanes a vehicle means to follow, `driveway` adds
//! lanes into driveways, `graph` builds
//! nodes and edges, `grid` has the bins of a move, `sample` the training samples, `returns` the moves that
//! lead back to a log, `net` the network,
//! `preference` its loss on moves that are rewarded, `weights` its parameters without a tensor library,
//! `store` its files. Rollouts are in `gump-engine`, training is in `gump-train`.

mod config;
pub mod driveway;
pub mod graph;
pub mod grid;
pub mod map;
#[cfg(feature = "tensors")]
mod net;
#[cfg(feature = "tensors")]
mod preference;
pub mod returns;
pub mod route;
pub mod sample;
#[cfg(feature = "tensors")]
mod store;
mod weights;

pub use self::config::RelativeConfig;
#[cfg(feature = "tensors")]
pub use self::net::RelativeNetwork;
#[cfg(feature = "tensors")]
pub use self::preference::{Anchor, Preference};
pub use self::sample::SampleConfig as RelativeSampleConfig;
#[cfg(feature = "tensors")]
pub use self::store::{config, header, is_relative, load, save};
pub use self::weights::RelativeWeights;
pub(crate) use self::weights::plain_numbers;
