//! How the ego met another: of which kind a contact is, and whose fault.
//!
//! The kinds are nuPlan's. When two count as having met is the business of whoever asks:
//! `gump-nuplan` scores planners with them, [`crate::reactions`] the traffic around one.

use gump_geometry::{OrientedBox, Pose};
use gump_scene::{Agent, AgentKind};

use crate::bearing::is_behind;

/// Below this speed one stands, metres per second.
///
/// Source: nuplan-devkit.
const STANDING: f64 = 0.05;

/// How the ego met something; the first that holds, in this order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum CollisionKind {
    /// The ego stood.
    StoppedEgo,
    /// The other stood, or never moves.
    StoppedTrack,
    /// The other came from behind.
    ActiveRear,
    /// The ego's front bumper hit it.
    ActiveFront,
    /// From the side.
    ActiveLateral,
}

impl CollisionKind {
    /// Whether the ego is to blame; from the side only where it was not within one lane.
    pub fn is_at_fault(self, in_one_lane: bool) -> bool {
        match self {
            Self::StoppedTrack | Self::ActiveFront => true,
            Self::ActiveLateral => !in_one_lane,
            Self::StoppedEgo | Self::ActiveRear => false,
        }
    }
}

/// How the ego, with this box, rear axle and speed, met an agent that it touches.
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

/// Speed of an agent, metres per second; things that do not move by themselves have none.
pub fn speed(agent: &Agent) -> f64 {
    if AgentKind::MOVING.contains(&agent.kind) {
        agent.state.speed()
    } else {
        0.0
    }
}
