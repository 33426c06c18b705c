//! Kinds of contact between the ego and others, and fault.
//!
//! The kinds are nuPlan's. The caller decides which contacts count: `gump-nuplan` scores planners
//! with them, [`crate::reactions`] the traffic around an ego.

use gump_geometry::{OrientedBox, Pose};
use gump_scene::{Agent, AgentKind};

use crate::bearing::is_behind;

/// Below this speed an agent stands, metres per second.
///
/// Source: nuplan-devkit.
const STANDING: f64 = 0.05;

/// The kind of a contact; the first that applies, in this order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum CollisionKind {
    /// The ego stands.
    StoppedEgo,
    /// The other stands, or is of a kind that never moves.
    StoppedTrack,
    /// The other came from behind.
    ActiveRear,
    /// The ego's front bumper hit it.
    ActiveFront,
    /// From the side.
    ActiveLateral,
}

impl CollisionKind {
    /// Whether the ego is at fault; for side contacts only if it was not within one lane.
    pub fn is_at_fault(self, in_one_lane: bool) -> bool {
        match self {
            Self::StoppedTrack | Self::ActiveFront => true,
            Self::ActiveLateral => !in_one_lane,
            Self::StoppedEgo | Self::ActiveRear => false,
        }
    }
}

/// The kind of contact of the ego, with this box, rear axle and speed, and an agent that it
/// touches.
///
/// Source: nuPlan's `no_ego_at_fault_collisions`.
pub fn classify(
    footprint: &OrientedBox,
    rear_axle: Pose,
    ego_speed: f64,
    agent: &Agent,
) -> CollisionKind {
    let [front_left, .., front_right] = footprint.corners();
    if ego_speed <= STANDING {
        CollisionKind::StoppedEgo
    } else if speed(agent) <= STANDING {
        CollisionKind::StoppedTrack
    } else if is_behind(rear_axle, agent.state.pose.position) {
        CollisionKind::ActiveRear
    } else if agent
        .oriented_box()
        .intersects_segment(front_left, front_right)
    {
        CollisionKind::ActiveFront
    } else {
        CollisionKind::ActiveLateral
    }
}

/// Speed of an agent, metres per second; 0 for kinds that never move.
pub fn speed(agent: &Agent) -> f64 {
    if AgentKind::MOVING.contains(&agent.kind) {
        agent.state.speed()
    } else {
        0.0
    }
}
