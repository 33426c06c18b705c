//! How nuPlan's ego follows what it is asked to drive: a vehicle with a rear axle and lagging
//! actuators.
//!
//! A [`Trajectory`] is what it is asked to drive, [`LqrTracker`] turns that into [`Controls`],
//! [`propagate`] into the next state.

mod lqr;
mod profile;
mod rear_axle;
mod trajectory;

pub use lqr::{LqrTracker, TRACKING_DT, TRACKING_HORIZON, Target, track_target};
pub use profile::{Profile, ProfileFit, Smoothness};
pub use rear_axle::{Controls, propagate, propagate_by};
pub use trajectory::Trajectory;
