//! `rl` from the outside: learning, going on, evaluating, and what is refused.
#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::Value;

const CONFIG: &str = "[env]\nn_envs = 4\n\
                      [ppo]\nrounds = 40\nunroll = 4\nbatch = 8\nhidden = [16]\nsegment = 20\n\
                      critic_rounds = 5\nimitation_steps = 20\nimitation_weight = 0.1\n\
                      [sac]\nsteps = 40\nbatch = 16\nhidden = [16]\n\
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
    for words in ["sac --train-world idm", "ppo", "imitation"] {
        for folder in ["whole", "halves"].map(|name| place.path(name)) {
            if folder.exists() {
                fs::remove_dir_all(folder).unwrap();
            }
        }
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
    assert_eq!(results["set"], "scene.tfrecord");
    let said = |results: &Value| results["warnings"].as_array().unwrap().clone();
    let alone = said(&results);
    assert!(
        alone.len() == 1
            && alone[0]
                .as_str()
                .unwrap()
                .contains("imitation in log among idm"),
        "{alone:?}"
    );
    let single = place.results(&format!("{words} --limit 1"), "single");
    assert!(
        said(&single)[0]
            .as_str()
            .unwrap()
            .contains("found 1, so there is none for")
    );
    assert_eq!(
        (
            &single["rows"][0]["low"],
            &single["rows"][0]["interval_over"]
        ),
        (&Value::Null, &Value::Null)
    );

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
    for part in ["rows", "differences", "scenarios", "set", "warnings"] {
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

/// Overwrites the temperature of a checkpoint, after which no loss is finite.
fn overheat(checkpoint: &Path) {
    let mut bytes = fs::read(checkpoint).unwrap();
    let len = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let header: Value = serde_json::from_slice(&bytes[8..8 + len]).unwrap();
    let start = header["log_alpha"]["data_offsets"][0].as_u64().unwrap() as usize;
    bytes[8 + len + start..][..4].copy_from_slice(&1e3f32.to_le_bytes());
    fs::write(checkpoint, bytes).unwrap();
}

#[test]
fn a_run_that_diverges_leaves_its_last_good_checkpoint() {
    let place = Workplace::new();
    place.results(&format!("{TRAIN} sac --stop-at 1"), "run");
    overheat(&place.path("run/checkpoint.safetensors"));
    let files = ["checkpoint.safetensors", "policy.safetensors"];
    let before = files.map(|name| bytes(&place.path("run"), name));
    let expected = "learning diverged at gradient step 21: a loss is not finite; the last good \
                    checkpoint is run/checkpoint.safetensors, after step 20";
    place.fails(&format!("{TRAIN} sac --resume --out run"), 1, expected);
    let after = files.map(|name| bytes(&place.path("run"), name));
    assert!(before == after);

    // One step whose loss is fine, and parameters that are not.
    let too_fast = CONFIG.replace("steps = 40\nbatch", "steps = 1\nbatch");
    let too_fast = format!("{too_fast}learning_rate = 1e38\n");
    fs::write(place.path("c.toml"), too_fast).unwrap();
    for algorithm in ["sac", "imitation"] {
        let expected = "diverged at gradient step 1: a number of \"actor.parameters\" is not \
                        finite; this run has no checkpoint yet";
        place.fails(&format!("{TRAIN} {algorithm} --out fast"), 1, expected);
        assert!(
            files
                .iter()
                .all(|name| !place.path("fast").join(name).exists())
        );
    }
}

#[test]
fn a_run_of_rounds_that_diverges_says_so() {
    let place = Workplace::new();
    let too_fast = CONFIG.replace("[ppo]\n", "[ppo]\nlearning_rate = 1e38\n");
    fs::write(place.path("c.toml"), too_fast).unwrap();
    place.fails(
        &format!("{TRAIN} ppo --out fast"),
        1,
        "learning diverged at",
    );
    assert!(!place.path("fast/policy.safetensors").exists());
}

#[test]
fn the_table_goes_on_without_a_policy_that_diverges() {
    let place = Workplace::new();
    place.results(
        &format!("{TRAIN} sac --stop-at 1 --seed 1"),
        "table/sac-log-1",
    );
    let checkpoint = place.path("table/sac-log-1/checkpoint.safetensors");
    overheat(&checkpoint);
    let before = fs::read(&checkpoint).unwrap();
    let words = "rl table --world idm --scenarios scene.tfrecord --policies 2";
    let first = place.results(words, "table");
    assert!(before == fs::read(&checkpoint).unwrap());
    assert_eq!(first["trained"].as_array().unwrap().len(), 5);
    let rows = first["rows"].as_array().unwrap();
    assert_eq!(rows.len(), 12);
    for row in rows {
        let is_hit = row["policy"] == "sac" && row["train_world"] == "log";
        assert_eq!(row["diverged"], u64::from(is_hit), "{row}");
        let n = 1 + u64::from(row["train_world"].is_string() && !is_hit);
        assert_eq!(row["policies"], n, "{row}");
    }
    let diverged = first["diverged"].as_array().unwrap();
    assert_eq!((diverged.len(), &diverged[0]["seed"]), (1, &"1".into()));
    let why = diverged[0]["why"].as_str().unwrap();
    assert!(why.contains("after step 20"), "{why}");
    let said = first["warnings"].to_string();
    assert!(
        said.contains("1 of 2 policies of sac in log diverged"),
        "{said}"
    );
    // The same again, without another attempt.
    let again = place.results(words, "table");
    assert_eq!(again["rows"], first["rows"]);
    assert_eq!(again["trained"].as_array().unwrap().len(), 5);
    fs::remove_file(place.path("table/sac-log-1/diverged.toml")).unwrap();
    fs::remove_file(&checkpoint).unwrap();
    let whole = place.results(words, "table");
    assert!(whole["diverged"].is_null() && whole["rows"][0]["diverged"].is_null());
    assert_eq!(whole["trained"].as_array().unwrap().len(), 6);
}

#[test]
fn a_table_of_several_worlds_is_trained_and_tested_in_shards() {
    let place = Workplace::new();
    let words = "rl table --world idm,constant-velocity --scenarios scene.tfrecord \
                 --policies 1 --imitation-policies 2 --policy-folder policies";
    let expected = "expected 5 trained policies before a shard is tested, found 5 unfinished";
    place.fails(&format!("{words} --shard 1/2 --out early"), 1, expected);
    for k in 1..=2 {
        let trained = place.results(&format!("{words} --train-only --shard {k}/2"), "train");
        assert_eq!(trained["trained"].as_array().unwrap().len(), [3, 2][k - 1]);
        assert_eq!(trained["train_set"], "scene.tfrecord");
        assert!(trained["rows"].is_null());
    }
    for k in 1..=2 {
        place.results(&format!("{words} --shard {k}/2"), &format!("test-{k}"));
    }
    let folders = [1, 2].map(|k| place.path(&format!("test-{k}")).display().to_string());
    let merged = place.results(&format!("evaluate merge {}", folders.join(" ")), "merged");
    let whole = place.results(words, "whole");
    assert!(
        whole["trained"]
            .as_array()
            .unwrap()
            .iter()
            .all(|t| t["resumed"] == true)
    );
    // Three rules and four kinds of policies in three worlds.
    assert_eq!(whole["rows"].as_array().unwrap().len(), 21);
    assert_eq!(whole["rows"][3]["policies"], 2);
    for part in ["rows", "differences", "scenarios", "set"] {
        assert_eq!(merged[part], whole[part], "{part}");
    }
}

const LIST: &str = "name = \"small\"\nabout = \"For a test.\"\n\
    [[made]]\nfile = \"train\"\nsplit = \"train\"\ngenerator = \"procedural/1\"\nseed = 5\n\
    count = 1\n\
    [[made]]\nfile = \"test\"\nsplit = \"test\"\ngenerator = \"procedural/1\"\n\
    seed = 900000998\ncount = 2\n";

#[test]
fn lists_of_scenes_are_learned_from_and_tested_on_by_split() {
    let place = Workplace::new();
    fs::write(place.path("small.toml"), LIST).unwrap();
    let train = "rl train --algorithm imitation --scenarios small.toml";
    place.fails(train, 1, "data benchmark --list");
    place.results(
        "data benchmark --list small.toml --freeze",
        "out/data-benchmark",
    );
    let trained = place.results(train, "policy");
    assert_eq!(
        (&trained["set"], &trained["scenarios"]),
        (&"small/train".into(), &1.into())
    );
    let tested = |scenarios: &str| {
        let words = "rl evaluate --policy policy/policy.safetensors --scenarios";
        let results = place.results(&format!("{words} {scenarios}"), "tested");
        (results["set"].clone(), results["scenarios"].clone())
    };
    assert_eq!(tested("small.toml"), ("small/test".into(), 2.into()));
    assert_eq!(tested("small.toml#train"), ("small/train".into(), 1.into()));
    let words = "rl table --world idm --policies 1 --scenarios small.toml";
    let table = place.results(words, "table");
    assert_eq!(
        (&table["train_set"], &table["set"]),
        (&"small/train".into(), &"small/test".into())
    );
    place.fails(&format!("{train}#tune"), 2, "#SPLIT with train or test");
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
        2,
        "found no checkpoint.safetensors",
    );
    place.results(&format!("{TRAIN} sac"), "run");
    let before = bytes(&place.path("run"), "policy.safetensors");
    for flags in ["", " --seed 3", " --from run/checkpoint.safetensors"] {
        let words = format!("{TRAIN} ppo{flags} --out run");
        place.fails(&words, 2, "would replace: continue that run with --resume");
    }
    assert!(bytes(&place.path("run"), "policy.safetensors") == before);
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
    place.fails(&format!("{table} idm,idm"), 2, "found idm twice");
    place.fails(
        &format!("{table} idm --imitation-policies 0"),
        2,
        "--imitation-policies",
    );
    let alone = format!("{table} idm --train-only --shard 1/2");
    place.fails(&alone, 2, "--policy-folder");
    let evaluate = "rl evaluate --scenarios scene.tfrecord --policy";
    place.fails(&format!("{evaluate} c.toml"), 1, "c.toml");
    place.fails(&format!("{evaluate} brake --repeats 0"), 2, "--repeats");
    fs::write(place.path("c.toml"), "[sac]\nbach = 3\n").unwrap();
    place.fails(&format!("{TRAIN} sac"), 2, "batch");
}
