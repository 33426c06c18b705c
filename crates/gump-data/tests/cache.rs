//! The cache gives back what went in, bit for bit, and reports what is wrong with a damaged file.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

mod common;

use std::fs;
use std::path::{Path, PathBuf};

use gump_data::cache::{Cache, write_shard};
use gump_data::{DataError, find, open};
use gump_geometry::{Polygon, Polyline, Pose, dvec2, dvec3};
use gump_scene::{
    Agent, AgentId, AgentKind, AgentState, Area, AreaKind, Frame, Lane, LaneId, LaneKind, Light,
    LightState, MapGraph, MapParts, Rng, RoadEdge, RoadEdgeKind, RoadLine, RoadLineKind, Roadblock,
    RoadblockId, Route, Scenario, ScenarioTag, Seed, StopSign, Unstated,
};
use rand::Rng as _;
use rand::seq::IndexedRandom as _;
use tempfile::TempDir;

fn assert_same(a: &Scenario, b: &Scenario) {
    assert_eq!((&a.id, a.now, a.ego, a.dt), (&b.id, b.now, b.ego, b.dt));
    assert_eq!(a.targets, b.targets);
    assert_eq!(a.objects_of_interest, b.objects_of_interest);
    assert_eq!(a.tags, b.tags);
    assert_eq!(a.route, b.route);
    assert_eq!(a.log, b.log);
    let (a, b) = (a.map.parts(), b.map.parts());
    assert_eq!(a.lanes, b.lanes);
    assert_eq!(a.roadblocks, b.roadblocks);
    assert_eq!(a.road_lines, b.road_lines);
    assert_eq!(a.road_edges, b.road_edges);
    assert_eq!(a.areas, b.areas);
    assert_eq!(a.stop_signs, b.stop_signs);
    assert_eq!(a.drivable, b.drivable);
}

/// Writes scenarios, reads them back, and writes what came back: equal, down to the bytes.
fn check_round_trip(scenarios: &[Scenario]) {
    let folder = TempDir::new().unwrap();
    let [once, twice] = ["once", "twice"].map(|name| folder.path().join(name));
    let bytes = write_shard(&once, scenarios).unwrap();
    assert_eq!(bytes, fs::metadata(&once).unwrap().len());
    let cache = Cache::open(&once).unwrap();
    assert_eq!(cache.len(), scenarios.len());
    let read = (0..cache.len()).map(|i| cache.get(i).unwrap().unwrap());
    let read: Vec<Scenario> = read.collect();
    for (i, (original, read)) in scenarios.iter().zip(&read).enumerate() {
        assert_same(original, read);
        assert_eq!(cache.id(i), Some(original.id.as_str()));
    }
    write_shard(&twice, &read).unwrap();
    assert!(fs::read(&once).unwrap() == fs::read(&twice).unwrap());
}

/// A number as formats state them: whole, single precision, decimal, or anything.
fn number(rng: &mut Rng, scale: f64) -> f64 {
    let value = rng.random_range(-scale..scale);
    match rng.random_range(0..4) {
        0 => value.round(),
        1 => f64::from(value as f32),
        2 => (value * 1e4).round() / 1e4,
        _ => value,
    }
}

fn line(rng: &mut Rng) -> (Polyline, Vec<f64>) {
    let n = rng.random_range(1..6);
    let points = (0..n).map(|_| dvec2(number(rng, 300.0), number(rng, 4e6)));
    let line = Polyline::new(points.collect()).unwrap();
    (line, (0..n).map(|_| number(rng, 100.0)).collect())
}

fn polygon(rng: &mut Rng) -> Polygon {
    let ring = |rng: &mut Rng| {
        let n = rng.random_range(3..7);
        (0..n)
            .map(|_| dvec2(number(rng, 300.0), number(rng, 300.0)))
            .collect::<Vec<_>>()
    };
    let holes = (0..rng.random_range(0..3)).map(|_| ring(rng)).collect();
    Polygon::with_holes(ring(rng), holes).unwrap()
}

fn map(rng: &mut Rng) -> MapGraph {
    let ids: Vec<LaneId> = (0..rng.random_range(0..5))
        .map(|i| LaneId(7 * i - 9))
        .collect();
    let links = |rng: &mut Rng| {
        let n = rng.random_range(0..=ids.len());
        ids.choose_multiple(rng, n).copied().collect::<Vec<_>>()
    };
    let lanes = ids.iter().map(|&id| {
        let (centerline, elevation) = line(rng);
        Lane {
            kind: [LaneKind::Freeway, LaneKind::BikeLane][rng.random_range(0..2)],
            width: number(rng, 9.0),
            speed_limit: rng.random_bool(0.5).then(|| number(rng, 30.0)),
            in_intersection: rng.random(),
            outline: rng.random_bool(0.5).then(|| polygon(rng)),
            roadblock: rng.random_bool(0.5).then_some(RoadblockId(3)),
            has_lights: [None, Some(false), Some(true)][rng.random_range(0..3)],
            predecessors: links(rng),
            successors: links(rng),
            left_neighbors: links(rng),
            right_neighbors: links(rng),
            ..Lane::new(id, centerline, elevation)
        }
    });
    let lanes = lanes.collect();
    let (border, elevation) = line(rng);
    let outline = polygon(rng);
    let area = polygon(rng);
    MapGraph::new(MapParts {
        lanes,
        roadblocks: vec![Roadblock {
            id: RoadblockId(3),
            outline,
            in_intersection: rng.random(),
            predecessors: vec![RoadblockId(3)],
            successors: Vec::new(),
        }],
        road_lines: vec![RoadLine {
            id: i64::MIN,
            kind: RoadLineKind::PassingDoubleYellow,
            line: border.clone(),
            elevation: elevation.clone(),
        }],
        road_edges: vec![RoadEdge {
            id: i64::MAX,
            kind: RoadEdgeKind::Median,
            line: border,
            elevation,
        }],
        areas: vec![Area {
            elevation: vec![0.25; area.ring().len()],
            lanes: links(rng),
            ..Area::new(5, AreaKind::Carpark, area)
        }],
        stop_signs: vec![StopSign {
            id: 6,
            position: dvec3(number(rng, 9.0), number(rng, 9.0), number(rng, 9.0)),
            lanes: links(rng),
        }],
        drivable: (0..rng.random_range(0..3)).map(|_| polygon(rng)).collect(),
        unstated: Unstated {
            stop_signs: rng.random(),
            lights: rng.random(),
        },
    })
    .unwrap()
}

/// Agents that come and go, change size and even kind; lights that move.
fn frame(rng: &mut Rng) -> Frame {
    let ids = (0..6).filter(|&id| id == 0 || rng.random_bool(0.7));
    let ids: Vec<i64> = ids.collect();
    let agents = ids.into_iter().map(|id| Agent {
        id: AgentId(id),
        kind: *[AgentKind::Vehicle, AgentKind::Sign].choose(rng).unwrap(),
        length: 1.0 + number(rng, 0.5),
        width: 2.0,
        height: if id == 1 { 1.5 } else { number(rng, 2.0) },
        elevation: number(rng, 10.0),
        state: AgentState {
            pose: Pose::new(number(rng, 1e5), number(rng, 4e6), number(rng, 3.0)),
            velocity: dvec2(number(rng, 20.0), number(rng, 20.0)),
        },
    });
    let agents = agents.collect();
    let lights = (0..rng.random_range(0..4)).map(|lane| Light {
        lane: LaneId(lane),
        state: *[LightState::Green, LightState::Unknown]
            .choose(rng)
            .unwrap(),
        stop_point: [None, Some(dvec2(1.0, 2.5)), Some(dvec2(0.1, 0.2))][rng.random_range(0..3)],
    });
    Frame::new(agents, lights.collect())
}

fn scenario(rng: &mut Rng) -> Scenario {
    let path = line(rng).0;
    let n = rng.random_range(1..12);
    Scenario {
        id: ["", "é#7", "637f20cafde22ff8"][rng.random_range(0..3)].into(),
        map: map(rng).into(),
        route: rng.random_bool(0.5).then(|| {
            Route {
                lanes: vec![LaneId(-9), LaneId(77)],
                roadblocks: vec![RoadblockId(3)],
                path,
            }
            .into()
        }),
        log: (0..n).map(|_| frame(rng)).collect(),
        dt: 0.1,
        now: rng.random_range(0..n),
        ego: AgentId(0),
        targets: vec![AgentId(1), AgentId(3)],
        objects_of_interest: vec![AgentId(9), AgentId(2)],
        tags: ScenarioTag::all()
            .filter(|_| rng.random_bool(0.1))
            .collect(),
    }
}

#[test]
fn any_scenario_comes_back_to_the_bit() {
    for seed in 0..300 {
        let mut rng = Seed(seed).rng();
        let n = rng.random_range(0..3);
        let scenarios: Vec<_> = (0..n).map(|_| scenario(&mut rng)).collect();
        check_round_trip(&scenarios);
    }
}

fn read_all(path: &Path) -> Vec<Scenario> {
    let records = open(path).unwrap();
    records.map(|record| record.unwrap().scenario).collect()
}

#[test]
fn fixtures_and_the_shipped_scenes_come_back() {
    check_round_trip(&[common::crossing()]);
    let root = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../.."));
    let mut scenes = 0;
    for place in ["datasets/mini", "crates/gump-data/tests/data"] {
        for file in gump_data::list_files(&root.join(place)).unwrap() {
            let scenarios: Vec<_> = match open(&file) {
                Ok(records) => records.filter_map(|r| Some(r.ok()?.scenario)).collect(),
                // Manifests, notices and packed databases lie among the scenes.
                Err(_) => continue,
            };
            check_round_trip(&scenarios);
            scenes += scenarios.len();
        }
    }
    assert!(scenes > 102, "{scenes}");
}

#[test]
fn real_scenarios_come_back() {
    for name in [
        "data/waymo/scenario_a.tfrecord",
        "data/argoverse2",
        "data/gpudrive/lights",
    ] {
        if let Some(path) = common::shared(name) {
            check_round_trip(&read_all(&path));
        }
    }
}

fn named(id: &str) -> Scenario {
    Scenario {
        id: id.into(),
        ..common::crossing()
    }
}

#[test]
fn a_folder_of_shards_is_one_cache() {
    let folder = TempDir::new().unwrap();
    let none: [Scenario; 0] = [];
    write_shard(&folder.path().join("a"), ["0", "1"].map(named)).unwrap();
    write_shard(&folder.path().join("b"), &none).unwrap();
    write_shard(&folder.path().join("deeper/c"), ["2"].map(named)).unwrap();
    fs::write(folder.path().join("notes.txt"), "no scenes").unwrap();
    let cache = Cache::open(folder.path()).unwrap();
    assert!(Cache::is_at(folder.path()).unwrap());
    let ids = |cache: &Cache| {
        (0..4)
            .map(|i| cache.id(i).map(str::to_owned))
            .collect::<Vec<_>>()
    };
    let expected = ["0", "1", "2"].map(|id| Some(id.to_owned()));
    assert_eq!(ids(&cache)[..3], expected);
    assert_eq!(ids(&cache)[3], None);
    assert!(cache.get(3).unwrap().is_none());
    assert_eq!(cache.get(2).unwrap().unwrap().id, "2");
    let read: Vec<_> = read_all(folder.path()).into_iter().map(|s| s.id).collect();
    assert_eq!(read, ["0", "1", "2"]);
    let place = folder.path().display();
    assert_eq!(find(&format!("{place}#2")).unwrap().id, "2");
    let mixed = folder.path().join("more.tfrecord");
    gump_data::womd::write_scenarios(&mixed, [named("3")]).unwrap();
    assert!(!Cache::is_at(folder.path()).unwrap());
    assert!(matches!(
        Cache::open(TempDir::new().unwrap().path()),
        Err(DataError::NoFiles { .. })
    ));
}

/// A shard of two small scenarios, and its bytes.
fn shard(folder: &TempDir) -> (PathBuf, Vec<u8>) {
    let text = "lane 1: 0,0 50,0\nego vehicle 0: 9,0 velocity 8,0\nhistory 0.2 future 0.2 dt 0.1";
    let small = gump_scene::fixture::scenario(text).unwrap();
    let path = folder.path().join("shard");
    write_shard(&path, [&small, &small]).unwrap();
    let bytes = fs::read(&path).unwrap();
    (path, bytes)
}

fn errors(path: &Path) -> Vec<String> {
    match Cache::open(path) {
        Err(error) => vec![error.to_string()],
        Ok(cache) => (0..cache.len())
            .filter_map(|i| cache.get(i).err())
            .map(|error| error.to_string())
            .collect(),
    }
}

#[test]
fn every_flipped_bit_and_every_cut_is_found() {
    let folder = TempDir::new().unwrap();
    let (path, sound) = shard(&folder);
    assert!(errors(&path).is_empty());
    for at in 0..sound.len() {
        let mut bytes = sound.clone();
        bytes[at] ^= 1 << (at % 8);
        fs::write(&path, &bytes).unwrap();
        let found = errors(&path);
        assert_eq!(found.len(), 1, "byte {at}");
        assert!(found[0].contains("shard"), "{}", found[0]);
        fs::write(&path, &sound[..at]).unwrap();
        assert_eq!(errors(&path).len(), 1, "cut at {at}");
    }
}

#[test]
fn errors_say_where_and_what() {
    let folder = TempDir::new().unwrap();
    let (path, sound) = shard(&folder);
    let place = path.display().to_string();
    let check = |bytes: &[u8], expected: &str| {
        fs::write(&path, bytes).unwrap();
        let found = errors(&path).join("; ").replace(&place, "FILE");
        assert!(found.contains(expected), "{found}");
    };
    let mut other = sound.clone();
    other[8] = 9;
    let version = "expected version 1 of the cache, found version 9: at byte 8 of FILE";
    check(&other, version);
    let cut = &sound[..sound.len() - 5];
    let at = format!("at byte {} of FILE", cut.len() - 24);
    check(cut, "expected the trailer of a complete shard");
    check(cut, &at);
    check(b"GUMPDATA", "found the end of the file: at byte 8 of FILE");
    check(b"", "expected a shard of the cache");
    let mut damaged = sound.clone();
    damaged[20] ^= 1;
    check(&damaged, "of the record");
    check(&damaged, "record 0 at byte 12 of FILE");
    // The reader of all formats names the bad record and delivers the other.
    let records: Vec<_> = open(&path).unwrap().map(|record| record.is_ok()).collect();
    assert_eq!(records, [false, true]);
}
