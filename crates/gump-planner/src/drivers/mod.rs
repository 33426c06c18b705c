//! Drivers that do not compare candidates: the log, a car that rolls on straight, nuPlan's IDM
//! planner, and the ego of a world.

mod imitation;
mod log;
mod nuplan_idm;
mod simple;

pub use imitation::ImitationDriver;
pub use log::LogDriver;
pub use nuplan_idm::NuplanIdmDriver;
pub use simple::SimpleDriver;
