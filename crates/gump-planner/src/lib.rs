//! Proposals, imagining them in any world, choosing one.
//!
//! Start with [`Interactive`]: it proposes what the ego might do, imagines how others answer and
//! keeps every candidate with its score. [`Planner`] is what all planners are; [`PlannerPolicy`]
//! lets one drive in a simulation. How traffic moves is a world's business, what is good a
//! reward's; nothing here reads a file or steps a world by itself.
//!
//! # Terms
//! * **proposal**: a trajectory of the ego. **Candidate**: a proposal with what became of it.
//! * **plan**: all candidates and which one was chosen.
//! * **way**: the line a proposal follows, the route or the lanes ahead.
//!
//! ```
//! use gump_planner::{Interactive, InteractiveConfig, Planner};
//! use gump_rollout::worlds::Idm;
//!
//! let scenario = gump_scene::fixture::scenario(
//!     "lane 1: 0,0 300,0 speed 15
//!      ego vehicle 0: 10,0 velocity 8,0
//!      agent vehicle 1: 60,0 velocity 6,0",
//! ).unwrap();
//! let world = Idm::default();
//! let mut planner = Interactive::new(&world, InteractiveConfig::default()).unwrap();
//! let plan = planner.plan(&scenario.present()).unwrap();
//! assert_eq!(plan.candidates.len(), 15);
//! let score = plan.choice().score.as_ref().unwrap();
//! assert!(plan.candidates.iter().all(|c| c.score.as_ref().unwrap().mean <= score.mean + 1e-6));
//! ```

pub mod closed_loop;
mod considered;
mod driver;
mod drivers;
mod error;
mod idm;
mod interactive;
mod obstacle;
mod path_ahead;
mod pdm;
mod planner;
mod proposal;
mod propose;
pub mod route_search;

pub use considered::{Considered, Explain};
pub use drivers::{LogDriver, NuplanIdmDriver, Planned, SimpleDriver};
pub use error::PlanError;
pub use idm::IdmPlanner;
pub use interactive::{Interactive, InteractiveConfig, planning_reward};
pub use pdm::{PdmClosed, PdmConfig, PdmScore};
pub use planner::{Candidate, CandidateScore, Plan, Planner, PlannerPolicy};
pub use proposal::{Proposal, ProposalKind};
pub use propose::{ProposalConfig, Proposals, emergency_brake, propose};
