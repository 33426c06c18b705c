//! Tracking of plans by nuPlan's ego: a vehicle with a rear axle and actuator lag.
//!
//! A [`Trajectory`] is the plan, [`LqrTracker`] turns it into [`Controls`], and [`propagate`]
//! computes the next state.

mod lqr;
mod profile;
mod rear_axle;
mod trajectory;

pub use lqr::{LqrTracker, TRACKING_DT, TRACKING_HORIZON, Target, track_target};
pub use profile::{Profile, ProfileFit, Smoothness};
pub use rear_axle::{Controls, propagate, propagate_by};
pub use trajectory::Trajectory;
