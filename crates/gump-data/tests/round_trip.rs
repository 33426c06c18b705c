//! Written scenarios read back as the same scenario.

mod common;

use std::io::Write;
use std::path::Path;

use gump_data::womd::write_scenarios;
use gump_data::{DataError, find, find_record, open, write_atomically};
use gump_scene::{Frame, MapGraph, Scenario};
use tempfile::TempDir;

/// The precision of an f32 heading or velocity.
const EPSILON: f64 = 2e-6;

fn same_frame(a: &Frame, b: &Frame) {
    assert_eq!(a.lights(), b.lights());
    assert_eq!(a.agents().len(), b.agents().len());
    for (a, b) in a.agents().iter().zip(b.agents()) {
        assert_eq!((a.id, a.kind), (b.id, b.kind));
        assert_eq!(a.state.pose.position, b.state.pose.position);
        assert_eq!(a.elevation, b.elevation);
        let near = |x: f64, y: f64| assert!((x - y).abs() <= EPSILON, "{x} is not {y}");
        near(a.state.pose.heading, b.state.pose.heading);
        near(a.state.velocity.x, b.state.velocity.x);
        near(a.state.velocity.y, b.state.velocity.y);
        near(a.length, b.length);
        near(a.width, b.width);
        near(a.height, b.height);
    }
}

/// Everything a format states; inferred parts are compared by [`same_inferred`].
fn same_stated(a: &Scenario, b: &Scenario) {
    assert_eq!((&a.id, a.now, a.ego), (&b.id, b.now, b.ego));
    assert_eq!(a.dt, b.dt);
    assert_eq!(a.targets, b.targets);
    assert_eq!(a.objects_of_interest, b.objects_of_interest);
    assert_eq!(a.log.len(), b.log.len());
    a.log.iter().zip(&b.log).for_each(|(a, b)| same_frame(a, b));
    assert_eq!(a.map.road_lines(), b.map.road_lines());
    assert_eq!(a.map.road_edges(), b.map.road_edges());
    assert_eq!(a.map.areas(), b.map.areas());
    assert_eq!(a.map.stop_signs(), b.map.stop_signs());
    let stated = |map: &MapGraph| {
        let mut lanes = map.lanes().to_vec();
        for lane in &mut lanes {
            (lane.width, lane.in_intersection) = (0.0, false);
        }
        lanes
    };
    assert_eq!(stated(&a.map), stated(&b.map));
}

fn same_inferred(a: &Scenario, b: &Scenario) {
    assert_eq!(a.map.lanes(), b.map.lanes());
    assert_eq!(a.map.drivable(), b.map.drivable());
    assert_eq!(a.route, b.route);
}

fn read_one(path: &Path) -> Scenario {
    let mut reader = open(path).expect("the file opens");
    let record = reader.next().expect("there is a record").expect("it reads");
    assert!(reader.next().is_none());
    record.scenario
}

#[test]
fn a_synthetic_scenario_comes_back() {
    let folder = TempDir::new().unwrap();
    let original = common::crossing();
    for name in ["made.tfrecord", "made.tfrecord.gz"] {
        let path = folder.path().join(name);
        let report = write_scenarios(&path, [&original]).unwrap();
        assert_eq!(report.dropped["lane width"], 5);
        let once = read_one(&path);
        same_stated(&original, &once);
        assert!(once.route.is_some() && !once.map.drivable().is_empty());
        // Inference depends only on what was written: a second round changes nothing at all.
        write_scenarios(&path, [&once]).unwrap();
        let twice = read_one(&path);
        same_stated(&once, &twice);
        same_inferred(&once, &twice);
    }
    let plain = std::fs::metadata(folder.path().join("made.tfrecord")).unwrap();
    let packed = std::fs::metadata(folder.path().join("made.tfrecord.gz")).unwrap();
    assert!(packed.len() * 2 < plain.len());
}

#[test]
fn real_scenarios_come_back() {
    let folder = TempDir::new().unwrap();
    for name in [
        "data/waymo/scenario_a.tfrecord",
        "data/waymo/scenario_b.tfrecord",
    ] {
        let Some(path) = common::shared(name) else {
            continue;
        };
        let original = read_one(&path);
        let copy = folder.path().join("copy.tfrecord");
        write_scenarios(&copy, [&original]).unwrap();
        let read = read_one(&copy);
        same_stated(&original, &read);
        same_inferred(&original, &read);
    }
}

fn named(id: &str) -> Scenario {
    Scenario {
        id: id.into(),
        ..common::crossing()
    }
}

#[test]
fn scenarios_are_found_by_index_and_by_id() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("many.tfrecord-00000-of-00001");
    write_scenarios(&path, ["a", "b", "77", "d#e"].map(named)).unwrap();
    let id = |what: &str| find(&format!("{}{what}", path.display())).map(|s| s.id);
    assert_eq!(id("").unwrap(), "a");
    assert_eq!(id("#0").unwrap(), "a");
    assert_eq!(id("#3").unwrap(), "d#e");
    assert_eq!(id("#b").unwrap(), "b");
    assert_eq!(id("#77").unwrap(), "77");
    let error = id("#nobody").unwrap_err();
    assert!(matches!(&error, DataError::NoSuchScenario { found: 4, .. }));
    assert!(
        error
            .to_string()
            .starts_with("expected a scenario \"nobody\", found 4 of other ids")
    );
}

#[test]
fn a_reader_of_one_scenario_reads_that_alone() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("many.tfrecord");
    write_scenarios(&path, ["a", "b", "c"].map(named)).unwrap();
    let open = |what: &str| open(Path::new(&format!("{}{what}", path.display())));
    for (what, expected) in [("#1", "b"), ("#c", "c")] {
        let reader = open(what).unwrap();
        assert_eq!(reader.format(), open("").unwrap().format());
        let ids: Vec<String> = reader.map(|record| record.unwrap().scenario.id).collect();
        assert_eq!(ids, [expected]);
    }
    assert!(matches!(
        open("#nobody").map(drop),
        Err(DataError::NoSuchScenario { found: 3, .. })
    ));
}

#[test]
fn earlier_records_are_passed_over_unseen_and_keep_their_index() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("many.tfrecord");
    write_scenarios(&path, ["a", "b", "c"].map(named)).unwrap();
    let mut bytes = std::fs::read(&path).unwrap();
    let record = bytes.len() / 3;
    bytes[record / 2] ^= 1;
    bytes[record + record / 2] ^= 1;
    std::fs::write(&path, &bytes).unwrap();
    let of = |index: usize| find_record(&format!("{}#{index}", path.display()));
    assert!(matches!(of(1), Err(DataError::Checksum { .. })));
    let third = of(2).unwrap();
    assert_eq!(third.scenario.id, "c");
    assert_eq!(third.offset as usize, 2 * record);
    assert_eq!(third.report.inferred["route from the ego's log"], 1);
    assert!(
        matches!(of(3), Err(DataError::Checksum { .. })),
        "the first problem on the way"
    );
}

#[test]
fn a_directory_is_read_in_the_order_of_its_names() {
    let folder = TempDir::new().unwrap();
    for (name, id) in [("b.tfrecord", "2"), ("a.tfrecord-00000-of-00001", "1")] {
        write_scenarios(&folder.path().join(name), [named(id)]).unwrap();
    }
    std::fs::write(folder.path().join("c.tfrecord.partial"), "unfinished").unwrap();
    std::fs::write(folder.path().join("notes.txt"), "no data").unwrap();
    let ids = open(folder.path()).unwrap().map(|r| r.unwrap().scenario.id);
    assert_eq!(ids.collect::<Vec<_>>(), ["1", "2"]);
    let second = find(&format!("{}#1", folder.path().display())).unwrap();
    assert_eq!(second.id, "2");
}

#[test]
fn a_broken_file_in_a_directory_does_not_hide_the_next() {
    let folder = TempDir::new().unwrap();
    std::fs::write(folder.path().join("a.tfrecord"), "garbage").unwrap();
    write_scenarios(&folder.path().join("b.tfrecord"), [named("b")]).unwrap();
    std::fs::write(folder.path().join("c.tfrecord"), "garbage").unwrap();
    write_scenarios(&folder.path().join("d.tfrecord"), [named("d")]).unwrap();
    let reader = open(folder.path()).unwrap();
    let read: Vec<bool> = reader.map(|record| record.is_ok()).collect();
    assert_eq!(read, [false, true, false, true]);
    let third = find(&format!("{}#3", folder.path().display())).unwrap();
    assert_eq!(third.id, "d");
}

#[test]
fn nothing_appears_under_the_final_name_when_writing_fails() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("out.tfrecord");
    let mut bad = common::crossing();
    bad.objects_of_interest = vec![gump_scene::AgentId(1 << 40)];
    let error = write_scenarios(&path, [common::crossing(), bad]).unwrap_err();
    assert!(matches!(error, DataError::Unwritable { .. }));
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    std::fs::write(&path, "what was there before").unwrap();
    let failed = write_atomically(&path, |file| {
        file.write_all(b"half a fi").expect("the disk has room");
        Err::<(), _>(DataError::Empty { path: path.clone() })
    });
    assert!(failed.is_err());
    assert_eq!(
        std::fs::read_to_string(&path).unwrap(),
        "what was there before"
    );
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
}
