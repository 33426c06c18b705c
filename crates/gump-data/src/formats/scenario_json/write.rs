//! Writes scenarios in the layout of the reader.

use std::collections::BTreeMap;
use std::io::Write as _;
use std::path::Path;

use flate2::Compression;
use flate2::write::GzEncoder;
use gump_geometry::DVec2;
use gump_scene::{Agent, AgentId, AgentKind, AreaKind, LaneId, LightState, RoadEdgeKind, Scenario};
use serde_json::{Map, Value, json};

use super::map::{lane_name, line_name};
use super::{NAME, VERSION};
use crate::io::stream::io_error;
use crate::{DataError, write_atomically};

/// Writes a scenario to a file, compressed if its name ends in `.gz`.
///
/// The layout cannot represent routes, tags, roadblocks, outlines of lanes, stop lines and areas of
/// intersections; they are dropped.
///
/// # Errors
/// [`DataError::Io`].
pub fn write_scenario(path: &Path, scenario: &Scenario) -> Result<(), DataError> {
    let document = document(scenario);
    let packed = path.extension().is_some_and(|ending| ending == "gz");
    write_atomically(path, |file| {
        let result = if packed {
            let mut packer = GzEncoder::new(file, Compression::default());
            let written = serde_json::to_writer(&mut packer, &document).map_err(Into::into);
            written.and_then(|()| packer.finish()?.flush())
        } else {
            serde_json::to_writer(file, &document).map_err(Into::into)
        };
        result.map_err(|e| io_error("write", e, path))
    })
}

fn document(scenario: &Scenario) -> Value {
    let n = scenario.log.len();
    let stamps: Vec<f64> = (0..n)
        .map(|i| (i as f64 * scenario.dt * 1e6).round() / 1e6)
        .collect();
    let targets: Map<String, Value> = scenario
        .targets
        .iter()
        .map(|id| (id.to_string(), json!({"track_id": id.0})))
        .collect();
    let interesting: Vec<i64> = scenario.objects_of_interest.iter().map(|id| id.0).collect();
    json!({
        "format": NAME,
        "version": VERSION,
        "id": scenario.id,
        "length": n,
        "metadata": {
            "ts": stamps,
            "sdc_id": scenario.ego.to_string(),
            "current_time_index": scenario.now,
            "tracks_to_predict": targets,
            "objects_of_interest": interesting,
        },
        "tracks": tracks(scenario),
        "dynamic_map_states": lights(scenario),
        "map_features": features(scenario),
    })
}

fn tracks(scenario: &Scenario) -> Map<String, Value> {
    let n = scenario.log.len();
    let mut by_id: BTreeMap<AgentId, Vec<Option<&Agent>>> = BTreeMap::new();
    for (step, frame) in scenario.log.iter().enumerate() {
        for agent in frame.agents() {
            by_id.entry(agent.id).or_insert_with(|| vec![None; n])[step] = Some(agent);
        }
    }
    let column = |states: &[Option<&Agent>], of: fn(&Agent) -> Value, absent: Value| -> Value {
        states
            .iter()
            .map(|state| state.map_or_else(|| absent.clone(), of))
            .collect()
    };
    let track = |(id, states): (&AgentId, &Vec<Option<&Agent>>)| {
        let kind = states
            .iter()
            .flatten()
            .next()
            .map_or(AgentKind::Other, |agent| agent.kind);
        let value = json!({
            "type": kind_name(kind),
            "state": {
                "valid": column(states, |_| json!(true), json!(false)),
                "position": column(states, |a| {
                    let p = a.state.pose.position;
                    json!([p.x, p.y, a.elevation])
                }, json!([0.0, 0.0, 0.0])),
                "heading": column(states, |a| json!(a.state.pose.heading), json!(0.0)),
                "velocity": column(states, |a| point(a.state.velocity), json!([0.0, 0.0])),
                "length": column(states, |a| json!(a.length), json!(0.0)),
                "width": column(states, |a| json!(a.width), json!(0.0)),
                "height": column(states, |a| json!(a.height), json!(0.0)),
            },
        });
        (id.to_string(), value)
    };
    by_id.iter().map(track).collect()
}

fn kind_name(kind: AgentKind) -> &'static str {
    match kind {
        AgentKind::Vehicle => "VEHICLE",
        AgentKind::Pedestrian => "PEDESTRIAN",
        AgentKind::Bicycle => "CYCLIST",
        AgentKind::TrafficCone => "TRAFFIC_CONE",
        AgentKind::Barrier => "TRAFFIC_BARRIER",
        AgentKind::Sign => "TRAFFIC_SIGN",
        AgentKind::Other => "OTHER",
    }
}

fn lights(scenario: &Scenario) -> Map<String, Value> {
    let n = scenario.log.len();
    let mut by_lane: BTreeMap<LaneId, (Vec<Value>, Option<DVec2>)> = BTreeMap::new();
    for (step, frame) in scenario.log.iter().enumerate() {
        for light in frame.lights() {
            let name = match light.state {
                LightState::Green => "LANE_STATE_GO",
                LightState::Yellow => "LANE_STATE_CAUTION",
                LightState::Red => "LANE_STATE_STOP",
                LightState::Unknown => "LANE_STATE_UNKNOWN",
            };
            let entry = by_lane.entry(light.lane);
            let (states, stop) = entry.or_insert_with(|| (vec![Value::Null; n], None));
            states[step] = json!(name);
            *stop = stop.or(light.stop_point);
        }
    }
    let signal = |(lane, (states, stop)): (LaneId, (Vec<Value>, Option<DVec2>))| {
        let value = json!({
            "type": "TRAFFIC_LIGHT",
            "lane": lane.0,
            "stop_point": stop.map(point),
            "state": {"object_state": states},
        });
        (lane.to_string(), value)
    };
    by_lane.into_iter().map(signal).collect()
}

fn point(p: DVec2) -> Value {
    json!([p.x, p.y])
}

fn points(plane: &[DVec2], heights: &[f64]) -> Value {
    plane
        .iter()
        .zip(heights)
        .map(|(p, z)| json!([p.x, p.y, z]))
        .collect()
}

fn features(scenario: &Scenario) -> Map<String, Value> {
    let (map, mut features) = (&scenario.map, Map::new());
    let ids = |ids: &[LaneId]| ids.iter().map(|id| id.0).collect::<Vec<_>>();
    for lane in map.lanes() {
        let value = json!({
            "type": lane_name(lane.kind),
            "polyline": points(lane.centerline.points(), &lane.elevation),
            "width": lane.width,
            "speed_limit_kmh": lane.speed_limit.map(|limit| limit * 3.6),
            "interpolating": lane.in_intersection,
            "entry_lanes": ids(&lane.predecessors),
            "exit_lanes": ids(&lane.successors),
            "left_neighbor": ids(&lane.left_neighbors),
            "right_neighbor": ids(&lane.right_neighbors),
        });
        features.insert(lane.id.to_string(), value);
    }
    // Formats may number lines and lanes apart; a key names one feature.
    let mut add = |what: &str, id: i64, value: Value| {
        let plain = id.to_string();
        let key = if features.contains_key(&plain) {
            format!("{what} {id}")
        } else {
            plain
        };
        features.insert(key, value);
    };
    for line in map.road_lines() {
        let shape = points(line.line.points(), &line.elevation);
        add(
            "line",
            line.id,
            json!({"type": line_name(line.kind), "polyline": shape}),
        );
    }
    for edge in map.road_edges() {
        let kind = match edge.kind {
            RoadEdgeKind::Median => "ROAD_EDGE_MEDIAN",
            RoadEdgeKind::Boundary | RoadEdgeKind::Unknown => "ROAD_EDGE_BOUNDARY",
        };
        let shape = points(edge.line.points(), &edge.elevation);
        add("edge", edge.id, json!({"type": kind, "polyline": shape}));
    }
    for area in map.areas() {
        let kind = match area.kind {
            AreaKind::Crosswalk => "CROSSWALK",
            AreaKind::SpeedBump => "SPEED_BUMP",
            AreaKind::Driveway => "DRIVEWAY",
            _ => continue,
        };
        let shape = points(area.polygon.ring(), &area.elevation);
        add("area", area.id, json!({"type": kind, "polygon": shape}));
    }
    for sign in map.stop_signs() {
        let position = sign.position.to_array();
        let lanes = ids(&sign.lanes);
        add(
            "sign",
            sign.id,
            json!({"type": "STOP_SIGN", "position": position, "lane": lanes}),
        );
    }
    for (i, surface) in map.drivable().iter().enumerate() {
        let shape: Value = surface.ring().iter().copied().map(point).collect();
        add(
            "surface",
            i as i64,
            json!({"type": "DRIVABLE_AREA", "polygon": shape}),
        );
    }
    features
}
