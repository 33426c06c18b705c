//! Rollouts as a table: it contains everything that was simulated, and reads back bit for bit.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

mod common;

use std::collections::BTreeSet;

use arrow_array::Array;
use arrow_array::cast::AsArray;
use arrow_array::types::{Float64Type, Int64Type};
use gump_data::{Table, write_rollouts};
use gump_scene::{AgentId, Frame, Rollout, Scenario, fixture};

const STEPS: usize = 6;

/// Three futures: agent 2 leaves at step 3, agent 9 comes at step 2 of the last future alone.
fn futures() -> (Scenario, Vec<Rollout>) {
    let scenario = fixture::scenario(
        "ego vehicle 0: 0,0 velocity 5,1 size 4.5,1.9
         agent pedestrian 2: 9,9 velocity 0,-1
         history 1 future 0 dt 0.1",
    )
    .unwrap();
    let future = |k: usize| {
        let mut rollout = Rollout::begin(scenario.present());
        for step in 1..=STEPS {
            let mut agents: Vec<_> = rollout.start().agents().to_vec();
            for agent in &mut agents {
                let moved = 0.1 * step as f64 * (1.0 + 0.1 * k as f64);
                agent.state.pose.position += agent.state.velocity * moved;
                agent.elevation += 0.01 * step as f64;
            }
            if step >= 3 {
                agents.retain(|agent| agent.id != AgentId(2));
            }
            if k == 2 && step >= 2 {
                let late = agents[0];
                agents.push(late);
                agents.last_mut().unwrap().id = AgentId(9);
            }
            rollout.push(Frame::new(agents, Vec::new()));
        }
        rollout
    };
    let futures = (0..3).map(future).collect();
    (scenario, futures)
}

#[test]
fn rollouts_stand_in_the_table_to_the_bit() {
    let (scenario, futures) = futures();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("futures.parquet");
    write_rollouts(&path, [("one", &futures[..]), ("two", &futures[..1])]).unwrap();
    let table = common::table(&path);
    // A full grid: three tracks in each of the three futures of the first, two in the second.
    let n_first = 3 * 3 * (STEPS + 1);
    assert_eq!(table.num_rows(), n_first + 2 * (STEPS + 1));
    let column = |name: &str| table.column_by_name(name).unwrap();
    let integer = |name: &str| column(name).as_primitive::<Int64Type>().clone();
    let number = |name: &str| column(name).as_primitive::<Float64Type>().clone();
    let text = |name: &str| column(name).as_string::<i32>().clone();
    let (ids, classes, events) = (text("scenario_id"), text("class"), text("event"));
    let (rollout, step, track) = (integer("rollout"), integer("step"), integer("track_id"));
    let (time, valid, is_ego) = (
        number("time_s"),
        column("valid").as_boolean(),
        column("is_ego").as_boolean(),
    );
    let names = "x y z heading vx vy speed length width height";
    let numbers: Vec<_> = names.split(' ').map(number).collect();
    let mut keys = Vec::new();
    let mut recorded = BTreeSet::new();
    for row in 0..table.num_rows() {
        assert_eq!(ids.value(row), if row < n_first { "one" } else { "two" });
        let at = step.value(row) as usize;
        assert!((time.value(row) - 0.1 * at as f64).abs() < 1e-12);
        let future = &futures[rollout.value(row) as usize];
        let frame = match at {
            0 => future.start(),
            at => &future.imagined()[at - 1],
        };
        let id = AgentId(track.value(row));
        let agent = frame.agent(id);
        assert_eq!(valid.value(row), agent.is_some());
        assert_eq!(is_ego.value(row), id == scenario.ego);
        let expected = agent.map(|agent| {
            let (pose, velocity) = (agent.state.pose, agent.state.velocity);
            assert_eq!(classes.value(row), agent.kind.name());
            let [x, y] = pose.position.to_array();
            let moves = [velocity.x, velocity.y, agent.state.speed()];
            let size = [agent.length, agent.width, agent.height];
            let place = [x, y, agent.elevation, pose.heading];
            [&place[..], &moves, &size].concat()
        });
        let found = numbers
            .iter()
            .map(|c| c.is_valid(row).then(|| c.value(row)));
        assert_eq!(found.collect::<Option<Vec<f64>>>(), expected, "row {row}");
        if events.is_valid(row) && row < n_first {
            recorded.insert((rollout.value(row), id.0, at, events.value(row).to_owned()));
        }
        keys.push((row >= n_first, rollout.value(row), id, at));
    }
    assert!(keys.is_sorted() && keys.windows(2).all(|pair| pair[0] != pair[1]));
    let leaves = (0..3).map(|k| (k, 2, 3, "departure".to_owned()));
    let expected: BTreeSet<_> = leaves.chain([(2, 9, 2, "birth".to_owned())]).collect();
    assert_eq!(recorded, expected);
}

#[test]
fn what_is_undefined_is_missing() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("table.parquet");
    let table = Table::default()
        .text("name", [Some("a"), None, Some("")])
        .integer("n", [None, Some(-3), Some(1 << 60)])
        .number("x", [Some(0.1), Some(f64::NAN), None])
        .truth("is", [Some(true), None, Some(false)]);
    let columns: Vec<_> = table.names().zip(table.kinds()).collect();
    let expected = [
        ("name", "text"),
        ("n", "integer"),
        ("x", "number"),
        ("is", "truth"),
    ];
    assert_eq!((columns, table.n_rows()), (expected.to_vec(), 3));
    table.write(&path).unwrap();
    let table = common::table(&path);
    let nulls: Vec<_> = table.columns().iter().map(|c| c.null_count()).collect();
    assert_eq!(nulls, [1, 1, 2, 1]);
    let n = table.column(1).as_primitive::<Int64Type>();
    assert_eq!((n.value(1), n.value(2)), (-3, 1 << 60));
    assert_eq!(table.column(2).as_primitive::<Float64Type>().value(0), 0.1);
    assert!(table.column(3).as_boolean().value(0) && !table.column(3).as_boolean().value(2));
    assert!(table.column(0).as_string::<i32>().is_valid(2));
}
