//! Planners: they propose trajectories, simulate them in a world, score them and choose one.
//!
//! Start with [`InteractiveDriver`], the paper's planner: it proposes policies for the ego, rolls
//! each out in a world in which other agents react, and keeps every candidate with its score.
//! Traffic is simulated by the world that the planner is given; the crate reads no files.
//!
//! All planners implement [`gump_nuplan::closed_loop::Driver`]: [`PdmClosed`], which uses a
//! constant-velocity forecast where [`InteractiveDriver`] uses rollouts, [`ImitationDriver`],
//! [`NuplanIdmDriver`], [`SimpleDriver`] and the oracle [`LogDriver`]. [`closed_loop`] drives one
//! and scores the drive; [`Comparison`] compares planners with confidence intervals, and
//! [`value_policies`] compares any policies in any world.
//!
//! # Terms
//! * **proposal**: a trajectory of the ego. **Candidate**: a proposal with its simulated outcome.
//! * **way**: the line that a proposal follows, taken from the route.
//! * **candidate**: a policy with its rollouts and scores. **Decision**: all candidates, and the one
//!   that was chosen.
//!
//! ```
//! use gump_nuplan::closed_loop::{Recording, derive_roadblocks};
//! use gump_planner::closed_loop::plan_once;
//! use gump_planner::{Explain, InteractiveDriver, InteractiveDriverConfig};
//! use gump_rollout::worlds::Idm;
//!
//! let mut scenario = gump_scene::fixture::scenario(
//!     "lane 1: 0,0 300,0 speed 15
//!      drivable: 0,-3 300,-3 300,3 0,3
//!      route 1
//!      ego vehicle 0: 10,0 velocity 8,0
//!      agent vehicle 1: 60,0 velocity 6,0",
//! ).unwrap();
//! derive_roadblocks(&mut scenario);
//! let recording = Recording::of_boxes(scenario).unwrap();
//! let world = Idm::default();
//! let config = InteractiveDriverConfig::default();
//! let mut planner = InteractiveDriver::new(&world, config).unwrap();
//! plan_once(&recording, &mut planner).unwrap();
//! let decision = planner.decision().unwrap();
//! // Five speeds on three lines, four other driving styles, and what the world has the ego do.
//! assert_eq!(decision.candidates.len(), 20);
//! let best = decision.candidates[decision.chosen].value;
//! let mut finalists = decision.candidates.iter().filter(|candidate| candidate.finalist);
//! assert!(finalists.all(|candidate| candidate.value <= best + 1e-6));
//! ```
//!
//! # Scoring a planner
//! Your own planner implements `Driver`: a name, and a trajectory per step.
//! `examples/score_a_planner.rs` scores this one in three worlds.
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
//!     fn drive(&mut self, moment: &PlannerInput<'_>) -> Result<Trajectory, BoxError> {
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

mod candidates;
pub mod closed_loop;
mod compare;
mod drivers;
mod error;
mod interactive;
mod pdm;
mod proposal;
pub mod route_search;

pub use candidates::{Candidate, Explain};
pub use compare::{Comparison, PolicyValue, ValueConfig, value_policies};
pub use drivers::{ImitationDriver, LogDriver, NuplanIdmDriver, SimpleDriver};
pub use error::PlanError;
pub use interactive::{
    Aggregate, Allocation, CandidateEvaluation, CandidateScore, Decision, InteractiveDriver,
    InteractiveDriverConfig, Phases, PlanBudget, ValueEstimate, WarmStart,
};
pub use pdm::{PdmClosed, PdmConfig, PdmScore, Side};
pub use proposal::{Proposal, ProposalKind};
