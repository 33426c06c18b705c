//! Every verb from the outside: exit status, sentences, files, and the report that scripts rely on.
#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

mod workplace;

#[path = "../../tests/shared.rs"]
mod shared_data;

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use gump_kernels::Kernel;
use gump_model::checkpoint::StorageType;
use gump_model::{Device, ModelConfig, Network, checkpoint};
use gump_scene::Seed;
use gump_train::{ModelChoice, RunConfig, TrainConfig};
use serde_json::Value;
use shared_data::shared;
use workplace::Workplace;

impl Workplace {
    /// Runs a verb that succeeds and returns its report.
    fn report(&self, words: &str) -> Value {
        let output = self.run(&format!("{words} --out out"));
        assert!(output.status.success(), "{words}: {}", stderr(&output));
        read_report(&self.path("out"))
    }

    /// Checks the exit status and that the error is one sentence with these parts.
    fn fails(&self, words: &str, status: i32, parts: &[&str]) {
        let output = self.run(words);
        let error = stderr(&output);
        assert_eq!(output.status.code(), Some(status), "{words}: {error}");
        assert!(!error.contains("panicked"), "{words}: {error}");
        for part in parts {
            assert!(error.contains(part), "{words}: expected {part} in: {error}");
        }
    }

    /// A small recorded scene on a file.
    fn scene(&self) -> &'static str {
        let scenario = gump_scene::fixture::scenario(
            "lane 1: -50,0 0,0 50,0 150,0 speed 15 width 3.5
             edge: -50,-2 150,-2
             edge: 150,2 -50,2
             ego vehicle 0: 0,0 velocity 8,0
             agent vehicle 1: 20,0 velocity 6,0
             agent pedestrian 2: 30,4",
        )
        .unwrap();
        gump_data::womd::write_scenarios(&self.path("scene.tfrecord"), [scenario]).unwrap();
        "scene.tfrecord"
    }

    /// Weights of a very small network that has learned nothing.
    fn weights(&self) -> &'static str {
        let network = Network::random(very_small(), Seed(0), &Device::Cpu).unwrap();
        checkpoint::save(&network, &self.path("w.safetensors"), StorageType::Half).unwrap();
        "w.safetensors"
    }

    /// Names in the output folder, sorted.
    fn files(&self) -> Vec<String> {
        let entries = fs::read_dir(self.path("out")).unwrap();
        let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
        let mut names: Vec<_> = names.collect();
        names.sort();
        names
    }
}

/// The shape of a network that is quick to build.
fn very_small() -> ModelConfig {
    ModelConfig {
        width: 32,
        layers: 1,
        heads: 2,
        trajectory_heads: vec![0],
        reconstruction: false,
        ..ModelConfig::tiny()
    }
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn read_report(folder: &Path) -> Value {
    serde_json::from_str(&fs::read_to_string(folder.join("report.json")).unwrap()).unwrap()
}

fn mini() -> String {
    let path =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../datasets/mini/procedural.tfrecord.gz");
    path.display().to_string()
}

#[test]
fn wrong_arguments_exit_with_2() {
    let place = Workplace::new();
    for words in [
        "",
        "fly",
        "simulate",
        "data inspect",
        "simulate --scenario s --world nowhere",
        "simulate --scenario s --world idm --futures 0",
        "simulate --scenario s --world idm --seconds 0",
        "simulate --scenario s --world idm --temperature 0",
        "simulate --scenario s --world idm --heat",
        "simulate --scenario s --world idm --device cuda",
        "simulate --scenario s --world idm --kernel neon",
        "data synthesize --scenes 1 --family cul-de-sac",
        "tidy --seed many",
    ] {
        place.fails(words, 2, &[]);
    }
    if Kernel::Amx.is_present() {
        eprintln!("skipped: this processor has amx, so that it can be asked for");
    } else {
        let words = "simulate --scenario s --world idm --kernel amx";
        place.fails(words, 2, &["--kernel", "no kernel amx"]);
    }
}

#[cfg(not(feature = "rerun"))]
#[test]
fn a_format_that_is_not_built_in_names_its_feature() {
    let words = "simulate --scenario s --world idm --format rerun";
    Workplace::new().fails(words, 2, &["--format rerun", "--features rerun"]);
}

#[test]
fn unknown_keys_of_a_config_file_are_refused_with_the_nearest() {
    let place = Workplace::new();
    fs::write(place.path("c.toml"), "futurs = 3\n").unwrap();
    let words = "simulate --scenario s --world idm --config c.toml";
    place.fails(words, 2, &["c.toml", "futurs", "did you mean futures?"]);
    fs::write(place.path("c.toml"), "[train.optimizer]\nwarm_up = 3\n").unwrap();
    let words = "train --data s --config c.toml";
    place.fails(words, 2, &["c.toml", "warm_up", "did you mean warmup?"]);
    fs::write(place.path("c.toml"), "model = \"huge\"\n").unwrap();
    place.fails(words, 2, &["huge", "tiny"]);
}

#[test]
fn flags_override_the_config_file() {
    let place = Workplace::new();
    let scene = place.scene();
    let file = format!("scenario = \"{scene}\"\nworld = \"idm\"\nfutures = 3\nseconds = 1\n");
    fs::write(place.path("c.toml"), file).unwrap();
    let report = place.report("simulate --config c.toml --futures 2");
    assert_eq!(report["results"]["futures"], 2);
    assert_eq!(report["results"]["steps"], 10);
    assert_eq!(report["config"]["world"], "idm");
}

#[test]
fn a_report_says_what_was_done() {
    let place = Workplace::new();
    let report = place.report("data synthesize --scenes 2 --seed 7");
    let keys: Vec<_> = report
        .as_object()
        .unwrap()
        .keys()
        .map(String::as_str)
        .collect();
    let expected = [
        "verb",
        "args",
        "commit",
        "seed",
        "config",
        "machine",
        "seconds",
        "peak_rss_mb",
        "results",
    ];
    assert_eq!(keys, expected);
    assert_eq!(report["verb"], "data synthesize");
    assert_eq!(report["seed"], 7);
    assert_eq!(report["args"][3], "2");
    assert!(report["seconds"]["total"].as_f64().unwrap() > 0.0);
    for key in ["cpu", "cores", "memory_gb", "device"] {
        assert!(report["machine"].get(key).is_some(), "{key}");
    }
}

#[test]
fn bad_input_is_one_sentence_and_exit_1() {
    let place = Workplace::new();
    let check = |words: &str, parts: &[&str]| {
        place.fails(words, 1, parts);
        let error = stderr(&place.run(words));
        assert_eq!(error.trim().lines().count(), 1, "{words}: {error}");
    };
    for words in [
        "data inspect nothing",
        "data verify nothing",
        "simulate --scenario nothing --world idm",
    ] {
        place.fails(words, 2, &["nothing"]);
        assert_eq!(stderr(&place.run(words)).trim().lines().count(), 1);
    }
    fs::write(place.path("empty"), "").unwrap();
    check("data inspect empty", &["empty"]);
    fs::write(place.path("text"), "once upon a time there was a car").unwrap();
    check("data inspect text", &["text", "once"]);
    let scene = place.scene();
    let words = format!("simulate --scenario {scene} --world model:text");
    check(&words, &["text"]);
    check("train --data empty", &["empty"]);
}

#[test]
fn inspect_counts_and_draws() {
    let place = Workplace::new();
    let scene = place.scene();
    let results = &place.report(&format!("data inspect {scene} --picture"))["results"];
    assert_eq!(results["scenarios"], 1);
    assert_eq!(results["agents_now"]["vehicle"], 2);
    assert_eq!(results["agents_now"]["pedestrian"], 1);
    let png = fs::read(place.path("out/picture.png")).unwrap();
    assert!(png.starts_with(b"\x89PNG"));
    let one = &place.report(&format!("data inspect {}#3", mini()))["results"];
    assert_eq!(one["scenarios"], 1);
    assert!(
        one["inferred"]
            .as_object()
            .is_some_and(|counts| !counts.is_empty())
    );
}

#[test]
fn verify_tells_sound_from_broken() {
    let place = Workplace::new();
    let results = &place.report(&format!("data verify {}", mini()))["results"];
    assert_eq!(
        (&results["scenarios"], &results["broken"]),
        (&24.into(), &0.into())
    );

    let scene = place.scene();
    let mut bytes = fs::read(place.path(scene)).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 0xFF;
    fs::write(place.path("damaged"), bytes).unwrap();
    place.fails(
        "data verify damaged --out out",
        1,
        &["broken", "1 findings"],
    );
    let report = read_report(&place.path("out"));
    assert_eq!(report["results"]["broken"], 1);
    assert!(report["error"].as_str().unwrap().contains("broken"));
}

#[test]
fn the_distance_between_sets_is_told_for_scenes_and_for_tables() {
    let place = Workplace::new();
    place.report("data synthesize --scenes 2 --shards 1 --profile recorded-like --cache --seed 3");
    assert_eq!(
        place.files(),
        ["report.json", "scenes-00000-of-00001.cache"]
    );
    let made = place.path("made");
    fs::rename(place.path("out"), &made).unwrap();
    let same = place.report("data stats made --against made --save-targets made.toml");
    assert_eq!(same["results"]["distance_mean"], 0.0);
    let rows = same["results"]["distances"].as_array().unwrap();
    assert!(rows.len() > 40 && rows.iter().any(|row| row["measure"] == "parked"));
    let from_table = place.report("data stats made --against made.toml");
    assert!(from_table["results"]["distance_mean"].as_f64().unwrap() < 1e-3);
    let scene = place.scene();
    let far = place.report(&format!("data stats {scene} --against made.toml"));
    let row = |measure: &str| {
        let rows = far["results"]["distances"].as_array().unwrap();
        let is = |row: &&Value| row["measure"] == measure && row["class"] == "vehicle";
        rows.iter().find(is).unwrap().clone()
    };
    assert_eq!(row("standing")["mean"], 0.0);
    assert!(row("standing")["distance"].as_f64().unwrap() > 0.5);
    place.fails(
        "data synthesize --kind sumo --profile recorded-like --scenes 1",
        2,
        &["--kind procedural"],
    );
    place.fails(
        "data synthesize --profile real --scenes 1",
        2,
        &["recorded-like"],
    );
}

#[test]
fn stats_count_sources_classes_and_tags() {
    let place = Workplace::new();
    let scene = place.scene();
    let results = place.report(&format!("data stats {scene} {scene}"))["results"].clone();
    assert_eq!(
        (&results["scenes"], &results["refused"]),
        (&2.into(), &0.into())
    );
    let sources = results["sources"].as_array().unwrap();
    assert_eq!((sources.len(), &sources[0]), (2, &sources[1]));
    assert_eq!(sources[0]["vehicle"], 2);
    assert_eq!(sources[0]["pedestrian"], 1);
    assert_eq!(sources[0]["lane_km"], 0.2);
    assert_eq!(results["duration_s"]["median"], 9.0);
    let vehicles = &results["classes"][0];
    assert_eq!(vehicles["class"], "vehicle");
    assert_eq!(vehicles["standing"], 0.0);
    assert_eq!(vehicles["speed_median"], 6.0);
    assert_eq!(vehicles["speed_p99"], 8.0);
    assert_eq!(results["classes"][1]["standing"], 1.0);
    let tag = &results["tags"][0];
    assert_eq!(tag["tag"], "medium_magnitude_speed");
    assert_eq!((&tag["scenes"], &tag["share"]), (&2.into(), &1.0.into()));
    place.fails("data stats nowhere", 2, &["nowhere"]);
}

#[test]
fn convert_makes_a_cache_that_goes_on_where_it_stopped() {
    let place = Workplace::new();
    let scene = fs::read(place.path(place.scene())).unwrap();
    fs::create_dir(place.path("in")).unwrap();
    for name in ["a", "b", "c"] {
        fs::write(place.path(&format!("in/{name}.tfrecord")), &scene).unwrap();
    }
    fs::write(place.path("in/broken.tfrecord"), &scene[..99]).unwrap();
    let all = "data convert --from in --to cache";
    let results = |words: &str| place.report(words)["results"].clone();
    // The file that ends too early makes the exit status 1, after the others are converted.
    let mark = place.path("cache/CACHE-INCOMPLETE");
    let converted = |words: &str| {
        let parts = [
            "in/broken.tfrecord",
            "the rest is converted",
            "CACHE-INCOMPLETE",
        ];
        place.fails(&format!("{words} --out out"), 1, &parts);
        place.fails("data inspect cache", 1, &["CACHE-INCOMPLETE"]);
        fs::remove_file(&mark).unwrap();
        read_report(&place.path("out"))["results"].clone()
    };
    let first = converted(all);
    assert_eq!(
        (&first["scenarios"], &first["resumed"]),
        (&3.into(), &0.into())
    );
    let problem = first["problems"][0].as_str().unwrap();
    assert!(problem.contains("in/broken.tfrecord"), "{problem}");
    // What a run that was stopped lacks is made, the rest is kept.
    let lost = fs::read(place.path("cache/scenes-00000.cache")).unwrap();
    fs::remove_file(place.path("cache/scenes-00000.cache")).unwrap();
    let again = converted(&format!("{all} --threads 1"));
    assert_eq!(again["resumed"], 2);
    for key in ["scenarios", "bytes", "files", "problems", "inferred"] {
        assert_eq!(again[key], first[key], "{key}");
    }
    assert_eq!(
        fs::read(place.path("cache/scenes-00000.cache")).unwrap(),
        lost
    );
    let seen = results("data inspect cache");
    assert_eq!(
        (&seen["format"], &seen["scenarios"]),
        (&"gump cache".into(), &3.into())
    );
    fs::remove_file(place.path("in/broken.tfrecord")).unwrap();
    place.fails(all, 2, &["the conversion of other files"]);
    fs::remove_dir_all(place.path("cache")).unwrap();
    results(all);
    assert!(!mark.exists());
    place.fails(
        "data convert --from in --to in/cache",
        2,
        &["lies in --from"],
    );
    place.fails(
        "data convert --from in --to cache --format waymo",
        2,
        &["another format"],
    );
    place.fails(&format!("{all} --smooth"), 2, &["another --smooth"]);
    let smooth = results("data convert --from in --to smooth --smooth --format parquet");
    assert_eq!(
        smooth["inferred"]["smoothed state"],
        Value::Null,
        "Waymo's are smooth"
    );
    place.fails(
        "data convert --from cache --to in",
        2,
        &["3 files of something else"],
    );
    fs::write(place.path("in/broken.tfrecord"), &scene[..99]).unwrap();
    place.fails(
        "data convert --from in/broken.tfrecord --to x",
        1,
        &["none could be"],
    );
}

#[test]
fn synthesized_scenes_are_sound_and_depend_on_the_seed_alone() {
    let place = Workplace::new();
    let bytes = |words: &str| {
        place.report(&format!("data synthesize --scenes 3 --shards 2 {words}"));
        assert_eq!(
            place.files(),
            [
                "report.json",
                "scenes-00000-of-00002.tfrecord.gz",
                "scenes-00001-of-00002.tfrecord.gz",
            ]
        );
        fs::read(place.path("out/scenes-00000-of-00002.tfrecord.gz")).unwrap()
    };
    let first = bytes("--seed 5 --threads 1");
    assert_eq!(first, bytes("--seed 5 --threads 2"));
    assert_ne!(first, bytes("--seed 6"));
    let results = &place.report("data verify out")["results"];
    assert_eq!(
        (&results["scenarios"], &results["broken"]),
        (&3.into(), &0.into())
    );
}

#[test]
fn simulate_writes_futures_in_every_world() {
    let place = Workplace::new();
    let (scene, weights) = (place.scene(), place.weights());
    for world in [
        "idm",
        "constant-velocity",
        "log",
        &format!("model:{weights}"),
    ] {
        let heat = match world.starts_with("model") {
            true => " --heat",
            false => "",
        };
        let words = format!(
            "simulate --scenario {scene} --world {world} --futures 2 --seconds 2 \
             --format waymo,parquet,apng{heat}"
        );
        let results = &place.report(&words)["results"];
        let counts = ["futures", "steps", "agents"].map(|key| results[key].as_u64().unwrap());
        assert_eq!(counts, [2, 20, 3], "{world}");
        for key in [
            "frames_per_second",
            "passes_per_frame",
            "collision_rate",
            "offroad_rate",
        ] {
            assert!(
                results[key].is_number(),
                "{world}: {key} is {}",
                results[key]
            );
        }
        assert_eq!(results["digest"].as_str().unwrap().len(), 64);
        let files = [
            "agents.parquet",
            "by_class.parquet",
            "film.gif",
            "film.png",
            "futures.json",
            "futures.npy",
            "futures.parquet",
            "picture.png",
            "report.json",
            "rollouts.binproto",
            "viewer.html",
        ];
        assert_eq!(place.files(), files, "{world}");
        let path = place.path("out/rollouts.binproto");
        let message = &gump_data::submission::read_rollouts(&path).unwrap()[0];
        assert_eq!(message.joint_scenes.len(), 2);
        let trajectories = &message.joint_scenes[1].simulated_trajectories;
        assert_eq!(
            (trajectories.len(), trajectories[0].center_x.len()),
            (3, 20)
        );
    }
}

#[test]
fn scenes_of_a_file_are_simulated_into_one_viewer() {
    let place = Workplace::new();
    let words = format!(
        "simulate --world idm -n 2 --scenario {}",
        two_scenes(&place)
    );
    let report = place.report(&format!("{words} --scenes 5"));
    let results = &report["results"];
    assert_eq!(
        (&results["scenes"], &results["agents"]),
        (&2.into(), &6.into())
    );
    let files = [
        "by_class.parquet",
        "report.json",
        "rows.parquet",
        "viewer.html",
    ];
    assert_eq!(place.files(), files);
    let viewer = fs::read_to_string(place.path("out/viewer.html")).unwrap();
    assert!(viewer.contains("scene 8") && viewer.contains("id=\"facts-2\""));
    // Each is simulated as it would be alone.
    let second = place.report(&format!("{words}#1"));
    assert_eq!(results["rows"][1]["digest"], second["results"]["digest"]);
    assert_eq!(second["results"]["futures"], 2);
    place.fails(
        &format!("{words}#1 --scenes 2"),
        2,
        &["--scenes", "file or folder"],
    );
    place.fails(
        &format!("{words} --scenes 2 --format apng"),
        2,
        &["--format"],
    );
}

#[test]
fn the_same_seed_imagines_the_same_on_any_number_of_threads() {
    let place = Workplace::new();
    let (scene, weights) = (place.scene(), place.weights());
    for world in ["idm", &format!("model:{weights}")] {
        let digest = |rest: &str| {
            let words = "simulate --futures 3 --seconds 2 --scenario";
            let report = place.report(&format!("{words} {scene} --world {world} {rest}"));
            report["results"]["digest"].as_str().unwrap().to_owned()
        };
        let first = digest("--seed 3 --threads 1");
        assert_eq!(first, digest("--seed 3 --threads 1"), "{world}");
        assert_eq!(first, digest("--seed 3 --threads 2"), "{world}");
        if world != "idm" {
            assert_ne!(first, digest("--seed 4"), "{world}");
        }
    }
}

#[test]
fn the_logged_future_changes_no_rollout() {
    let place = Workplace::new();
    let weights = place.weights();
    // The same past and present; in one of them the other car brakes hard from now on.
    let told = gump_scene::fixture::scenario(
        "lane 1: -50,0 150,0 speed 15
         ego vehicle 0: 0,0 velocity 8,0
         agent vehicle 1: 20,0 velocity 6,0",
    )
    .unwrap();
    let mut other = told.clone();
    let present = other.log[other.now].clone();
    for frame in &mut other.log[told.now + 1..] {
        *frame = present.clone();
    }
    for (name, scenario) in [("told", &told), ("other", &other)] {
        gump_data::womd::write_scenarios(&place.path(name), [scenario]).unwrap();
    }
    for world in ["idm", "constant-velocity", &format!("model:{weights}")] {
        let digest = |name: &str| {
            let words = "simulate --futures 2 --seconds 2 --scenario";
            let report = place.report(&format!("{words} {name} --world {world}"));
            report["results"]["digest"].clone()
        };
        assert_eq!(digest("told"), digest("other"), "{world}");
    }
}

#[test]
fn a_run_that_is_resumed_goes_on_as_if_nothing_had_happened() {
    let place = Workplace::new();
    let scene = place.scene();
    let mut model = very_small();
    model.visual.side_px = 64;
    model.visual.metres_per_px = 2.0;
    let config = RunConfig {
        model: ModelChoice::Config(Box::new(model)),
        train: TrainConfig {
            steps: 6,
            batch: 2,
            ..TrainConfig::default()
        },
    };
    let config = toml::to_string(&config).unwrap();
    fs::write(place.path("c.toml"), config).unwrap();
    let train = |rest: &str| {
        let words = format!("train --data {scene} --validation {scene} --config c.toml{rest}");
        place.report(&words)["results"].clone()
    };
    let whole = train("");
    for key in [
        "parameters",
        "tokens_per_second",
        "loss_first",
        "loss_last",
        "validation_loss",
        "validation_realism",
    ] {
        assert!(whole[key].is_number(), "{key}: {}", whole[key]);
    }
    assert_eq!(whole["resumed"], false);
    assert_eq!(whole["steps"], 6);
    let names = [
        "checkpoint.safetensors",
        "losses.csv",
        "losses.png",
        "losses.svg",
        "realism.png",
        "realism.svg",
        "report.json",
        "weights.safetensors",
    ];
    assert_eq!(place.files(), names);
    let losses = fs::read_to_string(place.path("out/losses.csv")).unwrap();
    assert_eq!(losses.lines().count(), 7);

    // Another run does not replace this one, nor its report.
    let learned = ["weights.safetensors", "report.json"];
    let learned = || learned.map(|name| fs::read(place.path("out").join(name)).unwrap());
    let before = learned();
    let words = format!("train --data {scene} --config c.toml --out out");
    let parts = ["out/checkpoint.safetensors", "--resume", "another --out"];
    place.fails(&words, 2, &parts);
    assert!(learned() == before);
    fs::remove_dir_all(place.path("out")).unwrap();

    let first_half = train(" --stop-at 3");
    assert_eq!(first_half["steps"], 3);
    let resumed = train(" --resume");
    assert_eq!(resumed["resumed"], true);
    for key in [
        "steps",
        "loss_first",
        "loss_last",
        "validation_loss",
        "validation_realism",
    ] {
        assert_eq!(resumed[key], whole[key], "{key}");
    }
    let again = fs::read_to_string(place.path("out/losses.csv")).unwrap();
    assert_eq!(again, losses);
    let words = format!("train --data {scene} --out out --resume --steps 9");
    place.fails(&words, 2, &["--steps 9", "began with 6"]);
}

#[test]
fn training_from_a_cache_is_training_from_its_source() {
    let place = Workplace::new();
    let scene = place.scene();
    place.report(&format!(
        "data convert --from {scene} --to cache --format cache"
    ));
    let mut model = very_small();
    model.visual.side_px = 64;
    model.visual.metres_per_px = 2.0;
    let config = RunConfig {
        model: ModelChoice::Config(Box::new(model)),
        train: TrainConfig {
            steps: 3,
            batch: 2,
            ..TrainConfig::default()
        },
    };
    fs::write(place.path("run.toml"), toml::to_string(&config).unwrap()).unwrap();
    let losses = |data: &str| {
        place.report(&format!("train --data {data} --config run.toml"));
        let losses = fs::read_to_string(place.path("out/losses.csv")).unwrap();
        fs::remove_dir_all(place.path("out")).unwrap();
        losses
    };
    assert_eq!(losses(scene), losses("cache"));
}

#[test]
fn ablate_nar_compares_the_two_ways_of_decoding() {
    let place = Workplace::new();
    let (scene, weights) = (place.scene(), place.weights());
    let words = "ablate nar --futures 2 --seconds 1 --scenario";
    let results = &place.report(&format!("{words} {scene} --world model:{weights}"))["results"];
    let rows = results["rows"].as_array().unwrap();
    let modes: Vec<_> = rows
        .iter()
        .map(|row| row["mode"].as_str().unwrap())
        .collect();
    assert_eq!(modes, ["full-AR", "partial-AR", "full-AR", "partial-AR"]);
    let decodings = rows.iter().map(|row| &row["decoding"]);
    let expected = ["ruled", "ruled", "raw", "raw"];
    assert!(decodings.eq(expected));
    assert_eq!(rows[1]["passes_per_frame"], 1.0);
    assert!(rows[0]["passes_per_frame"].as_f64().unwrap() > 1.0);
    let rate = |row: &Value| row["frames_per_second"].as_f64().unwrap();
    let ratio = results["ratio"].as_f64().unwrap();
    assert!((ratio - rate(&rows[1]) / rate(&rows[0])).abs() < 1e-9);
    assert!(results["difference"]["ade"].is_number());
    assert!(place.files().contains(&"picture.png".to_owned()));
    place.fails(
        &format!("{words} {scene} --world idm"),
        2,
        &["model:WEIGHTS"],
    );
}

#[test]
fn demo_tells_its_stages_or_what_is_missing() {
    let place = Workplace::new();
    let repository = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    if !repository
        .join("datasets/weights/gump-tiny.safetensors")
        .is_file()
    {
        place.fails("demo", 1, &["gump-tiny.safetensors", "cargo xtask train"]);
        return;
    }
    if std::env::var_os("RUN_SLOW_TESTS").is_none() {
        eprintln!("skipped: the demo takes half a minute, set RUN_SLOW_TESTS to run it");
        return;
    }
    let report = place.report("demo");
    let results = report["results"].as_object().unwrap();
    let stages: Vec<_> = results.keys().map(String::as_str).collect();
    let expected = [
        "read", "imagine", "plan", "generate", "train", "picture", "raster", "tokens", "network",
        "page",
    ];
    assert_eq!(stages, expected);
    for stage in expected {
        assert!(report["seconds"][stage].is_number(), "{stage}");
    }
    let page = fs::read_to_string(place.path("out/index.html")).unwrap();
    assert!(page.contains("data:image/gif;base64,") && !page.contains("src=\"http"));
    assert!(page.len() < 2_000_000, "{} bytes", page.len());
    assert_eq!(results["generate"]["holds"], true);
    let viewer = fs::read_to_string(place.path("out/viewer.html")).unwrap();
    assert!(page.contains("href=\"viewer.html\"") && viewer.contains("\"chosen\":true"));
}

#[test]
fn tidy_finds_nothing() {
    let place = Workplace::new();
    let results = &place.report("tidy")["results"];
    assert_eq!(results["problems"], 0);
}

#[test]
fn planners_are_judged_in_three_worlds_by_one_command() {
    let place = Workplace::new();
    let (scenes, weights) = (two_scenes(&place), place.weights());
    let drive = "--seconds 1 --films 0 --futures 2";
    let words = format!(
        "evaluate closed-loop --scenarios {scenes} --world log,idm,model:{weights} \
         --planner idm,pdm-closed,imitation,interactive,proposals {drive}"
    );
    let results = &place.report(&words)["results"];
    assert_eq!(results["imagination"], format!("model:{weights}"));
    let rows = results["rows"].as_array().unwrap();
    // Proposals are two rows.
    assert_eq!(rows.len(), 3 * 6);
    for row in rows {
        assert_eq!((&row["scenarios"], &row["failed"]), (&2.into(), &0.into()));
        let of = |key: &str| row[key].as_f64().unwrap();
        assert!(
            of("low") <= of("score") && of("score") <= of("high"),
            "{row}"
        );
    }
    for world in rows.chunks(6) {
        let score = |i: usize| world[i]["score"].as_f64().unwrap();
        assert!(
            score(5) >= score(4),
            "the oracle is at least the best proposal"
        );
    }
    let pairs = results["comparisons"].as_array().unwrap();
    assert_eq!(pairs.len(), 3 * 15);
    let files = place.files();
    for name in ["nuplan.parquet", "rows.parquet", "scenarios.parquet"] {
        assert!(files.contains(&name.to_owned()), "{files:?}");
    }
    assert!(results["ranking_changes"].is_array());
    place.fails(&format!("{words} --limit 0"), 2, &["--limit"]);
    let words = format!("evaluate open-loop --scenarios {scenes} --planner model --world idm");
    let row = &place.report(&words)["results"]["rows"][0];
    assert_eq!(row["planner"], "imitation");
    assert!(row["ade_8s"].as_f64().unwrap() > 0.0);
}

#[test]
fn a_decision_is_explained() {
    let place = Workplace::new();
    let (scenes, weights) = (two_scenes(&place), place.weights());
    let plan = format!("plan --scenario {scenes} --world model:{weights} --seconds 1 --futures 2");
    let results = &place.report(&format!("{plan} --explain 5"))["results"];
    let decision = &results["decision"];
    assert_eq!(
        (&decision["candidates"], &decision["futures"]),
        (&20.into(), &2.into())
    );
    assert!(decision["milliseconds"]["frames"].as_f64().unwrap() > 0.0);
    let page = fs::read_to_string(place.path("out/explain.html")).unwrap();
    // One film and one picture: what was chosen beside the best that was not.
    assert_eq!(page.matches("data:image/gif;base64,").count(), 1);
    assert_eq!(page.matches("data:image/png;base64,").count(), 1);
    for part in [
        " scores ",
        "What the others did",
        "time to collision",
        "vehicle 1",
    ] {
        assert!(page.contains(part), "{part}");
    }
    assert_eq!(results["decision_step"], 5);
    // Between two decisions the older one counts; without a number the one that mattered most does.
    let between = place.report(&format!("{plan} --explain 7"));
    assert_eq!(between["results"]["decision_step"], 5);
    let decisive = place.report(&format!("{plan} --explain"))["results"]["decision_step"].clone();
    assert!([0, 5].map(Value::from).contains(&decisive), "{decisive}");
    let viewer = fs::read_to_string(place.path("out/viewer.html")).unwrap();
    assert!(viewer.contains("\"chosen\":true"));
    let blind = format!("{plan} --planner pdm-closed --explain 5");
    place.fails(
        &blind,
        2,
        &["--explain 5", "--planner interactive", "pdm-closed"],
    );
}

/// Two made-up scenes of 9.1 s with a road.
fn two_scenes(place: &Workplace) -> &'static str {
    let scenes = [8.0, 5.0].map(|speed| {
        let text = format!(
            "lane 1: -50,0 0,0 150,0 speed 15 width 3.5
             edge: -50,-4 150,-4
             edge: 150,4 -50,4
             ego vehicle 0: 0,0 velocity {speed},0
             agent vehicle 1: 20,0 velocity 6,0
             agent pedestrian 2: 30,6
             history 1.0 future 8.0 dt 0.1"
        );
        let mut scene = gump_scene::fixture::scenario(&text).unwrap();
        scene.id = format!("scene {speed}");
        scene
    });
    gump_data::womd::write_scenarios(&place.path("two.tfrecord"), scenes).unwrap();
    "two.tfrecord"
}

#[test]
fn evaluate_wosac_scores_beside_oracle_and_baseline() {
    let place = Workplace::new();
    let scenes = two_scenes(&place);
    for year in ["2023-v0", "2023", "2024", "2025", "2025-generation"] {
        let words = format!("evaluate wosac --scenarios {scenes} --world idm --year {year}");
        let words = format!("{words} --rollouts-per-scenario 2 --explain");
        let results = &place.report(&words)["results"];
        let rows = results["rows"].as_array().unwrap();
        let worlds: Vec<_> = rows
            .iter()
            .map(|row| row["world"].as_str().unwrap())
            .collect();
        assert_eq!(
            worlds,
            ["idm", "logged-oracle", "constant-velocity"],
            "{year}"
        );
        for row in rows {
            assert_eq!((&row["year"], &row["scenarios"]), (&year.into(), &2.into()));
            for key in [
                "metametric",
                "kinematic",
                "interactive",
                "map_based",
                "min_ade",
                "ade",
            ] {
                assert!(row[key].is_number(), "{key}");
            }
            let components = row["components"].as_object().unwrap();
            let expected = if year.starts_with("2025") { 10 } else { 9 };
            assert_eq!(components.len(), expected, "{year}");
        }
        let metametric = &results["intervals"][0];
        let of = |key: &str| metametric[key].as_f64().unwrap();
        assert!(of("idm low") <= of("idm") && of("idm") <= of("idm high"));
        assert!(results["seconds_per_scenario"].as_f64().unwrap() > 0.0);
        assert!(results["explain"][0]["cost"].as_f64().unwrap() > 0.0);
        let files = place.files();
        for name in [
            "agents.parquet",
            "explain.jsonl",
            "rows.parquet",
            "scores.parquet",
        ] {
            assert!(files.contains(&name.to_owned()), "{files:?}");
        }
    }
}

#[test]
fn shards_of_an_evaluation_are_the_whole_to_the_bit() {
    let place = Workplace::new();
    let words = format!(
        "evaluate wosac --scenarios {} --world idm",
        two_scenes(&place)
    );
    let words = format!("{words} --rollouts-per-scenario 2 --threads");
    let whole = place.report(&format!("{words} 2"))["results"].clone();
    for shard in ["1", "2"] {
        let output = place.run(&format!("{words} 1 --shard {shard}/2 --out {shard}"));
        assert!(output.status.success(), "{}", stderr(&output));
    }
    let merged = place.report("evaluate merge 2 1")["results"].clone();
    for key in ["scenarios", "rows", "intervals"] {
        assert_eq!(whole[key], merged[key], "{key}");
    }
    place.fails("evaluate merge 1 --out m", 1, &["missing shard 2/2"]);
}

#[test]
fn shards_of_drives_are_the_whole_and_a_stopped_run_goes_on() {
    let place = Workplace::new();
    let words = format!(
        "evaluate closed-loop --scenarios {} --planner pdm-closed,interactive,proposals \
         --world log,idm --seconds 2 --futures 2 --films 0",
        two_scenes(&place)
    );
    // Whatever took time differs from run to run.
    let timeless = |mut results: Value| {
        for row in results["rows"].as_array_mut().unwrap() {
            assert!(row["milliseconds_per_step"].as_f64().unwrap() > 0.0);
            row["milliseconds_per_step"] = Value::Null;
        }
        results
    };
    let same = |a: &Value, b: &Value| {
        for key in ["set", "rows", "scenarios", "comparisons", "ranking_changes"] {
            assert_eq!(a[key], b[key], "{key}");
        }
    };
    let whole = timeless(place.report(&words)["results"].clone());
    assert_eq!(whole["rows"].as_array().unwrap().len(), 2 * 4);
    let shard = |shard: &str, out: &str| {
        Command::new(env!("CARGO_BIN_EXE_xtask"))
            .args(format!("{words} --threads 1 --shard {shard} --out {out}").split(' '))
            .current_dir(place.path(""))
            .env("CARGO_MANIFEST_DIR", env!("CARGO_MANIFEST_DIR"))
            .envs([("JOB_COMPLETION_INDEX", "1"), ("GUMP_SHARDS", "2")])
            .output()
            .unwrap()
    };
    for (k, out) in [("1/2", "first"), ("auto", "second")] {
        let output = shard(k, out);
        assert!(output.status.success(), "{}", stderr(&output));
    }
    let merged = place.report("evaluate merge second first")["results"].clone();
    same(&whole, &timeless(merged));
    place.fails("evaluate merge second --out m", 1, &["missing shard 1/2"]);
    let nowhere = format!("{words} --shard auto");
    place.fails(&nowhere, 2, &["JOB_COMPLETION_INDEX"]);

    // A run that was stopped in its second scenario keeps its first, which it does not drive again.
    // On one thread they are driven in their order.
    place.report(&format!("{words} --threads 1"));
    let ledger = fs::read_to_string(place.path("out/scenarios.toml")).unwrap();
    let second = ledger.rfind("[[scenario]]").unwrap();
    let stopped = ledger[..second + 40].replacen("score = ", "score = 7", 1);
    fs::create_dir(place.path("stopped")).unwrap();
    fs::write(place.path("stopped/scenarios.toml.partial"), stopped).unwrap();
    let output = place.run(&format!("{words} --out stopped"));
    assert!(output.status.success(), "{}", stderr(&output));
    let resumed = read_report(&place.path("stopped"))["results"].clone();
    let scores = |results: &Value| -> Vec<Value> {
        let scenarios = results["scenarios"].as_array().unwrap().iter();
        scenarios
            .map(|scenario| scenario["score"].clone())
            .collect()
    };
    let (before, after) = (scores(&whole), scores(&resumed));
    assert!(after[0].as_f64().unwrap() > 7.0, "{}", after[0]);
    assert_eq!(before[1..], after[1..]);
}

#[test]
fn evaluate_wosac_takes_rollouts_from_files() {
    let place = Workplace::new();
    let scenes = two_scenes(&place);
    let words = format!("simulate --scenario {scenes}#0 --world idm --futures 2 --format waymo");
    place.report(&words);
    let rollouts = place.path("rollouts.binproto");
    fs::copy(place.path("out/rollouts.binproto"), &rollouts).unwrap();
    let words = format!("evaluate wosac --scenarios {scenes} --rollouts rollouts.binproto");
    place.fails(&words, 1, &["scene 5", "expected rollouts of it"]);
    let words = format!("{words} --shard 1/2");
    let row = place.report(&words)["results"]["rows"][0].clone();
    assert_eq!(row["world"], "rollouts");
    assert!(row["metametric"].as_f64().unwrap() > 0.3);
    // Arrays have no heights, which the recording has.
    place.report(&format!(
        "simulate --scenario {scenes}#0 --world idm --futures 2"
    ));
    for file in ["futures.npy", "futures.json"] {
        fs::copy(place.path(&format!("out/{file}")), place.path(file)).unwrap();
    }
    let words = format!("evaluate wosac --scenarios {scenes} --rollouts futures.npy --shard 1/2");
    let parts = ["shard 1/2 of another evaluation", "another --out"];
    place.fails(&format!("{words} --out out"), 1, &parts);
    fs::remove_dir_all(place.path("out")).unwrap();
    let same = place.report(&words)["results"]["rows"][0].clone();
    assert_eq!(same["metametric"], row["metametric"]);
    place.fails(
        "evaluate wosac --scenarios two.tfrecord",
        2,
        &["--world", "--rollouts"],
    );
    let both = "evaluate wosac --scenarios two.tfrecord --world idm --shard 3/2";
    place.fails(both, 2, &["K/N"]);
}

#[test]
fn official_rollouts_of_a_recorded_scenario_get_the_official_score() {
    let place = Workplace::new();
    let scenario = shared("data/waymo/scenario_a.tfrecord");
    let rollouts = shared("golden/wosac/inputs_real/test_submission.binproto.gz");
    let (Some(scenario), Some(rollouts)) = (scenario, rollouts) else {
        return;
    };
    // Wheels 1.6.0, 1.6.1, 1.6.4 and 1.6.7 of the official evaluator.
    for (year, expected) in [
        ("2023-v0", 0.231_545),
        ("2023", 0.228_538),
        ("2024", 0.231_282),
        ("2025", 0.258_240),
    ] {
        let (scenario, rollouts) = (scenario.display(), rollouts.display());
        let words = format!("evaluate wosac --scenarios {scenario} --rollouts {rollouts}");
        let results = &place.report(&format!("{words} --year {year}"))["results"];
        let found = results["rows"][0]["metametric"].as_f64().unwrap();
        assert!((found - expected).abs() < 1e-6, "{year}: {found}");
    }
}

#[test]
fn bench_wosac_times_every_year() {
    let place = Workplace::new();
    let words = format!(
        "bench wosac --repeat 1 --rollouts 2 --scenarios {}",
        two_scenes(&place)
    );
    let rows = place.report(&words)["results"]["rows"].clone();
    assert_eq!(rows.as_array().unwrap().len(), 5);
    assert!(rows[3]["seconds_per_scenario"].as_f64().unwrap() > 0.0);
}

#[test]
fn bench_train_times_both_number_formats() {
    let place = Workplace::new();
    let words = "bench train --sizes tiny --batch 1 --steps 1 --rounds 1 --threads 1";
    let rows = place.report(words)["results"]["rows"].clone();
    let precisions: Vec<_> = rows.as_array().unwrap().iter().collect();
    assert_eq!(precisions.len(), 2);
    for (row, storage) in precisions.into_iter().zip(["f32", "bf16"]) {
        assert_eq!(row["precision"], storage);
        assert!(row["cpu_milliseconds_per_step"].as_f64().unwrap() > 0.0);
        assert!(row["ratio"].is_null());
    }
}
