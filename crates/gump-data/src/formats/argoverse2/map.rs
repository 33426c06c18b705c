//! The vector map: lane segments between bounds, drivable areas, pedestrian crossings.

use std::collections::BTreeMap;
use std::path::Path;

use gump_geometry::{DVec3, dvec3};
use gump_scene::{AreaKind, Lane, LaneId, LaneKind, MapParts, RoadLineKind, Unstated};
use serde::Deserialize;

use crate::complete::features;
use crate::formats::lanelet;
use crate::io::json::{self, Real};
use crate::{DataError, ReadReport};

#[derive(Deserialize)]
pub(super) struct Map {
    #[serde(default)]
    lane_segments: BTreeMap<String, Segment>,
    #[serde(default)]
    drivable_areas: BTreeMap<String, DrivableArea>,
    #[serde(default)]
    pedestrian_crossings: BTreeMap<String, Crossing>,
}

#[derive(Deserialize)]
struct Segment {
    id: i64,
    lane_type: String,
    #[serde(default)]
    is_intersection: bool,
    left_lane_boundary: Vec<Point>,
    right_lane_boundary: Vec<Point>,
    #[serde(default)]
    left_lane_mark_type: Option<String>,
    #[serde(default)]
    right_lane_mark_type: Option<String>,
    #[serde(default)]
    predecessors: Vec<i64>,
    #[serde(default)]
    successors: Vec<i64>,
    #[serde(default)]
    left_neighbor_id: Option<i64>,
    #[serde(default)]
    right_neighbor_id: Option<i64>,
}

#[derive(Deserialize)]
struct DrivableArea {
    #[serde(default)]
    id: Option<i64>,
    area_boundary: Vec<Point>,
}

#[derive(Deserialize)]
struct Crossing {
    id: i64,
    edge1: Vec<Point>,
    edge2: Vec<Point>,
}

#[derive(Clone, Copy, Deserialize)]
struct Point {
    x: Real,
    y: Real,
    #[serde(default)]
    z: Real,
}

fn places(points: &[Point]) -> Vec<DVec3> {
    points.iter().map(|p| dvec3(p.x.0, p.y.0, p.z.0)).collect()
}

/// First id of lines and edges, which have no ids in the format; beyond those of lanes and areas.
const FIRST_LINE_ID: i64 = 1 << 40;

/// Reads the map file.
pub(super) fn read(path: &Path) -> Result<Map, DataError> {
    json::read(path, "an Argoverse 2 map as JSON")
}

/// The features of the map. Centre lines run between the bounds; those that forecasting maps state
/// are left out because they are the same, without heights.
pub(super) fn parts(map: &Map, report: &mut ReadReport) -> MapParts {
    let mut parts = MapParts {
        unstated: Unstated {
            stop_signs: true,
            lights: true,
        },
        ..MapParts::default()
    };
    for segment in map.lane_segments.values() {
        add_lane(segment, &mut parts, report);
    }
    drop_oncoming_neighbors(&mut parts.lanes, report);
    add_lines(map, &mut parts, report);
    for (key, area) in &map.drivable_areas {
        let id = area.id.or_else(|| key.parse().ok()).unwrap_or_default();
        let points = features::sound_points(id, &places(&area.area_boundary), report);
        if let Some(polygon) = features::polygon(id, &points, report) {
            parts.drivable.push(polygon);
        }
    }
    for crossing in map.pedestrian_crossings.values() {
        let first = places(&crossing.edge1);
        let mut second = places(&crossing.edge2);
        lanelet::align(&first, &mut second);
        let ring: Vec<DVec3> = first.into_iter().chain(second.into_iter().rev()).collect();
        features::add_area(&mut parts, crossing.id, AreaKind::Crosswalk, &ring, report);
    }
    parts
}

fn add_lane(segment: &Segment, parts: &mut MapParts, report: &mut ReadReport) {
    let kind = match segment.lane_type.as_str() {
        "VEHICLE" | "BUS" => LaneKind::SurfaceStreet,
        "BIKE" => LaneKind::BikeLane,
        _ => LaneKind::Undefined,
    };
    let left = places(&segment.left_lane_boundary);
    let right = places(&segment.right_lane_boundary);
    let lane = lanelet::lane(segment.id, kind, &left, &right, report);
    let ids = |ids: &[i64]| ids.iter().copied().map(LaneId).collect();
    parts.lanes.extend(lane.map(|lane| Lane {
        in_intersection: segment.is_intersection,
        predecessors: ids(&segment.predecessors),
        successors: ids(&segment.successors),
        left_neighbors: segment.left_neighbor_id.map(LaneId).into_iter().collect(),
        right_neighbors: segment.right_neighbor_id.map(LaneId).into_iter().collect(),
        ..lane
    }));
}

/// The format's neighbours may lead the other way.
fn drop_oncoming_neighbors(lanes: &mut [Lane], report: &mut ReadReport) {
    let direction = |lane: &Lane| {
        let points = lane.centerline.points();
        points[points.len() - 1] - points[0]
    };
    let directions: BTreeMap<LaneId, _> = lanes.iter().map(|l| (l.id, direction(l))).collect();
    for lane in lanes {
        let own = directions[&lane.id];
        let same = |id: &LaneId| directions.get(id).is_none_or(|other| own.dot(*other) > 0.0);
        for side in [&mut lane.left_neighbors, &mut lane.right_neighbors] {
            let n = side.len();
            side.retain(same);
            report.drop("neighbour that leads the other way", n - side.len());
        }
    }
}

/// Painted bounds, each once: neighbours state the one between them twice.
fn add_lines(map: &Map, parts: &mut MapParts, report: &mut ReadReport) {
    let mut seen = std::collections::BTreeSet::new();
    for segment in map.lane_segments.values() {
        let bounds = [
            (&segment.left_lane_mark_type, &segment.left_lane_boundary),
            (&segment.right_lane_mark_type, &segment.right_lane_boundary),
        ];
        for (mark, bound) in bounds {
            let Some(kind) = mark.as_deref().and_then(line_kind) else {
                continue;
            };
            let line = places(bound);
            let key = |p: &DVec3| [(p.x * 100.0).round() as i64, (p.y * 100.0).round() as i64];
            let mut ends = [line.first().map(key), line.last().map(key)];
            ends.sort_unstable();
            if seen.insert(ends) {
                let id = FIRST_LINE_ID + seen.len() as i64;
                features::add_road_line(parts, id, kind, &line, report);
            }
        }
    }
}

/// `None` for bounds without paint.
fn line_kind(mark: &str) -> Option<RoadLineKind> {
    Some(match mark {
        "NONE" => return None,
        "DASHED_WHITE" | "DOUBLE_DASH_WHITE" => RoadLineKind::BrokenSingleWhite,
        "SOLID_WHITE" => RoadLineKind::SolidSingleWhite,
        "DOUBLE_SOLID_WHITE" | "DASH_SOLID_WHITE" | "SOLID_DASH_WHITE" => {
            RoadLineKind::SolidDoubleWhite
        }
        "DASHED_YELLOW" => RoadLineKind::BrokenSingleYellow,
        "DOUBLE_DASH_YELLOW" => RoadLineKind::BrokenDoubleYellow,
        "SOLID_YELLOW" => RoadLineKind::SolidSingleYellow,
        "DOUBLE_SOLID_YELLOW" => RoadLineKind::SolidDoubleYellow,
        "DASH_SOLID_YELLOW" | "SOLID_DASH_YELLOW" => RoadLineKind::PassingDoubleYellow,
        _ => RoadLineKind::Unknown,
    })
}
