//! A Lanelet2 map: nodes, ways between them, lanelets between ways.

use std::collections::{BTreeMap, BTreeSet};

use gump_geometry::{DVec3, dvec3};
use gump_scene::{AreaKind, Lane, LaneId, LaneKind, MapParts, RoadLineKind, Unstated};

use super::Meta;
use crate::ReadReport;
use crate::complete::features;
use crate::formats::lanelet;
use crate::io::xml::Element;

/// Semi-major axis of the WGS 84 ellipsoid, metres.
const EARTH: f64 = 6_378_137.0;
const METERS_PER_SECOND_IN_KMH: f64 = 1.0 / 3.6;

/// The most points of all bounds together: lanelets share ways, so a small file can ask for many.
/// These take a hundred megabytes.
const MAX_POINTS: usize = 4_000_000;

/// A way: its nodes in order.
type Way = Vec<i64>;

/// The map around the origin.
pub(super) fn parts(root: &Element, meta: &Meta, report: &mut ReadReport) -> MapParts {
    let mut parts = MapParts {
        unstated: Unstated {
            stop_signs: true,
            lights: true,
        },
        ..MapParts::default()
    };
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
    let (mut ids, mut room) = (BTreeSet::new(), MAX_POINTS);
    let relations = root.all("relation");
    for element in relations.filter(|relation| tag(relation, "type") == Some("lanelet")) {
        let member = |role: &str| {
            let found = element
                .all("member")
                .find(|member| member.attribute("role") == Some(role));
            ways.get(&found?.id("ref")?)
        };
        let own = element.id("id").filter(|id| ids.insert(*id));
        let (Some(id), Some(left), Some(right)) = (own, member("left"), member("right")) else {
            report.drop_damaged("lanelet without two bounds or an id of its own", || {
                format!(
                    "lanelet {}",
                    element.attribute("id").unwrap_or("without id")
                )
            });
            continue;
        };
        let n_points = left.len() + right.len();
        if n_points > room {
            report.drop_damaged("lanelet beyond what a map may hold", || {
                format!("lanelet {id}")
            });
            continue;
        }
        room -= n_points;
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

/// The most lanes that one lane is linked with in one way: a damaged file may lay thousands upon each
/// other.
const MAX_LINKS: usize = 16;

/// Links lanes: one follows another if its bounds begin at the nodes at which those of the other
/// end; lanes lie side by side if they share a bound and its direction.
fn link(lanes: &mut [Lane], bounds: &[(LaneId, [Way; 2])]) {
    type Ends = [Option<i64>; 2];
    let starts =
        |[left, right]: &[Way; 2]| -> Ends { [left.first(), right.first()].map(|n| n.copied()) };
    let ends =
        |[left, right]: &[Way; 2]| -> Ends { [left.last(), right.last()].map(|n| n.copied()) };
    let (mut starting, mut ending) = (BTreeMap::new(), BTreeMap::new());
    let (mut on_left, mut on_right) = (BTreeMap::new(), BTreeMap::new());
    for (id, own) in bounds {
        starting
            .entry(starts(own))
            .or_insert_with(Vec::new)
            .push(*id);
        ending.entry(ends(own)).or_insert_with(Vec::new).push(*id);
        on_left.entry(&own[0]).or_insert_with(Vec::new).push(*id);
        on_right.entry(&own[1]).or_insert_with(Vec::new).push(*id);
    }
    for (lane, (id, own)) in lanes.iter_mut().zip(bounds) {
        let others = |found: Option<&Vec<LaneId>>| -> Vec<LaneId> {
            let found = found.into_iter().flatten().copied();
            found.filter(|other| other != id).take(MAX_LINKS).collect()
        };
        lane.successors = others(starting.get(&ends(own)));
        lane.predecessors = others(ending.get(&starts(own)));
        lane.left_neighbors = others(on_right.get(&own[0]));
        lane.right_neighbors = others(on_left.get(&own[1]));
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::xml;
    use std::fmt::Write as _;

    #[test]
    fn lanelets_that_share_ways_do_not_multiply_without_end() {
        let mut text = String::from("<osm version='0.6'>");
        for way in [1, 2] {
            let longitude = 8.4 + 5e-5 * f64::from(way);
            for i in 0..1000 {
                let (node, latitude) = (1000 * way + i, 49.0 + 1e-6 * f64::from(i));
                write!(
                    text,
                    "<node id='{node}' lat='{latitude}' lon='{longitude}'/>"
                )
                .unwrap();
            }
            write!(text, "<way id='{way}'>").unwrap();
            for i in 0..1000 {
                write!(text, "<nd ref='{}'/>", 1000 * way + i).unwrap();
            }
            text += "</way>";
        }
        let most = MAX_POINTS / 2000;
        // One too many, and one whose id was there before.
        for id in (0..=most).chain([0]) {
            write!(
                text,
                "<relation id='{id}'><member role='left' ref='1'/><member role='right' ref='2'/>\
                 <tag k='type' v='lanelet'/></relation>"
            )
            .unwrap();
        }
        text += "</osm>";
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("some.osm");
        std::fs::write(&path, text).unwrap();
        let meta = Meta {
            rate_hz: 10.0,
            origin: [49.0, 8.4],
            speed_limit_kmh: 50.0,
        };
        let mut report = ReadReport::default();
        let parts = parts(&xml::read(&path, "a map").unwrap(), &meta, &mut report);
        assert_eq!(parts.lanes.len(), most);
        assert_eq!(report.dropped["lanelet beyond what a map may hold"], 1);
        let twice = "lanelet without two bounds or an id of its own";
        assert_eq!(report.dropped[twice], 1);
    }
}
