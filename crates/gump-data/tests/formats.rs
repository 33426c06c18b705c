//! Each format on a small file made by hand, damaged files, and directories of all of them.

mod common;

use std::fs;
use std::path::{Path, PathBuf};

use gump_data::{
    DataError, ReadOptions, ScenarioRecord, list_files, open, open_with, scenario_json, verify,
};
use gump_geometry::dvec2;
use gump_scene::{Agent, AgentId, AgentKind, Frame, LaneId, LightState};
use tempfile::TempDir;

fn data(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("tests/data")
        .join(name)
}

fn only(path: &Path) -> ScenarioRecord {
    let mut reader = open(path).expect("the file opens");
    let record = reader
        .next()
        .expect("there is a record")
        .expect("it can be read");
    assert!(reader.next().is_none());
    record
}

#[test]
fn gpudrive_states_what_it_states_and_the_rest_is_inferred() {
    let record = only(&data("gpudrive.json"));
    let (scenario, report) = (&record.scenario, &record.report);
    assert_eq!((scenario.id.as_str(), scenario.log.len()), ("abc", 3));
    // Headings are in degrees: 359 faces along the motion, and 1 does too.
    let ego = scenario.log[0].agent(scenario.ego).unwrap();
    assert_eq!(
        scenario.ego,
        AgentId(6),
        "the last vehicle that is always there"
    );
    assert!((ego.state.pose.heading + 1.0_f64.to_radians()).abs() < 1e-9);
    // A valid state may lie beyond -10000; an invalid one is absent whatever it holds.
    assert_eq!(ego.state.pose.position, dvec2(-10500.0, 4.0));
    assert!(scenario.log[2].agent(AgentId(5)).is_none());
    assert_eq!(
        scenario.map.lane(LaneId(1)).unwrap().successors,
        [LaneId(2)]
    );
    assert_eq!(
        scenario.log[0].light(LaneId(2)).unwrap().state,
        LightState::Red
    );
    assert!(scenario.log[1].lights().is_empty());
    assert_eq!(
        scenario.log[2].light(LaneId(2)).unwrap().state,
        LightState::Green
    );
    assert_eq!(
        report.dropped["simple shape of an outline that crosses itself"],
        1
    );
    assert!(matches!(
        open_with(&data("gpudrive.json"), ReadOptions::STATED)
            .unwrap()
            .next(),
        Some(Err(DataError::Scenario { .. }))
    ));
}

#[test]
fn commonroad_lanelets_are_lanes() {
    let record = only(&data("commonroad.xml"));
    let (scenario, report) = (&record.scenario, &record.report);
    let lane = scenario.map.lane(LaneId(1)).unwrap();
    assert_eq!((lane.width, lane.speed_limit), (4.0, Some(11.176)));
    assert_eq!(lane.successors, [LaneId(2)]);
    assert!(lane.left_neighbors.is_empty(), "it leads the other way");
    assert_eq!(
        scenario.map.lane(LaneId(2)).unwrap().speed_limit,
        Some(11.176)
    );
    assert_eq!(scenario.ego, AgentId(100));
    assert_eq!(
        report.inferred["ego: the obstacle at the planning problem's start"],
        1
    );
    // The light rules the lane behind its stop line.
    let states: Vec<_> = scenario
        .log
        .iter()
        .map(|f| f.light(LaneId(2)).unwrap().state)
        .collect();
    assert_eq!(
        states,
        [LightState::Red, LightState::Red, LightState::Green]
    );
    let far = |x, y| {
        scenario
            .map
            .road_edges()
            .iter()
            .map(|e| e.line.project(dvec2(x, y)).distance)
            .fold(f64::MAX, f64::min)
    };
    assert!(far(25.0, -2.0) < 0.01 && far(25.0, 6.0) < 0.01 && far(25.0, 2.0) > 1.0);
    assert!(
        scenario.map.is_drivable(dvec2(25.0, 1.9)) && !scenario.map.is_drivable(dvec2(25.0, -2.1))
    );
}

#[test]
fn taf_bw_tracks_drive_on_lanelets() {
    let tracks = "recorded_trackfiles/here/vehicle_tracks_000.csv";
    let record = only(&data("taf_bw").join(tracks));
    let (scenario, report) = (&record.scenario, &record.report);
    assert_eq!((scenario.id.as_str(), scenario.log.len()), ("here-000", 3));
    let lane = |id| scenario.map.lane(LaneId(id)).unwrap();
    // Bounds are given in any direction; the map's own metres are recovered from degrees.
    assert!(
        (lane(31).width - 4.0).abs() < 1e-3 && (lane(31).centerline.length() - 50.0).abs() < 1e-3
    );
    assert!(lane(31).centerline.points()[0].distance(dvec2(0.0, 0.0)) < 1e-3);
    assert!((lane(31).speed_limit.unwrap() - 60.0 / 3.6).abs() < 1e-9);
    assert_eq!(lane(32).speed_limit, Some(10.0), "that of the place");
    assert_eq!(lane(31).successors, [LaneId(32)]);
    assert_eq!(lane(31).left_neighbors, [LaneId(33)]);
    assert_eq!(lane(33).right_neighbors, [LaneId(31)]);
    assert_eq!(scenario.map.areas().len(), 1, "a crossing");
    let agent = |id| *scenario.log[2].agent(AgentId(id)).unwrap();
    assert_eq!(agent(7).state.pose.position, dvec2(12.0, 0.0));
    assert_eq!(agent(8).kind, AgentKind::Pedestrian);
    assert!((agent(8).state.velocity - dvec2(0.0, 1.0)).length() < 1e-9);
    assert_eq!(agent(9).kind, AgentKind::Bicycle);
    assert_eq!(scenario.ego, AgentId(7));
    assert_eq!(scenario.targets, [7, 8, 9].map(AgentId));
    assert_eq!(report.dropped["state between two time steps"], 1);
    assert_eq!(report.inferred["agent to predict"], 3);
    let folder = TempDir::new().unwrap();
    let alone = folder.path().join("vehicle_tracks_000.csv");
    fs::copy(data("taf_bw").join(tracks), &alone).unwrap();
    let error = open(&alone).unwrap().next().unwrap().unwrap_err();
    assert!(
        error
            .to_string()
            .contains("meta_data.csv beside it, found none"),
        "{error}"
    );
    let verification = verify(&data("taf_bw")).unwrap();
    assert_eq!(verification.skipped["Lanelet2 or OpenStreetMap map"], 1);
}

#[test]
fn own_data_needs_little() {
    let record = only(&data("own.json"));
    let (scenario, report) = (&record.scenario, &record.report);
    assert_eq!((scenario.dt, scenario.now, scenario.log.len()), (0.5, 1, 4));
    let ego = scenario.log[1].agent(scenario.ego).unwrap();
    assert_eq!(
        (ego.state.velocity, ego.state.pose.heading),
        (dvec2(10.0, 0.0), 0.0)
    );
    assert_eq!(ego.elevation, 2.0 + ego.height / 2.0);
    let walker = scenario.log[0].agent(AgentId(7)).unwrap();
    assert_eq!(walker.state.velocity, dvec2(0.0, -1.0));
    assert_eq!(report.notes.len(), 1, "{:?}", report.notes);
    assert!(report.notes[0].detail.starts_with("track 7 at step 3"));
    assert!(scenario.log[3].agent(AgentId(7)).is_none());
    let lanes = scenario.map.lanes();
    assert_eq!(lanes[0].successors, [lanes[1].id]);
    assert_eq!(scenario.log[0].lights()[0].lane, lanes[1].id);
    assert!(scenario.route.is_some());
}

/// Frames agree to a nanometre: parsing decimal numbers may be off in the last bit.
fn check_frame(found: &Frame, expected: &Frame) {
    assert_eq!(found.lights(), expected.lights());
    assert_eq!(found.agents().len(), expected.agents().len());
    for (a, b) in found.agents().iter().zip(expected.agents()) {
        let numbers = |agent: &Agent| {
            let (pose, velocity) = (agent.state.pose, agent.state.velocity);
            let (p, h) = (pose.position, pose.heading);
            let size = [agent.length, agent.width, agent.height];
            [
                p.x,
                p.y,
                h,
                velocity.x,
                velocity.y,
                size[0],
                size[1],
                size[2],
                agent.elevation,
            ]
        };
        assert_eq!((a.id, a.kind), (b.id, b.kind));
        for (a, b) in numbers(a).into_iter().zip(numbers(b)) {
            assert!((a - b).abs() < 1e-9, "{a} instead of {b}");
        }
    }
}

#[test]
fn what_is_written_as_json_is_read_again() {
    let folder = TempDir::new().unwrap();
    let written = common::crossing();
    for name in ["a.json", "a.json.gz"] {
        let path = folder.path().join(name);
        scenario_json::write_scenario(&path, &written).unwrap();
        let read = only(&path).scenario;
        assert_eq!(read.id, written.id);
        assert_eq!(
            (read.dt, read.now, read.ego),
            (written.dt, written.now, written.ego)
        );
        assert_eq!(read.log.len(), written.log.len());
        for (found, expected) in read.log.iter().zip(&written.log) {
            check_frame(found, expected);
        }
        assert_eq!(read.targets, written.targets);
        for lane in written.map.lanes() {
            let again = read.map.lane(lane.id).unwrap();
            assert_eq!(again.centerline, lane.centerline);
            assert_eq!(again.successors, lane.successors);
            assert_eq!(again.left_neighbors, lane.left_neighbors);
        }
        assert_eq!(read.map.areas().len(), written.map.areas().len());
    }
}

#[test]
fn a_wrong_version_is_refused() {
    let folder = TempDir::new().unwrap();
    let check = |from: &str, old: &str, new: &str, expected: &str| {
        let text = fs::read_to_string(data(from)).unwrap().replace(old, new);
        let path = folder.path().join(from);
        fs::write(&path, text).unwrap();
        let error = open(&path)
            .unwrap()
            .next()
            .unwrap()
            .unwrap_err()
            .to_string();
        assert!(error.contains(expected) && error.ends_with(from), "{error}");
    };
    check(
        "own.json",
        "\"version\": 1",
        "\"version\": 2",
        "expected version 1, found 2",
    );
    check("commonroad.xml", "2020a", "2031x", "found 2031x");
    check(
        "commonroad.xml",
        "timeStepSize=\"0.5\"",
        "timeStepSize=\"-1\"",
        "time step",
    );
}

#[test]
fn a_directory_of_all_formats_with_damage_and_strangers() {
    let folder = TempDir::new().unwrap();
    let inner = folder.path().join("deep/er");
    fs::create_dir_all(&inner).unwrap();
    for name in ["gpudrive.json", "commonroad.xml", "own.json"] {
        fs::copy(data(name), inner.join(name)).unwrap();
    }
    let whole = fs::read(data("gpudrive.json")).unwrap();
    fs::write(folder.path().join("cut.json"), &whole[..whole.len() / 2]).unwrap();
    fs::write(folder.path().join("empty.json"), "").unwrap();
    fs::write(folder.path().join("noise.tfrecord"), [7; 100]).unwrap();
    fs::write(folder.path().join("README.md"), "nothing to see").unwrap();
    fs::write(folder.path().join("index.json"), "[{\"file\": 1}]").unwrap();
    assert_eq!(list_files(folder.path()).unwrap().len(), 8);
    let mut reader = open(folder.path()).unwrap();
    let (good, bad): (Vec<_>, Vec<_>) = reader.by_ref().partition(Result::is_ok);
    assert_eq!((good.len(), bad.len()), (3, 3));
    assert_eq!(reader.skipped()["other text"], 2);
    for error in bad.into_iter().filter_map(Result::err) {
        let text = error.to_string();
        assert!(
            ["cut.json", "empty.json", "noise.tfrecord"]
                .iter()
                .any(|n| text.ends_with(n)),
            "{text}"
        );
    }
    let verification = verify(folder.path()).unwrap();
    assert_eq!(
        (verification.scenarios, verification.is_broken()),
        (3, true)
    );
    let files: usize = verification
        .formats
        .values()
        .map(|counts| counts.files)
        .sum();
    let broken: usize = verification
        .formats
        .values()
        .map(|counts| counts.broken)
        .sum();
    assert_eq!(
        (files, broken, verification.skipped["other text"]),
        (6, 3, 2)
    );
}

#[test]
fn absurd_documents_are_refused() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("deep.json");
    fs::write(&path, format!("{{\"objects\": {}", "[".repeat(100_000))).unwrap();
    let error = open(&path).unwrap().next().unwrap().unwrap_err();
    assert!(matches!(error, DataError::Json { .. }), "{error}");
    // A megabyte of gzip that unpacks to 200 MB.
    let mut packer = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    std::io::Write::write_all(&mut packer, b"{\"objects\": [").unwrap();
    for _ in 0..200 {
        std::io::Write::write_all(&mut packer, &vec![b' '; 1 << 20]).unwrap();
    }
    let path = folder.path().join("bomb.json.gz");
    fs::write(&path, packer.finish().unwrap()).unwrap();
    let error = open(&path).unwrap().next().unwrap().unwrap_err();
    assert!(matches!(error, DataError::TooLarge { .. }), "{error}");
}

#[test]
fn real_files_hold_what_an_independent_count_finds() {
    // Scenarios, tracks, frames and lanes, counted by a script of a few lines in Python.
    let check = |name: &str, expected: [usize; 4]| {
        let Some(path) = common::shared(name) else {
            return;
        };
        let found = verify(&path).unwrap();
        let sum = |of: fn(&gump_data::FormatCounts) -> usize| {
            found.formats.values().map(of).sum::<usize>()
        };
        let counts = [
            found.scenarios,
            sum(|c| c.tracks),
            sum(|c| c.frames),
            sum(|c| c.lanes),
        ];
        assert_eq!(counts, expected, "{name}");
        assert!(!found.is_broken(), "{name}: {:?}", found.counts);
    };
    check("data/gpudrive/lights", [11, 622, 1001, 1273]);
    check("data/gpudrive/validation", [23, 867, 2093, 2269]);
    check("data/argoverse2", [4, 441, 579, 631]);
    check("data/commonroad_ngsim", [77, 2454, 5189, 3210]);
    check("data/taf_bw", [27, 424, 8876, 951]);
}
