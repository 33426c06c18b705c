//! Conversion of a network to a map in the world frame.

use gump_geometry::{DVec2, DVec3, Polygon, Polyline, Pose};
use gump_scene::{
    Area, AreaKind, Lane, LaneId, MapError, MapGraph, MapParts, RoadEdge, RoadLine, StopSign,
};

use crate::network::{LaneIdx, Network, NetworkLane};

/// Position of a scene in the world: a pose and a plane with a gentle slope.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Placement {
    /// Scene frame to world frame.
    pub(crate) world_from_scene: Pose,
    /// Elevation of the scene's origin, metres.
    pub(crate) height: f64,
    /// Rise per metre along the scene's axes.
    pub(crate) slope: DVec2,
}

impl Placement {
    /// Elevation of the ground at a point of the scene frame, metres.
    pub(crate) fn elevation(&self, point: DVec2) -> f64 {
        self.height + self.slope.dot(point)
    }

    fn line(&self, points: &[DVec2]) -> (Polyline, Vec<f64>) {
        let placed = points.iter().map(|p| self.world_from_scene * *p).collect();
        let line = Polyline::new(placed).expect("network lines have points");
        (line, points.iter().map(|p| self.elevation(*p)).collect())
    }

    fn polygon(&self, ring: &[DVec2]) -> (Polygon, Vec<f64>) {
        let mut ring = ring.to_vec();
        ring.dedup_by(|a, b| a.distance(*b) < 1e-6);
        if ring.len() > 3 && ring[0].distance(ring[ring.len() - 1]) < 1e-6 {
            ring.pop();
        }
        let placed = ring.iter().map(|p| self.world_from_scene * *p).collect();
        let polygon = Polygon::new(placed).expect("network areas have at least three corners");
        (polygon, ring.iter().map(|p| self.elevation(*p)).collect())
    }
}

/// The id a lane has on the map.
pub(crate) fn lane_id(lane: LaneIdx) -> LaneId {
    LaneId(lane as i64 + 1)
}

/// Builds the map.
///
/// # Errors
/// None for a network of finite coordinates; the map's own checks are passed on.
pub(crate) fn build_map(network: &Network, placement: &Placement) -> Result<MapGraph, MapError> {
    let mut next_id = network.lanes.len() as i64 + 1;
    let mut id = || {
        next_id += 1;
        next_id
    };
    let mut parts = MapParts::default();
    let lanes = network.lanes.iter().enumerate();
    for (i, lane) in lanes.filter(|(i, _)| !network.unmapped.contains(i)) {
        parts.lanes.push(map_lane(network, i, lane, placement));
    }
    for (kind, points) in &network.furniture.lines {
        let (line, elevation) = placement.line(points);
        parts.road_lines.push(RoadLine {
            id: id(),
            kind: *kind,
            line,
            elevation,
        });
    }
    for (kind, points) in &network.furniture.edges {
        let (line, elevation) = placement.line(points);
        parts.road_edges.push(RoadEdge {
            id: id(),
            kind: *kind,
            line,
            elevation,
        });
    }
    let crosswalks = network
        .crosswalks
        .iter()
        .map(|c| (AreaKind::Crosswalk, &c.ring));
    let areas = network
        .furniture
        .areas
        .iter()
        .map(|(kind, ring)| (*kind, ring));
    for (kind, ring) in crosswalks.chain(areas) {
        let (polygon, elevation) = placement.polygon(ring);
        parts.areas.push(Area {
            elevation,
            ..Area::new(id(), kind, polygon)
        });
    }
    for (position, lanes) in &network.furniture.stop_signs {
        let world = placement.world_from_scene * *position;
        parts.stop_signs.push(StopSign {
            id: id(),
            position: DVec3::new(world.x, world.y, placement.elevation(*position) + 2.0),
            lanes: lanes.iter().map(|&lane| lane_id(lane)).collect(),
        });
    }
    for ring in &network.furniture.drivable {
        parts.drivable.push(placement.polygon(ring).0);
    }
    MapGraph::new(parts)
}

fn map_lane(network: &Network, i: LaneIdx, lane: &NetworkLane, placement: &Placement) -> Lane {
    let drawn = lane.drawn.as_deref().unwrap_or(lane.track.points());
    let (centerline, elevation) = placement.line(drawn);
    let ids = |lanes: &[LaneIdx]| lanes.iter().map(|&lane| lane_id(lane)).collect();
    let beside = |step: fn(&NetworkLane) -> Option<LaneIdx>| {
        let neighbors = std::iter::successors(step(lane), |&n| step(&network.lanes[n]));
        neighbors.map(lane_id).collect()
    };
    Lane {
        kind: lane.kind,
        width: lane.width,
        speed_limit: (!network.hides_limits).then_some(lane.speed_limit),
        in_intersection: lane.connector.as_ref().is_some_and(|connector| {
            network.junctions[connector.junction].control != crate::plan::Control::Free
        }),
        predecessors: ids(&lane.predecessors),
        successors: ids(&lane.successors),
        left_neighbors: beside(|lane| lane.left),
        right_neighbors: beside(|lane| lane.right),
        ..Lane::new(lane_id(i), centerline, elevation)
    }
}
