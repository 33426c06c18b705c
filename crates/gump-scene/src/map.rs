//! The road: lanes as a directed graph, lines, edges and areas; valid once built.

use std::collections::BTreeMap;
use std::fmt;

use gump_geometry::{DVec2, DVec3, PointIndex, Polygon, Polyline, SegmentIndex};

/// Identity of a lane, unique within a map.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct LaneId(pub i64);

impl fmt::Display for LaneId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// What a lane is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LaneKind {
    /// Grade-separated road.
    Freeway,
    /// Ordinary street, turning paths through intersections included.
    SurfaceStreet,
    /// Bicycle lane.
    BikeLane,
    /// Not stated.
    Undefined,
}

/// A lane: a centre line with a direction of travel, and its neighbours in the graph.
#[derive(Clone, Debug, PartialEq)]
pub struct Lane {
    /// Identity.
    pub id: LaneId,
    /// What it is for.
    pub kind: LaneKind,
    /// Centre line in the direction of travel, world frame, metres.
    pub centerline: Polyline,
    /// z of each centre-line point, metres.
    pub elevation: Vec<f64>,
    /// Full width, metres; where the format has none, the reader's estimate.
    pub width: f64,
    /// Speed limit, metres per second, if stated.
    pub speed_limit: Option<f64>,
    /// True if the lane lies inside an intersection.
    pub in_intersection: bool,
    /// Lanes that lead into this one.
    pub predecessors: Vec<LaneId>,
    /// Lanes this one leads to.
    pub successors: Vec<LaneId>,
    /// Lanes of the same direction next to it on the left, nearest first.
    pub left_neighbors: Vec<LaneId>,
    /// Lanes of the same direction next to it on the right, nearest first.
    pub right_neighbors: Vec<LaneId>,
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

/// What kind of border a road edge is.
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

/// What an area is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AreaKind {
    /// Pedestrians cross here.
    Crosswalk,
    /// A bump across the road.
    SpeedBump,
    /// Access to a property.
    Driveway,
    /// Where vehicles wait.
    StopLine,
    /// The area of an intersection.
    Intersection,
}

/// A polygon with a meaning.
#[derive(Clone, Debug, PartialEq)]
pub struct Area {
    /// Identity among all map features of its source.
    pub id: i64,
    /// What it is.
    pub kind: AreaKind,
    /// World frame, metres.
    pub polygon: Polygon,
    /// z of each corner, metres.
    pub elevation: Vec<f64>,
}

/// A stop sign and the lanes it rules.
#[derive(Clone, Debug, PartialEq)]
pub struct StopSign {
    /// Identity among all map features of its source.
    pub id: i64,
    /// World frame, metres, z up.
    pub position: DVec3,
    /// The lanes that must stop.
    pub lanes: Vec<LaneId>,
}

/// What a map is built from; see [`MapGraph::new`].
#[derive(Clone, Debug, Default)]
#[allow(missing_docs, reason = "each field is a list of the type it names")]
pub struct MapParts {
    pub lanes: Vec<Lane>,
    pub road_lines: Vec<RoadLine>,
    pub road_edges: Vec<RoadEdge>,
    pub areas: Vec<Area>,
    pub stop_signs: Vec<StopSign>,
    /// Surfaces a vehicle may be on; derived by the reader where the format has none.
    pub drivable: Vec<Polygon>,
}

/// Why parts do not make a map.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum MapError {
    /// Two lanes claim one id.
    #[error("lane id {0} occurs twice")]
    DuplicateLane(LaneId),
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

/// An immutable, indexed map; share it by `Arc`.
#[derive(Clone, Debug, Default)]
pub struct MapGraph {
    parts: MapParts,
    by_id: BTreeMap<LaneId, usize>,
    lane_segments: SegmentIndex<(usize, usize)>,
    edge_segments: SegmentIndex<(usize, usize)>,
    elevation_points: PointIndex,
    elevations: Vec<f64>,
}

impl MapGraph {
    /// Checks and indexes the parts. Links to lanes that are not in the map (cut off at its
    /// border) are dropped from the graph.
    ///
    /// # Errors
    /// [`MapError`] for duplicate lanes, mismatched elevations and coordinates that are not finite.
    pub fn new(mut parts: MapParts) -> Result<Self, MapError> {
        let mut by_id = BTreeMap::new();
        for (i, lane) in parts.lanes.iter().enumerate() {
            if by_id.insert(lane.id, i).is_some() {
                return Err(MapError::DuplicateLane(lane.id));
            }
            check_feature(lane.id.0, lane.centerline.points(), &lane.elevation)?;
        }
        for line in &parts.road_lines {
            check_feature(line.id, line.line.points(), &line.elevation)?;
        }
        for edge in &parts.road_edges {
            check_feature(edge.id, edge.line.points(), &edge.elevation)?;
        }
        for area in &parts.areas {
            check_feature(area.id, area.polygon.ring(), &area.elevation)?;
        }
        for lane in &mut parts.lanes {
            for links in [
                &mut lane.predecessors,
                &mut lane.successors,
                &mut lane.left_neighbors,
                &mut lane.right_neighbors,
            ] {
                links.retain(|id| by_id.contains_key(id));
            }
        }
        let lane_segments = parts.lanes.iter().enumerate().flat_map(|(lane, l)| {
            l.centerline
                .segments()
                .enumerate()
                .map(move |(segment, (a, b))| (a, b, (lane, segment)))
        });
        let lane_segments = SegmentIndex::new(lane_segments.collect::<Vec<_>>());
        let edge_segments = parts.road_edges.iter().enumerate().flat_map(|(edge, e)| {
            e.line
                .segments()
                .enumerate()
                .map(move |(segment, (a, b))| (a, b, (edge, segment)))
        });
        let edge_segments = SegmentIndex::new(edge_segments.collect::<Vec<_>>());
        let heights = || {
            let lanes = parts
                .lanes
                .iter()
                .map(|l| (l.centerline.points(), &l.elevation));
            let lines = parts
                .road_lines
                .iter()
                .map(|l| (l.line.points(), &l.elevation));
            let edges = parts
                .road_edges
                .iter()
                .map(|l| (l.line.points(), &l.elevation));
            lanes
                .chain(lines)
                .chain(edges)
                .flat_map(|(points, z)| points.iter().copied().zip(z.iter().copied()))
        };
        let elevation_points = PointIndex::new(heights().map(|(p, _)| p));
        let elevations = heights().map(|(_, z)| z).collect();
        Ok(Self {
            by_id,
            lane_segments,
            edge_segments,
            elevation_points,
            elevations,
            parts,
        })
    }

    /// All lanes, in the order given.
    pub fn lanes(&self) -> &[Lane] {
        &self.parts.lanes
    }

    /// The lane with this id.
    pub fn lane(&self, id: LaneId) -> Option<&Lane> {
        self.by_id.get(&id).map(|&i| &self.parts.lanes[i])
    }

    /// The lanes that follow `id`; none if the lane is unknown.
    pub fn successors(&self, id: LaneId) -> impl Iterator<Item = &Lane> {
        self.lane(id)
            .into_iter()
            .flat_map(|lane| &lane.successors)
            .filter_map(|&next| self.lane(next))
    }

    /// Lanes whose centre line passes within `radius` metres, nearest first, each once, with the
    /// distance.
    pub fn lanes_near(&self, point: DVec2, radius: f64) -> impl Iterator<Item = (&Lane, f64)> + '_ {
        let mut seen = Vec::new();
        self.lane_segments
            .within(point, radius)
            .filter_map(move |((lane, _), distance)| {
                if seen.contains(&lane) {
                    return None;
                }
                seen.push(lane);
                Some((&self.parts.lanes[lane], distance))
            })
    }

    /// Painted lines.
    pub fn road_lines(&self) -> &[RoadLine] {
        &self.parts.road_lines
    }

    /// Borders of the drivable surface.
    pub fn road_edges(&self) -> &[RoadEdge] {
        &self.parts.road_edges
    }

    /// Segments of road edges as (index into [`MapGraph::road_edges`], index of the segment,
    /// distance in metres), nearest first, lazily.
    pub fn nearest_road_edges(
        &self,
        point: DVec2,
    ) -> impl Iterator<Item = (usize, usize, f64)> + '_ {
        self.edge_segments
            .nearest(point)
            .map(|((edge, segment), distance)| (edge, segment, distance))
    }

    /// Crosswalks, bumps, driveways, stop lines, intersections.
    pub fn areas(&self) -> &[Area] {
        &self.parts.areas
    }

    /// Stop signs.
    pub fn stop_signs(&self) -> &[StopSign] {
        &self.parts.stop_signs
    }

    /// Surfaces a vehicle may be on.
    pub fn drivable(&self) -> &[Polygon] {
        &self.parts.drivable
    }

    /// True if `point` lies on a drivable surface. A map without any has no off-road: true.
    pub fn is_drivable(&self, point: DVec2) -> bool {
        self.parts.drivable.is_empty() || self.parts.drivable.iter().any(|p| p.contains(point))
    }

    /// Mean z of the four map points nearest to `point`, metres; `None` for a map without points.
    ///
    /// Source: the elevation rule of the GUMP paper's Waymo evaluation.
    pub fn elevation_at(&self, point: DVec2) -> Option<f64> {
        let (sum, n) = self
            .elevation_points
            .nearest(point, 4)
            .fold((0.0, 0), |(sum, n), (i, _)| {
                (sum + self.elevations[i], n + 1)
            });
        (n > 0).then(|| sum / f64::from(n))
    }
}

fn check_feature(id: i64, points: &[DVec2], elevations: &[f64]) -> Result<(), MapError> {
    if points.len() != elevations.len() {
        return Err(MapError::ElevationCount {
            id,
            points: points.len(),
            elevations: elevations.len(),
        });
    }
    let finite = |(p, z): (&DVec2, &f64)| p.is_finite() && z.is_finite();
    match points.iter().zip(elevations).position(|pair| !finite(pair)) {
        Some(point) => Err(MapError::NotFinite { id, point }),
        None => Ok(()),
    }
}
