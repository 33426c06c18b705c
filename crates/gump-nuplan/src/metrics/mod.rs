//! nuPlan's planning metrics and scores, and the paper's variants for reinforcement learning.
//!
//! Start with [`score`]: it measures a [`SimulationHistory`] in closed loop; [`ClosedLoop`] contains
//! every part. [`open_loop`] compares plans with the expert, [`Scoring`] combines metrics into one
//! number and a table, [`RlScore`] is the paper's score. Simulation is in `gump-rollout` and
//! `gump-planner`, files are in `gump-data`.
//!
//! The numbers agree with nuplan-devkit on its own test scenes and on recorded ones, see
//! `docs/results/0004-nuplan.md`. Where the devkit's documentation, the paper and the devkit's code
//! differ, the code is followed, because published scores come from it.
//!
//! # Terms
//! * **sample**: one executed step. **History**: all samples, with the expert's.
//! * **followed lanes**: the lanes under the ego's centre. **Corner lanes**: those under its
//!   corners.
//! * **at fault**: a collision that counts against the ego.
//!
//! # Scoring one's own planner
//! ```
//! use gump_nuplan::metrics::{Sample, Scoring, SimulationHistory, score};
//! use gump_scene::{EgoState, VehicleParameters, fixture};
//!
//! let scenario = fixture::scenario(
//!     "lane 1: 0,0 300,0 speed 15\ndrivable: 0,-2 300,-2 300,2 0,2\n\
//!      ego vehicle 0: 10,0 velocity 10,0\nagent vehicle 1: 60,0 velocity 9,0",
//! ).unwrap();
//! let at = |step: i64, speed: f64| EgoState {
//!     time_us: step * 100_000,
//!     rear_axle: gump_geometry::Pose::new(10.0 + 0.1 * speed * step as f64, 0.0, 0.0),
//!     velocity: gump_geometry::dvec2(speed, 0.0),
//!     ..EgoState::default()
//! };
//! // What your planner drove, and the traffic it met, step by step ...
//! let frames = scenario.log[scenario.now..].iter().cloned();
//! let samples: Vec<Sample> = frames.enumerate()
//!     .map(|(i, frame)| Sample { ego: at(i as i64, 8.0), frame, plan: vec![] })
//!     .collect();
//! // ... and what the recorded driver did.
//! let expert: Vec<EgoState> = (0..=80).map(|step| at(step, 10.0)).collect();
//! let drive = SimulationHistory {
//!     samples: &samples,
//!     expert: &expert,
//!     map: &scenario.map,
//!     ego: Some(scenario.ego),
//!     vehicle: VehicleParameters::PACIFICA,
//! };
//! let result = score(&drive).unwrap();
//! assert!((result.progress.ratio - 0.8).abs() < 1e-9);
//! assert!((result.score(&Scoring::closed_loop()) - 15.0 / 16.0).abs() < 1e-9);
//! ```

mod closed_loop;
mod collision;
mod comfort;
mod drivable_area;
mod driving_direction;
mod error;
mod history;
mod lanes;
mod open_loop;
mod paper;
mod progress;
mod savgol;
mod scoring;
mod speed_limit;
mod statistics;
mod time_to_collision;

pub use closed_loop::{ClosedLoop, score};
pub use collision::{CollisionEvent, Collisions, collisions};
pub use comfort::{ComfortSeries, Motion};
pub use drivable_area::{DrivableArea, TOLERANCE, drivable_area};
pub use driving_direction::{DrivingDirection, DrivingDirectionConfig, driving_direction};
pub use error::NuPlanError;
pub use gump_metrics::bearing::{bearing, is_ahead, is_behind, signed_lateral_gap};
pub use gump_metrics::encounter::{CollisionKind, classify};
pub use history::{RolloutHistory, Sample, SimulationHistory, vehicle_of};
pub use lanes::{
    CornerLanes, Keeping, LaneChange, Lanes, corner_lanes, followed_lanes, is_in_intersection,
    keeping, lane_changes,
};
pub use open_loop::{HorizonError, OpenLoop, OpenLoopConfig, expert_errors, open_loop};
pub use paper::{MEAN_PROGRESS, RlEpisode, RlScore};
pub use progress::{ExpertProgress, expert_progress};
pub use savgol::SavitzkyGolay;
pub use scoring::{AggregateRow, AggregateScores, MetricScores, ScenarioScores, Scoring};
pub use speed_limit::{MAX_OVERSPEED, SpeedLimit, speed_limit};
pub use statistics::Statistics;
pub use time_to_collision::{
    RoadContext, TimeToCollision, TimeToCollisionConfig, time_to_collision,
};
