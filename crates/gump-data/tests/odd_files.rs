//! Files that are huge, many, misnamed or filled in without care: what is sound is delivered, what
//! is not is named with its place and counted.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

mod common;

#[path = "common/hostile.rs"]
mod hostile;

use std::fs;
use std::path::Path;

use gump_data::{
    DataError, OutputFormat, ReadOptions, ScenarioRecord, convert, list_files, open, verify, womd,
};
use gump_scene::AgentId;
use tempfile::TempDir;

const TESTS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests");

#[test]
fn one_bad_shard_among_a_thousand_is_named_and_the_rest_delivered() {
    let (folder, to) = (TempDir::new().unwrap(), TempDir::new().unwrap());
    let place = |i: usize| {
        let name = format!("part.tfrecord-{i:05}-of-01000");
        folder.path().join(name)
    };
    let mut scenario = common::crossing();
    scenario.log.truncate(scenario.now + 2);
    for i in 0..1000 {
        scenario.id = format!("scene-{i}");
        womd::write_scenarios(&place(i), [&scenario, &scenario].map(Clone::clone)).unwrap();
    }
    let bytes = fs::read(place(617)).unwrap();
    // The second of its two records loses its end.
    fs::write(place(617), &bytes[..bytes.len() - 40]).unwrap();
    let (good, bad): (Vec<_>, Vec<_>) = open(folder.path()).unwrap().partition(Result::is_ok);
    assert_eq!((good.len(), bad.len()), (1999, 1));
    let error = bad.into_iter().find_map(Result::err).unwrap().to_string();
    let whole = bytes.len() / 2;
    for part in [
        "record 1",
        &format!("byte {whole}"),
        "part.tfrecord-00617-of-01000",
    ] {
        assert!(error.contains(part), "expected {part} in: {error}");
    }
    let verification = verify(folder.path()).unwrap();
    let broken: usize = verification.formats.values().map(|f| f.broken).sum();
    assert!(verification.is_broken() && broken > 0);
    let files = list_files(folder.path()).unwrap();
    let converted = convert::<DataError>(
        &files,
        ReadOptions::ALL,
        OutputFormat::Parquet,
        &to.path().join("all"),
        |_| Ok(()),
    );
    let converted = converted.unwrap();
    assert_eq!((converted.scenarios, converted.refused.len()), (1999, 1));
}

/// Bytes of a file as long as no memory of a small machine.
const HUGE: u64 = 10 << 30;

#[test]
fn ten_gigabytes_of_any_format_are_told_without_holding_them() {
    let folder = TempDir::new().unwrap();
    let before = peak_memory();
    for target in &hostile::TARGETS {
        let Some((seed, bytes)) = target.corpus().into_iter().find(|(file, _)| is_seed(file))
        else {
            panic!("{} has no seed", target.name);
        };
        let path = folder.path().join(seed.file_name().unwrap());
        fs::write(&path, &bytes).unwrap();
        // The zeros take no disk blocks.
        let file = fs::OpenOptions::new().write(true).open(&path).unwrap();
        if let Err(error) = file.set_len(HUGE) {
            eprintln!("SKIPPED: no sparse file of 10 GB can be made here: {error}");
            return;
        }
        let count = open(&path).map_or(0, |reader| reader.take(1000).count());
        assert!(count < 1000, "{}: goes on for ever", target.name);
        fs::remove_file(&path).unwrap();
    }
    if let Some((before, after)) = before.zip(peak_memory()) {
        let taken = (after - before) >> 20;
        assert!(taken < 1024, "{taken} MB were held");
    }
}

fn is_seed(file: &Path) -> bool {
    let name = file.file_name().unwrap_or_default().to_string_lossy();
    name.starts_with("seed")
}

/// The peak memory of this process, bytes, where the system reports it.
fn peak_memory() -> Option<u64> {
    let status = fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmHWM:"))?;
    let kilobytes: u64 = line.split_whitespace().nth(1)?.parse().ok()?;
    Some(kilobytes << 10)
}

#[test]
fn names_do_not_decide_what_a_file_is() {
    let (folder, sources) = (TempDir::new().unwrap(), TempDir::new().unwrap());
    let data = |name: &str| Path::new(TESTS).join("data").join(name);
    let [plain, packed] = ["a.tfrecord", "a.tfrecord.gz"].map(|name| sources.path().join(name));
    for path in [&plain, &packed] {
        womd::write_scenarios(path, [common::crossing()]).unwrap();
    }
    for (from, name) in [
        (data("gpudrive.json"), "cars.tfrecord"),
        (data("commonroad.xml"), "cars.json"),
        (data("own.json"), "cars.db"),
        (plain.clone(), "cars.xml"),
        (packed, "cars.json"),
        (plain.clone(), "cars"),
    ] {
        let path = folder.path().join(name);
        fs::copy(from, &path).unwrap();
        assert_eq!(
            open(&path).unwrap().filter(Result::is_ok).count(),
            1,
            "{name}"
        );
    }
}

/// The only scenario of CommonRoad's hand-made file with one string replaced by another.
fn careless(what: &str, by: &str) -> Result<ScenarioRecord, DataError> {
    let folder = TempDir::new().unwrap();
    let text = fs::read_to_string(Path::new(TESTS).join("data/commonroad.xml")).unwrap();
    assert_eq!(text.matches(what).count(), 1, "{what}");
    let path = folder.path().join("some.xml");
    fs::write(&path, text.replace(what, by)).unwrap();
    open(&path).unwrap().next().unwrap()
}

/// The second state of its only car, of three.
const SECOND: &str = "<state><position><point><x>10</x><y>0</y></point></position>\
    <orientation><exact>0</exact></orientation><time><exact>1</exact></time>\
    <velocity><exact>10</exact></velocity></state>";
/// The third.
const THIRD: &str = "<state><position><point><x>15</x><y>0</y></point></position>\
    <orientation><exact>0</exact></orientation><time><exact>2</exact></time>\
    <velocity><exact>10</exact></velocity></state>";

#[test]
fn states_out_of_order_twice_missing_or_nowhere() {
    let car = AgentId(100);
    let place = |record: &ScenarioRecord, step: usize| {
        let found = record.scenario.log[step].agent(car);
        found.map(|car| car.state.pose.position.x)
    };
    let both = [SECOND, THIRD].concat();
    let sorted = careless(&both, &[THIRD, SECOND].concat()).unwrap();
    assert_eq!(
        [0, 1, 2].map(|step| place(&sorted, step)),
        [5.0, 10.0, 15.0].map(Some)
    );
    let reason = "order of a track that is not sorted by time";
    assert_eq!(sorted.report.dropped[reason], 1);

    let twice = careless(&both, &[SECOND, SECOND, THIRD].concat()).unwrap();
    assert_eq!(place(&twice, 1), Some(10.0));
    let reason = "second state of a track in one step";
    assert_eq!(twice.report.dropped[reason], 1);
    assert!(twice.report.notes[0].detail.starts_with("track 100"));

    let gap = careless(SECOND, "").unwrap();
    assert_eq!(
        [0, 1, 2].map(|step| place(&gap, step)),
        [Some(5.0), None, Some(15.0)]
    );

    let nowhere = careless(SECOND, &SECOND.replace("<x>10</x>", "<x>NaN</x>")).unwrap();
    assert_eq!(
        [0, 1, 2].map(|step| place(&nowhere, step)),
        [Some(5.0), None, Some(15.0)]
    );
    let note = &nowhere.report.notes[0].detail;
    assert_eq!(note, "track 100 at step 1: coordinate NaN");
}

#[test]
fn obstacles_of_one_id_or_of_no_size() {
    let again = "<staticObstacle id=\"100\"><type>car</type><shape><rectangle><length>4</length>\
        <width>2</width></rectangle></shape><initialState><position><point><x>30</x><y>0</y>\
        </point></position><orientation><exact>0</exact></orientation><time><exact>0</exact>\
        </time></initialState></staticObstacle></commonRoad>";
    let twice = careless("</commonRoad>", again).unwrap();
    assert_eq!(twice.scenario.log[0].agents().len(), 1);
    assert_eq!(twice.report.dropped["track whose id occurs before"], 1);
    assert_eq!(twice.report.notes[0].detail, "track 100");

    let flat = careless("<length>4.5</length>", "<length>0</length>").unwrap();
    let car = flat.scenario.log[0].agents()[0];
    assert_eq!(
        (car.length, car.width),
        (4.7, 2.1),
        "the usual size of its class"
    );
    assert_eq!(flat.report.dropped["size that is none"], 1);
    assert_eq!(flat.report.inferred["size of an agent by its class"], 1);
}
