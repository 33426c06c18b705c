//! Scenes, actions and what came of them, for all tests of the environment.

#![allow(dead_code, reason = "each test binary uses its part")]
#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::sync::Arc;

use gump_rl::{DrivingEnv, EnvConfig, Outcome, PreparedScenario, TrafficSource, VectorEnv};
use gump_scene::{Seed, fixture};
use gump_synthesis::{SynthesisConfig, synthesize_many};
use rand::Rng as _;

pub(crate) const DT: f64 = 0.5;

/// A straight road, driven at 10 m/s.
pub(crate) const STREET: &str =
    "lane 1: 0,0 400,0 speed 15\nroute 1\nego vehicle 0: 10,0 velocity 10,0\n";

pub(crate) fn street(others: &str) -> Arc<[PreparedScenario]> {
    let scenario = fixture::scenario(&format!("{STREET}{others}")).unwrap();
    PreparedScenario::prepare([scenario], DT).unwrap()
}

/// Synthetic traffic on synthetic roads.
pub(crate) fn busy(n: usize) -> Arc<[PreparedScenario]> {
    let scenarios = synthesize_many(&SynthesisConfig::standard(), Seed(3), n);
    PreparedScenario::prepare(scenarios, DT).unwrap()
}

pub(crate) fn config(n_envs: usize) -> EnvConfig {
    EnvConfig {
        n_envs,
        ..EnvConfig::default()
    }
}

pub(crate) fn env<'w>(
    prepared: &Arc<[PreparedScenario]>,
    traffic: TrafficSource<'w>,
    n_envs: usize,
) -> DrivingEnv<'w> {
    DrivingEnv::new(Arc::clone(prepared), traffic, config(n_envs)).unwrap()
}

/// One step of one row, from one observation to the next.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Transition {
    pub(crate) before: Vec<f32>,
    pub(crate) action: Vec<f32>,
    pub(crate) reward: f32,
    pub(crate) after: Vec<f32>,
    pub(crate) terminated: bool,
    pub(crate) truncated: bool,
}

/// The action of a row in its `n`-th step of all: random, mild, the same for the same arguments.
pub(crate) fn wander(row: usize, n: u64, len: usize) -> Vec<f32> {
    let mut rng = Seed(99).fork(row as u64).fork(n).rng();
    (0..len).map(|_| rng.random_range(-0.5..0.6)).collect()
}

/// One row of a buffer of all rows.
pub(crate) fn part(all: &[f32], row: usize, n_rows: usize) -> Vec<f32> {
    let len = all.len() / n_rows;
    all[row * len..(row + 1) * len].to_vec()
}

/// Wanders for `n` steps from a reset; what every row went through.
pub(crate) fn roam(env: &mut DrivingEnv<'_>, seed: Seed, n: u64) -> Vec<Vec<Transition>> {
    env.reset(seed).unwrap();
    let rows = env.n_envs();
    let mut history = vec![Vec::new(); rows];
    for step in 0..n {
        let before = env.observations().to_vec();
        let len = env.action_len();
        let actions: Vec<Vec<f32>> = (0..rows).map(|row| wander(row, step, len)).collect();
        env.step(&actions.concat()).unwrap();
        for (row, history) in history.iter_mut().enumerate() {
            history.push(Transition {
                before: part(&before, row, rows),
                action: actions[row].clone(),
                reward: env.rewards()[row],
                after: part(env.final_observations(), row, rows),
                terminated: env.terminated()[row],
                truncated: env.truncated()[row],
            });
        }
    }
    history
}

/// Repeats one action in all rows until row 0 ends; how many steps that took, and the outcome.
pub(crate) fn until_end(env: &mut DrivingEnv<'_>, action: &[f32]) -> (usize, Outcome) {
    env.reset(Seed(0)).unwrap();
    for n in 1..1000 {
        env.step(&action.repeat(env.n_envs())).unwrap();
        if let Some((0, outcome)) = env.finished().first() {
            return (n, *outcome);
        }
    }
    panic!("no end");
}
