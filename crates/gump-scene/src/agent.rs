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

/// The kind of an agent.
///
/// Models predict only the kinds in [`AgentKind::MOVING`]; the others are drawn on rasters but
/// never tokenized. Formats that do not distinguish cones, barriers and signs use
/// [`AgentKind::Other`].
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

    /// The kinds that do not move: obstacles.
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

    /// True for the kinds that can move by themselves, even if the agent stands still.
    pub fn is_moving(self) -> bool {
        Self::MOVING.contains(&self)
    }

    /// Default length, width and height of an agent of this kind, metres; readers assign exactly
    /// these to an agent whose size its format does not state.
    ///
    /// Source: the medians of the 11,672 tracks in 201 scenes of the Waymo Open Motion Dataset; for
    /// things that do not move, a barrel.
    pub fn usual_size(self) -> [f64; 3] {
        match self {
            Self::Vehicle => [4.7, 2.1, 1.7],
            Self::Pedestrian => [0.9, 0.9, 1.7],
            Self::Bicycle => [1.8, 0.8, 1.7],
            _ => [0.6, 0.6, 1.0],
        }
    }
}

/// Pose and velocity of an agent.
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
    /// Its kind.
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

    /// True if the footprint is that of [`AgentKind::usual_size`], up to the precision of 32-bit
    /// formats. Code that must not mistake a default for a measurement treats such a size as not
    /// stated.
    pub fn has_usual_size(&self) -> bool {
        let [length, width, _] = self.kind.usual_size();
        (self.length - length).abs() < 1e-6 && (self.width - width).abs() < 1e-6
    }

    /// The same agent in another state.
    pub fn with_state(self, state: AgentState) -> Self {
        Self { state, ..self }
    }
}
