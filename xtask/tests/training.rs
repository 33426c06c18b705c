//! `train` from the outside: stages, several processes, and what must survive a full disk or a kill.
#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::fs;
use std::os::unix::process::ExitStatusExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use gump_model::checkpoint::StorageType;
use gump_model::{Device, ModelConfig, Network, checkpoint, relative};
use gump_scene::Seed;
use gump_train::{ModelChoice, RunConfig, TrainConfig};
use serde_json::Value;

/// Folders of scenes, and the configuration of a very small model.
struct Workplace {
    folder: tempfile::TempDir,
}

impl Workplace {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let scene = |speed: f64, future_s: f64, name: &str| {
            let text = format!(
                "lane 1: -50,0 350,0 speed 15 width 3.5
                 edge: -50,-5 350,-5
                 ego vehicle 0: 0,0 velocity 8,0
                 agent vehicle 1: 30,0 velocity {speed},0
                 history 1.0 future {future_s} dt 0.1"
            );
            let mut scene = gump_scene::fixture::scenario(&text).unwrap();
            scene.id = name.replace('/', "-");
            let path = folder.path().join(format!("{name}/scene.tfrecord"));
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            gump_data::womd::write_scenarios(&path, [scene]).unwrap();
        };
        scene(6.0, 4.0, "data/first");
        scene(2.0, 4.0, "data/more");
        scene(4.0, 8.0, "held-out");
        let place = Self { folder };
        fs::write(place.path("c.toml"), place.config()).unwrap();
        place
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn config(&self) -> String {
        let mut model = ModelConfig {
            width: 32,
            layers: 1,
            heads: 2,
            trajectory_heads: vec![0],
            reconstruction: false,
            ..ModelConfig::tiny()
        };
        model.visual.side_px = 64;
        model.visual.metres_per_px = 2.0;
        let train = TrainConfig {
            steps: 6,
            batch: 4,
            ema: Some(0.9),
            accumulate: 2,
            ..TrainConfig::default()
        };
        let model = ModelChoice::Config(Box::new(model));
        toml::to_string(&RunConfig { model, train }).unwrap()
    }

    fn command(&self, program: &str) -> Command {
        let mut command = Command::new(program);
        command
            .current_dir(self.folder.path())
            .env("CARGO_MANIFEST_DIR", env!("CARGO_MANIFEST_DIR"));
        command
    }

    fn run(&self, words: &str) -> Output {
        let words = format!("train --data data --quiet --config {words}");
        let mut command = self.command(env!("CARGO_BIN_EXE_xtask"));
        command.args(words.split(' ')).output().unwrap()
    }

    fn results(&self, words: &str, out: &str) -> Value {
        let output = self.run(&format!("{words} --out {out}"));
        assert!(output.status.success(), "{words}: {}", stderr(&output));
        let report = fs::read_to_string(self.path(out).join("report.json")).unwrap();
        serde_json::from_str::<Value>(&report).unwrap()["results"].take()
    }

    fn fails(&self, words: &str, status: i32, parts: &[&str]) {
        let output = self.run(words);
        let error = stderr(&output);
        assert_eq!(output.status.code(), Some(status), "{words}: {error}");
        for part in parts {
            assert!(error.contains(part), "{words}: {error}");
        }
    }

    /// Goes on with the run in `out` where no file may grow beyond a megabyte, which a checkpoint
    /// does.
    fn resume_where_disks_are_small(&self, out: &str, before: &str) -> Output {
        let xtask = env!("CARGO_BIN_EXE_xtask");
        let words = format!("train --data data --quiet --config c.toml --out {out} --resume");
        let script = format!("ulimit -c 0; ulimit -f 1000; {before} exec {xtask} {words}");
        self.command("bash").args(["-c", &script]).output().unwrap()
    }
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn losses(folder: &Path) -> String {
    fs::read_to_string(folder.join("losses.csv")).unwrap()
}

fn numbers(network: &Network) -> Vec<Vec<f32>> {
    let all = network.parameters().all();
    all.map(|(_, var)| var.flatten_all().unwrap().to_vec1().unwrap())
        .collect()
}

#[test]
fn a_full_disk_and_a_kill_leave_the_last_checkpoint() {
    let place = Workplace::new();
    place.results("c.toml", "whole");
    place.results("c.toml --stop-at 3", "broken");
    let [checkpoint, partial] = ["checkpoint.safetensors", "checkpoint.safetensors.partial"]
        .map(|name| place.path("broken").join(name));
    let kept = fs::read(&checkpoint).unwrap();

    // A write that fails, as on a full disk.
    let output = place.resume_where_disks_are_small("broken", "trap '' XFSZ;");
    let error = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{error}");
    assert!(error.contains("writing weights") && error.contains("checkpoint.safetensors"));
    assert!(fs::read(&checkpoint).unwrap() == kept && !partial.exists());

    // The same, but the system kills the process in the middle of writing.
    let output = place.resume_where_disks_are_small("broken", "");
    assert!(output.status.signal().is_some(), "{}", stderr(&output));
    assert!(fs::read(&checkpoint).unwrap() == kept && partial.exists());

    let resumed = place.results("c.toml --resume", "broken");
    assert_eq!(resumed["steps"], 6);
    assert!(!partial.exists());
    assert_eq!(losses(&place.path("broken")), losses(&place.path("whole")));
    let weights = |out: &str| checkpoint::load(&place.path(out), &Device::Cpu).unwrap();
    let [a, b] = ["broken", "whole"].map(|out| weights(&format!("{out}/weights.safetensors")));
    assert!(numbers(&a) == numbers(&b));
}

#[test]
fn a_resumed_run_goes_on_at_its_place_among_fresh_scenes() {
    let place = Workplace::new();
    let train = |words: &str| {
        let words = format!(
            "train --validation held-out --realism-rollouts 0 --quiet --config c.toml {words}"
        );
        let mut command = place.command(env!("CARGO_BIN_EXE_xtask"));
        command.args(words.split(' ')).output().unwrap()
    };
    let stream = "--data fresh:plain:3";
    for words in [
        "--out whole",
        "--out parts --stop-at 3",
        "--out parts --resume",
    ] {
        let output = train(&format!("{stream} {words}"));
        assert!(output.status.success(), "{words}: {}", stderr(&output));
    }
    assert_eq!(losses(&place.path("parts")), losses(&place.path("whole")));
    let output = train("--data fresh:plain:4 --out other");
    assert!(output.status.success(), "{}", stderr(&output));
    assert_ne!(losses(&place.path("other")), losses(&place.path("whole")));
    let output = train("--data fresh:anything --out none");
    assert_eq!(output.status.code(), Some(2));
    assert!(stderr(&output).contains("profiles plain, recorded-like, found \"anything\""));
}

#[test]
fn realism_is_told_of_scenes_on_which_it_is_defined() {
    let place = Workplace::new();
    let words = "c.toml --steps 2 --realism-rollouts 1";
    let results = place.results(&format!("{words} --validation held-out"), "out");
    let realism = results["validation_realism"].as_f64().unwrap();
    assert!(realism > 0.0 && realism < 1.0, "{realism}");
    let losses = losses(&place.path("out"));
    let last: Vec<&str> = losses.lines().last().unwrap().split(',').collect();
    let written: f64 = last[last.len() - 2].parse().unwrap();
    assert!((written - realism).abs() < 1e-12, "{losses}");
    assert!(place.path("out/realism.svg").is_file());
    // The same again: what is imagined changes nothing that is learned.
    let alone = "c.toml --steps 2 --realism-rollouts 0 --validation held-out";
    let without = place.results(alone, "without");
    assert_eq!(without["validation_loss"], results["validation_loss"]);
    assert!(without["validation_realism"].is_null());
    // Four seconds of future are too few.
    let short = place.results(&format!("{words} --validation data/more"), "short");
    assert!(short["validation_loss"].is_f64() && short["validation_realism"].is_null());
}

#[test]
fn a_configuration_that_contradicts_what_was_begun_is_refused() {
    let place = Workplace::new();
    place.results("c.toml --stop-at 1", "out");
    let changed = |from: &str, to: &str| {
        let config = place.config();
        assert!(config.contains(from), "{config}");
        fs::write(place.path("other.toml"), config.replace(from, to)).unwrap();
    };
    changed("ema = 0.9", "ema = 0.5");
    place.fails("other.toml --out out --resume", 2, &["ema is 0.5", "0.9"]);
    changed("width = 32", "width = 64");
    place.fails("other.toml --out out --resume", 2, &["another model"]);
    let words = "other.toml --out fresh --from out/weights.safetensors";
    place.fails(words, 2, &["weights.safetensors holds another model"]);
    changed("accumulate = 2", "accumulate = 5");
    place.fails("other.toml", 2, &["a batch of 4 cannot be shared"]);

    let checkpoint = || fs::read(place.path("out/checkpoint.safetensors")).unwrap();
    let before = checkpoint();
    fs::remove_dir_all(place.path("data/more")).unwrap();
    let parts = ["began with other data: 2 scenarios", "found 1 scenario ("];
    place.fails("c.toml --out out --resume", 2, &parts);
    assert!(checkpoint() == before);
}

#[test]
fn a_run_in_stages_goes_on_from_stage_to_stage() {
    let place = Workplace::new();
    let stages = "
        [[stage]]
        data = 'first'
        stop_at = 2
        [[stage]]
        [stage.train]
        steps = 3
        seed = 7
        [stage.train.optimizer]
        learning_rate = 1e-4
        ";
    fs::write(place.path("s.toml"), place.config() + stages).unwrap();
    let whole = place.results("s.toml", "out");
    assert_eq!(whole["steps"], 3);
    let steps = |stage: &str| losses(&place.path("out").join(stage)).lines().count() - 1;
    assert_eq!((steps("stage-1"), steps("stage-2")), (2, 3));
    let weights = fs::read(place.path("out/stage-2/weights.safetensors")).unwrap();

    // Another run does not replace one in stages, finished or not.
    place.fails(
        "s.toml --out out",
        2,
        &["out/weights.safetensors", "--resume"],
    );
    // By hand: the second stage goes on from the first one's network, in full precision.
    fs::remove_dir_all(place.path("out/stage-2")).unwrap();
    let resumed = place.results("s.toml --resume", "out");
    assert_eq!(resumed["loss_last"], whole["loss_last"]);
    let load = |name: &str| checkpoint::load(&place.path(name), &Device::Cpu).unwrap();
    fs::write(place.path("before.safetensors"), weights).unwrap();
    let before = numbers(&load("before.safetensors"));
    assert!(numbers(&load("out/weights.safetensors")) == before);

    place.fails("s.toml --stop-at 2", 2, &["--stop-at"]);
    for (wrong, parts) in [
        ("[[stage]]\nstop_at = 'soon'", ["stop_at", "a step"]),
        ("[[stage]]\nstop_after = 2", ["stop_after", "stop_at"]),
    ] {
        fs::write(place.path("wrong.toml"), place.config() + wrong).unwrap();
        place.fails("wrong.toml", 2, &parts);
    }
}

#[test]
fn the_recorded_stages_of_the_shipped_weights_can_be_run() {
    let place = Workplace::new();
    let recorded = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/shipped.toml");
    let recorded = fs::read_to_string(recorded).unwrap();
    assert!(recorded.contains("drives = 600"));
    let shorter = recorded.replace("drives = 600", "drives = 2");
    fs::write(place.path("shipped.toml"), shorter).unwrap();
    let results = place.results("shipped.toml --steps 1", "out");
    for stage in 1..=4 {
        let weights = place.path(&format!("out/stage-{stage}/weights.safetensors"));
        assert!(weights.is_file(), "{stage}");
    }
    let network = checkpoint::load(&place.path("out/weights.safetensors"), &Device::Cpu).unwrap();
    let shipped = Network::random(ModelConfig::tiny(), Seed(0), &Device::Cpu).unwrap();
    assert_eq!(network.config(), shipped.config());
    assert_eq!(results["parameters"], shipped.parameters().count());
    // What is shipped is half of that precision.
    let small = place.path("small.safetensors");
    checkpoint::save(&network, &small, StorageType::Half).unwrap();
    assert!(fs::metadata(small).unwrap().len() < 12_000_000);
}

#[test]
fn the_recorded_stages_of_the_relative_network_can_be_run() {
    let place = Workplace::new();
    let here = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let shipped = here.join("datasets/weights/gump-relative.safetensors");
    let shipped = relative::load(&shipped, &Device::Cpu).unwrap();
    let on_these = |name: &str| {
        let recorded = fs::read_to_string(here.join("configs").join(name)).unwrap();
        let lines = recorded
            .lines()
            .map(|line| match line.starts_with("data = [") {
                true => "data = ['first', 'more']",
                false => line,
            });
        let lines: Vec<&str> = lines.collect();
        fs::write(place.path(name), lines.join("\n")).unwrap();
    };
    on_these("relative.toml");
    place.results("relative.toml --steps 1", "out");
    let recorded = fs::read_to_string(place.path("relative.toml")).unwrap();
    for stage in 1..=recorded.matches("[[stage]]").count() {
        let weights = place.path(&format!("out/stage-{stage}/weights.safetensors"));
        let network = relative::load(&weights, &Device::Cpu).unwrap();
        assert_eq!(network.config(), shipped.config());
    }
    on_these("relative-8.toml");
    place.results("relative-8.toml --steps 1", "on");
    on_these("relative-9.toml");
    place.results(
        "relative-9.toml --steps 1 --from on/weights.safetensors",
        "further",
    );
    on_these("relative-parking.toml");
    place.results("relative-parking.toml --steps 1", "parking");
    on_these("placement.toml");
    place.results("placement.toml --steps 2", "placement");
    // Realism needs road edges, which the scenes here do not have.
    for (name, out) in [
        ("relative-rewards.toml", "rewards"),
        ("relative-10.toml", "ten"),
        (
            "relative-11.toml",
            "eleven --from further/weights.safetensors",
        ),
        (
            "relative-12.toml",
            "twelve --from further/weights.safetensors",
        ),
    ] {
        on_these(name);
        place.fails(
            &format!("{name} --steps 1 --out {out}"),
            1,
            &["realism: no scene has", "road edges"],
        );
    }
}

/// A very small network with relative attention, whose second stage drives.
const RELATIVE: &str = "
    model = 'relative'
    [relative]
    width = 32
    layers = 1
    heads = 2
    edge_width = 16
    edge_hidden = 24
    [train]
    batch = 2
    mixed_precision = true
    [[stage]]
    data = ['first=3', 'more']
    [stage.train]
    steps = 4
    [[stage]]
    [stage.train]
    steps = 4
    [stage.train.closed_loop]
    share = 1.0
    refresh = 2
    ";

#[test]
fn a_relative_network_trains_in_stages_and_goes_on_where_it_stopped() {
    let place = Workplace::new();
    fs::write(place.path("r.toml"), RELATIVE).unwrap();
    let whole = place.results("r.toml --validation held-out", "whole");
    assert_eq!(whole["steps"], 4);
    assert!(whole["validation_realism"].is_f64());
    let weights = |out: &str| {
        let path = place.path(&format!("{out}/weights.safetensors"));
        let network = relative::load(&path, &Device::Cpu).unwrap();
        let all = network.parameters().all();
        all.map(|(_, var)| var.flatten_all().unwrap().to_vec1::<f32>().unwrap())
            .collect::<Vec<_>>()
    };

    // The first stage alone, in two parts; then the rest.
    let first = RELATIVE.replace(
        "['first=3', 'more']\n",
        "['first=3', 'more']\nstop_at = 2\n",
    );
    fs::write(
        place.path("part.toml"),
        &first[..first.rfind("[[stage]]").unwrap()],
    )
    .unwrap();
    place.results("part.toml --validation held-out", "parts");
    let parts = place.results("r.toml --resume --validation held-out", "parts");
    assert_eq!(parts["resumed"], true);
    assert!(weights("parts") == weights("whole"));
    assert_eq!(
        losses(&place.path("parts/stage-1")),
        losses(&place.path("whole/stage-1"))
    );

    let on = "r.toml --from whole/weights.safetensors";
    assert!(place.results(on, "on")["loss_last"].is_f64());
    let world = "simulate --world model:whole/weights.safetensors --futures 2 --seconds 1 --out w \
                 --scenario held-out/scene.tfrecord";
    let mut command = place.command(env!("CARGO_BIN_EXE_xtask"));
    let output = command.args(world.split_whitespace()).output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    for (from, to, words, parts) in [
        (
            "width = 32",
            "width = 64",
            on,
            ["holds another model", "weights"],
        ),
        ("heads = 2", "heads = 3", "r.toml", ["width 32", "3 heads"]),
        (
            "share = 1.0",
            "share = 1.5",
            "r.toml",
            ["closed_loop", "share"],
        ),
        (
            "refresh = 2",
            "refreshed = 2",
            "r.toml",
            ["refreshed", "refresh"],
        ),
        (
            "batch = 2",
            "batch = 3",
            "r.toml --out whole --resume",
            ["batch", "began with 2"],
        ),
    ] {
        assert!(RELATIVE.contains(from), "{from}");
        let changed = RELATIVE.replace(from, to);
        fs::write(place.path("changed.toml"), changed).unwrap();
        place.fails(&words.replace("r.toml", "changed.toml"), 2, &parts);
    }
}

#[test]
fn weights_can_be_the_mean_of_those_of_stages() {
    let place = Workplace::new();
    let weights = |path: &str| {
        let network = relative::load(&place.path(path), &Device::Cpu).unwrap();
        let all = network.parameters().all();
        let all = all.map(|(_, var)| var.flatten_all().unwrap().to_vec1::<f32>().unwrap());
        all.flatten().collect::<Vec<f32>>()
    };
    let check_mean = |mean: &str, of: &[&str]| {
        let all: Vec<_> = of.iter().map(|path| weights(path)).collect();
        for (i, mean) in weights(mean).iter().enumerate() {
            // Files have half precision, of 11 bits.
            let sum: f32 = all.iter().map(|one| one[i]).sum();
            let size: f32 = all.iter().map(|one| one[i].abs()).sum();
            let expected = sum / all.len() as f32;
            assert!(
                (mean - expected).abs() <= 2e-3 * size + 1e-6,
                "{mean} of {of:?}"
            );
        }
    };
    let of =
        |list: &str| RELATIVE.replace("[train]", &format!("[weights]\nmean_of = {list}\n[train]"));
    fs::write(place.path("mean.toml"), of("[1, 2]")).unwrap();
    place.results("mean.toml", "out");
    let [first, second] = [
        "out/stage-1/weights.safetensors",
        "out/stage-2/weights.safetensors",
    ];
    assert_ne!(weights(first), weights(second));
    check_mean("out/weights.safetensors", &[first, second]);

    // A second run from the first one, whose last stage goes back to the start, without taking a step away
    // from it: its learning rate is as good as 0.
    let last = "[[stage]]\nfrom = [0, 1]\n[stage.train]\nsteps = 1\n[stage.train.optimizer]\nlearning_rate = 1e-9\n";
    fs::write(place.path("mean.toml"), format!("{}\n{last}", of("[0, 3]"))).unwrap();
    place.results("mean.toml --from out/weights.safetensors", "again");
    let [start, first, third] = [
        "out/weights",
        "again/stage-1/weights",
        "again/stage-3/weights",
    ]
    .map(|path| format!("{path}.safetensors"));
    check_mean(&third, &[&start, &first]);
    check_mean("again/weights.safetensors", &[&start, &third]);

    fs::write(place.path("mean.toml"), of("[3]")).unwrap();
    place.fails("mean.toml", 2, &["mean_of is [3]", "0 to 2"]);
    fs::write(place.path("mean.toml"), of("[0, 1]")).unwrap();
    place.fails(
        "mean.toml",
        2,
        &["stage 0 is the weights of --from, found none"],
    );
    let (whole, _) = RELATIVE.split_once("[[stage]]").unwrap();
    fs::write(
        place.path("mean.toml"),
        format!("{whole}\n[weights]\nmean_of = [1]\n"),
    )
    .unwrap();
    place.fails(
        "mean.toml",
        2,
        &["mean_of counts stages, found no [[stage]]"],
    );
    let stage = |key: &str| RELATIVE.replace("[[stage]]\n", &format!("[[stage]]\n{key}\n"));
    fs::write(place.path("mean.toml"), stage("weights = {mean_of = [1]}")).unwrap();
    place.fails("mean.toml", 2, &["unknown key weights"]);
    fs::write(place.path("mean.toml"), stage("from = [1]")).unwrap();
    place.fails(
        "mean.toml",
        2,
        &["from is [1], expected a list of stages, 0 to 0"],
    );
}

#[cfg(not(feature = "mpi"))]
#[test]
fn processes_that_know_nothing_of_each_other_are_refused() {
    let place = Workplace::new();
    let mut command = place.command(env!("CARGO_BIN_EXE_xtask"));
    command.args(["train", "--data", "data", "--config", "c.toml"]);
    let output = command.env("OMPI_COMM_WORLD_SIZE", "2").output().unwrap();
    assert_eq!(output.status.code(), Some(2));
    assert!(
        stderr(&output).contains("--features mpi"),
        "{}",
        stderr(&output)
    );
}

#[cfg(feature = "mpi")]
#[test]
fn two_processes_learn_what_one_learns() {
    if Command::new("mpirun").arg("--version").output().is_err() {
        eprintln!("skipped: there is no mpirun");
        return;
    }
    let place = Workplace::new();
    place.results("c.toml --validation data/more", "one");
    let words = "train --data data --quiet --config c.toml --validation data/more --out two";
    let mut command = place.command("mpirun");
    command.args(["-n", "2", "--allow-run-as-root", "--oversubscribe"]);
    command
        .arg(env!("CARGO_BIN_EXE_xtask"))
        .args(words.split(' '));
    let output = command.output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    let [one, two] = ["one", "two"].map(|out| losses(&place.path(out)));
    assert_eq!(one.lines().count(), two.lines().count());
    for (one, two) in one.lines().zip(two.lines()).skip(1) {
        for (a, b) in one.split(',').zip(two.split(',')) {
            let [a, b]: [f64; 2] = [a, b].map(|cell| cell.parse().unwrap_or(0.0));
            assert!(
                (a - b).abs() <= 1e-5 * (1.0 + a.abs()),
                "{one} against {two}"
            );
        }
    }
    // One writer: what is left is what one process leaves.
    let names = |out: &str| {
        let entries = fs::read_dir(place.path(out)).unwrap();
        let mut names: Vec<_> = entries.map(|entry| entry.unwrap().file_name()).collect();
        names.sort();
        names
    };
    assert_eq!(names("one"), names("two"));
    let mut command = place.command("mpirun");
    command.args(["-n", "8", "--allow-run-as-root", "--oversubscribe"]);
    command
        .arg(env!("CARGO_BIN_EXE_xtask"))
        .args(words.split(' '));
    let output = command.output().unwrap();
    assert!(!output.status.success());
    let error = stderr(&output);
    assert!(
        error.contains("a batch of 4 cannot be shared among 8"),
        "{error}"
    );
}
