//! Mistakes that newcomers make: each is answered by one sentence that says what to do, with exit
//! status 2 where the arguments are wrong, and leaves nothing behind that looks finished.
#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::Duration;

use gump_data::tfrecord::{TfRecordReader, write_record};
use gump_proto as proto;
use prost::Message as _;

/// A folder for one test, and the driver in it.
struct Workplace {
    folder: tempfile::TempDir,
}

impl Workplace {
    /// A folder with one small scene in `scene.tfrecord`.
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let place = Self { folder };
        place.write_scene("scene.tfrecord");
        place
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn write_scene(&self, name: &str) {
        let scenario = gump_scene::fixture::scenario(
            "lane 1: -50,0 0,0 50,0 150,0 speed 15 width 3.5
             edge: -50,-2 150,-2
             edge: 150,2 -50,2
             ego vehicle 0: 0,0 velocity 8,0
             agent vehicle 1: 20,0 velocity 6,0
             history 1.0 future 8.0 dt 0.1",
        )
        .unwrap();
        gump_data::womd::write_scenarios(&self.path(name), [scenario]).unwrap();
    }

    /// The scene's map with nobody on it, in `map.tfrecord`.
    fn write_map(&self) {
        let file = self.path("scene.tfrecord");
        let record = TfRecordReader::open(file).unwrap().next().unwrap().unwrap();
        let mut message = proto::Scenario::decode(&record.bytes[..]).unwrap();
        message.tracks.clear();
        message.tracks_to_predict.clear();
        let mut file = fs::File::create(self.path("map.tfrecord")).unwrap();
        write_record(&mut file, &message.encode_to_vec()).unwrap();
    }

    fn command(&self, words: &str) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_xtask"));
        command
            .args(words.split(' '))
            .current_dir(self.folder.path());
        command
    }

    fn run(&self, words: &str) -> Output {
        self.command(words).output().unwrap()
    }

    /// Checks the exit status and that the error is one line with these parts.
    fn check(&self, words: &str, status: i32, parts: &[&str]) {
        let output = self.run(words);
        let error = text(&output.stderr);
        assert_eq!(output.status.code(), Some(status), "{words}: {error}");
        assert_eq!(error.trim().lines().count(), 1, "{words}: {error}");
        for part in parts {
            assert!(error.contains(part), "{words}: expected {part} in: {error}");
        }
    }
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

#[test]
fn planners_in_other_processes_have_an_address() {
    let place = Workplace::new();
    let words = "evaluate closed-loop --scenarios scene.tfrecord --world log --planner";
    for wrong in [
        "grpc:",
        "grpc:nowhere",
        "grpc:localhost:0",
        "grpc:localhost:70000",
    ] {
        let output = place.run(&format!("{words} {wrong}"));
        let error = text(&output.stderr);
        let expected = "expected grpc:HOST:PORT with a port from 1 to 65535";
        assert_eq!(output.status.code(), Some(2), "{error}");
        assert!(error.contains(wrong) && error.contains(expected), "{error}");
    }
    if !cfg!(feature = "grpc") {
        let expected = "expected a build with the feature grpc, found one without";
        place.check(&format!("{words} grpc:localhost:50051"), 2, &[expected]);
    }
}

#[test]
fn numbers_that_cannot_be_meant_are_told_plainly() {
    let place = Workplace::new();
    let simulate = "simulate --scenario scene.tfrecord --world idm";
    let check = |flags: &str, part: &str| place.check(&format!("{simulate} {flags}"), 2, &[part]);
    check("--futures 0", "--futures: expected at least 1, found 0");
    check("--threads 0", "--threads: expected at least 1, found 0");
    check(
        "--seconds -3",
        "--seconds: expected a number from 0.1 to 3600",
    );
    check("--futures -3", "found -3");
    check("--futures 65537", "--futures: expected at most 65536");
    check("--threads 100000", "--threads: expected at most 1024");
    place.check(
        "ablate nar --scenario scene.tfrecord --seconds 0",
        2,
        &["--seconds: expected a number from 0.1"],
    );
    place.check(
        "train --data scene.tfrecord --batch 100000000",
        2,
        &["--batch: expected at most 65536 samples"],
    );
    assert!(!place.path("out/simulate/film.gif").exists());
}

#[test]
fn a_folder_and_a_number_beyond_the_last_are_told() {
    let place = Workplace::new();
    let simulate = |scenario: &str| {
        format!("simulate --scenario {scenario} --world constant-velocity --futures 1")
    };
    place.check(
        &simulate("scene.tfrecord#7"),
        2,
        &[
            "expected #0, the only scenario there is, found #7",
            "scene.tfrecord",
        ],
    );
    place.check(
        &simulate("scene.tfrecord#other"),
        2,
        &["\"other\"", "of another id"],
    );
    fs::create_dir(place.path("two")).unwrap();
    place.write_scene("two/a.tfrecord");
    let alone = place.run(&simulate("two"));
    assert!(alone.status.success(), "{}", text(&alone.stderr));
    place.write_scene("two/b.tfrecord");
    place.check(
        &simulate("two"),
        2,
        &["folder with 2 files", "two/a.tfrecord", "two#0"],
    );
    let plan = "plan --scenario two --planner idm --seconds 1";
    place.check(plan, 2, &["folder with 2 files"]);
    assert!(place.run(&simulate("two#1")).status.success());
}

#[test]
fn weights_are_found_or_hinted_at() {
    let place = Workplace::new();
    let world = |name: &str| format!("simulate --scenario scene.tfrecord --world {name}");
    let hint = place.run(&world("dir/w.bin"));
    assert_eq!(hint.status.code(), Some(2));
    assert!(
        text(&hint.stderr).contains("model:dir/w.bin"),
        "{}",
        text(&hint.stderr)
    );
    // A name that can only be weights is taken for weights, which are not there.
    place.check(&world("w.safetensors"), 2, &["w.safetensors"]);
    place.check(
        "simulate -s scene.tfrecord --weights w.safetensors",
        2,
        &["w.safetensors"],
    );
    for bare in ["model", "model:"] {
        let output = place.run(&world(bare));
        let error = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{error}");
        let shipped = "model:datasets/weights/gump-relative.safetensors";
        assert!(error.contains(shipped), "{error}");
    }
}

#[test]
fn shares_of_a_planner_are_from_0_to_1() {
    let place = Workplace::new();
    let words = "evaluate closed-loop --scenarios scene.tfrecord --planner interactive --world idm";
    for (flag, found) in [
        ("--hedge", "2"),
        ("--hedge", "NaN"),
        ("--hysteresis", "1.5"),
    ] {
        let expected = format!("{flag}: expected a number from 0 to 1, found {found}");
        place.check(&format!("{words} {flag} {found}"), 2, &[&expected]);
    }
    for (flag, found, range) in [
        ("--horizon", "0", "a number of seconds from 0.5 to 4"),
        ("--discount", "7", "a number above 0 and at most 1"),
        ("--futures", "100000", "at most 1024"),
        ("--network-modes", "100000", "at most 64"),
    ] {
        let expected = format!("{flag}: expected {range}, found {found}");
        place.check(&format!("{words} {flag} {found}"), 2, &[&expected]);
        let plan = format!("plan --scenario scene.tfrecord {flag} {found}");
        place.check(&plan, 2, &[&expected]);
    }
}

#[test]
fn names_of_nothing_are_wrong_arguments() {
    let place = Workplace::new();
    let simulate = "simulate --scenario scene.tfrecord --world idm";
    let check = |words: &str, part: &str| place.check(words, 2, &[part]);
    check("data inspect none.tfrecord", "none.tfrecord");
    check(&format!("{simulate} --config none.toml"), "none.toml");
    check(
        "evaluate behaviour --world idm --scenarios scene.tfrecord#1",
        "expected #0, the only scenario there is, found #1",
    );
    let lists = Path::new(env!("CARGO_MANIFEST_DIR")).join("../datasets/benchmarks");
    let list = lists.join("recorded.toml").display().to_string();
    let wosac = "evaluate wosac --world idm --scenarios";
    check(&format!("{wosac} {list}#foo"), "found ");
    place.write_map();
    let fix = "[[object]]\nid = \"a\"\nclass = \"tram\"\n";
    fs::write(place.path("fix.toml"), fix).unwrap();
    let generate = "generate --map map.tfrecord --fix fix.toml";
    let error = text(&place.run(generate).stderr);
    assert_eq!(error.matches("line 3").count(), 1, "{error}");
    check(generate, "--fix fix.toml: line 3: ");
}

#[test]
fn a_bench_tells_missing_pytorch_and_unknown_sizes() {
    let place = Workplace::new();
    for verb in ["train", "engine"] {
        let words = format!("bench {verb} --torch no-such-python");
        place.check(&words, 2, &["--torch no-such-python: cannot be run"]);
        let words = format!("bench {verb} --sizes huge");
        place.check(&words, 2, &["--sizes: expected one of tiny,", "found huge"]);
    }
}

#[cfg(unix)]
#[test]
fn a_bench_tells_pythons_without_a_recent_pytorch() {
    use std::os::unix::fs::PermissionsExt as _;
    let place = Workplace::new();
    let missing = "echo 'ModuleNotFoundError: no module torch' >&2; exit 1";
    for (name, says, expected) in [
        ("without", missing, "ModuleNotFoundError: no module torch"),
        (
            "old",
            "echo 1.13.1+cpu",
            "expected PyTorch 2.4 or newer, found 1.13.1+cpu",
        ),
        (
            "odd",
            "echo unknown",
            "expected PyTorch 2.4 or newer, found unknown",
        ),
    ] {
        let python = place.path(name);
        fs::write(&python, format!("#!/bin/sh\n{says}\n")).unwrap();
        fs::set_permissions(&python, fs::Permissions::from_mode(0o755)).unwrap();
        for verb in ["train", "engine"] {
            let words = format!("bench {verb} --sizes tiny --torch {}", python.display());
            place.check(&words, 2, &["--torch ", expected]);
        }
    }
}

#[test]
fn heads_are_asked_of_networks_that_have_them() {
    let place = Workplace::new();
    let words =
        |world: &str| format!("evaluate motion --scenarios scene.tfrecord --heads --world {world}");
    let expected = "--heads: expected --world model:WEIGHTS, found idm";
    place.check(&words("idm"), 2, &[expected]);
    let weights = Path::new(env!("CARGO_MANIFEST_DIR")).join("../datasets/weights");
    let relative = weights.join("gump-relative.safetensors");
    let world = format!("model:{}", relative.display());
    place.check(
        &words(&world),
        2,
        &["--heads: ", "found a relative network"],
    );
    for flag in [
        "--futures 8",
        "--temperature 0.5",
        "--raw",
        "--life",
        "--lights log",
    ] {
        let words = format!("{} {flag}", words(&world));
        let output = place.run(&words);
        let error = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{words}: {error}");
        assert!(error.contains("'--heads' cannot be used with"), "{error}");
    }
}

#[test]
fn a_broken_file_has_no_counts_before_the_reason() {
    let place = Workplace::new();
    place.write_map();
    let bytes = fs::read(place.path("scene.tfrecord")).unwrap();
    fs::write(place.path("cut.tfrecord"), &bytes[..bytes.len() - 99]).unwrap();
    for (name, why) in [("cut.tfrecord", "byte 0"), ("map.tfrecord", "a map alone")] {
        let words = format!("data inspect {name}");
        place.check(&words, 1, &["the only record", why, name]);
        assert_eq!(text(&place.run(&words).stdout), "", "{name}");
    }
}

#[test]
fn a_map_is_all_that_generation_needs() {
    let place = Workplace::new();
    place.write_map();
    let scenario = gump_data::find_map(&place.path("map.tfrecord").display().to_string()).unwrap();
    let ego = scenario.present().ego_now().state;
    assert_eq!(scenario.present().now().agents().len(), 1);
    let lane = &scenario.map.lanes()[0].centerline;
    assert_eq!(
        ego.pose.position,
        lane.pose_at(lane.length() / 2.0).position
    );
    let network =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../datasets/networks/lankershim.net.xml.gz");
    let network = network.display().to_string();
    assert!(gump_data::find_map(&network).unwrap().map.lanes().len() > 20);
    place.check(&format!("data inspect {network}"), 1, &["SUMO network"]);
    // What is missing to the driver is what the test withholds: the weights, not agents.
    let generate = "generate --map map.tfrecord --vehicles 1 --weights none.safetensors";
    place.check(generate, 2, &["none.safetensors"]);
}

#[test]
fn a_planner_that_cannot_explain_is_refused_before_it_drives() {
    let place = Workplace::new();
    let plan = "plan --scenario scene.tfrecord --seconds 1 --explain 20";
    place.check(
        &format!("{plan} --planner pdm-closed"),
        2,
        &["--explain 20", "interactive", "pdm-closed"],
    );
    place.check(
        plan,
        2,
        &["--explain 20: expected a step of the drive, 0 to 9"],
    );
    assert!(!place.path("out/plan/film.gif").exists());
}

#[test]
fn fewer_rollouts_than_the_challenge_asks_for_are_noted() {
    let place = Workplace::new();
    let wosac = "evaluate wosac --scenarios scene.tfrecord --world constant-velocity";
    let few = text(&place.run(&format!("{wosac} --futures 4 --out few")).stdout);
    assert!(
        few.contains("note: expected 32 rollouts") && few.contains("found 4"),
        "{few}"
    );
    let all = text(&place.run(&format!("{wosac} --out all")).stdout);
    assert!(
        all.contains("metametric") && !all.contains("note:"),
        "{all}"
    );
    assert!(all.lines().all(|line| line.chars().count() <= 120), "{all}");
    let wide = text(&place.run(&format!("{wosac} --out all --wide")).stdout);
    assert!(
        wide.lines().any(|line| line.chars().count() > 120),
        "{wide}"
    );
}

#[test]
fn a_version_is_told_and_a_device_only_asked_for_where_something_computes() {
    let place = Workplace::new();
    let version = text(&place.run("--version").stdout);
    assert!(version.contains(env!("CARGO_PKG_VERSION")), "{version}");
    place.check(
        "data inspect scene.tfrecord --device cpu",
        2,
        &["--device", "data inspect"],
    );
    let help = |words: &str| text(&place.run(words).stdout);
    assert!(!help("data inspect --help").contains("--device"));
    let simulate = help("simulate --help");
    for part in [
        "--device",
        "Decoding of a learned world:",
        "Common options:",
        "-s, --scenario",
    ] {
        assert!(simulate.contains(part), "expected {part} in: {simulate}");
    }
    for shell in ["bash", "zsh", "fish"] {
        assert!(
            help(&format!("completions {shell}")).contains("simulate"),
            "{shell}"
        );
    }
    assert!(place.run("manual --out man").status.success());
    let page = fs::read_to_string(place.path("man/xtask-simulate.1")).unwrap();
    assert!(page.contains("futures"), "{page}");
}

/// Ctrl-C in the middle of a conversion: exit status 130, and no reader takes what is there until
/// the same command has finished it.
#[cfg(unix)]
#[test]
fn a_conversion_that_was_stopped_is_no_data_set() {
    let place = Workplace::new();
    fs::create_dir(place.path("in")).unwrap();
    let scene = fs::read(place.path("scene.tfrecord")).unwrap();
    for i in 0..1500 {
        fs::write(place.path(&format!("in/{i}.tfrecord")), &scene).unwrap();
    }
    let words = "data convert --from in --to cache --threads 1";
    let mark = place.path("cache/CACHE-INCOMPLETE");
    let running = place
        .command(words)
        .stderr(std::process::Stdio::piped())
        .spawn();
    let running = running.unwrap();
    let waits = (0..60_000).take_while(|_| !mark.exists());
    let waited = waits.map(|_| std::thread::sleep(Duration::from_millis(1)));
    assert!(waited.count() < 60_000, "no mark");
    let interrupt = Command::new("kill")
        .args(["-INT", &running.id().to_string()])
        .status();
    assert!(interrupt.unwrap().success());
    let output = running.wait_with_output().unwrap();
    let error = text(&output.stderr);
    assert_eq!(output.status.code(), Some(130), "{error}");
    assert!(error.contains("the same command resumes"), "{error}");
    for reader in [
        "data inspect cache",
        "data stats cache",
        "train --data cache",
    ] {
        place.check(
            reader,
            1,
            &["CACHE-INCOMPLETE", "the same command finishes it"],
        );
    }
    let output = place.run(words);
    assert!(output.status.success(), "{}", text(&output.stderr));
    assert!(!mark.exists());
    let output = place.run("data stats cache");
    assert!(output.status.success(), "{}", text(&output.stderr));
}
