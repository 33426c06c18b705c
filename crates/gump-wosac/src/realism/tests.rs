//! The parts of features against isolated values of the reference.

use std::io::Read as _;

use gump_scene::{AgentId, AgentKind, Seed};
use rand::Rng as _;
use serde_json::Value;

use super::assemble::SimulatedAgents;
use super::box_distance::{ROUNDING_2024, signed_box_distance};
use super::estimate::Histogram;
use super::following::time_to_collision;
use super::kinematics::{Differences, kinematics, validity};
use super::lights::Lights;
use super::road_edge::{Hints, RoadEdges};
use super::*;

fn golden(name: &str) -> Value {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/golden/realism");
    let file = std::fs::File::open(format!("{folder}/{name}.json.gz")).unwrap();
    let mut text = String::new();
    let mut unpacked = flate2::read::GzDecoder::new(file);
    unpacked.read_to_string(&mut text).unwrap();
    serde_json::from_str(&text).unwrap()
}

fn numbers(value: &Value) -> Vec<f32> {
    let values = value.as_array().unwrap().iter();
    values
        .map(|v| v.as_f64().map_or(f32::NAN, |v| v as f32))
        .collect()
}

fn rows(value: &Value) -> Vec<Vec<f32>> {
    value.as_array().unwrap().iter().map(numbers).collect()
}

fn bits(value: &Value) -> Vec<bool> {
    value.as_str().unwrap().chars().map(|c| c == '1').collect()
}

/// NaN where expected, else within `relative` of the expected or of 1.
#[track_caller]
fn close(found: &[f32], expected: &[f32], relative: f32) {
    assert_eq!(found.len(), expected.len());
    for (i, (f, e)) in found.iter().zip(expected).enumerate() {
        let near = (f - e).abs() <= relative * e.abs().max(1.0);
        assert!(
            near || (f.is_nan() && e.is_nan()),
            "{i}: found {f}, expected {e}"
        );
    }
}

#[test]
fn box_distances_are_the_references() {
    for (year, key, rounding) in [
        ("2023", "distance_default", 0.0),
        ("2025", "distance_default", ROUNDING_2024),
        ("2025", "distance_rounding_0", 0.0),
        ("2025", "distance_rounding_1", 1.0),
    ] {
        let golden = golden(&format!("box_distance_{year}"));
        let columns = [
            "center_x", "center_y", "center_z", "heading", "length", "width", "height",
        ];
        let columns = columns.map(|name| rows(&golden[name]));
        let state = |who: usize, i: usize| {
            let [x, y, z, heading, length, width, height] =
                [0, 1, 2, 3, 4, 5, 6].map(|c| columns[c][who][i]);
            State::new([x, y, z], heading, [length, width, height])
        };
        let expected = numbers(&golden[key]);
        let found = |i| signed_box_distance(&state(0, i), &state(1, i), rounding);
        let found: Vec<f32> = (0..expected.len()).map(found).collect();
        // Corners at 2e4 m are 2e-3 m apart in f32; this is how sine and cosine differ there.
        close(&found, &expected, 5e-3);
        let exact = found
            .iter()
            .zip(&expected)
            .filter(|(f, e)| (*f - *e).abs() < 1e-5);
        assert!(exact.count() * 10 >= found.len() * 9);
    }
}

#[test]
fn kinematics_are_the_references() {
    for (year, differences) in [
        ("2023", Differences::Backward),
        ("2025", Differences::Central),
    ] {
        let golden = golden(&format!("kinematics_{year}"));
        let columns = ["x", "y", "z", "heading"].map(|name| rows(&golden[name]));
        for agent in 0..columns[0].len() {
            let state = |t: usize| {
                let [x, y, z, heading] = [0, 1, 2, 3].map(|c| columns[c][agent][t]);
                State::new([x, y, z], heading, [4.0, 2.0, 1.5])
            };
            let states: Vec<_> = (0..columns[0][agent].len()).map(state).collect();
            let found = kinematics(&states, differences);
            let expected = |name: &str| numbers(&golden[name][agent]);
            close(&found.linear_speed, &expected("linear_speed"), 1e-6);
            close(
                &found.linear_acceleration,
                &expected("linear_acceleration"),
                1e-6,
            );
            close(&found.angular_speed, &expected("angular_speed"), 1e-6);
            close(
                &found.angular_acceleration,
                &expected("angular_acceleration"),
                1e-6,
            );
            if year == "2025" {
                let (speed, acceleration) = validity(&bits(&golden["valid"][agent]), differences);
                assert_eq!(speed, bits(&golden["speed_validity"][agent]));
                assert_eq!(acceleration, bits(&golden["acceleration_validity"][agent]));
            }
        }
    }
}

#[test]
fn times_to_collision_are_the_references() {
    for (year, differences) in [
        ("2023", Differences::Backward),
        ("2025", Differences::Central),
    ] {
        let golden = golden(&format!("ttc_{year}"));
        let columns = ["center_x", "center_y", "heading", "length", "width"];
        let columns = columns.map(|name| rows(&golden[name]));
        let tracks: Vec<Vec<State>> = (0..columns[0].len())
            .map(|agent| {
                let valid = bits(&golden["valid"][agent]);
                let state = |t: usize| {
                    let [x, y, heading, length, width] =
                        [0, 1, 2, 3, 4].map(|c| columns[c][agent][t]);
                    let state = State::new([x, y, 0.0], heading, [length, width, 1.0]);
                    State {
                        valid: valid[t],
                        ..state
                    }
                };
                (0..valid.len()).map(state).collect()
            })
            .collect();
        let tracks: Vec<&[State]> = tracks.iter().map(Vec::as_slice).collect();
        for (agent, expected) in rows(&golden["ttc"]).iter().enumerate() {
            let time = |t| time_to_collision(&tracks, agent, t, differences);
            let found: Vec<f32> = (0..expected.len()).map(time).collect();
            close(&found, expected, 1e-6);
        }
    }
}

#[test]
fn road_edge_distances_are_the_references() {
    for (year, key) in [
        ("2023", "distance"),
        ("2025", "distance_z_stretch_3"),
        ("2025", "distance_z_stretch_1_not_cyclic"),
    ] {
        let golden = golden(&format!("polyline_distance_{year}"));
        let edges = golden["polylines"].as_array().unwrap().iter();
        let point = |p: Vec<f32>| [p[0], p[1], p[2]];
        let edges = edges.map(|edge| rows(edge).into_iter().map(point).collect());
        let edges: Vec<Vec<[f32; 3]>> = edges.collect();
        let edges = match key {
            "distance" => RoadEdges::new(&edges, Algorithm::V2023V1),
            "distance_z_stretch_3" => RoadEdges::new(&edges, Algorithm::V2025),
            _ => RoadEdges::under_rules(&edges, 1.0, false),
        };
        let mut hints = Hints::default();
        let queries = rows(&golden["queries_xyz"]).into_iter().map(point);
        let found = queries.map(|query| edges.signed_distance(query, &mut hints));
        close(&found.collect::<Vec<_>>(), &numbers(&golden[key]), 1e-6);
    }
}

#[test]
fn edges_of_2023_that_are_left_out_do_not_matter() {
    let mut rng = Seed(5).rng();
    let mut zeros = 0;
    for round in 0..60 {
        // Coarse numbers, so that points lie on extensions of edges, edges have points twice and
        // turn back. Every third map is large.
        let reach = if round % 3 == 0 { 400 } else { 60 };
        let mut place = |step: i32| [0, 1].map(|_| (rng.random_range(-reach..reach) / step) as f32);
        let mut edges: Vec<Vec<[f32; 3]>> = Vec::new();
        for k in 0..12 {
            let mut at = place(1);
            let mut edge = vec![[at[0], at[1], 0.0]];
            for _ in 0..k {
                let step = place(12);
                at = [at[0] + step[0], at[1] + step[1]];
                edge.push([at[0], at[1], 0.0]);
            }
            edges.push(edge);
        }
        let edges = RoadEdges::new(&edges, Algorithm::V2023V1);
        let mut hints = Hints::default();
        let [mut x, mut y] = place(1);
        for _ in 0..400 {
            let [right, up] = place(reach / 2);
            (x, y) = (x + 0.5 * right, y + 0.5 * up);
            let alone = edges.signed_distance([x, y, 0.0], &mut Hints::default());
            let found = edges.signed_distance([x, y, 0.0], &mut hints);
            assert_eq!(
                found.to_bits(),
                alone.to_bits(),
                "round {round} at {x}, {y}"
            );
            zeros += usize::from(alone == 0.0);
        }
    }
    assert!((50..12_000).contains(&zeros), "{zeros} distances of 0");
}

#[test]
fn red_light_violations_are_the_references() {
    let golden = golden("red_light_2025");
    let lanes = golden["lanes"].as_array().unwrap().iter();
    let ids = golden["lane_ids"].as_array().unwrap().iter();
    let lanes: Vec<SignalLane> = lanes
        .zip(ids)
        .map(|(points, id)| SignalLane {
            id: id.as_i64().unwrap(),
            points: rows(points).into_iter().map(|p| [p[0], p[1]]).collect(),
        })
        .collect();
    let signal = |s: Vec<f32>| Signal {
        lane: s[0] as i64,
        stop: [1.0, 4.0].contains(&s[1]),
        stop_point: [s[2], s[3]],
    };
    let steps = golden["signals"].as_array().unwrap().iter();
    let signals: Vec<Vec<Signal>> = steps
        .map(|step| rows(step).into_iter().map(signal).collect())
        .collect();
    let n = signals.len();
    let (x, y) = (rows(&golden["x"]), rows(&golden["y"]));
    let tracks: Vec<Track> = (0..x.len())
        .map(|agent| {
            let valid = bits(&golden["valid"][agent]);
            // The clock of the unit is shorter than a log's: its last state stays.
            let state = |t: usize| {
                let t = t.min(n - 1);
                let state = State::new([x[agent][t], y[agent][t], 0.0], 0.0, [4.0, 2.0, 1.0]);
                State {
                    valid: valid[t],
                    ..state
                }
            };
            let states = (0..N_STEPS).map(state).collect();
            Track::new(AgentId(agent as i64), AgentKind::Vehicle, states)
        })
        .collect();
    let padded = (0..N_STEPS)
        .map(|t| signals[t.min(n - 1)].clone())
        .collect();
    let log = Log::new("red light", tracks).signals(lanes.clone(), padded);
    let lights = Lights::new(&log).unwrap();
    let config = Config::of(Year::Y2025);
    let simulated: Vec<&Track> = log.tracks.iter().collect();
    let logged = SimulatedAgents::logged(&simulated, &config);
    for agent in 0..x.len() {
        let found = lights.violations(&logged, agent, 0);
        assert_eq!(found[..n], bits(&golden["violation"][agent]));
    }
    // The reference numbers lanes by index and segments within their padded lane.
    let queries = rows(&golden["nearest_queries_xy"]);
    let expected = rows(&golden["nearest_lane_and_segment_index"]);
    let longest = lanes.iter().map(|lane| lane.points.len()).max().unwrap();
    let starts: Vec<usize> = lanes
        .iter()
        .scan(0, |start, lane| {
            let first = *start;
            *start += lane.points.len().min(longest - 1);
            Some(first)
        })
        .collect();
    let mut hint = 0;
    for (query, expected) in queries.iter().zip(expected) {
        let (lane, segment) = lights.nearest([query[0], query[1]], &mut hint);
        let index = lanes.iter().position(|l| l.id == lane).unwrap();
        assert_eq!(
            [index, segment - starts[index]],
            [expected[0] as usize, expected[1] as usize]
        );
    }
}

#[test]
fn likelihoods_are_the_references() {
    for year in ["2023", "2025"] {
        let golden = golden(&format!("estimators_{year}"));
        for case in golden["cases"].as_array().unwrap() {
            likelihoods_of(case);
        }
        let edges = golden["histogram_edges_min|max|bins"].as_object().unwrap();
        for (name, expected) in edges {
            let parts: Vec<f32> = name.split('|').map(|p| p.parse().unwrap()).collect();
            let found = Histogram::new(parts[0], parts[1], parts[2] as usize, 0.1).edges;
            assert_eq!(found, numbers(expected), "{name}");
        }
    }
}

fn likelihoods_of(case: &Value) {
    let name = case["name"].as_str().unwrap();
    let number = |key: &str| case[key].as_f64().unwrap() as f32;
    let estimator = if name.starts_with("bernoulli") {
        Estimator::Bernoulli { pseudocount: 0.001 }
    } else if name.starts_with("kde") {
        Estimator::KernelDensity { bandwidth: 0.8 }
    } else {
        Estimator::Histogram {
            min: number("min_val"),
            max: number("max_val"),
            bins: number("num_bins") as usize,
            pseudocount: number("pseudocount"),
        }
    };
    let is = |key: &str| case[key].as_bool().unwrap_or(false);
    let feature = FeatureConfig {
        estimator,
        independent_timesteps: is("independent_timesteps"),
        aggregate_agents: is("aggregate_objects"),
        weight: 1.0,
    };
    let bools = |value: &Value| {
        bits(value)
            .into_iter()
            .map(|b| f32::from(u8::from(b)))
            .collect()
    };
    let (log, simulated, shape): (Vec<f32>, Vec<Vec<f32>>, _) = if case["log"].is_string() {
        let log: Vec<f32> = bools(&case["log"]);
        let simulated = case["sim"].as_array().unwrap().iter().map(bools).collect();
        let shape = FeatureShape {
            agents: log.len(),
            steps: 1,
        };
        (log, simulated, shape)
    } else {
        let log = rows(&case["log"]);
        let simulated = case["sim"].as_array().unwrap().iter();
        let shape = FeatureShape {
            agents: log.len(),
            steps: log[0].len(),
        };
        (
            log.concat(),
            simulated.map(|r| rows(r).concat()).collect(),
            shape,
        )
    };
    let simulated: Vec<&[f32]> = simulated.iter().map(Vec::as_slice).collect();
    let found = log_likelihoods(&feature, &log, &simulated, 1, shape);
    let expected = &case["log_likelihood"];
    let expected = match expected[0].is_array() {
        true => rows(expected).concat(),
        false => numbers(expected),
    };
    close(&found, &expected, 1e-6);
}
