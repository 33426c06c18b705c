//! Motion prediction and submissions from the outside: official numbers, shards, broken input.
#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

#[path = "../../tests/shared.rs"]
mod shared_data;

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use gump_data::submission::{
    N_FUTURES, predictions_to_proto, read_predictions, rollouts_to_proto, write_predictions,
    write_rollouts,
};
use gump_data::tfrecord::{TfRecordReader, write_record};
use gump_metrics::logged;
use gump_proto::motion::{MotionChallengeSubmission, PredictionKind};
use gump_proto::{
    self as proto, FeatureData, MapFeature, RequiredPrediction, SimAgentsChallengeSubmission,
};
use gump_scene::{PredictedMode, Prediction, Scenario};
use prost::Message;
use serde_json::Value;
use shared_data::shared;
use tempfile::TempDir;

/// The reference prints f32 results with nine digits.
const TOLERANCE: f64 = 1e-6;

fn run(folder: &TempDir, words: &str) -> Output {
    Command::new(env!("CARGO_BIN_EXE_xtask"))
        .args(words.split(' '))
        .current_dir(folder.path())
        .env("CARGO_MANIFEST_DIR", env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap()
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// The results of a run that succeeds.
fn results(folder: &TempDir, words: &str, out: &str) -> Value {
    let output = run(folder, &format!("{words} --quiet --out {out}"));
    assert!(output.status.success(), "{words}: {}", stderr(&output));
    report(folder, out)
}

fn report(folder: &TempDir, out: &str) -> Value {
    let path = folder.path().join(out).join("report.json");
    let mut report: Value = serde_json::from_str(&fs::read_to_string(path).unwrap()).unwrap();
    report["results"].take()
}

fn fails(folder: &TempDir, words: &str, status: i32, part: &str) {
    let output = run(folder, &format!("{words} --quiet --out failed"));
    let error = stderr(&output);
    assert_eq!(output.status.code(), Some(status), "{words}: {error}");
    assert!(error.contains(part), "{words}: expected {part} in: {error}");
}

fn mini() -> String {
    let repository = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let path = repository.join("datasets/mini/procedural.tfrecord.gz");
    path.display().to_string()
}

/// The scenarios of the official numbers as one file: those without a map get one, since every
/// scenario has a map and the measurements never look at it; what a joint prediction is of becomes
/// what is to be predicted.
fn official_scenarios(path: &Path, submission: &MotionChallengeSubmission) -> Option<()> {
    let names = [
        "golden/wosac/inputs/scenario_synm00000000001.tfrecord",
        "golden/wosac/inputs/scenario_syn0000000000001.tfrecord",
        "data/waymo/scenario_a.tfrecord",
        "data/waymo/scenario_b.tfrecord",
    ];
    let mut file = fs::File::create(path).unwrap();
    for name in names {
        let payload = TfRecordReader::open(shared(name)?)
            .unwrap()
            .next()?
            .unwrap();
        let mut scenario = proto::Scenario::decode(payload.bytes.as_slice()).unwrap();
        if scenario.map_features.is_empty() {
            scenario.map_features.push(MapFeature {
                id: Some(1),
                feature_data: Some(FeatureData::RoadEdge(proto::RoadEdge {
                    r#type: Some(1),
                    polyline: [0.0, 1.0]
                        .map(|x| proto::MapPoint {
                            x: Some(x),
                            y: Some(0.0),
                            z: Some(0.0),
                        })
                        .into(),
                })),
            });
        }
        if let Some(ids) = jointly_predicted(submission, scenario.scenario_id()) {
            let index = |id| scenario.tracks.iter().position(|t| t.id() == id).unwrap();
            let target = |&id: &i32| RequiredPrediction {
                track_index: Some(index(id) as i32),
                difficulty: None,
            };
            scenario.tracks_to_predict = ids.iter().map(target).collect();
        }
        write_record(&mut file, &scenario.encode_to_vec()).unwrap();
    }
    Some(())
}

fn jointly_predicted(submission: &MotionChallengeSubmission, id: &str) -> Option<Vec<i32>> {
    let mut messages = submission.scenario_predictions.iter();
    let message = messages.find(|m| m.scenario_id() == id)?;
    let Some(PredictionKind::JointPrediction(joint)) = &message.prediction_set else {
        return None;
    };
    let trajectories = &joint.joint_trajectories[0].trajectories;
    Some(trajectories.iter().map(|t| t.object_id()).collect())
}

/// The largest difference between our rows and the official ones.
fn largest_difference(rows: &Value, official: &Value) -> f64 {
    let mut largest = 0.0_f64;
    let official = official["bundles"].as_array().unwrap();
    for expected in official {
        let class = ["vehicle", "pedestrian", "bicycle"]
            [expected["object_type"].as_u64().unwrap() as usize - 1];
        let seconds = (expected["measurement_step"].as_f64().unwrap() + 1.0) / 2.0;
        let mut rows = rows.as_array().unwrap().iter();
        let row = rows.find(|row| row["class"] == class && row["horizon_s"] == seconds);
        let row = row.unwrap();
        for (theirs, ours) in [
            ("min_ade", "min_ade"),
            ("min_fde", "min_fde"),
            ("miss_rate", "miss_rate"),
            ("overlap_rate", "overlap_rate"),
            ("mAP", "map"),
            ("soft_mAP", "soft_map"),
        ] {
            let (a, b) = (
                expected[theirs].as_f64().unwrap(),
                row[ours].as_f64().unwrap(),
            );
            largest = largest.max((a - b).abs());
        }
    }
    assert!(official.len() >= 6);
    largest
}

#[test]
fn a_planner_that_takes_too_long_is_named_when_nothing_is_left() {
    let folder = TempDir::new().unwrap();
    let words = format!(
        "evaluate closed-loop --scenarios {} --limit 1 --world log --planner simple \
         --budget-ms 1e-6",
        mini()
    );
    let part = "every scenario failed, the first because: iteration 0: simple: took";
    fails(&folder, &words, 1, part);
}

#[test]
fn recordings_of_another_length_are_left_out_by_name_and_egos_chosen_where_none_is_stated() {
    let folder = TempDir::new().unwrap();
    let repository = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let realism = |path: &str| {
        let path = repository.join(path);
        format!(
            "evaluate wosac --scenarios {} --world log --rollouts-per-scenario 2",
            path.display()
        )
    };
    let words = realism("datasets/mini/ngsim-peachtree.tfrecord.gz");
    let found = results(&folder, &words, "out");
    assert_eq!(found["scenarios"], 1);
    let exclusions = found["left_out"].as_array().unwrap();
    assert_eq!(exclusions.len(), 1);
    let why = exclusions[0].as_str().unwrap();
    assert!(
        why.contains("USA_Peach-4_8_T-1: expected at least"),
        "{why}"
    );
    // CommonRoad states no ego, and this one lasts three steps of half a second.
    let words = realism("crates/gump-data/tests/data/commonroad.xml");
    let why = "none of 1 scenarios has the length and the rate of the benchmark";
    fails(&folder, &words, 1, why);
    let path = repository.join("datasets/mini/ngsim-us101.tfrecord.gz");
    let words = format!("evaluate motion --scenarios {} --world log", path.display());
    let found = results(&folder, &words, "motion");
    assert_eq!(found["scenarios"], 3);
    assert_eq!(found["left_out"].as_array().unwrap().len(), 2);
}

#[test]
fn motion_numbers_are_the_official_ones() {
    for set in ["gt", "cv", "noise8", "joint8"] {
        let golden = format!("golden/wosac/motion/submission_{set}.binproto");
        let Some(predictions) = shared(&golden) else {
            return;
        };
        let official = shared(&format!("golden/wosac/motion/result_{set}.json")).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let submission = read_predictions(&predictions).unwrap();
        let scenarios = folder.path().join("all.tfrecord");
        if official_scenarios(&scenarios, &submission).is_none() {
            return;
        }
        let words = format!(
            "evaluate motion --scenarios all.tfrecord --rollouts {}",
            predictions.display()
        );
        let found = results(&folder, &words, "out");
        let official = serde_json::from_str(&fs::read_to_string(official).unwrap()).unwrap();
        let difference = largest_difference(&found["rows"], &official);
        println!("{set}: differs by at most {difference:e} from the official numbers");
        assert!(difference < TOLERANCE, "{set}: {difference}");
    }
}

#[test]
fn the_log_is_a_perfect_forecaster() {
    let folder = tempfile::tempdir().unwrap();
    let words = format!(
        "evaluate motion --scenarios {} --world log --futures 2",
        mini()
    );
    let found = results(&folder, &words, "out");
    assert_eq!(found["scenarios"], 24);
    let rows = found["rows"].as_array().unwrap();
    let last = rows.last().unwrap();
    assert_eq!(
        (&last["class"], &last["horizon_s"]),
        (&"all".into(), &Value::Null)
    );
    assert_eq!(last["predictions"], found["predictions"]);
    for row in rows {
        // Made-up drivers never collide, and what happened is what was predicted.
        for name in ["min_ade", "min_fde", "miss_rate"] {
            assert_eq!(row[name], 0.0, "{name} of {row}");
        }
        assert_eq!((&row["map"], &row["soft_map"]), (&1.0.into(), &1.0.into()));
    }
    let interval = &found["intervals"][0]["min_ade"];
    assert_eq!(interval, &serde_json::json!([0.0, 0.0]));
}

#[test]
fn shards_add_up_and_an_interrupted_run_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let words = format!(
        "evaluate motion --scenarios {} --world constant-velocity --futures 1 --seed 5",
        mini()
    );
    let whole = results(&folder, &words, "whole");
    for k in 1..=3 {
        results(
            &folder,
            &format!("{words} --shard {k}/3"),
            &format!("part{k}"),
        );
    }
    let merged = results(&folder, "evaluate merge part3 part1 part2", "merged");
    assert_eq!(merged, whole);
    let again = results(&folder, &format!("{words} --threads 1"), "again");
    assert_eq!(again, whole);
    // A run that was stopped after some scenarios ends as if it had not been.
    let ledger = fs::read_to_string(folder.path().join("whole/scenarios.toml")).unwrap();
    let stopped = folder.path().join("stopped");
    fs::create_dir(&stopped).unwrap();
    fs::write(
        stopped.join("scenarios.toml.partial"),
        &ledger[..ledger.len() / 2],
    )
    .unwrap();
    assert_eq!(results(&folder, &words, "stopped"), whole);
}

/// Two scenarios of one scene, in a file.
fn two_scenarios(folder: &TempDir) -> Vec<Scenario> {
    let scene = gump_scene::fixture::scenario(
        "lane 1: -50,0 0,0 50,0 150,0 speed 15 width 3.5
         ego vehicle 0: 0,0 velocity 8,0
         agent vehicle 1: 20,0 velocity 6,0
         agent pedestrian 2: 30,4
         history 1 future 8 dt 0.1",
    )
    .unwrap();
    let named = |id: &str| Scenario {
        id: id.into(),
        targets: vec![scene.ego],
        ..scene.clone()
    };
    let scenarios = vec![named("a"), named("b")];
    gump_data::womd::write_scenarios(&folder.path().join("two.tfrecord"), &scenarios).unwrap();
    scenarios
}

/// Predictions of the log, `offset` metres beside it.
fn predictions(scenario: &Scenario, offset: f64) -> Vec<Prediction> {
    let of_agent = |&agent| {
        let positions = (1..=16).map(|k| {
            let frame = &scenario.log[scenario.now + 5 * k];
            let mut position = frame.agent(agent).unwrap().state.pose.position;
            position.y += offset;
            position
        });
        Prediction {
            agents: vec![agent],
            modes: vec![PredictedMode {
                confidence: 0.5,
                paths: vec![positions.collect()],
            }],
        }
    };
    scenario.targets.iter().map(of_agent).collect()
}

fn write_motion(folder: &TempDir, name: &str, scenarios: &[&Scenario]) {
    let message = |scenario: &&Scenario| {
        predictions_to_proto(&scenario.id, &predictions(scenario, 0.25)).unwrap()
    };
    let submission = MotionChallengeSubmission {
        scenario_predictions: scenarios.iter().map(message).collect(),
        ..MotionChallengeSubmission::default()
    };
    write_predictions(&folder.path().join(name), &submission).unwrap();
}

#[test]
fn predictions_come_from_files_of_either_kind() {
    let folder = tempfile::tempdir().unwrap();
    let scenarios = two_scenarios(&folder);
    let evaluate = "evaluate motion --scenarios two.tfrecord --rollouts";
    write_motion(&folder, "both.binproto", &[&scenarios[0], &scenarios[1]]);
    let found = results(&folder, &format!("{evaluate} both.binproto"), "out");
    let error = found["rows"][0]["min_ade"].as_f64().unwrap();
    assert!((error - 0.25).abs() < 1e-5, "{error}");
    // Futures of the sim agents challenge, one file per scenario.
    fs::create_dir(folder.path().join("futures")).unwrap();
    for scenario in &scenarios {
        let path = folder
            .path()
            .join(format!("futures/{}.binproto", scenario.id));
        write_rollouts(&path, &scenario.id, &[logged(scenario)]).unwrap();
    }
    let found = results(&folder, &format!("{evaluate} futures"), "out");
    let error = found["rows"][0]["min_ade"].as_f64().unwrap();
    assert!(error < 1e-5, "{error}");

    write_motion(&folder, "one.binproto", &[&scenarios[0]]);
    let words = |file: &str| format!("{evaluate} {file}");
    let missing = "expected predictions of scenario b, found none";
    fails(&folder, &words("one.binproto"), 1, missing);
    write_motion(&folder, "twice.binproto", &[&scenarios[0], &scenarios[0]]);
    let twice = "expected scenario a once, found it twice";
    fails(&folder, &words("twice.binproto"), 1, twice);
    let stranger = Scenario {
        id: "x".into(),
        ..scenarios[0].clone()
    };
    let three = [&scenarios[0], &scenarios[1], &stranger];
    write_motion(&folder, "three.binproto", &three);
    let unknown = "predictions of \"x\", which is not among the scenarios";
    fails(&folder, &words("three.binproto"), 1, unknown);
    fails(&folder, &words("two.tfrecord"), 1, "expected a");
    fails(&folder, &words("nothing"), 2, "nothing");
    let neither = "evaluate motion --scenarios two.tfrecord";
    fails(&folder, neither, 2, "--world");
    let wrong_shard = format!("{neither} --world idm --shard 3/2");
    fails(&folder, &wrong_shard, 2, "K/N");
}

const MAKER: &str =
    "--account me@example.org --method test --parameters 1K --complies-with-closed-loop";

#[test]
fn an_archive_is_packed_and_passes_its_own_check() {
    let folder = tempfile::tempdir().unwrap();
    two_scenarios(&folder);
    let submit = "submit wosac --scenarios two.tfrecord";
    let words = format!("{submit} --world constant-velocity {MAKER}");
    let found = results(&folder, &words, "out");
    assert_eq!(
        (&found["scenarios"], &found["n_problems"]),
        (&2.into(), &0.into())
    );
    assert_eq!(found["files"], serde_json::json!(["submission.tar.gz"]));
    let words = format!("{submit} --archive out/submission.tar.gz");
    assert_eq!(results(&folder, &words, "checked")["n_problems"], 0);
    // The archive lacks the scenarios of another set.
    let words = format!(
        "submit wosac --scenarios {} --archive out/submission.tar.gz",
        mini()
    );
    fails(
        &folder,
        &words,
        1,
        "breaks the challenge's rules in 26 ways",
    );
    let problems = report(&folder, "failed")["problems"].clone();
    assert_eq!(problems[0], "scenario \"a\" is not one of those expected");
}

#[test]
fn a_submission_that_breaks_the_rules_is_not_packed() {
    let folder = tempfile::tempdir().unwrap();
    let scenarios = two_scenarios(&folder);
    let submit = "submit wosac --scenarios two.tfrecord --rollouts futures.binproto";
    let mut messages: Vec<_> = scenarios
        .iter()
        .map(|s| {
            rollouts_to_proto(&s.id, &vec![logged(s); N_FUTURES])
                .unwrap()
                .0
        })
        .collect();
    let mut write = |damage: &dyn Fn(&mut Vec<proto::ScenarioRollouts>)| {
        let before = messages.clone();
        damage(&mut messages);
        let shard = SimAgentsChallengeSubmission {
            scenario_rollouts: std::mem::replace(&mut messages, before),
            ..SimAgentsChallengeSubmission::default()
        };
        fs::write(
            folder.path().join("futures.binproto"),
            shard.encode_to_vec(),
        )
        .unwrap();
    };
    let words = format!("{submit} {MAKER}");
    write(&|_| {});
    assert_eq!(results(&folder, &words, "good")["n_problems"], 0);
    write(&|m| m[1].joint_scenes[3].simulated_trajectories[0].heading[2] = f32::NAN);
    fails(
        &folder,
        &words,
        1,
        "scenario b: future 3: agent 0 has a state that is not a number",
    );
    assert!(!folder.path().join("failed/submission.tar.gz").exists());
    write(&|m| m.truncate(1));
    fails(&folder, &words, 1, "scenario b is missing");
    write(&|m| m[0].joint_scenes.truncate(7));
    fails(
        &folder,
        &words,
        1,
        "scenario a: expected 32 futures, found 7",
    );
    fails(&folder, submit, 2, "--account");
    fails(
        &folder,
        "submit wosac --scenarios two.tfrecord",
        2,
        "--rollouts",
    );
}

/// The value of one row of `evaluate behaviour`.
fn row<'a>(rows: &'a Value, world: &str, measure: &str, class: &str, seconds: u64) -> &'a Value {
    let rows = rows.as_array().unwrap().iter();
    let mut found = rows.filter(|row| {
        row["world"] == world
            && row["measure"] == measure
            && row["class"] == class
            && row["seconds"] == seconds
    });
    let row = found
        .next()
        .unwrap_or_else(|| panic!("no {measure} of {class} in {world}"));
    assert!(
        found.next().is_none(),
        "two rows {measure} of {class} in {world}"
    );
    row
}

#[test]
fn behaviour_is_counted_in_worlds_beside_the_log() {
    let folder = tempfile::tempdir().unwrap();
    let words = format!(
        "evaluate behaviour --scenarios {} --world log,constant-velocity,idm --futures 2 --limit 6",
        mini()
    );
    let results = results(&folder, &words, "out");
    assert_eq!(results["scenarios"], 6);
    let rows = &results["rows"];
    let keys = [
        "world", "class", "measure", "seconds", "value", "log", "low", "high",
    ];
    for one in rows.as_array().unwrap() {
        for key in keys {
            assert!(one.get(key).is_some(), "{key} is missing: {one}");
        }
        // The log replayed is the log.
        if one["world"] == "log" {
            assert_eq!(one["value"], one["log"], "{one}");
        }
        let number = |key: &str| one[key].as_f64();
        let inside = number("low")
            .zip(number("high"))
            .zip(number("value"))
            .is_none_or(|((low, high), value)| low <= value + 1e-9 && value <= high + 1e-9);
        assert!(inside, "{one}");
    }
    // At constant velocity, standing agents stay, and moving ones run into others.
    let parked = row(rows, "constant-velocity", "parked_move", "vehicle", 8);
    assert_eq!(parked["value"], 0.0);
    let overlaps = |world| {
        row(rows, world, "new_overlap", "all", 8)["value"]
            .as_f64()
            .unwrap()
    };
    assert!(overlaps("constant-velocity") > overlaps("log"), "{rows}");
    let standing = |seconds| &row(rows, "constant-velocity", "standing", "vehicle", seconds)["of"];
    assert!(standing(8).as_f64().unwrap() > 20.0);
    for file in [
        "shares.svg",
        "rates.png",
        "standing.svg",
        "rows.parquet",
        "scenarios.toml",
    ] {
        assert!(folder.path().join("out").join(file).is_file(), "{file}");
    }
}

#[test]
fn behaviour_after_the_log_has_no_log_and_shards_add_up() {
    let folder = tempfile::tempdir().unwrap();
    let verb = format!(
        "evaluate behaviour --scenarios {} --world idm --futures 1 --seconds 30 --limit 4",
        mini()
    );
    let whole = results(&folder, &verb, "whole");
    let rows = &whole["rows"];
    let late = row(rows, "idm", "standing", "vehicle", 30);
    assert!(late["value"].is_number() && late["log"].is_null(), "{late}");
    assert!(row(rows, "idm", "standing", "vehicle", 4)["log"].is_number());
    assert!(row(rows, "idm", "new_overlap", "all", 30)["log"].is_null());
    assert!(row(rows, "idm", "set_off", "vehicle", 30)["log"].is_number());
    for k in [1, 2] {
        results(&folder, &format!("{verb} --shard {k}/2"), &k.to_string());
    }
    let merged = results(&folder, "evaluate merge 2 1", "merged");
    assert_eq!(merged, whole);
}

#[test]
fn lights_are_counted_and_what_a_scene_lacks_is_noted() {
    let folder = tempfile::tempdir().unwrap();
    let scenario = gump_scene::fixture::scenario(
        "lane 1: -60,0 -8,0 next 3
         lane 2: 0,-60 0,-8 next 4
         lane 3: -8,0 60,0
         lane 4: 0,-8 0,60
         light 1 green:
         light 2 green:
         light 9 red:
         ego vehicle 0: -50,0 velocity 6,0
         agent vehicle 1: 0,-40 velocity 0,6
         history 1 future 9 dt 0.1",
    )
    .unwrap();
    let path = folder.path().join("crossing.json");
    gump_data::scenario_json::write_scenario(&path, &scenario).unwrap();
    let words = "evaluate behaviour --scenarios crossing.json --world log,idm --futures 4 \
                 --seconds 30";
    let found = results(&folder, words, "out");
    let notes = [("unmapped_light", 1), ("contradicting_lights", 1)];
    let check = |found: &Value| {
        let rows = found["notes"].as_array().unwrap().iter();
        let rows: Vec<_> = rows
            .map(|row| {
                (
                    row["note"].as_str().unwrap(),
                    row["cases"].as_u64().unwrap(),
                )
            })
            .collect();
        assert_eq!(rows, notes);
    };
    check(&found);
    assert!(folder.path().join("out/notes.parquet").is_file());
    let rows = &found["rows"];
    // The log contradicts itself throughout, the world never.
    let conflict = row(rows, "idm", "conflicting_green", "light", 30);
    assert_eq!(
        (&conflict["value"], &conflict["log"]),
        (&0.0.into(), &1.0.into())
    );
    for measure in ["red_phase_s", "green_phase_s", "light_change"] {
        let value = row(rows, "idm", measure, "light", 30)["value"].as_f64();
        assert!(
            value.is_some_and(|value| value > 1.0),
            "{measure}: {value:?}"
        );
    }
    let stands = row(rows, "idm", "free_road_standing", "vehicle", 30);
    assert!(
        stands["value"].is_number() && stands["log"].is_null(),
        "{stands}"
    );
    let shown = run(&folder, &format!("{words} --out shown"));
    let shown = String::from_utf8(shown.stdout).unwrap();
    for part in [
        "conflicting_green",
        "note: 1 lights of lanes that the map does not have",
    ] {
        assert!(shown.contains(part), "{part}: {shown}");
    }
    let words = "simulate --scenario crossing.json --world idm --futures 1 --seconds 2";
    check(&results(&folder, words, "simulated"));
    let held = results(&folder, &format!("{words} --lights hold"), "held");
    assert!(held.get("notes").is_none(), "{held}");
}

#[test]
fn behaviour_refuses_what_it_cannot_count() {
    let folder = tempfile::tempdir().unwrap();
    let verb = format!("evaluate behaviour --scenarios {}", mini());
    fails(&folder, &verb, 2, "--world");
    fails(
        &folder,
        &format!("{verb} --world sumo"),
        2,
        "expected log, idm",
    );
    fails(
        &folder,
        &format!("{verb} --world idm --seconds 9"),
        2,
        "expected 8, 30 or 60",
    );
    fails(
        &folder,
        &format!("{verb} --world idm --shard 3/2"),
        2,
        "K/N",
    );
    fails(
        &folder,
        "evaluate behaviour --scenarios nowhere --world idm",
        2,
        "nowhere",
    );
    fails(&folder, &format!("{verb} --world model:none"), 2, "none");
}

/// The row of `evaluate reactions` of a world and a manoeuvre.
fn reaction<'a>(results: &'a Value, world: &str, manoeuvre: &str) -> &'a Value {
    let rows = results["rows"].as_array().unwrap().iter();
    let mut found = rows.filter(|row| row["world"] == world && row["manoeuvre"] == manoeuvre);
    let row = found
        .next()
        .unwrap_or_else(|| panic!("no {manoeuvre} in {world}"));
    assert!(found.next().is_none(), "two rows {manoeuvre} in {world}");
    row
}

#[test]
fn who_reacts_runs_into_the_ego_less_than_who_does_not() {
    let folder = tempfile::tempdir().unwrap();
    let words = format!(
        "evaluate reactions --scenarios {} --world log,constant-velocity,idm --futures 2",
        mini()
    );
    let found = results(&folder, &words, "out");
    assert_eq!(found["scenarios"], 24);
    let number = |row: &Value, key: &str| row[key].as_f64().unwrap();
    for row in found["rows"].as_array().unwrap() {
        for key in ["world", "decoding", "manoeuvre", "agents", "low", "high"] {
            assert!(row.get(key).is_some(), "{key} is missing: {row}");
        }
        assert!(number(row, "agents") >= number(row, "scenes"), "{row}");
        let rate = number(row, "run_into_ego");
        assert!((0.0..=1.0).contains(&rate), "{row}");
        // The log replayed is the log.
        if row["world"] == "log" {
            assert_eq!(row["run_into_ego"], row["log"], "{row}");
        }
        // Every world is judged by the same agents.
        let log = reaction(&found, "log", row["manoeuvre"].as_str().unwrap());
        assert_eq!(row["agents"], log["agents"], "{row}");
    }
    // Recorded followers do not notice an ego that stops; those of IDM do.
    let rate = |world, manoeuvre| number(reaction(&found, world, manoeuvre), "run_into_ego");
    assert!(rate("log", "stop") > 0.05, "{}", found["rows"]);
    assert!(rate("idm", "stop") < 0.5 * rate("log", "stop"));
    // Where the ego follows its log, no agent of the log runs into it.
    assert_eq!(rate("log", "log"), 0.0);
    let cases = found["cases"].as_array().unwrap();
    let replayed = cases.iter().filter(|case| {
        case["world"] == "log" && case["manoeuvre"] == "stop" && case["near"] == true
    });
    assert_eq!(
        replayed.count() as f64,
        (rate("log", "stop") * number(reaction(&found, "log", "stop"), "agents")).round()
    );
    for file in [
        "reactions.svg",
        "rows.parquet",
        "cases.parquet",
        "scenarios.toml",
    ] {
        assert!(folder.path().join("out").join(file).is_file(), "{file}");
    }
}

#[test]
fn reactions_of_shards_add_up_for_any_number_of_threads() {
    let folder = tempfile::tempdir().unwrap();
    let verb = format!(
        "evaluate reactions --scenarios {} --world idm --futures 2 --limit 6 \
         --manoeuvre brake,change-lane",
        mini()
    );
    let whole = results(&folder, &format!("{verb} --threads 1"), "whole");
    for k in [1, 2] {
        results(
            &folder,
            &format!("{verb} --threads 3 --shard {k}/2"),
            &k.to_string(),
        );
    }
    let merged = results(&folder, "evaluate merge 2 1", "merged");
    assert_eq!(merged, whole);
}

#[test]
fn a_network_reacts_with_its_rules_and_alone() {
    let folder = tempfile::tempdir().unwrap();
    let weights = Path::new(env!("CARGO_MANIFEST_DIR")).join("../datasets/weights");
    let words = format!(
        "evaluate reactions --scenarios {} --world model:{}/gump-relative.safetensors \
         --manoeuvre stop --futures 1 --seconds 3 --limit 2",
        mini(),
        weights.display()
    );
    let found = results(&folder, &words, "out");
    let rows = found["rows"].as_array().unwrap().iter();
    let categories: Vec<_> = rows
        .map(|row| (&row["decoding"], &row["manoeuvre"]))
        .collect();
    let [stop, all] = ["stop", "all"].map(Value::from);
    let [ruled, raw] = ["ruled", "raw"].map(Value::from);
    assert_eq!(
        categories,
        [(&ruled, &stop), (&ruled, &all), (&raw, &stop), (&raw, &all)]
    );
}

#[test]
fn reactions_refuse_what_they_cannot_measure() {
    let folder = tempfile::tempdir().unwrap();
    let verb = format!("evaluate reactions --scenarios {}", mini());
    let wrong = [
        ("--world sumo", "expected log, idm"),
        ("--world idm --manoeuvre swerve", "expected log, brake"),
        ("--world idm --seconds 1", "2..=60"),
        ("--world idm --shard 3/2", "K/N"),
    ];
    for (flags, part) in wrong {
        fails(&folder, &format!("{verb} {flags}"), 2, part);
    }
    fails(
        &folder,
        &format!("{verb} --world idm --seconds 20 --limit 2"),
        1,
        "expected a log that goes on for 20 s, found 8.0 s",
    );
    fails(
        &folder,
        "evaluate reactions --scenarios nowhere --world idm",
        2,
        "nowhere",
    );
}
