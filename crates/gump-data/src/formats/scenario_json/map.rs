//! Map features: lanes, lines, edges, areas, by type.

use std::collections::BTreeMap;

use gump_geometry::DVec3;
use gump_scene::{
    AreaKind, Lane, LaneId, LaneKind, MapParts, RoadEdgeKind, RoadLineKind, StopSign,
};
use serde::Deserialize;

use super::names::{Names, place};
use crate::ReadReport;
use crate::complete::features;
use crate::io::json::Real;

/// Metres per second in one kilometre per hour.
const METERS_PER_SECOND_IN_KMH: f64 = 1.0 / 3.6;

#[derive(Deserialize)]
pub(super) struct Feature {
    #[serde(rename = "type")]
    kind: String,
    #[serde(default)]
    polyline: Vec<Vec<Real>>,
    #[serde(default)]
    polygon: Vec<Vec<Real>>,
    #[serde(default)]
    position: Vec<Real>,
    #[serde(default)]
    width: Option<f64>,
    #[serde(default)]
    speed_limit_kmh: Option<f64>,
    #[serde(default)]
    interpolating: bool,
    #[serde(default)]
    entry_lanes: Vec<serde_json::Value>,
    #[serde(default)]
    exit_lanes: Vec<serde_json::Value>,
    #[serde(default)]
    left_neighbor: Vec<serde_json::Value>,
    #[serde(default)]
    right_neighbor: Vec<serde_json::Value>,
    #[serde(default)]
    lane: Vec<serde_json::Value>,
}

pub(super) fn parts(
    map_features: &BTreeMap<String, Feature>,
    names: &mut Names,
    report: &mut ReadReport,
) -> MapParts {
    let mut parts = MapParts::default();
    for (name, feature) in map_features {
        let id = names.id(name);
        let kind = feature.kind.as_str();
        let places =
            |numbers: &[Vec<Real>]| numbers.iter().map(|p| place(p)).collect::<Vec<DVec3>>();
        let (line, ring) = (places(&feature.polyline), places(&feature.polygon));
        match kind {
            _ if kind.starts_with("LANE_") => {
                add_lane(feature, id, &line, &mut parts, names, report);
            }
            _ if kind.starts_with("ROAD_LINE") => {
                features::add_road_line(&mut parts, id, line_kind(kind), &line, report);
            }
            "ROAD_EDGE_MEDIAN" => {
                features::add_road_edge(&mut parts, id, RoadEdgeKind::Median, &line, report);
            }
            _ if kind.starts_with("ROAD_EDGE") => {
                features::add_road_edge(&mut parts, id, RoadEdgeKind::Boundary, &line, report);
            }
            "CROSSWALK" => features::add_area(&mut parts, id, AreaKind::Crosswalk, &ring, report),
            "SPEED_BUMP" => features::add_area(&mut parts, id, AreaKind::SpeedBump, &ring, report),
            "DRIVEWAY" => features::add_area(&mut parts, id, AreaKind::Driveway, &ring, report),
            "DRIVABLE_AREA" => parts.drivable.extend(features::polygon(id, &ring, report)),
            "STOP_SIGN" => {
                let position = place(&feature.position);
                let z = if position.z.is_finite() {
                    position.z
                } else {
                    0.0
                };
                if position.x.is_finite() && position.y.is_finite() {
                    let lanes = ids(&feature.lane, names);
                    let position = DVec3 { z, ..position };
                    parts.stop_signs.push(StopSign {
                        id,
                        position,
                        lanes,
                    });
                }
            }
            _ => report.drop("map feature of an unknown type", 1),
        }
    }
    parts
}

fn add_lane(
    feature: &Feature,
    id: i64,
    line: &[DVec3],
    parts: &mut MapParts,
    names: &mut Names,
    report: &mut ReadReport,
) {
    let Some(lane) = features::lane(id, lane_kind(&feature.kind), line, report) else {
        return;
    };
    let stated = |value: Option<f64>| value.filter(|v| *v > 0.0 && v.is_finite());
    let lane = Lane {
        width: stated(feature.width).unwrap_or(lane.width),
        speed_limit: stated(feature.speed_limit_kmh).map(|v| v * METERS_PER_SECOND_IN_KMH),
        in_intersection: feature.interpolating,
        predecessors: ids(&feature.entry_lanes, names),
        successors: ids(&feature.exit_lanes, names),
        left_neighbors: ids(&feature.left_neighbor, names),
        right_neighbors: ids(&feature.right_neighbor, names),
        ..lane
    };
    parts.lanes.push(lane);
}

/// Ids as text, as numbers, or as objects with a `feature_id`.
fn ids(values: &[serde_json::Value], names: &mut Names) -> Vec<LaneId> {
    let id = |value: &serde_json::Value| names.of(value.get("feature_id").unwrap_or(value));
    values.iter().filter_map(id).map(LaneId).collect()
}

fn lane_kind(name: &str) -> LaneKind {
    match name {
        "LANE_FREEWAY" => LaneKind::Freeway,
        "LANE_SURFACE_STREET" | "LANE_SURFACE_UNSTRUCTURE" => LaneKind::SurfaceStreet,
        "LANE_BIKE_LANE" => LaneKind::BikeLane,
        _ => LaneKind::Undefined,
    }
}

/// The names of lanes, lines and edges, in the order of their kinds.
pub(super) fn lane_name(kind: LaneKind) -> &'static str {
    match kind {
        LaneKind::Freeway => "LANE_FREEWAY",
        LaneKind::SurfaceStreet => "LANE_SURFACE_STREET",
        LaneKind::BikeLane => "LANE_BIKE_LANE",
        LaneKind::Undefined => "LANE_UNKNOWN",
    }
}

const LINES: [(RoadLineKind, &str); 8] = [
    (
        RoadLineKind::BrokenSingleWhite,
        "ROAD_LINE_BROKEN_SINGLE_WHITE",
    ),
    (
        RoadLineKind::SolidSingleWhite,
        "ROAD_LINE_SOLID_SINGLE_WHITE",
    ),
    (
        RoadLineKind::SolidDoubleWhite,
        "ROAD_LINE_SOLID_DOUBLE_WHITE",
    ),
    (
        RoadLineKind::BrokenSingleYellow,
        "ROAD_LINE_BROKEN_SINGLE_YELLOW",
    ),
    (
        RoadLineKind::BrokenDoubleYellow,
        "ROAD_LINE_BROKEN_DOUBLE_YELLOW",
    ),
    (
        RoadLineKind::SolidSingleYellow,
        "ROAD_LINE_SOLID_SINGLE_YELLOW",
    ),
    (
        RoadLineKind::SolidDoubleYellow,
        "ROAD_LINE_SOLID_DOUBLE_YELLOW",
    ),
    (
        RoadLineKind::PassingDoubleYellow,
        "ROAD_LINE_PASSING_DOUBLE_YELLOW",
    ),
];

fn line_kind(name: &str) -> RoadLineKind {
    let known = LINES.iter().find(|(_, known)| *known == name);
    known.map_or(RoadLineKind::Unknown, |(kind, _)| *kind)
}

pub(super) fn line_name(kind: RoadLineKind) -> &'static str {
    let known = LINES.iter().find(|(known, _)| *known == kind);
    known.map_or("ROAD_LINE_UNKNOWN", |(_, name)| name)
}
