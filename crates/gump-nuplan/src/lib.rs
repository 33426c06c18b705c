//! nuPlan's benchmark, equal to its devkit: closed loop, reactive agents, metrics and scores.
//!
//! [`closed_loop::drive`] lets a driver drive a recording among some traffic, [`tracking`] moves its
//! vehicle, [`reactive_agents`] are the traffic of the reactive challenge, and [`metrics`] measures
//! and scores what was driven, in closed loop and open loop. Drivers are in `gump-planner`, files in
//! `gump-data`.

pub mod closed_loop;
pub mod metrics;
pub mod path;
pub mod reactive_agents;
pub mod tracking;
