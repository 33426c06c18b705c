//! Map features: lanes, roadblocks, lines, edges, areas.
//!
//! The queries are in `map_graph`; start with [`Lane`] and [`MapParts`].

use std::borrow::Cow;
use std::fmt;

use gump_geometry::{DVec3, Polygon, Polyline, Pose, angle_difference};

/// Identity of a lane, unique within a map.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct LaneId(pub i64);

impl fmt::Display for LaneId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// Identity of a roadblock, unique within a map.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct RoadblockId(pub i64);

impl fmt::Display for RoadblockId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// The type of a lane.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LaneKind {
    /// Grade-separated road.
    Freeway,
    /// Ordinary street, including turning paths through intersections.
    SurfaceStreet,
    /// Bicycle lane.
    BikeLane,
    /// Not stated.
    Undefined,
}

impl LaneKind {
    /// The speed limit that rule-driven vehicles assume on a lane without a stated limit, metres
    /// per second; `None` if the type is not stated either. Networks are never given this value.
    ///
    /// Source: 65 mph on American freeways and 30 mph in their cities; 20 km/h is the pace of an
    /// unhurried cyclist.
    pub fn usual_speed_limit(self) -> Option<f64> {
        match self {
            Self::Freeway => Some(29.1),
            Self::SurfaceStreet => Some(TYPICAL_SPEED_LIMIT),
            Self::BikeLane => Some(5.6),
            Self::Undefined => None,
        }
    }
}

/// The default that is used where a number is needed for an unknown speed limit, metres per second:
/// 30 mph, the usual limit in American cities.
pub const TYPICAL_SPEED_LIMIT: f64 = 13.4;

/// Information that the source of a scene cannot express, so that its absence from the scene
/// carries no meaning.
///
/// Speed limits are not listed here: each lane has its own `Option`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Unstated {
    /// There may be stop signs on this map.
    pub stop_signs: bool,
    /// There may be traffic lights.
    pub lights: bool,
}

/// A lane: a centre line with a direction of travel, and its neighbours in the graph.
#[derive(Clone, Debug, PartialEq)]
pub struct Lane {
    /// Identity.
    pub id: LaneId,
    /// Its type.
    pub kind: LaneKind,
    /// Centre line in the direction of travel, world frame, metres; exactly the points the format
    /// states, repeated ones included.
    pub centerline: Polyline,
    /// z of each centre-line point, metres.
    pub elevation: Vec<f64>,
    /// Full width, metres; estimated by the reader where the format states none.
    pub width: f64,
    /// Speed limit, metres per second, if stated.
    pub speed_limit: Option<f64>,
    /// True if the lane lies inside an intersection or links two lanes there: nuPlan's lane
    /// connectors.
    pub in_intersection: bool,
    /// The surface of the lane, if the format states one; see [`Lane::surface`].
    pub outline: Option<Polygon>,
    /// The roadblock it belongs to, in formats that have them.
    pub roadblock: Option<RoadblockId>,
    /// Whether traffic lights control the lane; `None` where the format does not state it.
    pub has_lights: Option<bool>,
    /// Lanes that lead into this one.
    pub predecessors: Vec<LaneId>,
    /// Lanes this one leads to.
    pub successors: Vec<LaneId>,
    /// Lanes of the same direction next to it on the left, nearest first.
    pub left_neighbors: Vec<LaneId>,
    /// Lanes of the same direction next to it on the right, nearest first.
    pub right_neighbors: Vec<LaneId>,
}

impl Lane {
    /// A lane with these points and no neighbours: 3.5 m wide, a common width, of no stated type.
    /// Readers then set the fields that their format states.
    pub fn new(id: LaneId, centerline: Polyline, elevation: Vec<f64>) -> Self {
        Self {
            id,
            kind: LaneKind::Undefined,
            centerline,
            elevation,
            width: 3.5,
            speed_limit: None,
            in_intersection: false,
            outline: None,
            roadblock: None,
            has_lights: None,
            predecessors: Vec::new(),
            successors: Vec::new(),
            left_neighbors: Vec::new(),
            right_neighbors: Vec::new(),
        }
    }

    /// Where on the lane a pose is: the nearest point of its centre line, and the angle to it.
    pub fn foot(&self, pose: Pose) -> LaneFoot {
        let foot = self.centerline.project(pose.position);
        let way = self.centerline.pose_at(foot.arc_length).heading;
        LaneFoot {
            along_m: foot.arc_length,
            lateral_m: foot.lateral,
            turned: angle_difference(way, pose.heading).abs(),
        }
    }

    /// The stated outline, else the centre line widened to the lane's width, with flat ends;
    /// `None` for a lane without either.
    pub fn surface(&self) -> Option<Cow<'_, Polygon>> {
        match &self.outline {
            Some(outline) => Some(Cow::Borrowed(outline)),
            None => self.centerline.ribbon(self.width).map(Cow::Owned),
        }
    }
}

/// Where on a lane a pose is, from [`Lane::foot`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LaneFoot {
    /// Metres along the centre line, from 0 to its length.
    pub along_m: f64,
    /// Metres from the centre line, positive to its left.
    pub lateral_m: f64,
    /// Radians from the lane's direction, to either side.
    pub turned: f64,
}

/// Lanes side by side in one direction between two intersections, or the links of two such groups
/// through an intersection.
#[derive(Clone, Debug, PartialEq)]
pub struct Roadblock {
    /// Identity.
    pub id: RoadblockId,
    /// World frame, metres.
    pub outline: Polygon,
    /// True for nuPlan's roadblock connectors, which lie inside an intersection.
    pub in_intersection: bool,
    /// Roadblocks that lead into this one.
    pub predecessors: Vec<RoadblockId>,
    /// Roadblocks this one leads to.
    pub successors: Vec<RoadblockId>,
}

/// Paint on the road.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs, reason = "the names are the markings themselves")]
pub enum RoadLineKind {
    Unknown,
    BrokenSingleWhite,
    SolidSingleWhite,
    SolidDoubleWhite,
    BrokenSingleYellow,
    BrokenDoubleYellow,
    SolidSingleYellow,
    SolidDoubleYellow,
    PassingDoubleYellow,
}

/// A painted line.
#[derive(Clone, Debug, PartialEq)]
pub struct RoadLine {
    /// Identity among all map features of its source.
    pub id: i64,
    /// The marking.
    pub kind: RoadLineKind,
    /// World frame, metres.
    pub line: Polyline,
    /// z of each point, metres.
    pub elevation: Vec<f64>,
}

/// The type of a road edge.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs, reason = "the names are the borders themselves")]
pub enum RoadEdgeKind {
    Unknown,
    Boundary,
    Median,
}

/// A border of the drivable surface; the road is on its left.
#[derive(Clone, Debug, PartialEq)]
pub struct RoadEdge {
    /// Identity among all map features of its source.
    pub id: i64,
    /// The border.
    pub kind: RoadEdgeKind,
    /// World frame, metres.
    pub line: Polyline,
    /// z of each point, metres.
    pub elevation: Vec<f64>,
}

/// The type of an area.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AreaKind {
    /// Pedestrians cross here.
    Crosswalk,
    /// A bump across the road.
    SpeedBump,
    /// Access to a property.
    Driveway,
    /// A place at which vehicles wait.
    StopLine,
    /// A place at which vehicles wait before they turn across oncoming traffic.
    TurnStop,
    /// The area of an intersection.
    Intersection,
    /// For people on foot.
    Walkway,
    /// A place to park vehicles.
    Carpark,
}

/// A polygon with a meaning.
#[derive(Clone, Debug, PartialEq)]
pub struct Area {
    /// Identity among all map features of its source.
    pub id: i64,
    /// Its type.
    pub kind: AreaKind,
    /// World frame, metres.
    pub polygon: Polygon,
    /// z of each corner, metres.
    pub elevation: Vec<f64>,
    /// The lanes it applies to (of a stop line: those that wait at it); empty if not stated.
    pub lanes: Vec<LaneId>,
}

impl Area {
    /// An area at height 0 that applies to no lane.
    pub fn new(id: i64, kind: AreaKind, polygon: Polygon) -> Self {
        Self {
            id,
            kind,
            elevation: vec![0.0; polygon.ring().len()],
            polygon,
            lanes: Vec::new(),
        }
    }
}

/// A stop sign and the lanes it applies to.
#[derive(Clone, Debug, PartialEq)]
pub struct StopSign {
    /// Identity among all map features of its source.
    pub id: i64,
    /// World frame, metres, z up.
    pub position: DVec3,
    /// The lanes that must stop.
    pub lanes: Vec<LaneId>,
}

/// The parts that a map is built from; see [`MapGraph::new`](crate::MapGraph::new).
#[derive(Clone, Debug, Default)]
#[allow(missing_docs, reason = "each list is one of the type it names")]
pub struct MapParts {
    pub lanes: Vec<Lane>,
    pub roadblocks: Vec<Roadblock>,
    pub road_lines: Vec<RoadLine>,
    pub road_edges: Vec<RoadEdge>,
    pub areas: Vec<Area>,
    pub stop_signs: Vec<StopSign>,
    /// Surfaces a vehicle may be on; derived by the reader where the format has none.
    pub drivable: Vec<Polygon>,
    /// Information that the source cannot express.
    pub unstated: Unstated,
}

/// Why parts do not form a valid map.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum MapError {
    /// Two lanes have the same id.
    #[error("lane id {0} occurs twice")]
    DuplicateLane(LaneId),
    /// Two roadblocks have the same id.
    #[error("roadblock id {0} occurs twice")]
    DuplicateRoadblock(RoadblockId),
    /// A list of elevations does not match its line.
    #[error("map feature {id} has {points} points but {elevations} elevations")]
    ElevationCount {
        /// The feature.
        id: i64,
        /// Points of its line.
        points: usize,
        /// Elevations given.
        elevations: usize,
    },
    /// A coordinate is NaN or infinite.
    #[error("map feature {id} has a coordinate that is not a number at point {point}")]
    NotFinite {
        /// The feature.
        id: i64,
        /// Index of the point.
        point: usize,
    },
}
