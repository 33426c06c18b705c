//! The time to score 32 rollouts of 60 agents, 8 of them scored, on a map of 8,000 edge points.

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use gump_scene::{AgentId, AgentKind};
use gump_wosac::realism::{Config, Log, Reference, Rollouts, State, Track, Year};

/// Traffic on ten parallel streets, bent so that no two edges are alike.
fn city() -> Log {
    let street = |k: usize| 40.0 * k as f32;
    let car = |i: usize| {
        let (x, y, speed) = (i as f32 * 9.0, street(i % 10), 2.0 + (i % 7) as f32);
        let at = |step: usize| {
            let position = [x + speed * 0.1 * step as f32, y, 0.0];
            State::new(position, 0.0, [4.6, 1.9, 1.6])
        };
        Track::new(
            AgentId(i as i64),
            AgentKind::Vehicle,
            (0..91).map(at).collect(),
        )
    };
    let edge = |k: usize| {
        let side = if k.is_multiple_of(2) { -5.0 } else { 5.0 };
        let point = |j: usize| {
            let x = j as f32 * 1.5 - 50.0;
            [x, street(k / 2) + side + (x * 0.02 + k as f32).sin(), 0.0]
        };
        let points = (0..400).map(point);
        // The road lies on the left of its edges.
        if k.is_multiple_of(2) {
            points.collect()
        } else {
            points.rev().collect()
        }
    };
    let log = Log::new("city", (0..60).map(car).collect());
    let log = log.ego(AgentId(0)).expect("agent 0 has a track");
    let targets = (1..8).map(AgentId).collect();
    let log = log.targets(targets).expect("agents 1 to 7 have tracks");
    log.road_edges((0..20).map(edge).collect())
}

/// The log, each time a little further beside itself.
fn rollouts(log: &Log) -> Rollouts {
    let oracle = log.oracle(1, false);
    let future = |r: usize| {
        let mut future = oracle.futures[0].clone();
        for drive in &mut future {
            for (step, y) in drive.y.iter_mut().enumerate() {
                *y += (r as f32 - 16.0) * 0.002 * step as f32;
            }
        }
        future
    };
    Rollouts::new("city", (0..32).map(future).collect())
}

fn realism(criterion: &mut Criterion) {
    let log = city();
    let rollouts = rollouts(&log);
    for year in [Year::Y2023, Year::Y2025] {
        let config = Config::of(year);
        criterion.bench_function(&format!("wosac {}", year.name()), |bencher| {
            bencher.iter(|| {
                let reference = Reference::new(&log, &config).expect("the city is sound");
                let evaluation = reference.evaluate(black_box(&rollouts));
                evaluation.expect("the rollouts fit").scores
            });
        });
    }
}

criterion_group!(benches, realism);
criterion_main!(benches);
