//! Drivers of the closed loop that do not compare anything: the log, a car that just rolls, a
//! follower of the route, the ego of a world.

mod imitation;
mod log;
mod nuplan_idm;
mod simple;

pub use imitation::ImitationDriver;
pub use log::LogDriver;
pub use nuplan_idm::NuplanIdmDriver;
pub use simple::SimpleDriver;
