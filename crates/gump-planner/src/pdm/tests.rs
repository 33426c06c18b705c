//! Every intermediate result of the planner against its authors' code, on scenes made by hand.

use std::collections::BTreeSet;
use std::sync::Arc;

use approx::assert_abs_diff_eq;
use gump_geometry::{Polygon, Polyline, Pose, angle_difference, dvec2};
use gump_scene::{
    Agent, AgentId, AgentKind, AgentState, Area, AreaKind, Frame, Lane, LaneId, Light, LightState,
    MapGraph, MapParts, Roadblock, RoadblockId, Route, SceneState, VehicleParameters,
};
use serde_json::Value;

use super::*;
use forecast::Token;

/// Half a unit in the last place of the goldens, with room for sums.
const TOLERANCE: f64 = 1e-5;

fn rows(value: &Value) -> Vec<Vec<f64>> {
    value.as_array().unwrap().iter().map(numbers).collect()
}

/// Numbers; anything else (infinities are words) is read as infinity.
fn numbers(value: &Value) -> Vec<f64> {
    let list = value.as_array().unwrap().iter();
    list.map(|v| v.as_f64().unwrap_or(f64::INFINITY)).collect()
}

fn read(name: &str) -> Value {
    let path = format!(
        "{}/tests/data/nuplan/{name}.json",
        env!("CARGO_MANIFEST_DIR")
    );
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

fn id(value: &Value) -> i64 {
    value
        .as_i64()
        .unwrap_or_else(|| value.as_str().unwrap().parse().unwrap())
}

fn ids<T>(value: &Value, wrap: fn(i64) -> T) -> Vec<T> {
    value
        .as_array()
        .unwrap()
        .iter()
        .map(|v| wrap(id(v)))
        .collect()
}

fn points(value: &Value) -> Vec<gump_geometry::DVec2> {
    rows(value)
        .iter()
        .map(|row| dvec2(row[0], row[1]))
        .collect()
}

/// The synthetic intersection that the goldens were made on.
fn map() -> Arc<MapGraph> {
    let golden = read("map");
    let list = |key: &str| golden[key].as_array().unwrap().clone();
    let outline = |v: &Value| Polygon::new(points(&v["outline"])).unwrap();
    let lanes = list("lanes").into_iter().map(|v: Value| {
        let line = Polyline::new(points(&v["line"])).unwrap();
        let elevation = vec![0.0; line.points().len()];
        Lane {
            speed_limit: v["limit"].as_f64(),
            in_intersection: v["connector"].as_bool().unwrap(),
            outline: Some(outline(&v)),
            roadblock: Some(RoadblockId(id(&v["block"]))),
            has_lights: v["lights"].as_bool(),
            successors: ids(&v["next"], LaneId),
            ..Lane::new(LaneId(id(&v["id"])), line, elevation)
        }
    });
    let roadblocks = list("blocks").into_iter().map(|v: Value| Roadblock {
        id: RoadblockId(id(&v["id"])),
        outline: outline(&v),
        in_intersection: v["connector"].as_bool().unwrap(),
        predecessors: ids(&v["prev"], RoadblockId),
        successors: ids(&v["next"], RoadblockId),
    });
    let areas = list("areas").into_iter().map(|v: Value| {
        let kind = match v["kind"].as_str().unwrap() {
            "intersection" => AreaKind::Intersection,
            "carpark" => AreaKind::Carpark,
            _ => AreaKind::StopLine,
        };
        Area {
            lanes: ids(&v["lanes"], LaneId),
            ..Area::new(id(&v["id"]), kind, outline(&v))
        }
    });
    let parts = MapParts {
        lanes: lanes.collect(),
        roadblocks: roadblocks.collect(),
        areas: areas.collect(),
        ..MapParts::default()
    };
    Arc::new(MapGraph::new(parts).unwrap())
}

fn ego(row: &[f64]) -> EgoState {
    EgoState {
        time_us: row[0] as i64,
        rear_axle: Pose::new(row[1], row[2], row[3]),
        velocity: dvec2(row[4], row[5]),
        acceleration: dvec2(row[6], row[7]),
        steering_angle: row[8],
        yaw_rate: row[9],
        yaw_acceleration: row[10],
        steering_rate: row[11],
    }
}

fn frame(input: &Value, ego_state: &EgoState) -> Frame {
    let car = VehicleParameters::PACIFICA;
    let mut agents = vec![Agent {
        id: AgentId(-1),
        kind: AgentKind::Vehicle,
        length: car.length(),
        width: car.width,
        height: car.height,
        elevation: 0.0,
        state: ego_state.agent_state(&car),
    }];
    let kinds = [
        AgentKind::Vehicle,
        AgentKind::Pedestrian,
        AgentKind::Bicycle,
        AgentKind::TrafficCone,
        AgentKind::Barrier,
        AgentKind::Sign,
        AgentKind::Other,
    ];
    for (i, track) in input["tracks"].as_array().unwrap().iter().enumerate() {
        let n = |k: usize| track.get(k).and_then(Value::as_f64).unwrap_or(0.0);
        agents.push(Agent {
            id: AgentId(i as i64),
            kind: kinds[n(1) as usize],
            length: n(5),
            width: n(6),
            height: 1.5,
            elevation: 0.0,
            state: AgentState {
                pose: Pose::new(n(2), n(3), n(4)),
                velocity: dvec2(n(7), n(8)),
            },
        });
    }
    let lights = input["traffic_lights"]
        .as_array()
        .unwrap()
        .iter()
        .map(|light| Light {
            lane: LaneId(id(&light[0])),
            state: match light[1].as_str().unwrap() {
                "RED" => LightState::Red,
                "GREEN" => LightState::Green,
                "YELLOW" => LightState::Yellow,
                _ => LightState::Unknown,
            },
            stop_point: None,
        });
    Frame::new(agents, lights.collect())
}

fn check(map: &Arc<MapGraph>, name: &str, golden: &Value) {
    let input = &golden["input"];
    let state = ego(&numbers(&input["ego"]));
    let route = Arc::new(Route {
        lanes: Vec::new(),
        roadblocks: ids(&input["route"], RoadblockId),
        path: Polyline::new(vec![dvec2(0.0, 0.0)]).unwrap(),
    });
    let history = [frame(input, &state)];
    let moment = PlannerInput {
        iteration: 0,
        scene: SceneState {
            map,
            route: Some(&route),
            history: &history,
            ego: AgentId(-1),
            dt: 0.1,
        },
        ego: &state,
        past: &[],
    };
    let mut planner = PdmClosed::default();
    let initialization = PlannerInitialization {
        map,
        route: Some(&route),
        goal: None,
        vehicle: VehicleParameters::PACIFICA,
    };
    planner.start(&initialization).unwrap();
    let plan = planner.drive(&moment).unwrap();
    check_ground(name, &planner, golden);
    check_proposals(name, planner.thought(), golden);
    check_scores(name, planner.thought(), golden);
    assert_eq!(
        planner.best() as i64,
        golden["best"].as_i64().unwrap(),
        "{name}"
    );
    assert_eq!(
        plan.states().len() as i64,
        golden["trajectory_n"].as_i64().unwrap()
    );
    for (found, row) in plan
        .states()
        .iter()
        .step_by(5)
        .zip(rows(&golden["trajectory"]))
    {
        assert_eq!(found.time_us, row[0] as i64, "{name}");
        check_pose(name, found.rear_axle, &row[1..]);
    }
}

fn check_pose(name: &str, found: Pose, row: &[f64]) {
    let off = found.position.distance(dvec2(row[0], row[1]));
    assert!(off < TOLERANCE, "{name}: {found:?} is {off} m off {row:?}");
    let turned = angle_difference(found.heading, row[2]);
    assert!(
        turned.abs() < TOLERANCE,
        "{name}: {found:?} is turned off {row:?}"
    );
}

fn check_ground(name: &str, planner: &PdmClosed, golden: &Value) {
    let state = planner.state.as_ref().unwrap();
    let path = &state.centerline().path;
    assert_abs_diff_eq!(
        path.length(),
        golden["centerline_len"].as_f64().unwrap(),
        epsilon = 1e-5
    );
    assert_eq!(
        path.poses().count() as i64,
        golden["centerline_n"].as_i64().unwrap(),
        "{name}"
    );
    for (pose, row) in path.poses().zip(rows(&golden["centerline_xyh_head"])) {
        check_pose(name, pose, &row);
    }
    let mut lanes: Vec<i64> = state.ground.lanes().map(|lane| lane.0).collect();
    lanes.sort_unstable();
    let drivable: BTreeSet<i64> = ids(&golden["drivable_tokens"], |id| id)
        .into_iter()
        .collect();
    let known: BTreeSet<i64> = lanes.iter().copied().collect();
    assert!(
        known.is_subset(&drivable),
        "{name}: {known:?} and {drivable:?}"
    );
    let n_seen = golden["observation_tokens_t0"].as_array().unwrap().len();
    let found = state.forecast.objects.len() + state.forecast.red_lights.len();
    assert_eq!(found, n_seen, "{name}");
    let n_collided = golden["collided_track_ids"].as_array().unwrap().len();
    assert_eq!(state.forecast.collided.len(), n_collided, "{name}");
    assert!(
        state
            .forecast
            .collided
            .iter()
            .all(|t| matches!(t, Token::Agent(_) | Token::RedLight(_)))
    );
}

fn check_proposals(name: &str, thought: &Thought, golden: &Value) {
    for (i, proposal) in thought.proposals.iter().enumerate() {
        let leads = rows(&golden["leading"][i]);
        let states = rows(&golden["idm_states"][i]);
        assert_eq!(proposal.states.len(), states.len());
        for (k, (drive, row)) in proposal.states.iter().zip(&states).enumerate() {
            let lead = proposal.leads[k];
            for (found, expected) in [lead.progress, lead.speed, lead.rear].iter().zip(&leads[k]) {
                let off = (found - expected).abs();
                assert!(
                    off < TOLERANCE,
                    "{name} {i} {k}: lead {lead:?}, not {:?}",
                    leads[k]
                );
            }
            let off = (drive.progress - row[0])
                .abs()
                .max((drive.speed - row[1]).abs());
            assert!(off < TOLERANCE, "{name} {i} {k}: {drive:?}, not {row:?}");
        }
        for (k, row) in [10, 20, 30, 40]
            .iter()
            .zip(rows(&golden["proposals_t10_20_30_40"][i]))
        {
            check_pose(name, proposal.poses[*k], &row);
        }
        for (k, row) in [0, 1, 10, 20, 40]
            .iter()
            .zip(rows(&golden["simulated_t0_1_10_20_40"][i]))
        {
            let state = thought.drives[i][*k];
            check_pose(name, state.rear_axle, &row);
            let found = [
                state.velocity.x,
                state.velocity.y,
                state.acceleration.x,
                state.acceleration.y,
                state.steering_angle,
                state.steering_rate,
                state.yaw_rate,
                state.yaw_acceleration,
            ];
            for (field, (found, expected)) in found.iter().zip(&row[3..]).enumerate() {
                let off = (found - expected).abs();
                assert!(
                    off < TOLERANCE,
                    "{name} {i} {k} field {field}: {found}, not {expected}"
                );
            }
        }
    }
}

fn check_scores(name: &str, thought: &Thought, golden: &Value) {
    let gates = rows(&golden["multi_metrics"]);
    let terms = rows(&golden["weighted_metrics"]);
    let raw = numbers(&golden["progress_raw"]);
    let totals = numbers(&golden["scores"]);
    let steps = |key: &str| -> Vec<Option<usize>> {
        let steps = numbers(&golden[key]).into_iter();
        steps
            .map(|step| step.is_finite().then_some(step as usize))
            .collect()
    };
    let (collisions, ttc) = (steps("collision_time_idx"), steps("ttc_time_idx"));
    for (i, score) in thought.scores.iter().enumerate() {
        let exact = [
            (score.no_at_fault_collision, gates[0][i], "collision"),
            (score.drivable_area, gates[1][i], "drivable area"),
            (score.driving_direction, gates[2][i], "direction"),
            (score.time_to_collision, terms[1][i], "time to collision"),
            (score.comfort, terms[2][i], "comfort"),
        ];
        for (found, expected, what) in exact {
            assert_eq!(found, expected, "{name} {i}: {what}");
        }
        assert_eq!(score.collision_step, collisions[i], "{name} {i}");
        assert_eq!(score.ttc_step, ttc[i], "{name} {i}");
        for (found, expected) in [
            (score.progress_m, raw[i]),
            (score.progress, terms[0][i]),
            (score.total, totals[i]),
        ] {
            assert!(
                (found - expected).abs() < TOLERANCE,
                "{name} {i}: {score:?}, not {expected}"
            );
        }
    }
}

#[test]
fn every_step_of_the_planner_agrees() {
    let map = map();
    let mut n = 0;
    for file in ["pdm_iterations_a", "pdm_iterations_b"] {
        for (name, golden) in read(file).as_object().unwrap() {
            check(&map, name, golden);
            n += 1;
        }
    }
    assert_eq!(n, 8);
}
