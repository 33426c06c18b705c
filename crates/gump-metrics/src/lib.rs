//! Metrics of rollouts, and rewards that combine them.
//!
//! Start with [`Metric`]; [`ALL`] lists the metrics. [`summarize`] computes the usual metrics of
//! many futures at once, and [`Reward`] combines metrics into one number. [`mmd`] compares
//! generated scenes, [`behaviour`] counts events that a driver would notice, [`reactions`] counts
//! the agents that run into an ego that leaves its log, and [`statistics`] describes a set of
//! scenes.
//!
//! Benchmarks have their own crates: `gump-wosac` for realism and motion prediction, `gump-nuplan`
//! for planning. This crate neither steps a simulation nor reads files.
//!
//! # Terms
//! * **metric**: a measurement. **Reward**: a combination of metrics. **Score**: its value, with
//!   its parts.
//! * **gate**: a factor of a reward. **Term**: a summand.
//! * **ADE**, **FDE**: average and final displacement error relative to the log; *min* is over
//!   futures.
//!
//! ```
//! use gump_metrics::{Collision, logged, over_rollout, summarize};
//!
//! let scenario = gump_scene::fixture::scenario(
//!     "ego vehicle 0: 0,0 velocity 5,0
//!      agent vehicle 1: 30,0",
//! ).unwrap();
//! let rollout = logged(&scenario);
//! assert_eq!(over_rollout(&Collision, &rollout, scenario.ego), Some(1.0));
//! assert_eq!(summarize(&[rollout], Some(&scenario)).total().collision_rate(), Some(1.0));
//! ```

pub mod bearing;
pub mod behaviour;
mod bootstrap;
mod border;
mod collision;
mod comfort;
mod displacement;
pub mod encounter;
pub mod kinematics;
mod metric;
pub mod mmd;
mod offroad;
mod progress;
pub mod reactions;
mod red_light;
mod reward;
mod road_edge;
pub mod statistics;
mod summary;
pub mod tags;

pub use bootstrap::{Interval, interval, intervals, intervals_of_groups};
pub use border::Border;
pub use collision::{Collision, overlapping};
pub use comfort::{ComfortBounds, ComfortMeasurements, Discomfort};
pub use displacement::{Displacement, average_displacement};
pub use kinematics::{Acceleration, Speed, YawRate};
pub use metric::{ALL, Metric, Reduce, logged, over_rollout, over_rollouts};
pub use offroad::{OffRoad, metres_off_road};
pub use progress::{Progress, gained};
pub use red_light::RedLight;
pub use reward::{Gate, Reward, Score, Term};
pub use road_edge::{DistanceToRoadEdge, signed_distance_to_road_edge};
pub use summary::{Part, Summary, summarize};
