//! Data types for traffic scenes: agents, frames, maps, scenarios and rollouts.
//!
//! Plain values without I/O and without tensors. All other crates use these types and terms, so
//! read this page first.
//!
//! # Terms
//! * **agent**: anything that moves and has a bounding box; **ego**: the agent a planner may drive.
//! * **track**: one agent over time. **Frame**: all agents and lights at one instant.
//! * **scenario**: recorded traffic, including its future. **Rollout**: simulated traffic.
//! * **scene state**: the part of a scenario that a world or policy may see: past and present,
//!   never the future.
//! * **future**: one of several rollouts of the same scene. **Prediction**: a few paths of one
//!   agent, or of some together, each with a confidence.
//! * **lane**, **route**: the road as a directed graph, and the ego's path through it.
//! * **roadblock**: lanes side by side in one direction, or their links through an intersection.
//!
//! Conventions: SI units, radians counter-clockwise from +x, world frame in f64. An agent's pose is
//! its **box centre**; only [`EgoState`] uses the rear axle. A frame lists the agents that are
//! present; there are no validity masks.
//!
//! ```
//! let scenario = gump_scene::fixture::scenario(
//!     "lane 1: 0,0 100,0 speed 15
//!      ego vehicle 0: 10,0 velocity 8,0
//!      agent vehicle 1: 30,0 velocity 5,0",
//! ).unwrap();
//! let scene = scenario.present();
//! assert_eq!(scene.now().agents().len(), 2);
//! assert!(scene.map.lanes_near(gump_geometry::dvec2(12.0, 1.0), 2.0).count() == 1);
//! ```

mod agent;
mod bends;
mod ego_state;
pub mod fixture;
mod frame;
mod lanes_ahead;
mod light_index;
mod map;
mod map_graph;
mod prediction;
mod rollout;
mod route;
mod scenario;
mod scene_state;
mod stop_line;
mod tag;

pub use agent::{Agent, AgentId, AgentKind, AgentState};
pub use bends::{BendLimits, approach_speed, bend_speed};
pub use ego_state::{EgoState, VehicleParameters};
pub use frame::{Frame, Light, LightState};
pub use gump_seed::{Rng, Seed, standard_normal};
pub use lanes_ahead::{LaneAhead, PointAhead, lanes_ahead};
pub use light_index::{MAX_LIGHTS, light_indices, light_indices_of};
pub use map::{
    Area, AreaKind, Lane, LaneFoot, LaneId, LaneKind, MapError, MapParts, RoadEdge, RoadEdgeKind,
    RoadLine, RoadLineKind, Roadblock, RoadblockId, StopSign, TYPICAL_SPEED_LIMIT, Unstated,
};
pub use map_graph::MapGraph;
pub use prediction::{PredictedMode, Prediction};
pub use rollout::Rollout;
pub use route::Route;
pub use scenario::{Scenario, ScenarioError};
pub use scene_state::SceneState;
pub use stop_line::{stop_line, ways_beyond, ways_cross, ways_join};
pub use tag::{ParseTagError, ScenarioTag};
