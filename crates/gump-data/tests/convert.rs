//! Conversion: every format that is written reads back, bad records do not stop the others.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

mod common;

use std::fs;
use std::path::{Path, PathBuf};

use arrow_array::Array;
use arrow_array::cast::AsArray;
use arrow_array::types::{Float64Type, Int64Type};
use gump_data::{
    Converted, DataError, OutputFormat, ReadOptions, convert, groups, list_files, open, open_with,
    womd, write_tracks,
};
use gump_scene::{AgentId, Frame, Scenario};
use tempfile::TempDir;

fn named(id: &str) -> Scenario {
    Scenario {
        id: id.into(),
        ..common::crossing()
    }
}

fn run(from: &Path, format: OutputFormat, stem: &Path) -> Converted {
    let files = list_files(from).unwrap();
    let each = |_: &Scenario| Ok::<(), DataError>(());
    convert(&files, ReadOptions::ALL, format, stem, each).unwrap()
}

/// A folder of two good files, one that is broken in the middle, and one of another kind.
fn sources() -> TempDir {
    let folder = TempDir::new().unwrap();
    let place = |name: &str| folder.path().join(name);
    womd::write_scenarios(&place("a.tfrecord"), ["a", "b"].map(named)).unwrap();
    womd::write_scenarios(&place("b.tfrecord"), ["c", "d"].map(named)).unwrap();
    let mut bytes = fs::read(place("b.tfrecord")).unwrap();
    bytes[50] ^= 1;
    fs::write(place("b.tfrecord"), bytes).unwrap();
    womd::write_scenarios(&place("c.tfrecord.gz"), [named("e")]).unwrap();
    fs::write(place("licence.txt"), "for tests").unwrap();
    folder
}

#[test]
fn what_can_be_read_is_delivered_and_the_rest_is_named() {
    let from = sources();
    let to = TempDir::new().unwrap();
    let formats = [
        (OutputFormat::Cache, 1),
        (OutputFormat::Waymo, 1),
        (OutputFormat::ScenarioJson, 4),
    ];
    for (format, files) in formats {
        let folder = to.path().join(format!("{format:?}"));
        let converted = run(from.path(), format, &folder.join("scenes-00000"));
        assert_eq!((converted.scenarios, converted.files.len()), (4, files));
        let bytes = converted
            .files
            .iter()
            .map(|f| fs::metadata(f).unwrap().len());
        assert_eq!(converted.bytes, bytes.sum::<u64>());
        assert_eq!(converted.skipped["other text"], 1);
        let refused: Vec<_> = converted.refused.iter().map(ToString::to_string).collect();
        assert_eq!(refused.len(), 1);
        assert!(refused[0].contains("record 0 at byte 0 of"), "{refused:?}");
        assert!(refused[0].ends_with("b.tfrecord"), "{refused:?}");
        let read = open(&folder).unwrap().map(|r| r.unwrap().scenario);
        let read: Vec<Scenario> = read.collect();
        let ids: Vec<_> = read.iter().map(|s| s.id.as_str()).collect();
        assert_eq!(ids, ["a", "b", "d", "e"]);
        assert_eq!(read[2].log.len(), 91);
    }
}

#[test]
fn what_a_format_cannot_hold_is_named() {
    let from = TempDir::new().unwrap();
    let large = Scenario {
        objects_of_interest: vec![AgentId(1 << 40)],
        ..named("large")
    };
    let shard = from.path().join("in.cache");
    gump_data::cache::write_shard(&shard, [&large, &named("small")]).unwrap();
    let stem = from.path().join("out");
    let converted = run(&shard, OutputFormat::Waymo, &stem);
    assert_eq!((converted.scenarios, converted.refused.len()), (1, 1));
    assert!(matches!(&converted.refused[0], DataError::Unwritable { id, .. } if id == "large"));
    // With nothing left there is no file.
    gump_data::cache::write_shard(&shard, [&large]).unwrap();
    let converted = run(&shard, OutputFormat::Waymo, &stem.join("none"));
    assert!(converted.files.is_empty() && converted.bytes == 0);
    assert_eq!(fs::read_dir(&stem).unwrap().count(), 0);
}

#[test]
fn the_caller_may_end_the_work_and_leaves_no_file() {
    let from = sources();
    let to = TempDir::new().unwrap();
    let files = list_files(from.path()).unwrap();
    let mut seen = 0;
    let each = |_: &Scenario| {
        seen += 1;
        let path = PathBuf::from("enough");
        if seen < 3 {
            Ok(())
        } else {
            Err(DataError::Empty { path })
        }
    };
    let stem = to.path().join("scenes");
    let ended = convert(&files, ReadOptions::ALL, OutputFormat::Cache, &stem, each);
    assert!(matches!(ended, Err(DataError::Empty { .. })));
    assert_eq!(fs::read_dir(to.path()).unwrap().count(), 0);
}

#[test]
fn groups_hold_every_file_once_and_in_order() {
    let folder = TempDir::new().unwrap();
    let files: Vec<PathBuf> = (0..100)
        .map(|i| folder.path().join(format!("{i:03}")))
        .collect();
    for (i, file) in files.iter().enumerate() {
        fs::write(file, vec![0; 100 * (i % 7)]).unwrap();
    }
    let groups = groups(&files);
    assert!((12..=20).contains(&groups.len()), "{groups:?}");
    let all: Vec<usize> = groups.into_iter().flatten().collect();
    assert_eq!(all, (0..100).collect::<Vec<_>>());
    assert!(gump_data::groups(&[]).is_empty());
}

#[test]
fn a_table_of_tracks_reads_back() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("tracks.parquet");
    let scenarios = ["a", "b"].map(named);
    write_tracks(&path, &scenarios).unwrap();
    let table = common::table(&path);
    let names: Vec<_> = table
        .schema()
        .fields()
        .iter()
        .map(|f| f.name().clone())
        .collect();
    let expected = "scenario_id track_id class is_ego time_s x y heading vx vy length width";
    assert_eq!(names.join(" "), expected);
    let text = |name: &str| {
        table
            .column_by_name(name)
            .unwrap()
            .as_string::<i32>()
            .clone()
    };
    let number = |name: &str| {
        let column = table.column_by_name(name).unwrap();
        column.as_primitive::<Float64Type>().clone()
    };
    let ids = table.column_by_name("track_id").unwrap();
    let ids = ids.as_primitive::<Int64Type>();
    let is_ego = table.column_by_name("is_ego").unwrap().as_boolean();
    let columns = ["x", "y", "heading", "vx", "vy", "length", "width"].map(number);
    let (scenario_ids, classes, times) = (text("scenario_id"), text("class"), number("time_s"));
    assert_eq!(table.num_rows(), 2 * 5 * 91);
    for row in 0..table.num_rows() {
        let scenario = &scenarios[row / (5 * 91)];
        assert_eq!(scenario_ids.value(row), scenario.id);
        let step = row % 91;
        assert!((times.value(row) - step as f64 * 0.1).abs() < 1e-12);
        let agent = scenario.log[step].agent(AgentId(ids.value(row))).unwrap();
        assert_eq!(classes.value(row), agent.kind.name());
        assert_eq!(is_ego.value(row), agent.id == scenario.ego);
        let state = agent.state;
        let expected = [
            state.pose.position.x,
            state.pose.position.y,
            state.pose.heading,
            state.velocity.x,
            state.velocity.y,
            agent.length,
            agent.width,
        ];
        let found = columns.each_ref().map(|column| column.value(row));
        assert_eq!(found, expected);
        assert_eq!(columns[0].null_count(), 0);
    }
    assert!((0..91).all(|row| classes.value(row) == "vehicle" && ids.value(row) == 3));
}

#[test]
fn tables_are_written_by_conversion_too() {
    let from = sources();
    let to = TempDir::new().unwrap();
    let converted = run(
        from.path(),
        OutputFormat::Parquet,
        &to.path().join("tracks"),
    );
    assert_eq!(converted.scenarios, 4);
    assert_eq!(common::table(&converted.files[0]).num_rows(), 4 * 5 * 91);
}

#[test]
fn waymo_s_messages_state_the_lights_that_were_seen() {
    let folder = TempDir::new().unwrap();
    let mut scenario = common::crossing();
    for frame in &mut scenario.log[30..40] {
        *frame = Frame::new(frame.agents().to_vec(), Vec::new());
    }
    let from = folder.path().join("seen.tfrecord");
    womd::write_scenarios(&from, [&scenario]).unwrap();
    let dark = |format, ending: &str| {
        let stem = folder.path().join("converted");
        assert_eq!(run(&from, format, &stem).scenarios, 1);
        let read = open_with(&stem.with_extension(ending), ReadOptions::STATED);
        let scenario = read.unwrap().next().unwrap().unwrap().scenario;
        let dark = scenario
            .log
            .iter()
            .filter(|frame| frame.lights().is_empty());
        dark.count()
    };
    assert_eq!(dark(OutputFormat::Waymo, "tfrecord"), 10);
    assert_eq!(dark(OutputFormat::Cache, "cache"), 0);
}
