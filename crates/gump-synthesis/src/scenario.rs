//! From a seed to a scenario.

use std::fmt::Write;

use gump_scene::{Scenario, Seed, fixture};
use rand::Rng;
use rayon::prelude::*;

use crate::SynthesisConfig;

/// Makes up one scenario; the same seed and config always give the same one.
pub fn synthesize(config: &SynthesisConfig, seed: Seed) -> Scenario {
    let mut rng = seed.rng();
    let reach = config.extent_m;
    let speed = rng.random_range(8.0..16.0);
    let mut text = format!(
        "lane 1: {:.1},0 {reach:.1},0 speed {speed:.1}\nroute 1\nhistory {} future {} dt {}\n\
         ego vehicle 0: 0,0 velocity {speed:.1},0\n",
        -reach, config.history_s, config.future_s, config.dt
    );
    let mut x = 0.0;
    for id in 1..=rng.random_range(1..6) {
        x -= rng.random_range(12.0..25.0);
        writeln!(text, "agent vehicle {id}: {x:.1},0 velocity {speed:.1},0")
            .expect("writing to a string does not fail");
    }
    let mut scenario = fixture::scenario(&text).expect("the text is in the fixture's form");
    scenario.id = format!("procedural-{:016x}", seed.0);
    scenario
}

/// Makes up `n` scenarios on all threads of the pool; scenario `k` comes from `seed.fork(k)`, so
/// the number of threads changes nothing.
pub fn synthesize_many(config: &SynthesisConfig, seed: Seed, n: usize) -> Vec<Scenario> {
    (0..n as u64)
        .into_par_iter()
        .map(|k| synthesize(config, seed.fork(k)))
        .collect()
}
