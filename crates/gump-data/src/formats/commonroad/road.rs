//! Conversion of lanelets to lanes with outlines, links, markings and speed limits.

use std::collections::{BTreeMap, BTreeSet};

use gump_geometry::{DVec2, DVec3, dvec3};
use gump_scene::{AreaKind, Lane, LaneId, LaneKind, MapParts, RoadLineKind, StopSign};

use crate::complete::features;
use crate::formats::lanelet;
use crate::io::xml::Element;
use crate::{ReadOptions, ReadReport};

/// The map of a scenario.
pub(super) fn parts(root: &Element, options: ReadOptions, report: &mut ReadReport) -> MapParts {
    let mut parts = MapParts::default();
    let limits = speed_signs(root);
    let mut ids = BTreeSet::new();
    for element in root.all("lanelet") {
        let Some(id) = element.id("id").filter(|id| !ids.contains(id)) else {
            report.drop_damaged("lanelet without an id of its own", || {
                format!(
                    "lanelet {}",
                    element.attribute("id").unwrap_or("without id")
                )
            });
            continue;
        };
        ids.insert(id);
        add_lanelet(element, id, &limits, &mut parts, report);
    }
    add_lines(root, &mut parts, report);
    add_stop_signs(root, &mut parts, report);
    mark_intersections(root, &mut parts);
    if options.infer_drivable {
        let surfaces = parts.lanes.iter().filter(|l| l.kind != LaneKind::BikeLane);
        parts.drivable = surfaces.filter_map(|lane| lane.outline.clone()).collect();
        report.infer("drivable surface of a lane", parts.drivable.len());
    }
    parts
}

fn add_lanelet(
    element: &Element,
    id: i64,
    limits: &BTreeMap<i64, f64>,
    parts: &mut MapParts,
    report: &mut ReadReport,
) {
    let [left, right] = ["leftBound", "rightBound"].map(|bound| points(element.child(bound)));
    let kinds: Vec<&str> = element
        .all("laneletType")
        .filter_map(|e| e.text(&[]))
        .collect();
    if kinds.contains(&"crosswalk") {
        let ring: Vec<DVec3> = left.iter().chain(right.iter().rev()).copied().collect();
        features::add_area(parts, id, AreaKind::Crosswalk, &ring, report);
        return;
    }
    if kinds.contains(&"sidewalk") {
        report.drop("sidewalk", 1);
        return;
    }
    let Some(mut lane) = lanelet::lane(id, kind(&kinds), &left, &right, report) else {
        return;
    };
    let links = |name| {
        element
            .all(name)
            .filter_map(|e| e.id("ref"))
            .map(LaneId)
            .collect()
    };
    lane.predecessors = links("predecessor");
    lane.successors = links("successor");
    lane.left_neighbors = neighbour(element, "adjacentLeft").into_iter().collect();
    lane.right_neighbors = neighbour(element, "adjacentRight").into_iter().collect();
    let signs = element.all("trafficSignRef").filter_map(|e| e.id("ref"));
    let by_sign = signs.filter_map(|sign| limits.get(&sign).copied()).next();
    let stated = Some(element.number(&["speedLimit"])).filter(|limit| limit.is_finite());
    lane.speed_limit = stated.or(by_sign).filter(|&limit| limit > 0.0);
    lane.has_lights = element.child("trafficLightRef").map(|_| true);
    parts.lanes.push(lane);
}

/// The lanelet beside if it leads the same way.
fn neighbour(element: &Element, side: &str) -> Option<LaneId> {
    let beside = element.child(side)?;
    let same = beside.attribute("drivingDir") == Some("same");
    beside.id("ref").filter(|_| same).map(LaneId)
}

fn points(bound: Option<&Element>) -> Vec<DVec3> {
    let points = bound.into_iter().flat_map(|bound| bound.all("point"));
    points
        .map(|p| {
            let z = p.number(&["z"]);
            dvec3(
                p.number(&["x"]),
                p.number(&["y"]),
                if z.is_nan() { 0.0 } else { z },
            )
        })
        .collect()
}

fn kind(kinds: &[&str]) -> LaneKind {
    let any = |names: &[&str]| kinds.iter().any(|kind| names.contains(kind));
    if any(&["bicycleLane"]) {
        LaneKind::BikeLane
    } else if any(&[
        "highway",
        "interstate",
        "mainCarriageWay",
        "accessRamp",
        "exitRamp",
    ]) {
        LaneKind::Freeway
    } else if any(&["urban", "country", "driveWay", "busLane", "intersection"]) {
        LaneKind::SurfaceStreet
    } else {
        LaneKind::Undefined
    }
}

/// Speed limits in metres per second by the id of their sign: "R2-1" in the United States, "274"
/// in Germany. CommonRoad gives values in metres per second whatever the country.
fn speed_signs(root: &Element) -> BTreeMap<i64, f64> {
    let limit = |sign: &Element| {
        let mut elements = sign.all("trafficSignElement");
        let element =
            elements.find(|e| matches!(e.text(&["trafficSignID"]), Some("R2-1" | "274")))?;
        let value = element.number(&["additionalValue"]);
        Some((sign.id("id")?, value)).filter(|(_, value)| value.is_finite())
    };
    root.all("trafficSign").filter_map(limit).collect()
}

/// Painted bounds, each once: neighbours state the one between them twice.
fn add_lines(root: &Element, parts: &mut MapParts, report: &mut ReadReport) {
    let mut seen: BTreeSet<[[i64; 2]; 2]> = BTreeSet::new();
    for bound in root.all("lanelet").flat_map(|lanelet| {
        ["leftBound", "rightBound"]
            .into_iter()
            .filter_map(|side| lanelet.child(side))
    }) {
        let kind = match bound.text(&["lineMarking"]) {
            Some("dashed" | "broad_dashed") => RoadLineKind::BrokenSingleWhite,
            Some("solid" | "broad_solid") => RoadLineKind::SolidSingleWhite,
            _ => continue,
        };
        let line = points(Some(bound));
        let (Some(first), Some(last)) = (line.first(), line.last()) else {
            continue;
        };
        let key = |p: &DVec3| [(p.x * 100.0).round() as i64, (p.y * 100.0).round() as i64];
        let mut ends = [key(first), key(last)];
        ends.sort_unstable();
        if seen.insert(ends) {
            let id = FIRST_LINE_ID + seen.len() as i64;
            features::add_road_line(parts, id, kind, &line, report);
        }
    }
}

/// First id of lines, which have no ids in the format; beyond those of lanelets.
const FIRST_LINE_ID: i64 = 1 << 40;

/// Stop signs ("R1-1" in the United States, "206" in Germany) at the stop lines of their lanes.
fn add_stop_signs(root: &Element, parts: &mut MapParts, report: &mut ReadReport) {
    let is_stop = |sign: &&Element| {
        let mut elements = sign.all("trafficSignElement");
        elements.any(|e| matches!(e.text(&["trafficSignID"]), Some("R1-1" | "206")))
    };
    let mut ruled: BTreeMap<i64, Vec<LaneId>> = BTreeMap::new();
    for lanelet in root.all("lanelet") {
        for sign in lanelet.all("trafficSignRef").filter_map(|e| e.id("ref")) {
            ruled
                .entry(sign)
                .or_default()
                .extend(lanelet.id("id").map(LaneId));
        }
    }
    let end = |lane: &Lane| lane.centerline.points().last().copied();
    let ends: BTreeMap<LaneId, DVec2> = parts
        .lanes
        .iter()
        .filter_map(|lane| Some((lane.id, end(lane)?)))
        .collect();
    for sign in root.all("trafficSign").filter(is_stop) {
        let Some(id) = sign.id("id") else { continue };
        let lanes = ruled.remove(&id).unwrap_or_default();
        let at_lane = lanes.iter().find_map(|lane| ends.get(lane));
        let stated = points(sign.child("position")).first().copied();
        match stated
            .filter(|p| p.is_finite())
            .or(at_lane.map(|p| p.extend(0.0)))
        {
            Some(position) => parts.stop_signs.push(StopSign {
                id,
                position,
                lanes,
            }),
            None => report.drop("stop sign without a place", 1),
        }
    }
}

/// Lanes that follow an incoming lane of an intersection lie inside it.
fn mark_intersections(root: &Element, parts: &mut MapParts) {
    let incoming = root.all("intersection").flat_map(|i| i.all("incoming"));
    let inside: BTreeSet<LaneId> = incoming
        .flat_map(|incoming| incoming.children.iter())
        .filter(|child| child.name.starts_with("successors"))
        .filter_map(|child| child.id("ref"))
        .map(LaneId)
        .collect();
    for lane in &mut parts.lanes {
        lane.in_intersection |= inside.contains(&lane.id);
    }
}
