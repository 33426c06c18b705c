//! Summaries and findings of files made for the purpose.

mod common;

use std::collections::BTreeMap;

use gump_data::womd::write_scenarios;
use gump_data::{ReadOptions, Severity, Verification, inspect, open_with, verify};
use gump_geometry::dvec2;
use gump_scene::{Agent, AgentId, Frame, LaneId, Light, LightState, Scenario};
use tempfile::TempDir;

/// The result of `verify` on one file with these scenarios.
fn verified(scenarios: &[Scenario]) -> Verification {
    let folder = TempDir::new().expect("there is a temporary folder");
    let path = folder.path().join("some.tfrecord");
    write_scenarios(&path, scenarios).expect("the scenarios fit Waymo's message");
    verify(&path).expect("the file opens")
}

/// The fixture with one agent changed in one frame.
fn with(frame: usize, id: i64, change: impl Fn(&mut Agent)) -> Scenario {
    let mut scenario = common::crossing();
    let old = &scenario.log[frame];
    let agents = old.agents().iter().map(|agent| {
        let mut agent = *agent;
        if agent.id == AgentId(id) {
            change(&mut agent);
        }
        agent
    });
    scenario.log[frame] = Frame::new(agents.collect(), old.lights().to_vec());
    scenario
}

fn check(scenario: &Scenario, expected: &[(&'static str, usize)]) {
    let result = verified(std::slice::from_ref(scenario));
    let expected: BTreeMap<_, _> = expected.iter().copied().collect();
    assert_eq!(result.counts, expected, "{:?}", result.findings);
    assert!(!result.is_broken());
    assert!(result.findings.iter().all(|f| f.scenario == "fixture"));
}

#[test]
fn a_sound_scenario_has_no_findings() {
    check(&common::crossing(), &[]);
}

#[test]
fn agents_inside_each_other_are_found() {
    let scenario = with(10, 9, |agent| agent.state.pose.position = dvec2(-40.0, 0.0));
    // The misplaced box also jumps there and back.
    check(&scenario, &[("overlapping start", 1), ("jump", 2)]);
}

#[test]
fn impossible_speeds_are_found() {
    let scenario = with(40, 7, |agent| agent.state.velocity = dvec2(0.0, -14.0));
    check(&scenario, &[("impossible speed", 1)]);
}

#[test]
fn lights_without_lanes_and_frames_without_lights_are_found() {
    let mut scenario = common::crossing();
    let agents = scenario.log[3].agents().to_vec();
    // Longer than a colour is held.
    for frame in &mut scenario.log[50..] {
        *frame = Frame::new(frame.agents().to_vec(), Vec::new());
    }
    let stray = Light {
        lane: LaneId(404),
        state: LightState::Red,
        stop_point: None,
    };
    scenario.log[4] = Frame::new(agents, vec![stray]);
    // Frame 4 repeats the agents of frame 3: a step of 0.8 m too little is no jump yet.
    check(
        &scenario,
        &[("light of an unknown lane", 1), ("missing lights", 1)],
    );
}

#[test]
fn lights_out_of_sight_for_a_second_are_held_unless_it_is_turned_off() {
    let mut scenario = common::crossing();
    let recorded = scenario.log.clone();
    for (step, frame) in scenario.log.iter_mut().enumerate().skip(30).take(10) {
        let unseen = frame.lights().iter().map(|light| Light {
            state: LightState::Unknown,
            ..*light
        });
        let lights = if step % 2 == 0 {
            unseen.collect()
        } else {
            Vec::new()
        };
        *frame = Frame::new(frame.agents().to_vec(), lights);
    }
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("some.tfrecord");
    write_scenarios(&path, [&scenario]).unwrap();
    let read = |options| {
        let mut reader = open_with(&path, options).expect("the file opens");
        reader.next().expect("one record").expect("it reads")
    };
    let lights = |log: &[Frame]| log.iter().map(|f| f.lights().to_vec()).collect::<Vec<_>>();
    let held = read(ReadOptions::ALL);
    assert_eq!(lights(&held.scenario.log), lights(&recorded));
    let counted = held.report.inferred["colour of a light between two sightings"];
    assert_eq!(counted, 2 * 10, "two lights, ten frames");
    let seen = read(ReadOptions {
        infer_light_gaps: false,
        ..ReadOptions::ALL
    });
    assert_eq!(lights(&seen.scenario.log), lights(&scenario.log));
}

#[test]
fn roles_without_agents_and_an_ego_off_the_lanes_are_found() {
    let mut scenario = common::crossing();
    scenario.objects_of_interest.push(AgentId(404));
    let gone = scenario.log[10]
        .agents()
        .iter()
        .filter(|a| a.id != AgentId(8));
    scenario.log[10] = Frame::new(gone.copied().collect(), scenario.log[10].lights().to_vec());
    for frame in &mut scenario.log {
        let moved = frame.agents().iter().map(|agent| {
            let mut agent = *agent;
            agent.state.pose.position.y += if agent.id == AgentId(10) { 90.0 } else { 0.0 };
            agent
        });
        *frame = Frame::new(moved.collect(), frame.lights().to_vec());
    }
    check(
        &scenario,
        &[
            ("absent target", 1),
            ("missing route", 1),
            ("unknown object of interest", 1),
        ],
    );
}

#[test]
fn doubled_scenarios_and_unreadable_records_are_broken() {
    let doubled = verified(&[common::crossing(), common::crossing()]);
    assert!(doubled.is_broken());
    assert_eq!(doubled.counts["scenario id occurs twice"], 1);

    let folder = TempDir::new().unwrap();
    let path = folder.path().join("some.tfrecord");
    write_scenarios(&path, [common::crossing(), common::crossing()]).unwrap();
    let mut bytes = std::fs::read(&path).unwrap();
    bytes[100] ^= 4;
    std::fs::write(&path, &bytes).unwrap();
    let result = verify(&path).unwrap();
    assert_eq!(result.scenarios, 1);
    assert_eq!(result.findings[0].severity, Severity::Broken);
    assert_eq!(result.counts["unreadable record"], 1);
    let summary = inspect(&path, ReadOptions::ALL).unwrap();
    assert_eq!((summary.scenarios, summary.unreadable.len()), (1, 1));
}

#[test]
fn a_summary_counts_a_synthetic_scenario() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("some.tfrecord");
    write_scenarios(&path, [common::crossing()]).unwrap();
    let summary = inspect(&path, ReadOptions::ALL).unwrap();
    let counts = BTreeMap::from([
        ("bicycle", 1),
        ("other", 1),
        ("pedestrian", 1),
        ("vehicle", 2),
    ]);
    assert_eq!(summary.agents_now, counts);
    assert_eq!(summary.tracks, counts);
    assert_eq!(
        summary.lights_now,
        BTreeMap::from([("green", 1), ("red", 1)])
    );
    assert_eq!(summary.rate_hz, Some([10.0, 10.0]));
    assert_eq!(summary.history_s, Some([1.0, 1.0]));
    assert_eq!(summary.map["crosswalk"], 1);
    assert_eq!(summary.map["lane with a speed limit"], 2);
    assert_eq!(summary.map["link between lanes"], 2);
    assert_eq!(summary.targets, 5);
    let json = serde_json::to_value(&summary).unwrap();
    assert_eq!(json["inferred"]["route from the ego's log"], 1);
}

#[test]
fn without_inference_only_what_is_stated_is_there() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("some.tfrecord");
    write_scenarios(&path, [common::crossing()]).unwrap();
    let read = |options| {
        let mut reader = open_with(&path, options).expect("the file opens");
        reader.next().expect("one record").expect("it reads")
    };
    let stated = read(ReadOptions::STATED);
    assert!(stated.report.inferred.is_empty());
    assert!(stated.scenario.route.is_none() && stated.scenario.map.drivable().is_empty());
    assert!(
        stated
            .scenario
            .map
            .lanes()
            .iter()
            .all(|lane| lane.width == 3.5)
    );
    let route_only = read(ReadOptions {
        infer_route: true,
        ..ReadOptions::STATED
    });
    let lanes = route_only
        .scenario
        .route
        .expect("the ego drives on lanes")
        .lanes
        .clone();
    assert_eq!(lanes, [LaneId(1), LaneId(2)]);
    assert_eq!(route_only.report.inferred.len(), 1);
}
