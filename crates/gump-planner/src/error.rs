//! What can keep a planner from planning.

use gump_nuplan::metrics::NuPlanError;
use gump_rollout::{BoxError, RolloutError};
use gump_scene::{AgentId, RoadblockId};

/// Why there is no plan.
#[derive(Debug, thiserror::Error)]
pub enum PlanError {
    /// A planner of the closed loop was asked before it was told where to go.
    #[error("the planner was asked to drive before it was given a mission")]
    NoMission,
    /// There is nowhere to go.
    #[error("the mission has no route, expected the roadblocks to drive through")]
    NoRoute,
    /// A closed loop stopped.
    #[error(transparent)]
    Drive(#[from] RolloutError),
    /// A drive that cannot be scored.
    #[error(transparent)]
    Score(#[from] NuPlanError),
    /// The route belongs to another map.
    #[error("no roadblock of the route is in the map, the first is {first}")]
    ForeignRoute {
        /// The first roadblock of the route.
        first: RoadblockId,
    },
    /// A state in the present frame is NaN or infinite.
    #[error("agent {agent} has a state that is not a finite number")]
    NotFinite {
        /// The agent.
        agent: AgentId,
    },
    /// A parameter outside its range.
    #[error("the parameter {name} is {value}, expected {expected}")]
    Parameter {
        /// Which one.
        name: &'static str,
        /// What was given.
        value: f64,
        /// What is allowed.
        expected: &'static str,
    },
    /// The world could not imagine the proposals.
    #[error("the world \"{world}\" could not imagine the proposals: {source}")]
    World {
        /// Name of the world.
        world: String,
        /// What it reported.
        source: BoxError,
    },
}
