//! The made-up map, as nuPlan's reader reads it.

use gump_geometry::{DVec2, Polygon, Polyline, dvec2};
use gump_scene::{Area, AreaKind, Lane, LaneId, MapGraph, MapParts, Roadblock, RoadblockId};
use serde_json::Value;

use crate::common::{golden, list, number};

pub(crate) fn synthetic_map() -> MapGraph {
    let golden = golden("synth_map");
    let mut lanes: Vec<Lane> = list(&golden["lanes"]).iter().map(lane).collect();
    let links: Vec<(LaneId, Vec<LaneId>)> = lanes
        .iter()
        .map(|lane| (lane.id, lane.successors.clone()))
        .collect();
    for lane in &mut lanes {
        let leading = links.iter().filter(|(_, next)| next.contains(&lane.id));
        lane.predecessors = leading.map(|(id, _)| *id).collect();
    }
    let areas = list(&golden["areas"]).iter();
    let intersections = areas.filter(|area| area["kind"] == "intersection");
    MapGraph::new(MapParts {
        lanes,
        roadblocks: list(&golden["blocks"]).iter().map(block).collect(),
        areas: intersections
            .map(|area| {
                let outline = polygon(&area["outline"]);
                Area::new(id(&area["id"]), AreaKind::Intersection, outline)
            })
            .collect(),
        drivable: list(&golden["drivable"]).iter().map(polygon).collect(),
        ..MapParts::default()
    })
    .unwrap()
}

fn lane(row: &Value) -> Lane {
    let centerline = Polyline::new(points(&row["line"])).unwrap();
    let elevation = vec![0.0; centerline.points().len()];
    Lane {
        in_intersection: row["connector"].as_bool().unwrap(),
        speed_limit: row["limit"].as_f64(),
        outline: Some(polygon(&row["outline"])),
        roadblock: Some(RoadblockId(id(&row["block"]))),
        successors: list(&row["next"]).iter().map(|n| LaneId(id(n))).collect(),
        ..Lane::new(LaneId(id(&row["id"])), centerline, elevation)
    }
}

fn block(row: &Value) -> Roadblock {
    Roadblock {
        id: RoadblockId(id(&row["id"])),
        outline: polygon(&row["outline"]),
        in_intersection: row["connector"].as_bool().unwrap(),
        predecessors: Vec::new(),
        successors: Vec::new(),
    }
}

fn id(value: &Value) -> i64 {
    value.as_i64().unwrap()
}

fn points(value: &Value) -> Vec<DVec2> {
    let point = |point: &Value| dvec2(number(&point[0]), number(&point[1]));
    list(value).iter().map(point).collect()
}

fn polygon(value: &Value) -> Polygon {
    Polygon::new(points(value)).unwrap()
}
