//! nuPlan's readers against what the official devkit reads from the same files.

#![allow(
    clippy::unwrap_used,
    reason = "a golden that cannot be read fails its test"
)]

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::sync::Arc;

use gump_data::DataError;
use gump_data::nuplan::{
    EGO, Event, Extraction, Log, Maps, NuplanScenario, ScenarioFilter, Split, Token, Utm, read_map,
};
use gump_geometry::{DVec2, Pose, dvec2, wrap_angle};
use gump_scene::{
    AgentKind, AreaKind, EgoState, Lane, LaneId, LightState, MapGraph, RoadblockId,
    VehicleParameters,
};
use serde_json::Value;

#[path = "common/nuplan.rs"]
mod common;

use common::{DATA, Folder};

fn golden(name: &str) -> Value {
    let text = fs::read_to_string(Path::new(DATA).join(name)).unwrap();
    serde_json::from_str(&text).unwrap()
}

fn number(value: &Value) -> f64 {
    match value.as_str() {
        Some("nan") => f64::NAN,
        _ => value.as_f64().unwrap(),
    }
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(number).collect()
}

fn ids(value: &Value) -> Vec<i64> {
    let texts = value.as_array().unwrap().iter();
    texts
        .map(|id| id.as_str().unwrap().parse().unwrap())
        .collect()
}

#[track_caller]
fn close(found: f64, expected: f64, tolerance: f64, what: &str) {
    assert!(
        (found - expected).abs() <= tolerance,
        "{what}: expected {expected}, found {found}"
    );
}

#[track_caller]
fn close_pose(found: Pose, expected: &[f64], tolerance: f64, what: &str) {
    close(found.position.x, expected[0], tolerance, what);
    close(found.position.y, expected[1], tolerance, what);
    close(
        wrap_angle(found.heading - expected[2]),
        0.0,
        tolerance,
        what,
    );
}

#[test]
fn places_are_projected_as_proj_does() {
    let rows = golden("utm.json");
    for row in rows["rows"].as_array().unwrap() {
        let zone = Utm::from_epsg(row[1].as_i64().unwrap()).unwrap();
        let found = zone.project(number(&row[2]), number(&row[3]));
        let expected = dvec2(number(&row[4]), number(&row[5]));
        assert!(found.distance(expected) < 1e-6, "{row}: {found}");
    }
}

fn city() -> MapGraph {
    let map = read_map(&Folder::new().map()).unwrap();
    assert_eq!(map.epsg, 32611);
    assert!(map.report.dropped.is_empty(), "{:?}", map.report.dropped);
    Arc::unwrap_or_clone(map.graph)
}

fn split<'a>(lanes: impl Iterator<Item = &'a Lane>) -> [Vec<i64>; 2] {
    let (connectors, lanes): (Vec<_>, Vec<_>) = lanes.partition(|lane| lane.in_intersection);
    [lanes, connectors].map(|lanes| lanes.iter().map(|lane| lane.id.0).collect())
}

#[test]
fn places_are_in_the_same_lanes_areas_and_roadblocks() {
    let map = city();
    let golden = golden("synth_map_queries.json");
    let queries = golden["queries"].as_array().unwrap();
    assert_eq!(queries.len(), 180);
    for query in queries {
        let point = dvec2(number(&query[0]), number(&query[1]));
        let [lanes, connectors] = split(map.lanes_containing(point));
        assert_eq!(lanes, ids(&query[2]), "lanes at {point}");
        assert_eq!(connectors, ids(&query[3]), "connectors at {point}");
        let flag = |value: &Value| value.as_i64().unwrap() == 1;
        assert_eq!(
            map.is_drivable(point),
            flag(&query[4]),
            "drivable at {point}"
        );
        let within = |kind| map.areas_containing(point, kind).next().is_some();
        assert_eq!(
            within(AreaKind::Intersection),
            flag(&query[5]),
            "intersection at {point}"
        );
        let distance = map.drivable_distance(point).unwrap();
        close(distance, number(&query[6]), 1e-5, "distance to the road");
        let (inside, plain): (Vec<_>, Vec<_>) = map
            .roadblocks_containing(point)
            .partition(|b| b.in_intersection);
        let plain: Vec<i64> = plain.iter().map(|b| b.id.0).collect();
        assert_eq!(plain, ids(&query[7]), "roadblocks at {point}");
        let inside: Vec<i64> = inside.iter().map(|b| b.id.0).collect();
        assert_eq!(inside, ids(&query[8]), "roadblock connectors at {point}");
        assert_eq!(
            within(AreaKind::TurnStop),
            flag(&query[9]),
            "turn stop at {point}"
        );
        for (id, nearest) in query[10].as_object().unwrap() {
            let lane = map.lane(LaneId(id.parse().unwrap())).unwrap();
            let expected = numbers(nearest);
            let foot = lane.centerline.project(point).arc_length;
            close(foot, expected[0], 1e-5, "arc length");
            let place = lane.centerline.pose_at(foot).position;
            close(
                place.distance(dvec2(expected[1], expected[2])),
                0.0,
                1e-5,
                "foot",
            );
        }
    }
}

#[test]
fn lanes_and_connectors_have_the_same_attributes_and_links() {
    let map = city();
    let golden = golden("synth_map_queries.json");
    let objects = golden["objects"].as_object().unwrap();
    assert_eq!(map.lanes().len(), objects.len());
    for (id, object) in objects {
        let lane = map.lane(LaneId(id.parse().unwrap())).unwrap();
        let links = |lanes: &[LaneId]| lanes.iter().map(|id| id.0).collect::<Vec<_>>();
        assert_eq!(lane.in_intersection, object["kind"] == "connector", "{id}");
        assert_eq!(links(&lane.predecessors), ids(&object["inc"]), "{id}");
        assert_eq!(links(&lane.successors), ids(&object["out"]), "{id}");
        let block: i64 = object["roadblock"].as_str().unwrap().parse().unwrap();
        assert_eq!(lane.roadblock, Some(RoadblockId(block)), "{id}");
        assert_eq!(lane.speed_limit, object["speed"].as_f64(), "{id}");
        close(
            lane.centerline.length(),
            number(&object["length"]),
            1e-5,
            id,
        );
        let points = lane.centerline.points();
        for (key, point) in [("first", points[0]), ("last", points[points.len() - 1])] {
            let expected = numbers(&object[key]);
            close(
                point.distance(dvec2(expected[0], expected[1])),
                0.0,
                1e-5,
                id,
            );
        }
        let side = |key: &str| -> Vec<i64> {
            let id = object.get(key).and_then(Value::as_str);
            id.map(|id| id.parse().unwrap()).into_iter().collect()
        };
        assert_eq!(links(&lane.left_neighbors), side("left"), "{id}");
        assert_eq!(links(&lane.right_neighbors), side("right"), "{id}");
        let has_lights = object.get("has_tl").and_then(Value::as_bool);
        assert_eq!(lane.has_lights, Some(has_lights.unwrap_or(false)), "{id}");
        if lane.in_intersection {
            let stops: Vec<i64> = map.stop_lines(lane.id).map(|area| area.id).collect();
            assert_eq!(stops, ids(&object["stop_lines"]), "{id}");
            let area = lane.outline.as_ref().unwrap().signed_area().abs();
            close(area, number(&object["area"]), 1e-4, id);
        }
        close(lane.width, 3.5, 0.02, id);
    }
}

#[test]
fn a_square_finds_what_the_devkit_finds_nearby() {
    let map = city();
    let golden = golden("synth_map_queries.json");
    let expected = &golden["proximal_30m_at_minus10_0"];
    let sorted = |mut ids: Vec<i64>| {
        ids.sort_unstable();
        ids
    };
    let (center, half) = (dvec2(664_490.0, 3_998_500.0), 30.0);
    let [lanes, connectors] = split(map.lanes_in_square(center, half));
    assert_eq!(sorted(lanes), ids(&expected["LANE"]));
    assert_eq!(sorted(connectors), ids(&expected["LANE_CONNECTOR"]));
    let blocks = |inside| {
        let blocks = map.roadblocks_in_square(center, half);
        let ids = blocks
            .filter(|b| b.in_intersection == inside)
            .map(|b| b.id.0);
        sorted(ids.collect())
    };
    assert_eq!(blocks(false), ids(&expected["ROADBLOCK"]));
    assert_eq!(blocks(true), ids(&expected["ROADBLOCK_CONNECTOR"]));
    for (key, kind) in [
        ("STOP_LINE", AreaKind::StopLine),
        ("CROSSWALK", AreaKind::Crosswalk),
        ("INTERSECTION", AreaKind::Intersection),
        ("CARPARK_AREA", AreaKind::Carpark),
    ] {
        let found = map.areas_in_square(center, half, kind).map(|area| area.id);
        assert_eq!(sorted(found.collect()), ids(&expected[key]), "{key}");
    }
}

fn token(value: &Value) -> Token {
    value.as_str().unwrap().parse().unwrap()
}

fn event(log: &Log) -> Event {
    let golden = golden("synth_readers.json");
    log.event(token(&golden["event_token"])).unwrap().unwrap()
}

fn scenario() -> NuplanScenario {
    let folder = Folder::new();
    let log = Log::open(&folder.log()).unwrap();
    let map = Maps::default().of(&log).unwrap();
    let event = event(&log);
    let kind = "stopping_with_lead";
    NuplanScenario::read(&log, &event, kind, &map.graph, &Extraction::default()).unwrap()
}

/// Rows of the golden: time, x, y, heading, vx, vy, ax, ay, steering.
#[track_caller]
fn same_ego(found: &EgoState, expected: &Value) {
    let row = numbers(expected);
    assert_eq!(found.time_us, expected[0].as_i64().unwrap());
    close_pose(found.rear_axle, &row[1..4], 1e-6, "rear axle");
    close(
        found.velocity.distance(dvec2(row[4], row[5])),
        0.0,
        1e-6,
        "velocity",
    );
    close(
        found.acceleration.distance(dvec2(row[6], row[7])),
        0.0,
        1e-6,
        "acceleration",
    );
    close(found.steering_angle, row[8], 0.0, "steering");
}

#[test]
fn the_filter_by_type_selects_what_the_devkit_selects() {
    let folder = Folder::new();
    let golden = golden("synth_readers.json");
    let expected = golden["scenarios_filtered_by_type"].as_array().unwrap();
    let log = Log::open(&folder.log()).unwrap();
    let types = expected
        .iter()
        .map(|row| row[3].as_str().unwrap().to_owned());
    let filter = ScenarioFilter {
        types: Some(types.collect()),
        ..ScenarioFilter::default()
    };
    let selected = filter.select(std::slice::from_ref(&log)).unwrap();
    assert_eq!(selected.len(), expected.len());
    for (found, row) in selected.iter().zip(expected) {
        assert_eq!(found.event.token, token(&row[0]));
        assert_eq!(found.event.time_us, row[1].as_i64().unwrap());
        assert_eq!(log.map_name(), row[2]);
        assert_eq!(found.scenario_type, row[3].as_str().unwrap());
    }
}

#[test]
fn iterations_history_and_expert_are_those_of_the_devkit() {
    let golden = golden("synth_readers.json");
    let scenario = scenario();
    assert_eq!(scenario.scenario_type, golden["scenario_type"]);
    let n = golden["n_iterations"].as_u64().unwrap() as usize;
    assert_eq!(scenario.iterations.len(), n);
    let first = golden["iteration_tokens_first5"].as_array().unwrap();
    let last = golden["iteration_tokens_last2"].as_array().unwrap();
    for (frame, expected) in scenario.iterations.iter().zip(first) {
        assert_eq!(frame.token, token(expected));
    }
    for (frame, expected) in scenario.iterations[n - 2..].iter().zip(last) {
        assert_eq!(frame.token, token(expected));
    }
    let times = golden["timestamps"].as_array().unwrap();
    for (frame, expected) in scenario.iterations.iter().zip(times) {
        assert_eq!(frame.ego.time_us, expected.as_i64().unwrap());
    }
    let past = golden["ego_past_22"].as_array().unwrap();
    assert_eq!(scenario.history.len(), past.len());
    for (frame, expected) in scenario.history.iter().zip(past) {
        same_ego(&frame.ego, expected);
    }
    for (frame, expected) in scenario
        .iterations
        .iter()
        .zip(golden["expert"].as_array().unwrap())
    {
        same_ego(&frame.ego, expected);
    }
    let future = golden["ego_future_8s_8"].as_array().unwrap();
    let each_second = scenario.expert().skip(10).step_by(10);
    assert!(
        scenario.expert().count() > n,
        "the expert goes on after the last iteration"
    );
    for (state, expected) in each_second.zip(future) {
        same_ego(&state, expected);
    }
}

#[test]
fn objects_lights_goal_and_route_are_those_of_the_devkit() {
    let golden = golden("synth_readers.json");
    let scenario = scenario();
    const KINDS: [AgentKind; 7] = [
        AgentKind::Vehicle,
        AgentKind::Pedestrian,
        AgentKind::Bicycle,
        AgentKind::TrafficCone,
        AgentKind::Barrier,
        AgentKind::Sign,
        AgentKind::Other,
    ];
    for (index, rows) in golden["tracked_objects"].as_object().unwrap() {
        let frame = &scenario.iterations[index.parse::<usize>().unwrap()];
        let rows = rows.as_array().unwrap();
        assert_eq!(frame.objects.len(), rows.len());
        for (agent, row) in frame.objects.iter().zip(rows) {
            assert_eq!(scenario.track(agent.id), Some(token(&row[0])));
            assert_eq!(agent.kind, KINDS[row[1].as_u64().unwrap() as usize]);
            let row: Vec<f64> = row.as_array().unwrap()[2..].iter().map(number).collect();
            close_pose(agent.state.pose, &row[..3], 1e-6, "object");
            close(agent.length, row[3], 1e-6, "length");
            close(agent.width, row[4], 1e-6, "width");
            let velocity = row.get(5..7).map_or(DVec2::ZERO, |v| dvec2(v[0], v[1]));
            close(
                agent.state.velocity.distance(velocity),
                0.0,
                1e-6,
                "velocity",
            );
        }
    }
    let counts = golden["past_tracked_objects_counts"].as_array().unwrap();
    for (frame, count) in scenario.history.iter().zip(counts) {
        assert_eq!(frame.objects.len() as u64, count.as_u64().unwrap());
    }
    let names = BTreeMap::from([
        (LightState::Green, "GREEN"),
        (LightState::Yellow, "YELLOW"),
        (LightState::Red, "RED"),
        (LightState::Unknown, "UNKNOWN"),
    ]);
    for (index, rows) in golden["traffic_lights"].as_object().unwrap() {
        let frame = &scenario.iterations[index.parse::<usize>().unwrap()];
        let found: Vec<(i64, &str)> = frame
            .lights
            .iter()
            .map(|light| (light.lane.0, names[&light.state]))
            .collect();
        let expected: Vec<(i64, &str)> = rows
            .as_array()
            .unwrap()
            .iter()
            .map(|row| (row[0].as_i64().unwrap(), row[1].as_str().unwrap()))
            .collect();
        assert_eq!(found, expected, "iteration {index}");
    }
    let goal = numbers(&golden["mission_goal"]);
    close_pose(scenario.goal.unwrap(), &goal, 1e-6, "goal");
    let route: Vec<i64> = scenario.roadblocks.iter().map(|id| id.0).collect();
    assert_eq!(route, ids(&golden["route_roadblock_ids"]));
}

#[test]
fn a_scenario_of_ours_has_the_ego_at_its_box_centre_and_a_route_of_lanes() {
    let folder = Folder::new();
    let records: Vec<_> = gump_data::open(&folder.log()).unwrap().collect();
    assert_eq!(records.len(), 2);
    let record = records[0].as_ref().unwrap();
    let scenario = &record.scenario;
    assert_eq!(scenario.id, "af6639f0bc724ead");
    assert_eq!(
        (scenario.log.len(), scenario.now, scenario.dt),
        (173, 22, 0.1)
    );
    let tags: Vec<&str> = scenario.tags.iter().map(|tag| tag.name()).collect();
    assert_eq!(
        tags,
        [
            "on_stopline_traffic_light",
            "starting_straight_traffic_light_intersection_traversal",
            "stopping_with_lead"
        ]
    );
    let ego = scenario.present().ego_now();
    assert_eq!(ego.id, EGO);
    assert_eq!(ego.length, VehicleParameters::PACIFICA.length());
    close(
        ego.state.pose.position.x,
        664_443.001_72 + 1.461,
        1e-4,
        "centre",
    );
    let route = scenario.route.as_ref().unwrap();
    assert_eq!(route.roadblocks.len(), 5);
    // On the right lane, straight on to the last roadblock.
    assert_eq!(route.lanes, [102, 202, 106, 212, 114].map(LaneId));
    assert!(route.path.length() > 400.0);
    assert_eq!(scenario.present().now().agents().len(), 20);
}

#[test]
fn one_scenario_is_found_by_its_token() {
    let folder = Folder::new();
    let path = folder.log();
    let name = format!("{}#bb9890a09992ca53", path.display());
    assert_eq!(gump_data::find(&name).unwrap().id, "bb9890a09992ca53");
    let name = format!("{}#bb9890a09992ca54", path.display());
    let error = gump_data::find(&name).unwrap_err();
    assert!(
        matches!(error, DataError::NoSuchScenario { found: 2, .. }),
        "{error}"
    );
}

#[test]
fn a_published_split_selects_nothing_here_and_the_census_says_why() {
    let folder = Folder::new();
    let log = Log::open(&folder.log()).unwrap();
    let census = log.census().unwrap();
    assert_eq!(
        (census.rows, census.scenes, census.tagged, census.usable),
        (760, 10, 2, 2)
    );
    let filter = Split::Val14.filter();
    let why = filter.explain(&census);
    assert!(
        why.contains("760 rows in 10 scenes, 2 of them tagged"),
        "{why}"
    );
    assert!(why.contains("it lacks starting_left_turn, "), "{why}");
    assert!(why.contains("stopping_with_lead 1"), "{why}");
    assert!(filter.select(&[log]).unwrap().is_empty());
}
