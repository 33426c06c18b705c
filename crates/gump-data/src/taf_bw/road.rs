//! A Lanelet2 map: nodes, ways between them, lanelets between ways.

use std::collections::BTreeMap;

use gump_geometry::{DVec3, dvec3};
use gump_scene::{AreaKind, Lane, LaneId, LaneKind, MapParts, RoadLineKind};

use super::Meta;
use crate::xml::Element;
use crate::{ReadReport, features, lanelet};

/// Semi-major axis of the WGS 84 ellipsoid, metres.
const EARTH: f64 = 6_378_137.0;
const METERS_PER_SECOND_IN_KMH: f64 = 1.0 / 3.6;

/// A way: its nodes in order.
type Way = Vec<i64>;

/// The map around the origin.
pub(super) fn parts(root: &Element, meta: &Meta, report: &mut ReadReport) -> MapParts {
    let mut parts = MapParts::default();
    let nodes: BTreeMap<i64, DVec3> = root
        .all("node")
        .filter_map(|node| Some((node.id("id")?, place(node, meta)?)))
        .collect();
    let mut ways: BTreeMap<i64, Way> = BTreeMap::new();
    for element in root.all("way") {
        let Some(id) = element.id("id") else {
            report.drop("way without an id", 1);
            continue;
        };
        let refs = element.all("nd").filter_map(|nd| nd.id("ref"));
        let way: Way = refs.filter(|node| nodes.contains_key(node)).collect();
        add_line(element, id, &points(&way, &nodes), &mut parts, report);
        ways.insert(id, way);
    }
    let mut bounds: Vec<(LaneId, [Way; 2])> = Vec::new();
    let relations = root.all("relation");
    for element in relations.filter(|relation| tag(relation, "type") == Some("lanelet")) {
        let member = |role: &str| {
            let found = element
                .all("member")
                .find(|member| member.attribute("role") == Some(role));
            ways.get(&found?.id("ref")?)
        };
        let (Some(id), Some(left), Some(right)) =
            (element.id("id"), member("left"), member("right"))
        else {
            report.drop_damaged("lanelet without two bounds", || {
                format!(
                    "lanelet {}",
                    element.attribute("id").unwrap_or("without id")
                )
            });
            continue;
        };
        let [left, right] = directed(left, right, &nodes);
        let [a, b] = [&left, &right].map(|way| points(way, &nodes));
        let kind = match tag(element, "subtype") {
            Some("crosswalk") => {
                let ring: Vec<DVec3> = a.iter().chain(b.iter().rev()).copied().collect();
                features::add_area(&mut parts, id, AreaKind::Crosswalk, &ring, report);
                continue;
            }
            Some("walkway" | "stairs") => {
                report.drop("sidewalk", 1);
                continue;
            }
            Some("bikelane" | "bicycle_lane") => LaneKind::BikeLane,
            _ => LaneKind::SurfaceStreet,
        };
        let Some(lane) = lanelet::lane(id, kind, &a, &b, report) else {
            continue;
        };
        let limit = tag(element, "maxspeed").and_then(|limit| limit.parse().ok());
        let limit = limit.unwrap_or(meta.speed_limit_kmh) * METERS_PER_SECOND_IN_KMH;
        bounds.push((lane.id, [left, right]));
        parts.lanes.push(Lane {
            speed_limit: Some(limit).filter(|&limit| limit > 0.0 && limit.is_finite()),
            ..lane
        });
    }
    link(&mut parts.lanes, &bounds);
    parts
}

/// A node in metres east and north of the origin: Mercator's projection of the sphere, scaled to be
/// true there, which is how the recordings were projected.
fn place(node: &Element, meta: &Meta) -> Option<DVec3> {
    let degrees = |name| node.attribute(name)?.parse::<f64>().ok();
    let (latitude, longitude) = (degrees("lat")?, degrees("lon")?);
    let [latitude_0, longitude_0] = meta.origin;
    let scale = latitude_0.to_radians().cos() * EARTH;
    let north = |latitude: f64| (0.25 * std::f64::consts::PI + latitude.to_radians() / 2.0).tan();
    let x = scale * (longitude - longitude_0).to_radians();
    let y = scale * (north(latitude) / north(latitude_0)).ln();
    Some(dvec3(x, y, 0.0))
}

fn points(way: &Way, nodes: &BTreeMap<i64, DVec3>) -> Vec<DVec3> {
    way.iter().map(|node| nodes[node]).collect()
}

fn tag<'e>(element: &'e Element, key: &str) -> Option<&'e str> {
    let mut tags = element.all("tag");
    let found = tags.find(|tag| tag.attribute("k") == Some(key));
    found?.attribute("v")
}

/// Both bounds in the direction of travel: ways may be given in either, and lanes of two directions
/// share them.
fn directed(left: &Way, right: &Way, nodes: &BTreeMap<i64, DVec3>) -> [Way; 2] {
    let (mut left, mut right) = (left.clone(), right.clone());
    let a = points(&left, nodes);
    let mut b = points(&right, nodes);
    let first = b.first().copied();
    lanelet::align(&a, &mut b);
    if b.first().copied() != first {
        right.reverse();
    }
    // Driving on, the left bound lies to the left: round the outline it goes clockwise.
    let ring: Vec<DVec3> = a.iter().chain(b.iter().rev()).copied().collect();
    let next = ring.iter().cycle().skip(1);
    let area: f64 = ring
        .iter()
        .zip(next)
        .map(|(p, q)| p.x * q.y - q.x * p.y)
        .sum();
    if area > 0.0 {
        left.reverse();
        right.reverse();
    }
    [left, right]
}

/// Lanes go on where bounds end at the nodes at which others begin; they lie side by side where they
/// share a bound and its direction.
fn link(lanes: &mut [Lane], bounds: &[(LaneId, [Way; 2])]) {
    let ends = |[left, right]: &[Way; 2]| (left.last().copied(), right.last().copied());
    let starts = |[left, right]: &[Way; 2]| (left.first().copied(), right.first().copied());
    for (lane, (_, own)) in lanes.iter_mut().zip(bounds) {
        for (id, other) in bounds.iter().filter(|(id, _)| *id != lane.id) {
            if starts(other) == ends(own) {
                lane.successors.push(*id);
            }
            if ends(other) == starts(own) {
                lane.predecessors.push(*id);
            }
            if other[1] == own[0] {
                lane.left_neighbors.push(*id);
            }
            if other[0] == own[1] {
                lane.right_neighbors.push(*id);
            }
        }
    }
}

/// Painted lines; borders of the road are those of its lanes.
fn add_line(
    element: &Element,
    id: i64,
    points: &[DVec3],
    parts: &mut MapParts,
    report: &mut ReadReport,
) {
    let kind = match tag(element, "subtype") {
        Some("solid") => RoadLineKind::SolidSingleWhite,
        _ => RoadLineKind::BrokenSingleWhite,
    };
    let painted = matches!(tag(element, "type"), Some("line_thin" | "line_thick"));
    if painted && points.len() > 1 {
        features::add_road_line(parts, id, kind, points, report);
    }
}
