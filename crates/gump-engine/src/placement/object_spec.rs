//! Specification of one object of a scene.

use gump_scene::{Agent, AgentId, AgentKind, AgentState, LaneId, MapGraph};
use serde::Deserialize;

/// Specification of one object; fields that are `None` are left to the model.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ObjectSpec {
    /// Its name, by which others refer to it; "ego" is the ego.
    pub id: String,
    /// Its class; the ego is a vehicle.
    #[serde(default)]
    pub class: Class,
    /// Box centre ahead of the ego's pose, metres.
    pub x: Option<Bounds>,
    /// Box centre left of the ego's pose, metres.
    pub y: Option<Bounds>,
    /// Heading relative to the ego's, radians; bounds go counter-clockwise from the first to the
    /// second.
    pub heading: Option<Bounds>,
    /// Metres per second.
    pub speed: Option<Bounds>,
    /// Metres.
    pub length: Option<Bounds>,
    /// Metres.
    pub width: Option<Bounds>,
    /// The lane whose centre line it is on, with the lane's direction.
    pub lane: Option<i64>,
    /// The object it follows, and the gap between the boxes.
    pub behind: Option<Relation>,
    /// The object that follows it, and the gap between the boxes.
    pub ahead_of: Option<Relation>,
}

impl ObjectSpec {
    /// Its lane.
    pub fn lane(&self) -> Option<LaneId> {
        self.lane.map(LaneId)
    }
}

/// The class of an object.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Class {
    /// A car, a truck, a bus.
    #[default]
    Vehicle,
    /// A pedestrian.
    Pedestrian,
    /// A bicycle with its rider.
    Bicycle,
}

impl Class {
    /// The kind of agent.
    pub fn kind(self) -> AgentKind {
        match self {
            Self::Vehicle => AgentKind::Vehicle,
            Self::Pedestrian => AgentKind::Pedestrian,
            Self::Bicycle => AgentKind::Bicycle,
        }
    }
}

/// A range of numbers, both ends included; a single number is both ends.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(from = "NumberOrPair")]
pub struct Bounds {
    /// The minimum.
    pub low: f64,
    /// The maximum.
    pub high: f64,
}

impl Bounds {
    /// From the minimum to the maximum.
    pub fn new(low: f64, high: f64) -> Self {
        Self { low, high }
    }

    /// True within the bounds or up to `slack` beyond.
    pub(crate) fn admit(&self, value: f64, slack: f64) -> bool {
        self.low - slack <= value && value <= self.high + slack
    }

    /// As `admit`, for angles.
    pub fn admit_angle(&self, angle: f64, slack: f64) -> bool {
        let width = self.high - self.low;
        let turn = (angle - self.low).rem_euclid(std::f64::consts::TAU);
        turn <= width + slack || turn >= std::f64::consts::TAU - slack
    }
}

#[derive(Deserialize)]
#[serde(untagged)]
enum NumberOrPair {
    Number(f64),
    Pair([f64; 2]),
}

impl From<NumberOrPair> for Bounds {
    fn from(given: NumberOrPair) -> Self {
        match given {
            NumberOrPair::Number(value) => Self::new(value, value),
            NumberOrPair::Pair([low, high]) => Self::new(low, high),
        }
    }
}

/// A gap to another object in a row along that object's heading.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Relation {
    /// The other's id.
    pub object: String,
    /// From box to box.
    pub metres: f64,
}

/// An object in the world frame; heights are typical of the class, a car's and a person's.
pub fn agent_of(
    id: AgentId,
    kind: AgentKind,
    [length, width]: [f64; 2],
    state: AgentState,
    map: &MapGraph,
) -> Agent {
    let height = if kind == AgentKind::Vehicle {
        1.6
    } else {
        1.75
    };
    let ground = map.elevation_at(state.pose.position).unwrap_or(0.0);
    Agent {
        id,
        kind,
        length,
        width,
        height,
        elevation: ground + height / 2.0,
        state,
    }
}
