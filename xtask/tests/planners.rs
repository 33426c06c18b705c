//! Evaluations of planners from the outside: shards that do not belong together, planners that fail,
//! and what a report says of its own limits.
#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

mod workplace;

use std::fs;
use std::path::Path;

use gump_model::checkpoint::StorageType;
use gump_model::{Device, ModelConfig, Network, checkpoint};
use gump_scene::Seed;
use serde_json::Value;
use workplace::Workplace;

impl Workplace {
    /// The results of a run that succeeds, and what it printed.
    fn results(&self, words: &str, out: &str) -> (Value, String) {
        let output = self.run(&format!("{words} --out {out}"));
        let error = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{words}: {error}");
        let text = fs::read_to_string(self.path(out).join("report.json")).unwrap();
        let mut report: Value = serde_json::from_str(&text).unwrap();
        let printed = String::from_utf8_lossy(&output.stdout).into_owned();
        (report["results"].take(), printed)
    }

    /// Checks that a run fails with one sentence that has these parts.
    fn fails(&self, words: &str, out: &str, parts: &[&str]) {
        let output = self.run(&format!("{words} --quiet --out {out}"));
        let error = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(1), "{words}: {error}");
        assert_eq!(error.trim().lines().count(), 1, "{words}: {error}");
        for part in parts {
            assert!(error.contains(part), "{words}: expected {part} in: {error}");
        }
    }

    /// Changes a ledger, which has `from` once.
    fn edit(&self, out: &str, from: &str, to: &str) {
        let path = self.path(out).join("scenarios.toml");
        let text = fs::read_to_string(&path).unwrap();
        assert_eq!(text.matches(from).count(), 1, "{from} in {text}");
        fs::write(path, text.replace(from, to)).unwrap();
    }

    /// Turns a ledger into one of version 0.1, which has no checksums.
    fn forget_checksums(&self, out: &str) {
        let path = self.path(out).join("scenarios.toml");
        let text = fs::read_to_string(&path).unwrap();
        let (before, rest) = text.split_once("[evaluation.settings.checksums]").unwrap();
        let (sums, after) = rest.split_once("[[scenario]]").unwrap();
        assert!(sums.contains("scenario_ids = "), "{sums}");
        fs::write(path, format!("{before}[[scenario]]{after}")).unwrap();
    }

    /// Writes scenes of one street with these ids.
    fn write_scenes(&self, ids: &[&str]) {
        let scenes = ids.iter().enumerate().map(|(i, id)| {
            let lane = match id.starts_with("no lanes") {
                true => "",
                false => "lane 1: -50,0 0,0 250,0 speed 15 width 3.5",
            };
            let text = format!(
                "{lane}
                 edge: -50,-4 250,-4
                 edge: 250,4 -50,4
                 ego vehicle 0: 0,0 velocity {},0
                 agent vehicle 1: 25,0 velocity 6,0
                 history 1.0 future 9.0 dt 0.1",
                5 + i
            );
            let mut scene = gump_scene::fixture::scenario(&text).unwrap();
            scene.id = (*id).into();
            scene
        });
        gump_data::womd::write_scenarios(&self.path("scenes.tfrecord"), scenes).unwrap();
    }

    fn write_weights(&self, seed: u64) {
        let config = ModelConfig {
            width: 32,
            layers: 1,
            heads: 2,
            trajectory_heads: vec![0],
            reconstruction: false,
            ..ModelConfig::tiny()
        };
        let network = Network::random(config, Seed(seed), &Device::Cpu).unwrap();
        checkpoint::save(&network, &self.path("w.safetensors"), StorageType::Half).unwrap();
    }
}

const DRIVE: &str = "evaluate closed-loop --films 0 --seconds 1";

fn mini() -> String {
    let repository = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let path = repository.join("datasets/mini/procedural.tfrecord.gz");
    path.display().to_string()
}

#[test]
fn intervals_of_shards_are_those_of_the_whole_whatever_the_seed() {
    let place = Workplace::new();
    let words = format!(
        "{DRIVE} --scenarios {} --limit 7 --world log --planner simple,idm",
        mini()
    );
    let timeless = |(mut results, _): (Value, String)| {
        for row in results["rows"].as_array_mut().unwrap() {
            row["milliseconds_per_step"] = Value::Null;
        }
        results
    };
    let whole = timeless(place.results(&format!("{words} --seed 5"), "whole"));
    for k in [1, 2] {
        let shard = format!("{words} --seed 5 --shard {k}/2");
        place.results(&shard, &k.to_string());
    }
    let merged = timeless(place.results("evaluate merge 2 1", "merged"));
    assert_eq!(merged, whole);
    // Neither the log nor these planners have any chance: only the intervals depend on the seed.
    let other = timeless(place.results(&words, "other"));
    assert_eq!(other["scenarios"], whole["scenarios"]);
    assert_ne!(other["rows"], whole["rows"]);
    assert_ne!(other["comparisons"], whole["comparisons"]);
}

#[test]
fn doubled_and_foreign_shards_of_drives_are_refused() {
    let place = Workplace::new();
    place.write_scenes(&["a", "b", "c", "d"]);
    let words = format!("{DRIVE} --scenarios scenes.tfrecord --world log --planner simple");
    for k in 1..=2 {
        place.results(&format!("{words} --shard {k}/2"), &format!("{k}of2"));
    }
    place.results(&format!("{words} --shard 1/3"), "1of3");
    place.results(&format!("{words} --shard 2/2 --seed 1"), "seed");
    let refused = |folders: &str, parts: &[&str]| {
        place.fails(&format!("evaluate merge {folders}"), "merged", parts);
    };
    refused("1of2 1of2", &["expected every shard once, found 1/2"]);
    let differ = "expected shards of one evaluation, but 1of2 and";
    refused(
        "1of2 1of3",
        &[differ, "1of3 differ: number of shards 2 and 3"],
    );
    refused("1of2 seed", &[differ, "seed differ: seed \"0\" and \"1\""]);
    // One shard in the folder of another.
    let parts = [
        "expected a folder for shard 2/2 alone, found shard 1/2",
        "1of2",
        "give every shard its own --out",
    ];
    place.fails(&format!("{words} --shard 2/2"), "1of2", &parts);
    let (merged, _) = place.results("evaluate merge 2of2 1of2", "merged");
    let scenarios = merged["scenarios"].as_array().unwrap().iter();
    let ids: Vec<&str> = scenarios.map(|row| row["id"].as_str().unwrap()).collect();
    assert_eq!(ids, ["a", "b", "c", "d"]);
    place.edit("1of2", "index = 2\n", "index = 0\n");
    refused("1of2 2of2", &["found scenario 0 twice in 1of2"]);
    let path = place.path("1of2/scenarios.toml");
    let text = fs::read_to_string(&path).unwrap();
    fs::write(path, text.replacen("index = 0\n", "index = 1\n", 1)).unwrap();
    refused("2of2 1of2", &["scenario 1 is not of shard 1/2: 1of2"]);
}

#[test]
fn a_broken_file_is_not_the_fault_of_a_planner() {
    let place = Workplace::new();
    place.write_scenes(&["a", "b"]);
    let bytes = fs::read(place.path("scenes.tfrecord")).unwrap();
    fs::write(place.path("scenes.tfrecord"), &bytes[..bytes.len() - 99]).unwrap();
    let parts = [
        "found 1 of 2 broken, which are left out; the first, scenes.tfrecord#1: ",
        "record 1 at byte",
    ];
    for (words, out) in [
        (format!("{DRIVE} --world log --planner simple"), "closed"),
        ("evaluate open-loop --planner simple".into(), "open"),
    ] {
        let words = format!("{words} --scenarios scenes.tfrecord");
        place.fails(&words, out, &parts);
        let text = fs::read_to_string(place.path(out).join("report.json")).unwrap();
        let results = &serde_json::from_str::<Value>(&text).unwrap()["results"];
        let row = &results["rows"][0];
        assert_eq!((&row["scenarios"], &row["failed"]), (&1.into(), &0.into()));
        assert_eq!(results["unreadable"][0]["id"], "scenes.tfrecord#1");
    }
    // The part that is there is no whole either.
    place.fails("evaluate merge closed", "merged", &parts);
}

#[test]
fn shards_of_other_scenarios_or_weights_under_the_same_names_are_refused() {
    let place = Workplace::new();
    // The network is loaded and not asked.
    let words = format!(
        "{DRIVE} --scenarios scenes.tfrecord --world log --planner simple \
         --imagination model:w.safetensors"
    );
    let drive = |shard: &str, out: &str| {
        place.results(&format!("{words} --shard {shard}"), out);
    };
    place.write_scenes(&["a", "b", "c"]);
    place.write_weights(0);
    drive("1/2", "first");
    drive("2/2", "second");
    place.write_weights(1);
    drive("2/2", "weights");
    place.write_weights(0);
    place.write_scenes(&["a", "x", "c"]);
    drive("2/2", "scenes");
    let refused = |folder: &str, input: &str| {
        let expected = format!("expected shards that read the same, found {input} of checksum");
        let words = format!("evaluate merge first {folder}");
        place.fails(&words, "merged", &[&expected, "in first but of", folder]);
    };
    refused("weights", "model:w.safetensors");
    refused("scenes", "scenario_ids");
    let merges = || {
        let (merged, _) = place.results("evaluate merge first second", "merged");
        assert_eq!(merged["rows"][0]["scenarios"], 3);
    };
    merges();
    place.forget_checksums("second");
    merges();
    place.forget_checksums("first");
    merges();
}

#[test]
fn scenarios_in_which_planners_fail_are_counted_and_named() {
    let place = Workplace::new();
    place.write_scenes(&["a", "no lanes", "c"]);
    let check = |results: &Value, printed: &str, failed: &str| {
        for row in results["rows"].as_array().unwrap() {
            assert_eq!((&row["scenarios"], &row["failed"]), (&3.into(), &1.into()));
            assert!(row["low"].is_number(), "{row}");
        }
        let warnings = results["warnings"].as_array().unwrap();
        let [warning] = &warnings[..] else {
            panic!("{warnings:?}")
        };
        let warning = warning.as_str().unwrap();
        assert!(warning.ends_with(failed), "{warning}");
        assert!(
            printed.contains(&format!("warning: {warning}")),
            "{printed}"
        );
        for scenario in results["scenarios"].as_array().unwrap() {
            let error = scenario["error"].as_str();
            let expected = scenario["id"] == "no lanes";
            assert_eq!(error.is_some(), expected, "{scenario}");
            assert!(
                error.is_none_or(|error| error.contains("lanes")),
                "{scenario}"
            );
        }
    };
    let scenes = "--scenarios scenes.tfrecord --planner simple,log";
    let (results, printed) = place.results(&format!("{DRIVE} {scenes} --world log"), "closed");
    let failed = "hard: simple among log in 1 of 3, log among log in 1 of 3";
    check(&results, &printed, failed);
    assert_eq!(results["comparisons"][0]["scenarios"], 2);
    let (results, printed) = place.results(&format!("evaluate open-loop {scenes}"), "open");
    check(&results, &printed, "hard: simple in 1 of 3, log in 1 of 3");
}

#[test]
fn a_single_scenario_has_no_interval_and_the_report_says_so() {
    let place = Workplace::new();
    place.write_scenes(&["a"]);
    let scenes = "--scenarios scenes.tfrecord --planner simple,log";
    let (results, printed) = place.results(&format!("{DRIVE} {scenes} --world log,idm"), "closed");
    let comparisons = results["comparisons"].as_array().unwrap();
    assert_eq!(comparisons.len(), 2);
    for row in comparisons {
        assert!(row["difference"].is_number(), "{row}");
        assert!(row["low"].is_null() && row["high"].is_null(), "{row}");
        assert_eq!(row["scenarios"], 1);
    }
    let warnings = [
        "an interval takes at least 2 scenarios, found 1, so there is none for simple among log, \
         log among log, simple among idm, log among idm",
        "differences without an interval, which takes at least 2 scenarios that both drove to the \
         end: simple less log among log (1), simple less log among idm (1)",
    ];
    assert_eq!(results["warnings"], serde_json::json!(warnings));
    for warning in warnings {
        assert!(
            printed.contains(&format!("warning: {warning}")),
            "{printed}"
        );
    }
    let (results, _) = place.results(&format!("evaluate open-loop {scenes}"), "open");
    let warnings = results["warnings"].as_array().unwrap();
    assert_eq!(warnings.len(), 1);
    let warning = warnings[0].as_str().unwrap();
    assert!(
        warning.ends_with("there is none for simple, log"),
        "{warning}"
    );
}

#[test]
fn the_scenes_of_a_difference_are_named_and_can_be_driven_again() {
    let place = Workplace::new();
    let scenes = mini();
    let words = format!("{DRIVE} --scenarios {scenes} --limit 8 --world idm --planner simple,idm");
    let (results, printed) = place.results(&words, "out");
    let drives = results["scenarios"].as_array().unwrap();
    let score = |planner: &Value, id: &Value| {
        let mut drives = drives.iter();
        let drive = drives.find(|drive| drive["planner"] == *planner && drive["id"] == *id);
        drive.unwrap()["score"].as_f64().unwrap()
    };
    let named = results["wins_and_losses"].as_array().unwrap();
    assert!(!named.is_empty() && printed.contains("wins_and_losses"));
    let largest = (0..8).map(|i| {
        let id = &drives[i]["id"];
        (score(&"simple".into(), id) - score(&"idm".into(), id)).abs()
    });
    let largest = largest.fold(0.0, f64::max);
    let mut found = 0.0_f64;
    for row in named {
        let difference = row["difference"].as_f64().unwrap();
        let (a, b) = (
            score(&row["planner"], &row["id"]),
            score(&row["less"], &row["id"]),
        );
        assert!((difference - (a - b)).abs() < 1e-12, "{row}");
        found = found.max(difference.abs());
    }
    assert!((found - largest).abs() < 1e-12, "{found} and {largest}");
    assert!(place.path("out/wins_and_losses.parquet").is_file());
    let id = named[0]["id"].as_str().unwrap();
    let words = format!("plan --scenario {scenes}#{id} --planner idm --world idm --seconds 1");
    let (planned, _) = place.results(&words, "plan");
    assert_eq!(planned["score"], score(&"idm".into(), &named[0]["id"]));
}
