//! Conversion of a [`MapGraph`] to Waymo map features: the inverse of `map`.

use gump_geometry::DVec2;
use gump_scene::{
    Area, AreaKind, Lane, LaneId, LaneKind, MapGraph, RoadEdgeKind, RoadLineKind, StopSign,
};

use super::map::METERS_PER_SECOND_IN_MPH;
use crate::ReadReport;
use gump_proto::{self as proto, FeatureData, LaneType, MapPoint, RoadEdgeType, RoadLineType};

/// All features of the map, each kind in its order; areas Waymo does not know are dropped.
pub(super) fn features_from_map(map: &MapGraph, report: &mut ReadReport) -> Vec<proto::MapFeature> {
    report.drop("drivable surface", map.drivable().len());
    report.drop("lane width", map.lanes().len());
    let lanes = map.lanes().iter().map(|lane| (lane.id.0, lane_data(lane)));
    let lines = map.road_lines().iter().map(|line| {
        let polyline = points(line.line.points(), &line.elevation);
        let r#type = Some(line_type(line.kind).into());
        (
            line.id,
            FeatureData::RoadLine(proto::RoadLine { r#type, polyline }),
        )
    });
    let edges = map.road_edges().iter().map(|edge| {
        let polyline = points(edge.line.points(), &edge.elevation);
        let r#type = Some(edge_type(edge.kind).into());
        (
            edge.id,
            FeatureData::RoadEdge(proto::RoadEdge { r#type, polyline }),
        )
    });
    let signs = map
        .stop_signs()
        .iter()
        .map(|sign| (sign.id, sign_data(sign)));
    let areas = map.areas().iter().filter_map(|area| {
        let data = area_data(area);
        report.drop(
            "area of a kind Waymo does not have",
            usize::from(data.is_none()),
        );
        Some((area.id, data?))
    });
    let all = lanes.chain(lines).chain(edges).chain(signs).chain(areas);
    all.map(|(id, data)| proto::MapFeature {
        id: Some(id),
        feature_data: Some(data),
    })
    .collect()
}

fn lane_data(lane: &Lane) -> FeatureData {
    let ids = |ids: &[LaneId]| ids.iter().map(|id| id.0).collect();
    FeatureData::Lane(proto::LaneCenter {
        speed_limit_mph: lane.speed_limit.map(miles_per_hour),
        r#type: Some(lane_type(lane.kind).into()),
        interpolating: Some(lane.in_intersection),
        polyline: points(lane.centerline.points(), &lane.elevation),
        entry_lanes: ids(&lane.predecessors),
        exit_lanes: ids(&lane.successors),
        left_neighbors: neighbors(lane, &lane.left_neighbors),
        right_neighbors: neighbors(lane, &lane.right_neighbors),
        left_boundaries: Vec::new(),
        right_boundaries: Vec::new(),
    })
}

/// Neighbours along the whole lane: a lane here does not know for which stretch.
fn neighbors(lane: &Lane, ids: &[LaneId]) -> Vec<proto::LaneNeighbor> {
    let last = i32::try_from(lane.centerline.points().len() - 1).unwrap_or(i32::MAX);
    let neighbor = |id: &LaneId| proto::LaneNeighbor {
        feature_id: Some(id.0),
        self_start_index: Some(0),
        self_end_index: Some(last),
        ..proto::LaneNeighbor::default()
    };
    ids.iter().map(neighbor).collect()
}

/// The speed limit in miles per hour, chosen so that reading it gives the same bits wherever
/// such a number exists.
fn miles_per_hour(limit: f64) -> f64 {
    let mph = limit / METERS_PER_SECOND_IN_MPH;
    let candidates = [mph.round(), mph, mph.next_up(), mph.next_down()];
    let exact = |mph: &f64| *mph * METERS_PER_SECOND_IN_MPH == limit;
    candidates.into_iter().find(exact).unwrap_or(mph)
}

fn sign_data(sign: &StopSign) -> FeatureData {
    FeatureData::StopSign(proto::StopSign {
        lane: sign.lanes.iter().map(|id| id.0).collect(),
        position: Some(point(sign.position.truncate(), sign.position.z)),
    })
}

fn area_data(area: &Area) -> Option<FeatureData> {
    let outline = proto::Outline {
        polygon: points(area.polygon.ring(), &area.elevation),
    };
    match area.kind {
        AreaKind::Crosswalk => Some(FeatureData::Crosswalk(outline)),
        AreaKind::SpeedBump => Some(FeatureData::SpeedBump(outline)),
        AreaKind::Driveway => Some(FeatureData::Driveway(outline)),
        AreaKind::StopLine
        | AreaKind::TurnStop
        | AreaKind::Intersection
        | AreaKind::Walkway
        | AreaKind::Carpark => None,
    }
}

fn points(plane: &[DVec2], elevation: &[f64]) -> Vec<MapPoint> {
    let zipped = plane.iter().zip(elevation);
    zipped.map(|(&p, &z)| point(p, z)).collect()
}

pub(super) fn point(p: DVec2, z: f64) -> MapPoint {
    MapPoint {
        x: Some(p.x),
        y: Some(p.y),
        z: Some(z),
    }
}

fn lane_type(kind: LaneKind) -> LaneType {
    match kind {
        LaneKind::Undefined => LaneType::Undefined,
        LaneKind::Freeway => LaneType::Freeway,
        LaneKind::SurfaceStreet => LaneType::SurfaceStreet,
        LaneKind::BikeLane => LaneType::BikeLane,
    }
}

fn line_type(kind: RoadLineKind) -> RoadLineType {
    match kind {
        RoadLineKind::Unknown => RoadLineType::Unknown,
        RoadLineKind::BrokenSingleWhite => RoadLineType::BrokenSingleWhite,
        RoadLineKind::SolidSingleWhite => RoadLineType::SolidSingleWhite,
        RoadLineKind::SolidDoubleWhite => RoadLineType::SolidDoubleWhite,
        RoadLineKind::BrokenSingleYellow => RoadLineType::BrokenSingleYellow,
        RoadLineKind::BrokenDoubleYellow => RoadLineType::BrokenDoubleYellow,
        RoadLineKind::SolidSingleYellow => RoadLineType::SolidSingleYellow,
        RoadLineKind::SolidDoubleYellow => RoadLineType::SolidDoubleYellow,
        RoadLineKind::PassingDoubleYellow => RoadLineType::PassingDoubleYellow,
    }
}

fn edge_type(kind: RoadEdgeKind) -> RoadEdgeType {
    match kind {
        RoadEdgeKind::Unknown => RoadEdgeType::Unknown,
        RoadEdgeKind::Boundary => RoadEdgeType::Boundary,
        RoadEdgeKind::Median => RoadEdgeType::Median,
    }
}
