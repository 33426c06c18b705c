//! Whole simulations against nuPlan's own: 150 steps, four planners, three kinds of traffic.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

#[path = "../../../tests/shared.rs"]
mod shared_data;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use gump_data::ReadOptions;
use gump_data::nuplan::{Extraction, Log, NuplanScenario, Token, read_map};
use gump_geometry::angle_difference;
use gump_nuplan::closed_loop::{DriveConfig, Driver, Recording, Replayed, Tracking, Traffic};
use gump_nuplan::reactive_agents::NuplanIdm;
use gump_planner::closed_loop::{drive_and_score, plan_and_compare};
use gump_planner::{LogDriver, NuplanIdmDriver, PdmClosed, SimpleDriver};
use gump_scene::{AgentId, EgoState, VehicleParameters};
use serde_json::Value;

/// Metres, metres per second and the like, over 150 steps.
const TOLERANCE: f64 = 1e-4;
/// Radians: a nearly standing ego steers hard for micrometres, which is where rounding shows first
/// (1.02e-4 in one of the eight, 1e-6 or less in the others).
const STEERING_TOLERANCE: f64 = 2e-4;

fn golden_folder() -> Option<PathBuf> {
    shared_data::shared("golden/nuplan")
}

struct Synthetic {
    recording: Recording,
    after: Vec<EgoState>,
    scenario: NuplanScenario,
}

fn synthetic(folder: &Path) -> Synthetic {
    let log = Log::open(&folder.join("synth/log.db")).unwrap();
    let map = read_map(&folder.join("synth/map.gpkg")).unwrap();
    let token: Token = "af6639f0bc724ead".parse().unwrap();
    let event = log.event(token).unwrap().unwrap();
    let map = Arc::clone(&map.graph);
    let extraction = Extraction::default();
    let scenario =
        NuplanScenario::read(&log, &event, "stopping_with_lead", &map, &extraction).unwrap();
    let (plain, _) = scenario.to_scenario(ReadOptions::ALL).unwrap();
    let frames = scenario.history.iter().chain(&scenario.iterations);
    let ego = frames.map(|frame| frame.ego).collect();
    let car = VehicleParameters::PACIFICA;
    Synthetic {
        recording: Recording::new(plain, ego, car, scenario.goal).unwrap(),
        after: scenario.ego_after.clone(),
        scenario,
    }
}

fn read(folder: &Path, name: &str) -> Value {
    let text = std::fs::read_to_string(folder.join(format!("synth_sim_{name}.json"))).unwrap();
    serde_json::from_str(&text).unwrap()
}

fn numbers(value: &Value) -> Vec<f64> {
    let list = value.as_array().unwrap().iter();
    list.map(|v| v.as_f64().unwrap_or(f64::INFINITY)).collect()
}

fn check_ego(name: &str, states: &[EgoState], golden: &Value) {
    let rows = golden["ego"].as_array().unwrap();
    assert_eq!(states.len(), rows.len(), "{name}");
    let mut worst = [0.0f64; 9];
    for (step, (state, row)) in states.iter().zip(rows).enumerate() {
        let row = numbers(row);
        assert_eq!(state.time_us, row[0] as i64, "{name} step {step}");
        let found = [
            state.rear_axle.position.x - row[1],
            state.rear_axle.position.y - row[2],
            angle_difference(state.rear_axle.heading, row[3]),
            state.velocity.x - row[4],
            state.velocity.y - row[5],
            state.acceleration.x - row[6],
            state.acceleration.y - row[7],
            state.steering_angle - row[8],
            state.yaw_rate - row[9],
        ];
        for (worst, off) in worst.iter_mut().zip(found) {
            *worst = worst.max(off.abs());
        }
    }
    eprintln!("{name}: {worst:?}");
    for (field, off) in worst.iter().enumerate() {
        let tolerance = if field == 7 {
            STEERING_TOLERANCE
        } else {
            TOLERANCE
        };
        assert!(*off < tolerance, "{name} field {field}: off by {off}");
    }
}

fn check_agents(
    name: &str,
    synthetic: &Synthetic,
    driven: &gump_nuplan::closed_loop::Driven,
    golden: &Value,
) {
    let Some(tokens) = golden["idm_agent_tokens"].as_array() else {
        return;
    };
    let id_of = |token: &Value| {
        let wanted: Token = token.as_str().unwrap().parse().unwrap();
        let tracks = &synthetic.scenario.tracks;
        AgentId(tracks.iter().position(|&t| t == wanted).unwrap() as i64 + 1)
    };
    for (step, expected) in golden["idm_agents"].as_array().unwrap().iter().enumerate() {
        let frame = driven.rollout.at(step);
        let frame = frame.now();
        let moving = frame.agents().iter().filter(|agent| {
            agent.kind == gump_scene::AgentKind::Vehicle && agent.id != gump_data::nuplan::EGO
        });
        assert_eq!(
            moving.count(),
            expected.as_array().unwrap().len(),
            "{name} step {step}"
        );
        for row in expected.as_array().unwrap() {
            let row = numbers(row);
            let agent = frame.agent(id_of(&tokens[row[0] as usize])).unwrap();
            let state = agent.state;
            let off = (state.pose.position - gump_geometry::dvec2(row[1], row[2])).length();
            let speed = (state.velocity - gump_geometry::dvec2(row[4], row[5])).length();
            let turned = angle_difference(state.pose.heading, row[3]).abs();
            assert!(
                off < TOLERANCE && speed < TOLERANCE && turned < TOLERANCE,
                "{name} step {step}: {state:?}, not {row:?}"
            );
        }
    }
}

fn check(
    folder: &Path,
    synthetic: &Synthetic,
    name: &str,
    traffic: &mut dyn Traffic,
    driver: &mut dyn Driver,
    tracking: Tracking,
) {
    let golden = read(folder, name);
    let config = DriveConfig {
        tracking,
        keep_plans: true,
        ..DriveConfig::default()
    };
    let recording = &synthetic.recording;
    let map = &recording.scenario().map;
    let scored = drive_and_score(recording, map, traffic, driver, &config).unwrap();
    check_agents(name, synthetic, &scored.driven, &golden);
    for (step, plan) in golden["planner_trajectories"]
        .as_object()
        .into_iter()
        .flatten()
    {
        let found = &scored.driven.plans[step.parse::<usize>().unwrap()];
        let rows = plan.as_array().unwrap();
        assert_eq!(found.states().len(), rows.len(), "{name} plan {step}");
        for (state, row) in found.states().iter().zip(rows) {
            let row = numbers(row);
            assert!(
                (state.time_us - row[0] as i64).abs() <= 1,
                "{name} plan {step}"
            );
            let off = (state.rear_axle.position - gump_geometry::dvec2(row[1], row[2])).length();
            assert!(
                off < TOLERANCE,
                "{name} plan {step}: off by {off}: {state:?}, not {row:?}"
            );
        }
    }
    check_ego(name, &scored.driven.ego, &golden);
    for (metric, score) in scored.metrics.scores() {
        let expected = golden["metrics"][&metric]["score"].as_f64().unwrap();
        let off = (score.unwrap() - expected).abs();
        assert!(off < 1e-5, "{name} {metric}: {score:?}, not {expected}");
    }
    let expected = golden["scenario_score"].as_f64().unwrap();
    assert!(
        (scored.score - expected).abs() < 1e-5,
        "{name}: {}, not {expected}",
        scored.score
    );
}

#[test]
fn whole_simulations_agree() {
    let Some(folder) = golden_folder() else {
        return;
    };
    let synthetic = synthetic(&folder);
    let log = || LogDriver::new(&synthetic.recording, &synthetic.after);
    let two_stage = Tracking::TwoStage;
    let run = |name: &str, traffic: &mut dyn Traffic, driver: &mut dyn Driver, tracking| {
        check(&folder, &synthetic, name, traffic, driver, tracking);
    };
    run(
        "log_future_log_replay",
        &mut Replayed,
        &mut log(),
        two_stage,
    );
    run(
        "log_future_perfect_tracking",
        &mut Replayed,
        &mut log(),
        Tracking::Perfect,
    );
    run(
        "log_future_open_loop",
        &mut Replayed,
        &mut log(),
        Tracking::Log,
    );
    let (idm, pdm) = (NuplanIdmDriver::default, PdmClosed::default);
    let reactive = NuplanIdm::default;
    run(
        "simple_idm_agents",
        &mut reactive(),
        &mut SimpleDriver::default(),
        two_stage,
    );
    run(
        "idm_planner_open_loop",
        &mut Replayed,
        &mut idm(),
        Tracking::Log,
    );
    run(
        "idm_planner_idm_agents",
        &mut reactive(),
        &mut idm(),
        two_stage,
    );
    run(
        "pdm_closed_log_replay",
        &mut Replayed,
        &mut pdm(),
        two_stage,
    );
    run(
        "pdm_closed_idm_agents",
        &mut reactive(),
        &mut pdm(),
        two_stage,
    );
}

#[test]
fn open_loop_scores_agree() {
    let Some(folder) = golden_folder() else {
        return;
    };
    let synthetic = synthetic(&folder);
    let mut log = LogDriver::new(&synthetic.recording, &synthetic.after);
    let mut idm = NuplanIdmDriver::default();
    let drivers: [(&str, &mut dyn Driver); 2] = [
        ("log_future_open_loop", &mut log),
        ("idm_planner_open_loop", &mut idm),
    ];
    for (name, driver) in drivers {
        let golden = read(&folder, name);
        let (recording, after) = (&synthetic.recording, &synthetic.after);
        let open = plan_and_compare(recording, after, &mut Replayed, driver, 15.0).unwrap();
        for (metric, score) in &open.scores {
            let expected = golden["open_loop"]["metrics"][metric]["score"]
                .as_f64()
                .unwrap();
            let off = (score.unwrap() - expected).abs();
            assert!(off < 1e-5, "{name} {metric}: {score:?}, not {expected}");
        }
    }
}
