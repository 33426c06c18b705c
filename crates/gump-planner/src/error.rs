//! Errors of planners.

use gump_nuplan::metrics::NuPlanError;
use gump_rollout::{BoxError, RolloutError};
use gump_scene::{AgentId, RoadblockId};

/// Why planning failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PlanError {
    /// A planner was asked for a plan before it had an initialization.
    #[error("the planner was asked to drive before it was initialized")]
    NotInitialized,
    /// There is no route.
    #[error("the initialization has no route, expected the roadblocks to drive through")]
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
        /// Its name.
        name: &'static str,
        /// Its value.
        value: f64,
        /// The allowed range.
        expected: &'static str,
    },
    /// The world could not simulate the proposals.
    #[error("the world \"{world}\" could not imagine the proposals: {source}")]
    World {
        /// Name of the world.
        world: String,
        /// Its error.
        source: BoxError,
    },
}
