//! Every example of the workspace, run as a user runs it: it succeeds, says what it is known to
//! say (to the letter where the guide quotes it), and leaves behind what it announces.
//!
//! Examples are found in the source folders, so a new one is run without a line here. Their
//! executables lie beside that of this test, where `cargo test --workspace` puts them.
#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::collections::BTreeMap;
use std::env::consts::EXE_SUFFIX;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Words that the output of an example has; only such as are the same on every machine.
const SAYS: [(&str, &str); 13] = [
    ("brake_for_nobody", "among idm: 0.0 % of agents collide"),
    ("build_a_scenario", "after 8 s: +1.4 m to the car ahead"),
    ("closest_calls", "8 scenes, the closest calls first"),
    ("conflict_point", "11 and 14 m/s"),
    ("drive_in_traffic", "log: 32 episodes"),
    ("explain_a_choice", "chosen: brisk"),
    ("film_a_scene", "out/scene.png: 640 x 480 pixels"),
    ("make_scenes", "4 scenes in out/roundabouts.tfrecord"),
    ("measure_realism", "idm: realism 0."),
    ("raster_as_text", "drivable_area"),
    ("score_a_planner", "among idm: "),
    ("tokens_of_a_dataset", "a vocabulary of 2972 tokens"),
    ("train_relative", "step 6 loss "),
];

/// Examples that are longer than a page, and why.
const LONG: [(&str, &str); 1] = [("statistics", "a report, cited in datasets/README.md")];

#[test]
fn every_example_runs() {
    let sources = sources();
    assert!(sources.len() >= SAYS.len(), "only {} found", sources.len());
    let missing = SAYS.iter().find(|(name, _)| !sources.contains_key(*name));
    assert_eq!(
        missing, None,
        "an example that is expected to say something"
    );
    let problems: Vec<String> = sources
        .iter()
        .filter_map(|(name, path)| run(name, path))
        .collect();
    assert!(problems.is_empty(), "{}", problems.join("\n"));
}

#[test]
fn examples_fit_a_page() {
    for (name, path) in sources() {
        let text = fs::read_to_string(&path).unwrap();
        // Marks by which the guide quotes an example are no part of it.
        let lines = text
            .lines()
            .filter(|line| !line.contains("// ANCHOR"))
            .count();
        let long = LONG.iter().any(|(pardoned, _)| *pardoned == name);
        assert_eq!(lines >= 60, long, "{} has {lines} lines", path.display());
    }
}

/// The examples of all packages by name, each with its source.
fn sources() -> BTreeMap<String, PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let crates = fs::read_dir(root.join("crates")).unwrap();
    let mut folders: Vec<PathBuf> = crates.map(|c| c.unwrap().path().join("examples")).collect();
    folders.push(root.join("examples"));
    let mut sources = BTreeMap::new();
    for folder in folders.into_iter().filter(|folder| folder.is_dir()) {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.extension().is_some_and(|extension| extension == "rs") {
                let name = path.file_stem().unwrap().to_str().unwrap().to_owned();
                let other = sources.insert(name, path.clone());
                assert_eq!(
                    other,
                    None,
                    "{} has the name of another example",
                    path.display()
                );
            }
        }
    }
    sources
}

/// Runs an example in a separate folder; returns what is wrong with it, if anything.
fn run(name: &str, source: &Path) -> Option<String> {
    let test = std::env::current_exe().unwrap();
    let built = test
        .parent()
        .and_then(Path::parent)
        .unwrap()
        .join("examples");
    let executable = built.join(format!("{name}{EXE_SUFFIX}"));
    let wrong = |what: String| Some(format!("{}: {what}", source.display()));
    if !executable.exists() {
        let advice =
            "build it with `cargo test --workspace` or `cargo build --workspace --examples`";
        return wrong(format!(
            "expected the executable {}; {advice}",
            executable.display()
        ));
    }
    let place = tempfile::tempdir().unwrap();
    let output = Command::new(&executable)
        .current_dir(place.path())
        .output()
        .unwrap();
    let printed = String::from_utf8_lossy(&output.stdout);
    if !output.status.success() {
        return wrong(format!(
            "{}: {}",
            output.status,
            String::from_utf8_lossy(&output.stderr)
        ));
    }
    if printed.trim().is_empty() || printed.contains("NaN") {
        return wrong(format!(
            "expected it to say something that makes sense, found: {printed}"
        ));
    }
    if let Some((_, words)) = SAYS
        .iter()
        .find(|(known, words)| *known == name && !printed.contains(words))
    {
        return wrong(format!(
            "expected \"{words}\" in its output, found: {printed}"
        ));
    }
    let quoted = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/guide/src/output");
    if let Ok(quoted) = fs::read_to_string(quoted.join(format!("{name}.txt")))
        && quoted != printed
    {
        return wrong(format!(
            "the guide quotes other output than this: {printed}"
        ));
    }
    let text = fs::read_to_string(source).unwrap();
    let announced = text.lines().take_while(|line| line.starts_with("//!"));
    let mut files = announced
        .flat_map(|line| line.split('`'))
        .filter(|word| word.starts_with("out/"));
    let lacking = files.find(|file| !place.path().join(file).is_file());
    lacking.and_then(|file| wrong(format!("expected it to write {file}, found no such file")))
}
