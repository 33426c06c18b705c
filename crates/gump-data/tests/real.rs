//! Real Waymo files hold what an independent parser, written for this purpose alone, found there.

mod common;

use std::collections::BTreeMap;

use gump_data::tfrecord::{TfRecordReader, masked_crc};
use gump_data::{ReadOptions, inspect, open, open_with, verify};
use gump_scene::{AgentId, LightState, Scenario};

fn scenario(name: &str) -> Option<Scenario> {
    let path = common::shared(name)?;
    let mut reader = open(&path).expect("the file opens");
    let record = reader.next().expect("there is a record").expect("it reads");
    assert!(reader.next().is_none(), "expected one record");
    Some(record.scenario)
}

fn ids(ids: &[AgentId]) -> Vec<i64> {
    ids.iter().map(|id| id.0).collect()
}

/// Sums over all valid states of x, y, z, length and speed.
fn sums(scenario: &Scenario) -> [f64; 5] {
    let mut sums = [0.0; 5];
    for agent in scenario.log.iter().flat_map(|frame| frame.agents()) {
        let p = agent.state.pose.position;
        let values = [p.x, p.y, agent.elevation, agent.length, agent.state.speed()];
        sums.iter_mut().zip(values).for_each(|(sum, v)| *sum += v);
    }
    sums
}

fn near(found: &[f64], expected: &[f64]) {
    for (found, expected) in found.iter().zip(expected) {
        let relative = (found - expected).abs() / expected.abs();
        assert!(relative < 1e-9, "expected {expected}, found {found}");
    }
}

fn lane_sums(scenario: &Scenario) -> [f64; 2] {
    let lanes = scenario.map.lanes();
    let x = lanes
        .iter()
        .flat_map(|l| l.centerline.points())
        .map(|p| p.x);
    [x.sum(), lanes.iter().flat_map(|l| &l.elevation).sum()]
}

#[test]
fn scenario_a_is_complete() {
    let Some(scenario) = scenario("data/waymo/scenario_a.tfrecord") else {
        return;
    };
    assert_eq!(scenario.id, "637f20cafde22ff8");
    assert_eq!(
        (scenario.dt, scenario.now, scenario.log.len()),
        (0.1, 10, 91)
    );
    assert_eq!(scenario.ego, AgentId(2406));
    assert_eq!(ids(&scenario.targets), [1675, 1676, 2320]);
    assert_eq!(scenario.objects_of_interest, []);
    let expected = [
        -35816322.64383518,
        -30788109.68358506,
        -847252.467721527,
        20408.516610264778,
        20282.196324262844,
    ];
    near(&sums(&scenario), &expected);
    near(
        &lane_sums(&scenario),
        &[-78938977.34798843, -1878013.9113444574],
    );
    let map = &scenario.map;
    let links: usize = map.lanes().iter().map(|lane| lane.successors.len()).sum();
    let beside = |lane: &gump_scene::Lane| lane.left_neighbors.len() + lane.right_neighbors.len();
    assert_eq!(links, 193);
    assert_eq!(map.lanes().iter().map(beside).sum::<usize>(), 382);
    assert_eq!(lights(&scenario), BTreeMap::from(SCENARIO_A_HELD));
}

/// Lights of all frames by state.
fn lights(scenario: &Scenario) -> BTreeMap<LightState, usize> {
    let mut counts = BTreeMap::new();
    for light in scenario.log.iter().flat_map(|frame| frame.lights()) {
        *counts.entry(light.state).or_insert(0) += 1;
    }
    counts
}

/// Four lights are out of sight for 10 frames between reds, two for 6, two for 39 and again for 5.
const UNSEEN: usize = 4 * 10 + 2 * 6 + 2 * (39 + 5);
const SCENARIO_A_SEEN: [(LightState, usize); 2] =
    [(LightState::Red, 324 + 228), (LightState::Unknown, 540)];
const SCENARIO_A_HELD: [(LightState, usize); 2] = [
    (LightState::Red, 324 + 228 + UNSEEN),
    (LightState::Unknown, 540 - UNSEEN),
];

#[test]
fn lights_that_are_red_before_and_after_are_red_while_they_are_not_seen() {
    let Some(path) = common::shared("data/waymo/scenario_a.tfrecord") else {
        return;
    };
    let read = |options| {
        let mut reader = open_with(&path, options).expect("the file opens");
        reader.next().expect("there is a record").expect("it reads")
    };
    let held = read(ReadOptions::ALL);
    let reason = "colour of a light between two sightings";
    assert_eq!(held.report.inferred[reason], UNSEEN);
    assert_eq!(lights(&held.scenario), BTreeMap::from(SCENARIO_A_HELD));
    let seen = read(ReadOptions::STATED);
    assert_eq!(lights(&seen.scenario), BTreeMap::from(SCENARIO_A_SEEN));
}

#[test]
fn scenario_b_is_complete() {
    let Some(scenario) = scenario("data/waymo/scenario_b.tfrecord") else {
        return;
    };
    assert_eq!(scenario.id, "ee519cf571686d19");
    // The stamps are 0.10024 s apart on average: the nominal rate is what counts.
    assert_eq!(
        (scenario.dt, scenario.now, scenario.log.len()),
        (0.1, 10, 91)
    );
    assert_eq!(scenario.ego, AgentId(2893));
    assert_eq!(ids(&scenario.targets), [625, 635, 2677, 2694]);
    assert_eq!(ids(&scenario.objects_of_interest), [625, 2694]);
    let expected = [
        54969349.41196506,
        6798033.052351485,
        -14810.844450220337,
        32132.834838092327,
        3409.716589800182,
    ];
    near(&sums(&scenario), &expected);
    near(
        &lane_sums(&scenario),
        &[28911085.643729802, -15450.715583596246],
    );
    assert!(scenario.log.iter().all(|frame| frame.lights().is_empty()));
}

#[test]
fn the_summaries_count_what_is_there() {
    let check =
        |name: &str, tracks: &[(&str, usize)], now: &[(&str, usize)], map: &[(&str, usize)]| {
            let Some(path) = common::shared(name) else {
                return;
            };
            let summary = inspect(&path, ReadOptions::ALL).expect("the file opens");
            assert_eq!(summary.scenarios, 1);
            let found: Vec<_> = summary.tracks.iter().map(|(k, n)| (*k, *n)).collect();
            assert_eq!(found, tracks);
            let found: Vec<_> = summary.agents_now.iter().map(|(k, n)| (*k, *n)).collect();
            assert_eq!(found, now);
            for (kind, n) in map {
                assert_eq!(summary.map.get(kind), Some(n), "{kind}");
            }
            assert_eq!(summary.duration_s, Some([9.0, 9.0]));
            assert_eq!(summary.with_route, 1);
        };
    check(
        "data/waymo/scenario_a.tfrecord",
        &[("bicycle", 3), ("pedestrian", 10), ("vehicle", 70)],
        &[("bicycle", 2), ("pedestrian", 3), ("vehicle", 45)],
        &[
            ("street lane", 198),
            ("bicycle lane", 1),
            ("road line", 59),
            ("road edge", 28),
            ("crosswalk", 4),
            ("speed bump", 3),
            ("stop sign", 8),
            ("lane with a speed limit", 198),
        ],
    );
    check(
        "data/waymo/scenario_b.tfrecord",
        &[("pedestrian", 68), ("vehicle", 189)],
        &[("pedestrian", 29), ("vehicle", 55)],
        &[
            ("street lane", 114),
            ("road line", 12),
            ("road edge", 75),
            ("crosswalk", 4),
            ("speed bump", 6),
            ("stop sign", 4),
        ],
    );
}

#[test]
fn checksums_match_the_golden_values() {
    // (file, length of the record, masked CRC of the length, masked CRC of the payload)
    let goldens = [
        (
            "data/waymo/scenario_a.tfrecord",
            952_947,
            289_683_225,
            2_193_030_663,
        ),
        (
            "data/waymo/scenario_b.tfrecord",
            996_519,
            3_667_543_702,
            2_356_611_264,
        ),
        (
            "golden/wosac/inputs/scenario_syn0000000000001.tfrecord",
            86_019,
            3_905_923_129,
            1_572_229_778,
        ),
        (
            "golden/wosac/inputs/scenario_synm00000000001.tfrecord",
            65_929,
            3_624_358_674,
            3_392_034_857,
        ),
    ];
    for (name, length, crc_of_length, crc_of_payload) in goldens {
        assert_eq!(masked_crc(&u64::to_le_bytes(length)), crc_of_length);
        let Some(path) = common::shared(name) else {
            continue;
        };
        let mut records = TfRecordReader::open(path).unwrap();
        let payload = records.next().unwrap().unwrap().bytes;
        assert_eq!(payload.len() as u64, length);
        assert_eq!(masked_crc(&payload), crc_of_payload);
    }
}

#[test]
fn the_synthetic_golden_reads_and_the_one_without_a_map_is_refused() {
    if let Some(scenario) = scenario("golden/wosac/inputs/scenario_syn0000000000001.tfrecord") {
        assert_eq!(scenario.present().now().agents().len(), 10);
        assert_eq!(ids(&scenario.objects_of_interest), [100, 7]);
    }
    let name = "golden/wosac/inputs/scenario_synm00000000001.tfrecord";
    if let Some(path) = common::shared(name) {
        let error = open(&path)
            .unwrap()
            .next()
            .unwrap()
            .unwrap_err()
            .to_string();
        let expected = "scenario synm00000000001: expected a map, found no map feature: \
                        record 0 at byte 0 of ";
        assert!(error.starts_with(expected), "{error}");
    }
}

#[test]
fn real_files_are_not_broken() {
    for name in [
        "data/waymo/scenario_a.tfrecord",
        "data/waymo/scenario_b.tfrecord",
    ] {
        if let Some(path) = common::shared(name) {
            let result = verify(&path).unwrap();
            assert!(!result.is_broken(), "{:?}", result.findings);
            println!("{name}: {:?}", result.counts);
        }
    }
}

#[test]
fn the_inferred_surfaces_hold_moving_vehicles_and_the_route_leads_along_the_log() {
    for (name, share) in [
        ("data/waymo/scenario_a.tfrecord", 0.97),
        // In this one people manoeuvre in a car park, where Waymo maps no lanes.
        ("data/waymo/scenario_b.tfrecord", 0.9),
    ] {
        let Some(scenario) = scenario(name) else {
            continue;
        };
        let agents = scenario.log.iter().flat_map(|frame| frame.agents());
        let moving =
            agents.filter(|a| a.kind == gump_scene::AgentKind::Vehicle && a.state.speed() > 1.0);
        let on_road: Vec<bool> = moving
            .map(|a| scenario.map.is_drivable(a.state.pose.position))
            .collect();
        let n = on_road.iter().filter(|on| **on).count();
        assert!(
            n as f64 >= share * on_road.len() as f64,
            "{n} of {}",
            on_road.len()
        );
        let route = scenario.route.as_ref().unwrap();
        let mut last = 0.0;
        for frame in &scenario.log {
            let ego = frame.agent(scenario.ego).unwrap();
            for corner in ego.oriented_box().corners() {
                assert!(scenario.map.is_drivable(corner));
            }
            let projection = route.path.project(ego.state.pose.position);
            assert!(projection.distance < 1.5, "{projection:?}");
            assert!(projection.arc_length >= last - 0.1, "{projection:?}");
            last = projection.arc_length;
        }
        for pair in route.lanes.windows(2) {
            let lane = scenario.map.lane(pair[0]).unwrap();
            assert!(lane.successors.contains(&pair[1]));
        }
    }
}
