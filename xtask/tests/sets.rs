//! Frozen sets from the outside: made, held to their sums, scored on by name, refused where they differ.
#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

#[path = "../../tests/shared.rs"]
mod shared_data;

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;
use tempfile::TempDir;

fn run(folder: &TempDir, words: &str) -> Output {
    Command::new(env!("CARGO_BIN_EXE_xtask"))
        .args(words.split(' '))
        .current_dir(folder.path())
        .env("CARGO_MANIFEST_DIR", env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap()
}

/// The results of a run that succeeds.
fn results(folder: &TempDir, words: &str, out: &str) -> Value {
    let output = run(folder, &format!("{words} --quiet --out {out}"));
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{words}: {error}");
    let path = folder.path().join(out).join("report.json");
    let mut report: Value = serde_json::from_str(&fs::read_to_string(path).unwrap()).unwrap();
    report["results"].take()
}

fn fails(folder: &TempDir, words: &str, status: i32, part: &str) {
    let output = run(folder, &format!("{words} --quiet --out failed"));
    let error = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(status), "{words}: {error}");
    assert!(error.contains(part), "{words}: expected {part} in: {error}");
    assert_eq!(error.trim().lines().count(), 1, "one sentence: {error}");
}

const SMALL: &str = "# A comment that stays.
name = \"small\"
about = \"For a test.\"

[[made]]
file = \"procedural\"
split = \"tune\"
generator = \"procedural/1\"
seed = 900000999
count = 2
";

#[test]
fn a_list_makes_the_same_scenes_anywhere_and_results_name_it() {
    let folder = tempfile::tempdir().unwrap();
    let list = folder.path().join("small.toml");
    fs::write(&list, SMALL).unwrap();
    let frozen = results(&folder, "data benchmark --list small.toml --freeze", "a");
    assert_eq!(frozen["rows"][0]["state"], "frozen");
    let text = fs::read_to_string(&list).unwrap();
    assert!(text.starts_with("# A comment that stays.\n"), "{text}");
    // Made again, elsewhere and on one thread, and found as it should be.
    let words = "data benchmark --list small.toml --threads 1";
    let made = results(&folder, words, "out/data-benchmark");
    assert_eq!(made["rows"][0]["state"], "made as listed");
    let again = results(&folder, words, "out/data-benchmark");
    assert_eq!(again["rows"][0]["state"], "as listed");
    results(&folder, "data benchmark --list small.toml --check a", "b");
    assert_eq!(fs::read_to_string(&list).unwrap(), text);

    let words = "evaluate wosac --world constant-velocity --rollouts-per-scenario 2";
    let scored = results(
        &folder,
        &format!("{words} --scenarios small.toml#tune"),
        "c",
    );
    assert_eq!(
        (&scored["set"], &scored["scenarios"]),
        (&"small".into(), &2.into())
    );
    for shard in ["1/2", "2/2"] {
        let words = format!("{words} --scenarios small.toml --shard {shard}");
        results(&folder, &words, &format!("s{}", &shard[..1]));
    }
    let merged = results(&folder, "evaluate merge s1 s2", "merged");
    assert_eq!(merged["set"], scored["set"]);
    assert_eq!(merged["rows"], scored["rows"]);
    let words = "evaluate motion --scenarios small.toml --world constant-velocity --futures 2";
    assert_eq!(results(&folder, words, "motion")["set"], "small");
    let words = "evaluate closed-loop --scenarios small.toml --planner log --world log --films 0 \
                 --seconds 1";
    let driven = results(&folder, words, "driven");
    assert_eq!(driven["set"], "small");
    assert_eq!(driven["rows"][0]["scenarios"], 2);

    fails(
        &folder,
        &format!("{words} --scenarios small.toml#test"),
        2,
        "with tune, found",
    );
    // One digit of a sum.
    let i = text.find("scenes = [").unwrap();
    let at = i + text[i..].find("    \"").unwrap() + 5;
    let digit = if &text[at..=at] == "0" { "1" } else { "0" };
    fs::write(&list, format!("{}{digit}{}", &text[..at], &text[at + 1..])).unwrap();
    let differs = "expected scene 0 of procedural to be";
    fails(&folder, "data benchmark --list small.toml", 1, differs);
    fails(
        &folder,
        "data benchmark --list small.toml --check a",
        1,
        differs,
    );
    fails(
        &folder,
        &format!("{words} --scenarios small.toml"),
        1,
        differs,
    );
    fs::write(&list, text.replace("procedural/1", "procedural/99")).unwrap();
    fs::remove_dir_all(folder.path().join("failed")).unwrap();
    fails(
        &folder,
        "data benchmark --list small.toml",
        1,
        "found procedural/99",
    );
    fails(
        &folder,
        "data benchmark --list nowhere.toml",
        2,
        "cannot read the list",
    );
    fails(
        &folder,
        "evaluate wosac --scenarios small.toml#x --world log",
        2,
        "found small.toml#x",
    );
}

#[test]
fn seeds_of_frozen_sets_are_not_for_training() {
    let folder = tempfile::tempdir().unwrap();
    let words = "data synthesize --scenes 1 --seed";
    fails(
        &folder,
        &format!("{words} 900000001"),
        2,
        "those are of the frozen sets",
    );
    results(&folder, &format!("{words} 899999999"), "a");
}

#[test]
fn recorded_scenes_of_two_formats_are_one_set() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    if shared_data::shared("data").is_none() {
        return;
    }
    let text = fs::read_to_string(root.join("datasets/benchmarks/recorded.toml")).unwrap();
    let line = |end: &str| text.lines().find(|line| line.ends_with(end)).unwrap();
    let part = |folder: &str, line: &str| {
        format!(
            "[[recorded]]\nsplit = \"test\"\nfolder = \"{folder}\"\nabout = \"\"\nscenes = [\n{line}\n]\n"
        )
    };
    let (waymo, other) = (line(" ee519cf571686d19\","), line(" 140fca52e29b6ec1\","));
    let head = "name = \"two\"\nabout = \"\"\n";
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, waymo: &str| {
        let text = [
            head,
            &part("gpudrive/validation", other),
            &part("waymo", waymo),
        ]
        .concat();
        fs::write(folder.path().join(name), text).unwrap();
    };
    write("two.toml", waymo);
    let found = results(&folder, "data benchmark --list two.toml", "a");
    assert_eq!(found["rows"].as_array().unwrap().len(), 2);
    let words = "evaluate wosac --scenarios two.toml --world log --rollouts-per-scenario 1";
    let scored = results(&folder, words, "b");
    assert_eq!(
        (&scored["set"], &scored["scenarios"]),
        (&"two".into(), &2.into())
    );
    let entries = fs::read_to_string(folder.path().join("b/scenarios.toml")).unwrap();
    let (first, second) = (
        entries.find("140fca52e29b6ec1"),
        entries.find("ee519cf571686d19"),
    );
    assert!(first.is_some() && first < second, "{entries}");
    // A sum that differs, a file that is not there.
    write("other.toml", &waymo.replacen(char::is_alphanumeric, "x", 1));
    fails(
        &folder,
        &words.replace("two", "other"),
        1,
        "expected SHA-256 x",
    );
    write("absent.toml", &waymo.replace("scenario_b", "scenario_c"));
    fails(
        &folder,
        &words.replace("two", "absent"),
        1,
        "expected the recorded scene ee519cf571686d19",
    );
}
