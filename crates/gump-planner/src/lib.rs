//! Proposals, imagining them in any world, choosing one.
//!
//! Start with [`Interactive`]: it proposes what the ego might do, imagines how others answer and
//! keeps every candidate with its score. [`Planner`] is what plans from a scene alone;
//! [`PlannerPolicy`] lets one drive in a simulation. How traffic moves is a world's business, what
//! is good a reward's; nothing here reads a file or steps a world by itself.
//!
//! nuPlan's closed loop is driven by a [`gump_nuplan::closed_loop::Driver`]: [`PdmClosed`], the
//! paper's [`InteractiveDriver`], which is PDM with imagination in place of a forecast,
//! [`ImitationDriver`], [`NuplanIdmDriver`], [`SimpleDriver`], the oracle [`LogDriver`], or any
//! [`Planner`] as [`Planned`]. [`closed_loop`] lets one drive and scores it; [`Comparison`] says who
//! is better and how sure that is, [`value_policies`] does it for any policy in any world.
//!
//! # Terms
//! * **proposal**: a trajectory of the ego. **Candidate**: a proposal with what became of it.
//! * **plan**: all candidates and which one was chosen.
//! * **way**: the line a proposal follows, the route or the lanes ahead.
//! * **prospect**: a policy with all that was imagined of it. **Decision**: all prospects and which
//!   one drives on.
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
//!
//! # Scoring a planner
//! A planner of one's own is a `Driver`: a name, and a trajectory per step.
//! `examples/score_a_planner.rs` judges this one in three worlds.
//! ```
//! use gump_planner::closed_loop::drive_scenario;
//! use gump_nuplan::{closed_loop::*, reactive_agents::NuplanIdm, tracking::Trajectory};
//! use gump_rollout::BoxError;
//! use gump_scene::EgoState;
//!
//! /// Goes on straight at the speed it has.
//! struct Cruise;
//! impl Driver for Cruise {
//!     fn name(&self) -> &str { "cruise" }
//!     fn drive(&mut self, moment: &Moment<'_>) -> Result<Trajectory, BoxError> {
//!         let (ego, step) = (*moment.ego, 0.1 * moment.ego.speed());
//!         let states = (0..=40).map(|i| EgoState {
//!             time_us: ego.time_us + 100_000 * i,
//!             rear_axle: ego.rear_axle * gump_geometry::Pose::new(step * i as f64, 0.0, 0.0),
//!             ..ego
//!         });
//!         Ok(Trajectory::new(states.collect())?)
//!     }
//! }
//!
//! let scenario = gump_scene::fixture::scenario(
//!     "lane 1: 0,0 300,0 speed 12
//!      drivable: -10,-2 300,-2 300,2 -10,2
//!      route 1
//!      ego vehicle 0: 10,0 velocity 8,0 size 5.176,2.297
//!      agent vehicle 1: 60,0 velocity 8,0",
//! ).unwrap();
//! let (mut traffic, config) = (NuplanIdm::default(), DriveConfig::default());
//! let scored = drive_scenario(&scenario, &mut traffic, &mut Cruise, &config).unwrap();
//! assert_eq!(scored.metrics.collisions.score, 1.0);
//! assert!(scored.score > 0.5);
//! ```

pub mod closed_loop;
mod compare;
mod considered;
mod driver;
mod drivers;
mod error;
mod idm;
mod interactive;
mod interactive_driver;
mod obstacle;
mod path_ahead;
mod pdm;
mod planner;
mod proposal;
mod propose;
pub mod route_search;

pub use compare::{Comparison, PolicyValue, ValueConfig, value_policies};
pub use considered::{Considered, Explain};
pub use drivers::{ImitationDriver, LogDriver, NuplanIdmDriver, Planned, SimpleDriver};
pub use error::PlanError;
pub use idm::IdmPlanner;
pub use interactive::{Interactive, InteractiveConfig, planning_reward};
pub use interactive_driver::{
    Decision, InteractiveDriver, InteractiveDriverConfig, Phases, PlanBudget, Prospect, Worth,
};
pub use pdm::{PdmClosed, PdmConfig, PdmScore};
pub use planner::{Candidate, CandidateScore, Plan, Planner, PlannerPolicy};
pub use proposal::{Proposal, ProposalKind};
pub use propose::{ProposalConfig, Proposals, emergency_brake, propose};
