//! nuPlan's benchmark, equal to its devkit: closed loop, reactive agents, metrics and scores.
//!
//! [`closed_loop::drive`] simulates a recording with a driver in control of the ego, [`tracking`]
//! moves the ego's vehicle along the driver's trajectory, [`reactive_agents`] is the traffic of the
//! reactive challenge, and [`metrics`] scores drives in closed loop and plans in open loop. Drivers
//! are in `gump-planner`, file formats in `gump-data`.

pub mod closed_loop;
pub mod metrics;
pub mod path;
pub mod reactive_agents;
pub mod tracking;
