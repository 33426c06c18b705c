//! Motion-prediction measurements against the official C++ code, prediction by prediction, on
//! made-up scenarios.
//!
//! `golden/motion.json` holds two scenarios with 19 agents to predict, four sets of predictions
//! (the log, constant velocity, 8 noisy modes, 8 noisy joint modes) and what the metric code of
//! the Waymo Open Dataset (git 99a4cb3, C++, doubles) says about each. Nothing in it is recorded.
#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::sync::Arc;

use gump_geometry::{DVec2, Pose, dvec2, wrap_angle};
use gump_scene::{
    Agent, AgentId, AgentKind, AgentState, Frame, MapGraph, MapParts, PredictedMode, Prediction,
    Scenario,
};
use gump_wosac::motion::{
    MotionCell, MotionConfig, MotionProblem, MotionTally, PrecisionSamples, Shape, ShapeRules,
    evaluate_predictions, shape,
};
use serde_json::Value;

/// The reference prints f32 results with nine digits.
const TOLERANCE: f64 = 1e-6;

fn golden() -> Value {
    serde_json::from_str(include_str!("golden/motion.json")).unwrap()
}

/// An f32 that was printed with the fewest digits that identify it.
fn single(value: &Value) -> f64 {
    f64::from(value.as_f64().unwrap() as f32)
}

fn list(value: &Value) -> &[Value] {
    value.as_array().unwrap()
}

fn id(value: &Value) -> AgentId {
    AgentId(value.as_i64().unwrap())
}

fn scenario(golden: &Value, name: &str) -> Scenario {
    let all = list(&golden["scenarios"]);
    let found = all.iter().find(|s| s["id"] == name).unwrap();
    let tracks = list(&found["tracks"]);
    let n_frames = list(&tracks[0]["states"]).len();
    let frame = |step: usize| {
        let agents = tracks.iter().filter_map(|track| {
            let state = track["states"][step].as_array()?;
            let [length, width, heading, vx, vy] = [3, 4, 2, 5, 6].map(|i| single(&state[i]));
            let position = [0, 1].map(|i| state[i].as_f64().unwrap());
            Some(Agent {
                id: id(&track["id"]),
                kind: kind(&track["type"]),
                length,
                width,
                height: 1.5,
                elevation: 0.0,
                state: AgentState {
                    pose: Pose::new(position[0], position[1], wrap_angle(heading)),
                    velocity: dvec2(vx, vy),
                },
            })
        });
        Frame::new(agents.collect(), vec![])
    };
    Scenario {
        id: name.into(),
        map: Arc::new(MapGraph::new(MapParts::default()).unwrap()),
        route: None,
        log: (0..n_frames).map(frame).collect(),
        dt: 0.1,
        now: 0,
        ego: AgentId(0),
        targets: list(&found["targets"]).iter().map(id).collect(),
        objects_of_interest: vec![],
        tags: vec![],
    }
}

fn kind(object_type: &Value) -> AgentKind {
    match object_type.as_i64().unwrap() {
        1 => AgentKind::Vehicle,
        2 => AgentKind::Pedestrian,
        3 => AgentKind::Bicycle,
        _ => AgentKind::Other,
    }
}

fn prediction(value: &Value) -> Prediction {
    let point = |p: &Value| dvec2(single(&p[0]), single(&p[1]));
    let path = |path: &Value| list(path).iter().map(point).collect::<Vec<DVec2>>();
    let mode = |mode: &Value| PredictedMode {
        confidence: single(&mode["confidence"]),
        paths: list(&mode["paths"]).iter().map(path).collect(),
    };
    Prediction {
        agents: list(&value["agents"]).iter().map(id).collect(),
        modes: list(&value["modes"]).iter().map(mode).collect(),
    }
}

/// Measures one prediction alone.
fn measure(scenario: &Scenario, prediction: &Prediction) -> MotionTally {
    let mut alone = scenario.clone();
    alone.targets.clone_from(&prediction.agents);
    let config = MotionConfig::challenge();
    let prediction = std::slice::from_ref(prediction);
    MotionTally::of(&evaluate_predictions(&alone, prediction, &config).unwrap())
}

fn check_mean(name: &str, found: Option<f64>, expected: &Value) {
    match (found, expected["count"].as_i64().unwrap()) {
        (None, 0) => {}
        (Some(found), 1) => {
            let total = expected["total"].as_f64().unwrap();
            assert!(
                (found - total).abs() < TOLERANCE,
                "{name}: {found}, {total}"
            );
        }
        (found, count) => panic!("{name}: {found:?}, expected {count} measurements"),
    }
}

fn check_samples(name: &str, found: &PrecisionSamples, expected: &Value) {
    let n = expected["num_trajectories"].as_u64().unwrap();
    assert_eq!(found.n_predictions() as u64, n, "{name}");
    let samples = list(&expected["samples"]);
    assert_eq!(found.samples().len(), samples.len(), "{name}");
    for (found, expected) in found.samples().iter().zip(samples) {
        assert_eq!(found.confidence, single(&expected[0]), "{name}");
        assert_eq!(found.hit, expected[1] == 1, "{name}");
    }
}

fn check_shapes(
    name: &str,
    found: &std::collections::BTreeMap<Shape, PrecisionSamples>,
    expected: &Value,
) {
    let expected: Vec<&Value> = list(expected)
        .iter()
        .filter(|bucket| bucket["num_trajectories"] != 0)
        .collect();
    let found: Vec<_> = found
        .iter()
        .filter(|(_, s)| s.n_predictions() > 0)
        .collect();
    assert_eq!(found.len(), expected.len(), "{name}");
    for ((shape, samples), expected) in found.iter().zip(expected) {
        assert_eq!(waymo_name(**shape), expected["bucket"], "{name}");
        check_samples(name, samples, expected);
    }
}

fn waymo_name(shape: Shape) -> String {
    shape.name().to_uppercase().replace('-', "_")
}

fn check_cell(name: &str, cell: &MotionCell, expected: &Value) {
    check_mean(name, cell.min_ade.value(), &expected["min_ade"]);
    check_mean(name, cell.min_fde.value(), &expected["min_fde"]);
    check_mean(name, cell.miss_rate.value(), &expected["miss"]);
    check_mean(name, cell.overlap_rate.value(), &expected["overlap"]);
    check_shapes(name, &cell.precision, &expected["map_samples"]);
    check_shapes(name, &cell.soft_precision, &expected["soft_map_samples"]);
}

#[test]
fn every_prediction_measures_as_in_the_reference() {
    let golden = golden();
    let mut n_cells = 0;
    for set in list(&golden["sets"]) {
        let scenario = scenario(&golden, set["scenario"].as_str().unwrap());
        let predictions: Vec<_> = list(&set["predictions"]).iter().map(prediction).collect();
        for expected in list(&set["expected"]) {
            let ids: Vec<AgentId> = list(&expected["object_ids"]).iter().map(id).collect();
            let of_ids = |p: &&Prediction| p.agents == ids;
            let tally = measure(&scenario, predictions.iter().find(of_ids).unwrap());
            let step = expected["measurement_step"].as_u64().unwrap() as usize;
            let horizon = [5, 9, 15].iter().position(|&s| s == step).unwrap();
            let name = format!("{} {ids:?} step {step}", set["set"]);
            let cell = &tally.cells[&(kind(&expected["object_type"]), horizon)];
            check_cell(&name, cell, expected);
            n_cells += 1;
        }
    }
    assert_eq!(n_cells, 3 * (3 * 19 + 2));
}

#[test]
fn every_shape_is_that_of_the_reference() {
    let golden = golden();
    let mut shapes = std::collections::BTreeSet::new();
    for set in list(&golden["sets"]) {
        let scenario = scenario(&golden, set["scenario"].as_str().unwrap());
        for (agent, expected) in set["track_types"].as_object().unwrap() {
            let agent = AgentId(agent.parse().unwrap());
            let found = shape(&scenario, agent, ShapeRules::Current);
            let name = found.map(waymo_name);
            assert_eq!(name.as_deref(), expected.as_str(), "agent {agent}");
            shapes.extend(found);
        }
    }
    assert_eq!(shapes.len(), 8);
}

#[test]
fn scenarios_merge_in_any_order() {
    let golden = golden();
    let config = MotionConfig::challenge();
    let tallies: Vec<MotionTally> = list(&golden["sets"])
        .iter()
        .filter(|set| set["set"] == "noise8")
        .map(|set| {
            let scenario = scenario(&golden, set["scenario"].as_str().unwrap());
            let predictions: Vec<_> = list(&set["predictions"]).iter().map(prediction).collect();
            MotionTally::of(&evaluate_predictions(&scenario, &predictions, &config).unwrap())
        })
        .collect();
    let merged = |tallies: &mut dyn Iterator<Item = &MotionTally>| {
        let mut all = MotionTally::default();
        tallies.for_each(|tally| all.merge(tally));
        all.rows(&config)
    };
    assert_eq!(tallies.len(), 2);
    let rows = merged(&mut tallies.iter());
    assert_eq!(rows, merged(&mut tallies.iter().rev()));
    // Three kinds and their mean, each at three horizons and over them.
    assert_eq!(rows.len(), 16);
    let last = rows.last().unwrap();
    assert_eq!(
        (last.kind, last.seconds, last.predictions),
        (None, None, 19)
    );
    let by_hand: f64 = rows[..12]
        .iter()
        .filter(|row| row.seconds.is_some())
        .map(|row| row.map.unwrap())
        .sum::<f64>()
        / 9.0;
    assert!((last.map.unwrap() - by_hand).abs() < 1e-12);
}

#[test]
fn what_does_not_fit_is_named() {
    let golden = golden();
    let set = list(&golden["sets"])
        .iter()
        .find(|set| set["set"] == "cv")
        .unwrap();
    let scenario = scenario(&golden, set["scenario"].as_str().unwrap());
    let predictions: Vec<_> = list(&set["predictions"]).iter().map(prediction).collect();
    let check = |damage: &dyn Fn(&mut Scenario, &mut Vec<Prediction>), expected: MotionProblem| {
        let (mut scenario, mut predictions) = (scenario.clone(), predictions.clone());
        damage(&mut scenario, &mut predictions);
        let config = MotionConfig::challenge();
        let error = evaluate_predictions(&scenario, &predictions, &config).unwrap_err();
        assert_eq!(error.problem, expected);
        assert!(error.to_string().starts_with("scenario synm00000000001: "));
    };
    let first = predictions[0].agents[0];
    check(&|_, p| drop(p.remove(0)), MotionProblem::Missing(first));
    check(
        &|s, _| s.targets.retain(|&target| target != first),
        MotionProblem::Unexpected(first),
    );
    check(
        &|_, p| p.push(p[0].clone()),
        MotionProblem::Duplicate(first),
    );
    check(
        &|s, p| {
            s.targets[1] = AgentId(4711);
            p[1].agents[0] = AgentId(4711);
        },
        MotionProblem::NeverPresent(AgentId(4711)),
    );
    check(&|_, p| p[0].agents.clear(), MotionProblem::NoAgents(0));
    check(&|_, p| p[0].modes.clear(), MotionProblem::NoModes(first));
    check(
        &|_, p| p[0].modes[0].paths.clear(),
        MotionProblem::PathCount {
            agent: first,
            mode: 0,
            expected: 1,
            found: 0,
        },
    );
    check(
        &|_, p| p[0].modes[0].paths[0].truncate(15),
        MotionProblem::PathLength {
            agent: first,
            mode: 0,
            expected: 16,
            found: 15,
        },
    );
    check(
        &|_, p| p[0].modes[0].paths[0][3].y = f64::NAN,
        MotionProblem::Position {
            agent: first,
            mode: 0,
            step: 3,
        },
    );
    check(
        &|_, p| p[0].modes[0].confidence = f64::INFINITY,
        MotionProblem::Confidence {
            agent: first,
            mode: 0,
        },
    );
    check(
        &|s, _| s.log.truncate(80),
        MotionProblem::ShortLog {
            expected: 80,
            found: 79,
        },
    );
    check(
        &|s, _| s.dt = 0.15,
        MotionProblem::TimeStep {
            expected: 0.5,
            found: 0.15,
        },
    );
}
