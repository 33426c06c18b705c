//! Scenarios made up from nothing: procedural roads and rule-driven traffic.
//!
//! Free of any recording and of its licence, endless, and the same for the same seed. Start with
//! [`synthesize`], or with [`Profile`] for scenes like recorded ones, which [`track`] shows as a
//! vehicle's sensors would. Scenes that SUMO simulates begin with [`draw_sumo_demand`]; running SUMO is the
//! driver's affair, reading what it puts out that of `gump_data::sumo`.
//!
//! ```
//! use gump_scene::Seed;
//! use gump_synthesis::{SynthesisConfig, synthesize};
//!
//! let scenario = synthesize(&SynthesisConfig::standard(), Seed(7));
//! assert_eq!((scenario.log.len(), scenario.now), (91, 10));
//! assert!(scenario.present().ego_now().length > 0.0);
//! ```

mod config;
mod curve;
mod family;
mod layout;
mod map;
mod network;
mod plan;
mod profile;
mod record;
mod recorded;
mod scenario;
mod smooth;
mod sumo_demand;
mod tracker;
mod traffic;

/// Version of the generators: it grows whenever a seed gives another scene than before.
///
/// Frozen sets of scenes name the version that made them; [`SynthesisConfig::of_version`] and
/// [`SumoDemand::of_version`] say what a version asked for. `tests/frozen.rs` holds every version
/// to the scenes it made first.
pub const GENERATOR_VERSION: u32 = 1;

pub use config::SynthesisConfig;
pub use family::RoadFamily;
pub use profile::Profile;
pub use scenario::{synthesize, synthesize_many, try_synthesize};
pub use smooth::smooth_motion;
pub use sumo_demand::{SumoDemand, draw_sumo_demand};
pub use tracker::{Tracker, track};
