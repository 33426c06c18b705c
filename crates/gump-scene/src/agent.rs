//! Agents and their states.

use std::fmt;

use gump_geometry::{DVec2, OrientedBox, Pose};

/// Identity of an agent, unique within a scenario.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct AgentId(pub i64);

impl fmt::Display for AgentId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// What an agent is.
///
/// Only the kinds of [`AgentKind::MOVING`] are predicted; the others are drawn, never tokenized.
/// Formats that do not tell cones, barriers and signs apart say [`AgentKind::Other`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum AgentKind {
    /// Cars, trucks, buses, motorcycles.
    Vehicle,
    /// People on foot.
    Pedestrian,
    /// Bicycles with their riders.
    Bicycle,
    /// Traffic cones.
    TrafficCone,
    /// Barriers.
    Barrier,
    /// Signs of construction zones.
    Sign,
    /// Anything else that occupies space.
    Other,
}

impl AgentKind {
    /// The kinds a model predicts, in class order.
    pub const MOVING: [Self; 3] = [Self::Vehicle, Self::Pedestrian, Self::Bicycle];

    /// The kinds that only stand in the way.
    pub const STATIC: [Self; 4] = [Self::TrafficCone, Self::Barrier, Self::Sign, Self::Other];

    /// The lower-case English name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Vehicle => "vehicle",
            Self::Pedestrian => "pedestrian",
            Self::Bicycle => "bicycle",
            Self::TrafficCone => "traffic_cone",
            Self::Barrier => "barrier",
            Self::Sign => "sign",
            Self::Other => "other",
        }
    }

    /// True for the kinds that move by themselves, whether they stand still or not.
    pub fn is_moving(self) -> bool {
        Self::MOVING.contains(&self)
    }
}

/// Where an agent is and how it moves.
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub struct AgentState {
    /// Box centre and heading, world frame, metres and radians in [-π, π).
    pub pose: Pose,
    /// World-frame velocity, metres per second.
    pub velocity: DVec2,
}

impl AgentState {
    /// Magnitude of the velocity, metres per second.
    pub fn speed(&self) -> f64 {
        self.velocity.length()
    }

    /// True if every number is finite.
    pub fn is_finite(&self) -> bool {
        self.pose.is_finite() && self.velocity.is_finite()
    }
}

/// One agent at one instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Agent {
    /// Identity, stable over the scenario.
    pub id: AgentId,
    /// What it is.
    pub kind: AgentKind,
    /// Extent along the heading, metres, > 0.
    pub length: f64,
    /// Extent across the heading, metres, > 0.
    pub width: f64,
    /// Vertical extent, metres; 0 where a format has none.
    pub height: f64,
    /// z of the box centre, metres; 0 where a format has none.
    pub elevation: f64,
    /// Pose and velocity.
    pub state: AgentState,
}

impl Agent {
    /// The agent's footprint.
    pub fn oriented_box(&self) -> OrientedBox {
        OrientedBox {
            pose: self.state.pose,
            length: self.length,
            width: self.width,
        }
    }

    /// The same agent in another state.
    pub fn with_state(self, state: AgentState) -> Self {
        Self { state, ..self }
    }
}
