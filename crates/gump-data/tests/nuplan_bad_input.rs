//! Errors of nuPlan's readers on logs and maps that are damaged, missing or of another place.

use std::fs;
use std::path::Path;

use gump_data::nuplan::read_map;
use gump_data::{ReadOptions, verify};
use gump_scene::LaneId;

#[path = "common/nuplan.rs"]
mod common;

use common::{DATA, Folder, unpacked};

/// Opens the log and checks the sentence of the error.
#[track_caller]
fn fails(folder: &Folder, expected: &[&str]) {
    let error = match gump_data::open(&folder.log()) {
        Ok(reader) => reader.filter_map(Result::err).next().expect("an error"),
        Err(error) => error,
    };
    let text = error.to_string();
    for part in expected {
        assert!(text.contains(part), "expected \"{part}\" in: {text}");
    }
}

#[test]
fn a_log_without_its_map_says_where_it_was_looked_for() {
    let folder = Folder::new();
    fs::remove_file(folder.map()).unwrap();
    fails(
        &folder,
        &[
            "us-nv-las-vegas-strip/VERSION/map.gpkg",
            "NUPLAN_MAPS_ROOT",
            "log.db",
        ],
    );
}

#[test]
fn the_map_s_version_is_that_of_the_list_or_the_published_one() {
    let folder = Folder::new();
    let maps = folder.0.path().join("maps");
    let place = |version: &str| {
        let place = maps.join("us-nv-las-vegas-strip").join(version);
        fs::create_dir_all(&place).unwrap();
        fs::write(place.join("map.gpkg"), unpacked("map.gpkg")).unwrap();
    };
    fs::remove_file(folder.map()).unwrap();
    place("9.0.1");
    fails(
        &folder,
        &[
            "version 9.15.1915 of the map of us-nv-las-vegas-strip",
            "found 9.0.1",
        ],
    );
    let list = r#"{"us-nv-las-vegas-strip": {"version": "9.0.1", "layers": []}}"#;
    fs::write(maps.join("nuplan-maps-v1.0.json"), list).unwrap();
    assert_eq!(gump_data::open(&folder.log()).unwrap().count(), 2);
    fs::write(maps.join("nuplan-maps-v1.0.json"), "{").unwrap();
    fails(
        &folder,
        &["versions of maps by location", "nuplan-maps-v1.0.json"],
    );
    fs::remove_file(maps.join("nuplan-maps-v1.0.json")).unwrap();
    place("9.15.1915");
    assert_eq!(gump_data::open(&folder.log()).unwrap().count(), 2);
}

#[test]
fn a_map_of_another_place_is_refused() {
    let folder = Folder::new();
    Folder::execute(
        &folder.map(),
        "UPDATE meta SET value = 'epsg:32619' WHERE key = 'projectedCoordSystem'",
    );
    fails(
        &folder,
        &["a map in epsg:32611", "found epsg:32619", "map.gpkg"],
    );
    let folder = Folder::new();
    Folder::execute(&folder.log(), "UPDATE ego_pose SET x = x + 90000");
    fails(
        &folder,
        &["lanes within 2000 m of where the log", "found none"],
    );
}

#[test]
fn a_missing_table_or_column_is_named() {
    let folder = Folder::new();
    Folder::execute(&folder.log(), "DROP TABLE scenario_tag");
    fails(&folder, &["a table scenario_tag", "lidar_box", "log.db"]);
    let folder = Folder::new();
    Folder::execute(
        &folder.log(),
        "ALTER TABLE ego_pose DROP COLUMN acceleration_x",
    );
    fails(
        &folder,
        &[
            "a column acceleration_x in table ego_pose",
            "acceleration_y",
        ],
    );
    let folder = Folder::new();
    Folder::execute(
        &folder.map(),
        "ALTER TABLE lanes_polygons DROP COLUMN lane_group_fid",
    );
    fails(
        &folder,
        &[
            "a column lane_group_fid in table lanes_polygons",
            "map.gpkg",
        ],
    );
}

#[test]
fn a_log_without_tags_or_the_merged_lidar_says_what_it_has() {
    let folder = Folder::new();
    Folder::execute(&folder.log(), "DELETE FROM scenario_tag");
    fails(
        &folder,
        &["a tagged row", "760 rows in 10 scenes, 0 of them tagged"],
    );
    fs::write(folder.log(), unpacked("minimal.db")).unwrap();
    fails(&folder, &["a tagged row", "0 rows in 10 scenes"]);
}

#[test]
fn a_log_without_scenarios_and_a_database_of_another_kind_are_not_broken() {
    let folder = Folder::new();
    fs::write(folder.log(), unpacked("minimal.db")).unwrap();
    fs::remove_file(folder.map()).unwrap();
    let other = folder.0.path().join("tracks.shf");
    Folder::execute(&other, "CREATE TABLE Trajectory (vehicle, time, x, y)");
    let found = verify(folder.0.path()).unwrap();
    assert!(!found.is_broken(), "{:?}", found.findings);
    assert_eq!(found.counts["file without scenarios"], 1);
    assert!(found.findings[0].detail.contains("a tagged row"));
    assert_eq!(found.skipped["other SQLite database"], 1);
    let error = gump_data::open(&other).err().unwrap().to_string();
    assert!(error.contains("found other SQLite database"), "{error}");
    // A log that is no longer sound is, and so is one whose map is missing.
    Folder::execute(&folder.log(), "DROP TABLE scenario_tag");
    assert!(verify(folder.0.path()).unwrap().is_broken());
    fs::write(folder.log(), unpacked("log.db")).unwrap();
    let found = verify(folder.0.path()).unwrap();
    assert!(found.is_broken());
    assert!(found.findings[0].detail.contains("NUPLAN_MAPS_ROOT"));
}

#[test]
fn a_map_in_place_of_a_log_is_told_apart() {
    let folder = Folder::new();
    let error = gump_data::open(&folder.map()).err().unwrap().to_string();
    assert!(error.contains("found nuPlan map (GeoPackage)"), "{error}");
    // In a folder, the map is passed over and the log is read.
    let reader = gump_data::open(folder.0.path()).unwrap();
    assert_eq!(reader.filter(Result::is_ok).count(), 2);
    fs::copy(Path::new(DATA).join("log.db.gz"), folder.log()).unwrap();
    fails(&folder, &["unpack it first", "log.db"]);
}

#[test]
fn a_broken_shape_costs_its_feature_only() {
    let folder = Folder::new();
    Folder::execute(
        &folder.map(),
        "UPDATE baseline_paths SET geom = x'4750' WHERE lane_fid = 111;
         UPDATE lanes_polygons SET geom = NULL WHERE fid = 112;",
    );
    let map = read_map(&folder.map()).unwrap();
    assert_eq!(map.graph.lanes().len(), 24);
    assert!(map.graph.lane(LaneId(111)).is_none());
    assert_eq!(map.report.dropped["map feature whose shape is damaged"], 2);
    let notes: Vec<&str> = map
        .report
        .notes
        .iter()
        .map(|note| note.detail.as_str())
        .collect();
    assert!(
        notes[0].contains("baseline_paths 311: expected 1 bytes at byte 2"),
        "{notes:?}"
    );
    assert!(
        notes
            .iter()
            .any(|n| n.contains("lanes_polygons 112: expected a shape")),
        "{notes:?}"
    );
    // Nothing leads to lanes that are gone.
    assert!(map.graph.lane(LaneId(203)).unwrap().successors.is_empty());
    assert_eq!(
        gump_data::open(&folder.log())
            .unwrap()
            .filter(Result::is_ok)
            .count(),
        2
    );
}

#[test]
fn a_route_off_the_map_fails_its_scenario_and_the_others_go_on() {
    let folder = Folder::new();
    Folder::execute(
        &folder.log(),
        "UPDATE scene SET roadblock_ids = '777 778' WHERE token = (
             SELECT scene_token FROM lidar_pc WHERE hex(token) = 'AF6639F0BC724EAD')",
    );
    let records: Vec<_> = gump_data::open(&folder.log()).unwrap().collect();
    let errors: Vec<String> = records
        .iter()
        .filter_map(|r| r.as_ref().err().map(ToString::to_string))
        .collect();
    assert!(!errors.is_empty(), "the route is unknown");
    assert!(
        errors[0].contains("a route of roadblocks that are in the map"),
        "{}",
        errors[0]
    );
    assert!(errors[0].contains("none of 777 778"), "{}", errors[0]);
    let folder = Folder::new();
    Folder::execute(
        &folder.log(),
        "UPDATE scene SET roadblock_ids = '10 777 12'",
    );
    let record = gump_data::open(&folder.log())
        .unwrap()
        .next()
        .unwrap()
        .unwrap();
    let dropped = &record.report.dropped;
    assert_eq!(dropped["roadblock of the route that is not in the map"], 1);
}

#[test]
fn states_that_are_no_numbers_fail_their_scenario() {
    let folder = Folder::new();
    Folder::execute(
        &folder.log(),
        "UPDATE ego_pose SET x = NULL WHERE token = (
             SELECT ego_pose_token FROM lidar_pc WHERE hex(token) = 'AF6639F0BC724EAD')",
    );
    fails(
        &folder,
        &[
            "scenario af6639f0bc724ead",
            "the ego's states to be numbers",
        ],
    );
    let folder = Folder::new();
    Folder::execute(&folder.log(), "UPDATE lidar_box SET vx = NULL, vy = NULL");
    let record = gump_data::open(&folder.log())
        .unwrap()
        .next()
        .unwrap()
        .unwrap();
    assert!(record.report.inferred["velocity that is not recorded: 0"] > 0);
    Folder::execute(
        &folder.log(),
        "UPDATE lidar_pc SET timestamp = 0 WHERE rowid % 5 = 0",
    );
    fails(&folder, &["time stamps 0.1 s apart"]);
    let folder = Folder::new();
    Folder::execute(&folder.log(), "UPDATE lidar_box SET x = 'here'");
    fails(&folder, &["could not read the boxes", "log.db"]);
}

#[test]
fn damaged_files_never_panic() {
    let read = |folder: &Folder| {
        if let Ok(reader) = gump_data::open(&folder.log()) {
            for record in reader.flatten() {
                record.scenario.validate().unwrap();
            }
        }
        if let Ok(map) = read_map(&folder.map()) {
            assert!(map.graph.lanes().len() <= 26);
        }
    };
    let mut rng = gump_scene::Seed(11).rng();
    let mut random = |below: usize| rand::Rng::random_range(&mut rng, 0..below);
    let (log, map) = (unpacked("log.db"), unpacked("map.gpkg"));
    let folder = Folder::new();
    for round in 0..60 {
        let (mut bytes, path) = if round % 2 == 0 {
            (log.clone(), folder.log())
        } else {
            (map.clone(), folder.map())
        };
        if round % 6 < 2 {
            bytes.truncate(random(bytes.len()));
        } else {
            // The first page holds the schema; elsewhere many changes are needed to be felt.
            let range = if round % 6 < 4 { 8192 } else { bytes.len() };
            for _ in 0..(if range == 8192 { 3 } else { 400 }) {
                bytes[random(range)] ^= 1 << random(8);
            }
        }
        fs::write(&path, &bytes).unwrap();
        read(&folder);
        fs::write(folder.log(), &log).unwrap();
        fs::write(folder.map(), &map).unwrap();
    }
    // Options change what is inferred, never whether it can be read.
    let stated = gump_data::open_with(&folder.log(), ReadOptions::STATED).unwrap();
    assert_eq!(stated.filter(Result::is_ok).count(), 2);
}
