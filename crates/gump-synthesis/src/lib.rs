//! Synthetic scenarios: procedural roads and rule-driven traffic.
//!
//! No recording is used, so no licence of one applies. The number of scenes is unlimited, and the
//! same seed gives the same scene. Start with [`synthesize`], or with [`Profile`] for scenes with
//! the statistics of recorded ones; [`track`] simulates their observation by a vehicle's sensors.
//! Scenes simulated by SUMO begin with [`draw_sumo_demand`]; `xtask` runs SUMO, and
//! `gump_data::sumo` reads its output.
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
mod steering;
mod sumo_demand;
mod tracker;
mod traffic;

/// Version of the generators, increased whenever a seed gives another scene than before.
///
/// Frozen sets of scenes name the version that generated them; [`SynthesisConfig::of_version`] and
/// [`SumoDemand::of_version`] return the configuration of a version. `tests/frozen.rs` checks that
/// every version still generates its original scenes.
pub const GENERATOR_VERSION: u32 = 2;

pub use config::SynthesisConfig;
pub use family::RoadFamily;
pub use profile::Profile;
pub use scenario::{synthesize, synthesize_many, try_synthesize};
pub use smooth::smooth_motion;
pub use steering::steer;
pub use sumo_demand::{SumoDemand, draw_sumo_demand};
pub use tracker::{Tracker, track};
