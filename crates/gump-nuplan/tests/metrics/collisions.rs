//! Boxes that touch, kinds of collisions, fault and times to collision on scenes without a map.

use gump_geometry::{OrientedBox, Pose, dvec2};
use gump_nuplan::metrics::{
    CollisionKind, RoadContext, Sample, TimeToCollisionConfig, collisions, time_to_collision,
};
use gump_scene::{Agent, AgentId, EgoState, MapGraph};
use serde_json::Value;

use crate::common::{
    agent, assert_all_close, assert_close, drive, entries, golden, kind, list, number, numbers,
    samples,
};

/// The devkit's number of a kind of collision.
pub(crate) fn kind_id(kind: CollisionKind) -> u64 {
    match kind {
        CollisionKind::StoppedEgo => 0,
        CollisionKind::StoppedTrack => 1,
        CollisionKind::ActiveFront => 2,
        CollisionKind::ActiveRear => 3,
        CollisionKind::ActiveLateral => 4,
    }
}

#[test]
fn boxes_collide_alike() {
    let golden = golden("collision_ttc");
    let rows = list(&golden["boxes"]["rows"]);
    assert_eq!(rows.len(), 120);
    for (i, row) in rows.iter().enumerate() {
        let shape = |value| {
            let row = numbers(value);
            OrientedBox {
                pose: Pose::new(row[0], row[1], row[2]),
                length: row[3],
                width: row[4],
            }
        };
        let (a, b) = (shape(&row[0]), shape(&row[1]));
        assert_eq!(a.touches(&b), row[2].as_bool().unwrap(), "pair {i}");
        let gap = a.signed_distance(&b).max(0.0);
        assert_close(gap, number(&row[3]), 1e-6, &format!("pair {i}"));
    }
}

/// All objects go straight on, cones and barriers too, though their speed counts as 0.
fn moving_samples(case: &Value) -> Vec<Sample> {
    let (speed, heading) = (number(&case["ego"][0]), number(&case["ego"][1]));
    let dt = number(&case["dt"]);
    let n = case["n"].as_u64().unwrap() as usize;
    let ahead = |start: Pose, speed: f64, k: usize| Pose {
        position: start.position + start.direction() * (speed * dt * k as f64),
        ..start
    };
    let ego = |k: usize| EgoState {
        time_us: 1_000_000 + (k as f64 * dt * 1e6).round() as i64,
        rear_axle: ahead(Pose::new(0.0, 0.0, heading), speed, k),
        velocity: dvec2(speed, 0.0),
        ..EgoState::default()
    };
    let track = |k: usize, id: usize, row: &Value| -> Agent {
        let numbers: Vec<f64> = list(row)[1..].iter().map(number).collect();
        let [_, x, y, heading, length, width, speed] = numbers[..] else {
            panic!("{row}");
        };
        let pose = ahead(Pose::new(x, y, heading), speed, k);
        let velocity = pose.direction() * speed;
        agent(id, &row[1], pose, [length, width], velocity)
    };
    let frames = (0..n).map(|k| {
        let tracks = list(&case["tracks"]).iter().enumerate();
        tracks.map(|(id, row)| track(k, id, row)).collect()
    });
    samples((0..n).map(ego).collect(), frames)
}

#[test]
fn collisions_and_times_to_collision_agree() {
    let golden = golden("collision_ttc");
    let cases = list(&golden["cases"]);
    assert_eq!(cases.len(), 60);
    let mut n_collisions = 0;
    for (i, case) in cases.iter().enumerate() {
        let samples = moving_samples(case);
        let map = MapGraph::default();
        let drive = drive(&samples, &[], &map);
        let context = RoadContext {
            in_one_lane: case["in_single_lane"].as_bool().unwrap(),
            in_intersection: case["in_intersection"].as_bool().unwrap(),
        };
        let found = collisions(&drive, &vec![context.in_one_lane; samples.len()]);
        let id = |token: &str| {
            let mut tracks = list(&case["tracks"]).iter();
            AgentId(tracks.position(|row| row[0] == token).unwrap() as i64)
        };
        let mut expected: Vec<(i64, AgentId, u64, f64)> = list(&case["collisions"])
            .iter()
            .flat_map(|at| entries(&at[1]).map(move |entry| (at[0].as_i64().unwrap(), entry)))
            .map(|(t, (token, of))| (t, id(token), of[0].as_u64().unwrap(), number(&of[1])))
            .collect();
        expected.sort_by_key(|(t, id, ..)| (*t, *id));
        assert_eq!(found.events.len(), expected.len(), "case {i}");
        for (event, (t, id, kind, energy)) in found.events.iter().zip(&expected) {
            let key = (event.time_us, event.agent, kind_id(event.kind));
            assert_eq!(key, (*t, *id, *kind), "case {i}");
            assert_close(event.energy, *energy, 1e-6, "energy");
        }
        n_collisions += expected.len();
        for (type_id, energies) in entries(&case["at_fault_by_type"]) {
            let kind = kind(type_id.parse().unwrap());
            let of_kind = found.at_fault().filter(|event| event.agent_kind == kind);
            let found: Vec<f64> = of_kind.map(|event| event.energy).collect();
            assert_eq!(found.len(), list(energies).len(), "case {i} type {type_id}");
        }
        let times: Vec<i64> = found.at_fault().map(|event| event.time_us).collect();
        let expected: Vec<i64> = list(&case["at_fault_timestamps"])
            .iter()
            .map(|t| t.as_i64().unwrap())
            .collect();
        assert_eq!(times, expected, "case {i}");

        let contexts = vec![context; samples.len()];
        let config = TimeToCollisionConfig::default();
        let ttc = time_to_collision(&drive, &contexts, &found, &config);
        assert_all_close(
            &ttc.series,
            &numbers(&case["ttc"]),
            1e-6,
            &format!("case {i}"),
        );
    }
    assert!(n_collisions > 10, "only {n_collisions}");
}
