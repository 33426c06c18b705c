//! Conversion of Waymo map features to [`MapParts`], without inference.

use std::collections::BTreeSet;

use gump_geometry::{DVec2, Polygon, Polyline, dvec2, dvec3};
use gump_scene::{
    Area, AreaKind, Lane, LaneId, LaneKind, MapParts, RoadEdge, RoadEdgeKind, RoadLine,
    RoadLineKind, StopSign,
};

use crate::complete::infer;
use crate::error::MAX_COORDINATE;
use crate::{Problem, ReadReport};
use gump_proto::{self as proto, FeatureData, LaneType, RoadEdgeType, RoadLineType};

/// Metres per second in one mile per hour (international mile, exact).
pub(crate) const METERS_PER_SECOND_IN_MPH: f64 = 0.447_04;

/// Sorts features into parts; features without a shape are dropped and counted.
///
/// Error: [`Problem::MapPoint`].
///
pub(crate) fn parts_from_proto(
    features: &[proto::MapFeature],
    report: &mut ReadReport,
) -> Result<MapParts, Problem> {
    let mut parts = MapParts::default();
    for feature in features {
        let id = feature.id();
        check_points(feature)?;
        match &feature.feature_data {
            Some(FeatureData::Lane(lane)) => parts.lanes.extend(lane_from_proto(id, lane, report)),
            Some(FeatureData::RoadLine(line)) => {
                let kind = line_kind(line.r#type());
                let shape = shape(&line.polyline, "road line without points", report);
                parts
                    .road_lines
                    .extend(shape.map(|(line, elevation)| RoadLine {
                        id,
                        kind,
                        line,
                        elevation,
                    }));
            }
            Some(FeatureData::RoadEdge(edge)) => {
                let kind = edge_kind(edge.r#type());
                let shape = shape(&edge.polyline, "road edge without points", report);
                parts
                    .road_edges
                    .extend(shape.map(|(line, elevation)| RoadEdge {
                        id,
                        kind,
                        line,
                        elevation,
                    }));
            }
            Some(FeatureData::StopSign(sign)) => {
                let p = sign.position.unwrap_or_default();
                parts.stop_signs.push(StopSign {
                    id,
                    position: dvec3(p.x(), p.y(), p.z()),
                    lanes: sign.lane.iter().copied().map(LaneId).collect(),
                });
            }
            Some(FeatureData::Crosswalk(outline)) => {
                parts
                    .areas
                    .extend(area(id, AreaKind::Crosswalk, outline, report));
            }
            Some(FeatureData::SpeedBump(outline)) => {
                parts
                    .areas
                    .extend(area(id, AreaKind::SpeedBump, outline, report));
            }
            Some(FeatureData::Driveway(outline)) => {
                parts
                    .areas
                    .extend(area(id, AreaKind::Driveway, outline, report));
            }
            None => report.drop("map feature of an unknown type", 1),
        }
    }
    count_dead_links(&parts, report);
    Ok(parts)
}

fn check_points(feature: &proto::MapFeature) -> Result<(), Problem> {
    let points = match &feature.feature_data {
        Some(FeatureData::Lane(lane)) => &lane.polyline,
        Some(FeatureData::RoadLine(line)) => &line.polyline,
        Some(FeatureData::RoadEdge(edge)) => &edge.polyline,
        Some(FeatureData::StopSign(sign)) => &sign.position.into_iter().collect(),
        Some(FeatureData::Crosswalk(o) | FeatureData::SpeedBump(o) | FeatureData::Driveway(o)) => {
            &o.polygon
        }
        None => return Ok(()),
    };
    for (point, p) in points.iter().enumerate() {
        let sound = |value: &f64| value.abs() <= MAX_COORDINATE;
        if let Some(value) = [p.x(), p.y(), p.z()].into_iter().find(|v| !sound(v)) {
            let feature = feature.id();
            return Err(Problem::MapPoint {
                feature,
                point,
                value,
            });
        }
    }
    Ok(())
}

fn lane_from_proto(id: i64, lane: &proto::LaneCenter, report: &mut ReadReport) -> Option<Lane> {
    report.drop(
        "boundary segment of a lane",
        lane.left_boundaries.len() + lane.right_boundaries.len(),
    );
    let (centerline, elevation) = shape(&lane.polyline, "lane without points", report)?;
    let kind = lane_kind(lane.r#type());
    Some(Lane {
        kind,
        width: infer::default_width(kind),
        speed_limit: Some(lane.speed_limit_mph() * METERS_PER_SECOND_IN_MPH)
            .filter(|&limit| limit > 0.0 && limit.is_finite()),
        in_intersection: lane.interpolating(),
        predecessors: ids(lane.entry_lanes.iter().copied()),
        successors: ids(lane.exit_lanes.iter().copied()),
        left_neighbors: ids(lane.left_neighbors.iter().map(|n| n.feature_id())),
        right_neighbors: ids(lane.right_neighbors.iter().map(|n| n.feature_id())),
        ..Lane::new(LaneId(id), centerline, elevation)
    })
}

/// Each id once, in the order of first mention: a neighbour may be listed once per stretch.
fn ids(ids: impl Iterator<Item = i64>) -> Vec<LaneId> {
    let mut seen = BTreeSet::new();
    ids.map(LaneId).filter(|id| seen.insert(*id)).collect()
}

fn shape(
    points: &[proto::MapPoint],
    without_points: &'static str,
    report: &mut ReadReport,
) -> Option<(Polyline, Vec<f64>)> {
    let line = Polyline::new(plane(points));
    if line.is_none() {
        report.drop(without_points, 1);
    }
    Some((line?, points.iter().map(|p| p.z()).collect()))
}

fn area(
    id: i64,
    kind: AreaKind,
    outline: &proto::Outline,
    report: &mut ReadReport,
) -> Option<Area> {
    let polygon = Polygon::new(plane(&outline.polygon));
    if polygon.is_none() {
        report.drop("outline of fewer than 3 points", 1);
    }
    let polygon = polygon?;
    // The polygon may have dropped a closing point.
    let corners = &outline.polygon[..polygon.ring().len()];
    Some(Area {
        elevation: corners.iter().map(|p| p.z()).collect(),
        ..Area::new(id, kind, polygon)
    })
}

fn plane(points: &[proto::MapPoint]) -> Vec<DVec2> {
    points.iter().map(|p| dvec2(p.x(), p.y())).collect()
}

fn count_dead_links(parts: &MapParts, report: &mut ReadReport) {
    let known: BTreeSet<LaneId> = parts.lanes.iter().map(|lane| lane.id).collect();
    let dead = |ids: &[LaneId]| ids.iter().filter(|id| !known.contains(id)).count();
    for lane in &parts.lanes {
        let links = dead(&lane.predecessors) + dead(&lane.successors);
        report.drop("link to a lane that is not in the map", links);
        let neighbors = dead(&lane.left_neighbors) + dead(&lane.right_neighbors);
        report.drop("neighbour that is not in the map", neighbors);
    }
}

fn lane_kind(kind: LaneType) -> LaneKind {
    match kind {
        LaneType::Undefined => LaneKind::Undefined,
        LaneType::Freeway => LaneKind::Freeway,
        LaneType::SurfaceStreet => LaneKind::SurfaceStreet,
        LaneType::BikeLane => LaneKind::BikeLane,
    }
}

fn line_kind(kind: RoadLineType) -> RoadLineKind {
    match kind {
        RoadLineType::Unknown => RoadLineKind::Unknown,
        RoadLineType::BrokenSingleWhite => RoadLineKind::BrokenSingleWhite,
        RoadLineType::SolidSingleWhite => RoadLineKind::SolidSingleWhite,
        RoadLineType::SolidDoubleWhite => RoadLineKind::SolidDoubleWhite,
        RoadLineType::BrokenSingleYellow => RoadLineKind::BrokenSingleYellow,
        RoadLineType::BrokenDoubleYellow => RoadLineKind::BrokenDoubleYellow,
        RoadLineType::SolidSingleYellow => RoadLineKind::SolidSingleYellow,
        RoadLineType::SolidDoubleYellow => RoadLineKind::SolidDoubleYellow,
        RoadLineType::PassingDoubleYellow => RoadLineKind::PassingDoubleYellow,
    }
}

fn edge_kind(kind: RoadEdgeType) -> RoadEdgeKind {
    match kind {
        RoadEdgeType::Unknown => RoadEdgeKind::Unknown,
        RoadEdgeType::Boundary => RoadEdgeKind::Boundary,
        RoadEdgeType::Median => RoadEdgeKind::Median,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn points(list: &[(f64, f64)]) -> Vec<proto::MapPoint> {
        let point = |&(x, y): &(f64, f64)| proto::MapPoint {
            x: Some(x),
            y: Some(y),
            z: Some(x + y),
        };
        list.iter().map(point).collect()
    }

    fn read(data: Option<FeatureData>) -> (MapParts, ReadReport) {
        let feature = proto::MapFeature {
            id: Some(5),
            feature_data: data,
        };
        let mut report = ReadReport::default();
        let parts = parts_from_proto(&[feature], &mut report).unwrap();
        (parts, report)
    }

    #[test]
    fn a_lane_keeps_what_is_stated() {
        let neighbor = |id| proto::LaneNeighbor {
            feature_id: Some(id),
            ..proto::LaneNeighbor::default()
        };
        let (parts, report) = read(Some(FeatureData::Lane(proto::LaneCenter {
            speed_limit_mph: Some(25.0),
            r#type: Some(LaneType::BikeLane.into()),
            interpolating: Some(true),
            polyline: points(&[(0.0, 1.0), (5.0, 1.0)]),
            left_neighbors: vec![neighbor(5), neighbor(8), neighbor(5)],
            exit_lanes: vec![5, 6],
            ..proto::LaneCenter::default()
        })));
        let lane = &parts.lanes[0];
        assert_eq!(lane.speed_limit, Some(11.176));
        assert_eq!((lane.kind, lane.width), (LaneKind::BikeLane, 1.5));
        assert!(lane.in_intersection);
        assert_eq!(lane.elevation, [1.0, 6.0]);
        // A neighbour is listed once however many stretches it runs along.
        assert_eq!(lane.left_neighbors, [LaneId(5), LaneId(8)]);
        assert_eq!(report.dropped["neighbour that is not in the map"], 1);
        assert_eq!(report.dropped["link to a lane that is not in the map"], 1);
    }

    #[test]
    fn the_closing_point_of_an_outline_takes_its_height_with_it() {
        let ring = [(0.0, 0.0), (4.0, 0.0), (4.0, 3.0), (0.0, 0.0)];
        let polygon = points(&ring);
        let (parts, _) = read(Some(FeatureData::Driveway(proto::Outline { polygon })));
        assert_eq!(parts.areas[0].kind, AreaKind::Driveway);
        assert_eq!(parts.areas[0].elevation, [0.0, 4.0, 7.0]);
    }

    #[test]
    fn features_without_shape_are_dropped_and_counted() {
        let check = |data, reason| {
            let (parts, report) = read(data);
            assert!(parts.lanes.is_empty() && parts.areas.is_empty());
            assert_eq!(report.dropped[reason], 1);
        };
        check(None, "map feature of an unknown type");
        let lane = proto::LaneCenter::default();
        check(Some(FeatureData::Lane(lane)), "lane without points");
        let polygon = points(&[(0.0, 0.0), (1.0, 1.0)]);
        let bump = FeatureData::SpeedBump(proto::Outline { polygon });
        check(Some(bump), "outline of fewer than 3 points");
    }
}
