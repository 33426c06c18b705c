//! Traffic by rules: steps of vehicles per second among fifty of them, nuPlan's reactive agents
//! one after another in one scene and in as many scenes as there are threads, and our own IDM.

use std::fmt::Write as _;
use std::hint::black_box;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use gump_nuplan::closed_loop::{Recording, Step, Traffic};
use gump_nuplan::reactive_agents::NuplanIdm;
use gump_nuplan::tracking::Trajectory;
use gump_rollout::worlds::{Idm, IdmConfig};
use gump_rollout::{SimulateConfig, Start, simulate};
use gump_scene::Seed;
use rayon::prelude::*;

const N_VEHICLES: usize = 50;
const N_STEPS: usize = 150;
const SCENES: usize = 16;

/// Four lanes in a wide bend, a car every ten metres.
fn recording() -> Recording {
    const RADIUS: f64 = 400.0;
    let at = |lane: usize, s: f64| {
        let (angle, r) = (s / RADIUS, RADIUS - 3.5 * lane as f64);
        (r * angle.sin(), RADIUS - r * angle.cos(), angle)
    };
    let mut text = String::from("history 1.1 future 15.1 dt 0.1\n");
    for lane in 0..4 {
        write!(text, "lane {}:", lane + 1).expect("strings take everything");
        for i in 0..=500 {
            let (x, y, _) = at(lane, f64::from(i));
            write!(text, " {x:.4},{y:.4}").expect("strings take everything");
        }
        text.push_str(" speed 12\n");
    }
    for i in 0..=N_VEHICLES {
        let (lane, row) = (i % 4, i / 4);
        let (x, y, h) = at(lane, 60.0 + 10.0 * row as f64);
        let (vx, vy) = (8.0 * h.cos(), 8.0 * h.sin());
        let who = match i {
            // The ego is in the middle of its lane's queue.
            25 => "ego vehicle 0".to_owned(),
            i => format!("agent vehicle {}", i + 1),
        };
        writeln!(
            text,
            "{who}: {x:.4},{y:.4} heading {h:.6} velocity {vx:.4},{vy:.4}"
        )
        .expect("strings take everything");
    }
    text.push_str("route 2\n");
    let scenario = gump_scene::fixture::scenario(&text).expect("the bench's own scene");
    Recording::of_boxes(scenario).expect("the bench's own scene")
}

/// Fifteen seconds of traffic around an ego that follows its log.
fn drive(recording: &Recording) -> usize {
    let scenario = recording.scenario();
    let scene = scenario.present();
    let mut traffic = NuplanIdm::default();
    traffic.begin(recording).expect("the scene has vehicles");
    let n = N_STEPS.min(scenario.future().len() - 1);
    let mut moved = 0;
    for iteration in 0..n {
        let (ego, next) = (recording.ego_at(iteration), recording.ego_at(iteration + 1));
        let plan = Trajectory::new(vec![*ego, *next]).expect("two states in order");
        let step = Step {
            recording,
            iteration,
            ego,
            next,
            plan: &plan,
            scene,
        };
        let others = traffic.advance(&step).expect("nothing can go wrong here");
        moved += others.agents.len();
    }
    moved
}

fn bench(c: &mut Criterion) {
    let recording = recording();
    let steps = drive(&recording);
    let mut group = c.benchmark_group("traffic");
    group.sample_size(20);
    group.throughput(Throughput::Elements(steps as u64));
    group.bench_function("nuplan-idm/one-scene", |b| {
        b.iter(|| drive(black_box(&recording)));
    });
    group.throughput(Throughput::Elements((SCENES * steps) as u64));
    group.bench_function("nuplan-idm/all-threads", |b| {
        b.iter(|| {
            let moved = (0..SCENES).into_par_iter().map(|_| drive(&recording));
            moved.sum::<usize>()
        });
    });
    let world = Idm::new(IdmConfig::default()).expect("defaults are good");
    let config = SimulateConfig::default();
    group.throughput(Throughput::Elements((32 * N_VEHICLES * 80) as u64));
    group.bench_function("idm/32-futures", |b| {
        b.iter(|| {
            let start = Start {
                scene: recording.scenario().present(),
                n_futures: 32,
                seed: Seed(1),
            };
            simulate(&world, &[start], None, &config).expect("nothing can go wrong here")
        });
    });
    group.finish();
}

criterion_group!(benches, bench);
criterion_main!(benches);
