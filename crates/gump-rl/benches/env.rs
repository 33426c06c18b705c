//! Environment steps per second, 128 episodes side by side: "elements" are steps of one episode.
//!
//! The scenes are synthetic, 64 of them, all prepared before the clock starts; actions are random
//! and mild, so that episodes of every length occur and restarts are part of the price.

#![allow(
    missing_docs,
    reason = "criterion's macros make undocumented functions"
)]
#![allow(clippy::unwrap_used, reason = "a benchmark fails by panicking")]

use std::sync::Arc;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use gump_rl::{
    DrivingEnv, EnvConfig, ObservationSpec, PreparedScenario, RasterView, Rules, TrafficSource,
    VectorEnv,
};
use gump_rollout::worlds::Idm;
use gump_scene::Seed;
use gump_synthesis::{SynthesisConfig, synthesize_many};
use rand::Rng as _;

/// As many as in the paper.
const N_ENVS: usize = 128;

fn prepared() -> Arc<[PreparedScenario]> {
    let scenarios = synthesize_many(&SynthesisConfig::standard(), Seed(1), 64);
    PreparedScenario::prepare(scenarios, 0.5).unwrap()
}

/// Random actions for some steps, used over and over.
fn actions(len: usize) -> Vec<Vec<f32>> {
    let mut rng = Seed(2).rng();
    let mut batch = || {
        let numbers = (0..N_ENVS * len).map(|_| rng.random_range(-0.3..0.3));
        numbers.collect()
    };
    (0..64).map(|_| batch()).collect()
}

fn measure(
    c: &mut Criterion,
    name: &str,
    traffic: TrafficSource<'_>,
    observation: ObservationSpec,
) {
    let config = EnvConfig {
        n_envs: N_ENVS,
        rules: Rules::default(),
        observation,
        ..EnvConfig::default()
    };
    let mut env = DrivingEnv::new(prepared(), traffic, config).unwrap();
    env.reset(Seed(0)).unwrap();
    let actions = actions(env.action_len());
    let mut step = 0;
    let mut advance = || {
        env.step(&actions[step % actions.len()]).unwrap();
        step += 1;
    };
    for _ in 0..300 {
        advance();
    }
    let mut group = c.benchmark_group("env");
    group.throughput(Throughput::Elements(N_ENVS as u64));
    group.bench_function(name, |b| b.iter(&mut advance));
    group.finish();
}

fn env(c: &mut Criterion) {
    let vector = ObservationSpec::default();
    let raster = ObservationSpec::Raster(RasterView::default());
    measure(c, "log/vector", TrafficSource::Log, vector);
    measure(c, "log/raster-64", TrafficSource::Log, raster);
    let idm = Idm::default();
    measure(c, "idm/vector", TrafficSource::World(&idm), vector);
}

criterion_group!(benches, env);
criterion_main!(benches);
