//! `rl` from the outside: learning, going on, evaluating, and what is refused.
#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::Value;

const CONFIG: &str = "[env]\nn_envs = 4\n[sac]\nsteps = 40\nbatch = 16\nhidden = [16]\n\
                      initial_steps = 40\nsegment = 20\nreplay_capacity = 100\n";

/// A folder for one test with a scene and a configuration.
struct Workplace {
    folder: tempfile::TempDir,
}

impl Workplace {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let scenario = gump_scene::fixture::scenario(
            "lane 1: -50,0 350,0 speed 15 width 3.5
             edge: -50,-2 350,-2
             edge: 350,2 -50,2
             route 1
             ego vehicle 0: 0,0 velocity 8,0
             agent vehicle 1: 30,0 velocity 6,0",
        )
        .unwrap();
        let path = folder.path().join("scene.tfrecord");
        let mut other = scenario.clone();
        other.id = "other".into();
        gump_data::womd::write_scenarios(&path, [scenario, other]).unwrap();
        fs::write(folder.path().join("c.toml"), CONFIG).unwrap();
        Self { folder }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn run(&self, words: &str) -> Output {
        Command::new(env!("CARGO_BIN_EXE_xtask"))
            .args(words.split(' '))
            .args(["--config", "c.toml"])
            .current_dir(self.folder.path())
            .env("CARGO_MANIFEST_DIR", env!("CARGO_MANIFEST_DIR"))
            .output()
            .unwrap()
    }

    fn results(&self, words: &str, out: &str) -> Value {
        let output = self.run(&format!("{words} --out {out}"));
        let error = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{words}: {error}");
        let report = fs::read_to_string(self.path(out).join("report.json")).unwrap();
        serde_json::from_str::<Value>(&report).unwrap()["results"].take()
    }

    fn fails(&self, words: &str, status: i32, part: &str) {
        let output = self.run(words);
        let error = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(status), "{words}: {error}");
        assert!(
            error.contains(part) && !error.contains("panicked"),
            "{words}: {error}"
        );
    }
}

fn bytes(folder: &Path, name: &str) -> Vec<u8> {
    fs::read(folder.join(name)).unwrap()
}

const TRAIN: &str = "rl train --scenarios scene.tfrecord --algorithm";

#[test]
fn a_policy_learns_goes_on_and_is_evaluated() {
    let place = Workplace::new();
    for words in ["sac --train-world idm", "imitation"] {
        let whole = place.results(&format!("{TRAIN} {words}"), "whole");
        assert_eq!(
            (&whole["steps"], &whole["scenarios"]),
            (&40.into(), &2.into())
        );
        place.results(&format!("{TRAIN} {words} --stop-at 1"), "halves");
        let rest = place.results(&format!("{TRAIN} {words} --resume"), "halves");
        assert_eq!(
            (&rest["steps"], &rest["resumed"]),
            (&40.into(), &true.into())
        );
        let [whole, halves] = ["whole", "halves"].map(|name| place.path(name));
        for name in ["checkpoint.safetensors", "policy.safetensors", "curves.csv"] {
            assert!(
                bytes(&whole, name) == bytes(&halves, name),
                "{words}: {name}"
            );
        }
    }
    let words = "rl evaluate --scenarios scene.tfrecord --repeats 2 --test-world log,idm \
                 --policy whole/policy.safetensors,expert,brake";
    let results = place.results(words, "evaluated");
    let rows = results["rows"].as_array().unwrap();
    assert_eq!(rows.len(), 6);
    assert_eq!(
        (&rows[0]["policy"], &rows[0]["train_world"]),
        (&"imitation".into(), &"log".into())
    );
    assert_eq!(
        (&rows[1]["policy"], &rows[1]["episodes"]),
        (&"expert".into(), &4.into())
    );
    assert_eq!(rows[1]["collision_rate"], 0.0);
    assert!(rows[1]["progress_m"].as_f64().unwrap() > 60.0);
    assert!(rows[2]["score"].as_f64() < rows[1]["score"].as_f64());
    assert_eq!(results["differences"].as_array().unwrap().len(), 6);
    let drives = fs::read_to_string(place.path("evaluated/drives.csv")).unwrap();
    assert_eq!(drives.lines().count(), 1 + 6 * 4);

    // Shards put together are the whole.
    for k in 1..=2 {
        place.results(&format!("{words} --shard {k}/2"), &format!("shard-{k}"));
    }
    let merge = |shards: &str| {
        let folders = shards.split(' ').map(|k| place.path(&format!("shard-{k}")));
        let folders: Vec<String> = folders.map(|f| f.display().to_string()).collect();
        format!("evaluate merge {}", folders.join(" "))
    };
    let merged = place.results(&merge("2 1"), "merged");
    for part in ["rows", "differences", "scenarios"] {
        assert_eq!(merged[part], results[part], "{part}");
    }
    let again = fs::read_to_string(place.path("merged/drives.csv")).unwrap();
    assert_eq!(again, drives);
    let half = place.results(&format!("{} --incomplete", merge("2")), "half");
    assert_eq!(
        (&half["scenarios"], &half["shards"]),
        (&1.into(), &"2/2".into())
    );
    let other = words.replace("whole/policy", "halves/policy");
    place.results(&format!("{other} --shard 2/2"), "shard-foreign");
    for wrong in ["1 foreign", "1 1", "1"] {
        place.fails(&merge(wrong), 1, "shard");
    }
}

#[test]
fn the_table_trains_what_is_missing() {
    let place = Workplace::new();
    let words = "rl table --world idm --scenarios scene.tfrecord --policies 2";
    let first = place.results(words, "table");
    // Three rules and three kinds of policies in two worlds.
    assert_eq!(first["rows"].as_array().unwrap().len(), 12);
    assert_eq!(first["rows"][3]["policies"], 2);
    let again = place.results(words, "table");
    assert_eq!(again["rows"], first["rows"]);
    assert!(
        again["trained"]
            .as_array()
            .unwrap()
            .iter()
            .all(|t| t["resumed"] == true)
    );
}

#[test]
fn what_cannot_be_is_refused() {
    let place = Workplace::new();
    place.fails(
        &format!("{TRAIN} imitation --train-world idm"),
        2,
        "--train-world",
    );
    place.fails(
        &format!("{TRAIN} sac --resume --out nowhere"),
        1,
        "checkpoint.safetensors",
    );
    place.results(&format!("{TRAIN} sac"), "run");
    place.fails(
        &format!("{TRAIN} sac --resume --steps 50 --out run"),
        2,
        "--steps 50",
    );
    place.fails(
        &format!("{TRAIN} imitation --resume --out run"),
        2,
        "--algorithm",
    );
    let table = "rl table --scenarios scene.tfrecord --world";
    place.fails(&format!("{table} log"), 2, "--world");
    let evaluate = "rl evaluate --scenarios scene.tfrecord --policy";
    place.fails(&format!("{evaluate} c.toml"), 1, "c.toml");
    place.fails(&format!("{evaluate} brake --repeats 0"), 2, "--repeats");
    fs::write(place.path("c.toml"), "[sac]\nbach = 3\n").unwrap();
    place.fails(&format!("{TRAIN} sac"), 2, "batch");
}
