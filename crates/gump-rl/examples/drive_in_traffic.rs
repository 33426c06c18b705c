//! A vectorised environment for your own learner: eight egos in reactive traffic, which coast and
//! then follow the log.
//!
//! `cargo run -p gump-rl --example drive_in_traffic [FILE]`

use std::error::Error;
use std::path::PathBuf;

use gump_rl::{DrivingEnv, EnvConfig, PreparedScenario, RlError, TrafficSource, VectorEnv};
use gump_rollout::worlds::Idm;
use gump_scene::Seed;

const SHIPPED: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../../datasets/mini/procedural.tfrecord.gz"
);

/// Fills in one action per row; observations are in the environment.
type Policy = fn(&DrivingEnv<'_>, &mut [f32]) -> Result<(), RlError>;

fn main() -> Result<(), Box<dyn Error>> {
    let path = PathBuf::from(std::env::args().nth(1).unwrap_or_else(|| SHIPPED.into()));
    let records = gump_data::open(&path)?.take(8);
    let scenarios = records.map(|record| Ok(record?.scenario));
    let scenarios = scenarios.collect::<Result<Vec<_>, gump_data::DataError>>()?;

    // ANCHOR: env
    // Steps of half a second; an action is acceleration and steering, each in [-1, 1].
    let prepared = PreparedScenario::prepare(scenarios, 0.5)?;
    let world = Idm::default();
    let config = EnvConfig {
        n_envs: 8,
        ..EnvConfig::default()
    };
    let mut env = DrivingEnv::new(prepared, TrafficSource::World(&world), config)?;
    // ANCHOR_END: env

    let coast: Policy = |_, actions| {
        actions.fill(0.0);
        Ok(())
    };
    let expert: Policy = |env, actions| env.expert_actions(actions);
    println!("{} numbers per observation", env.observation_len());
    for (name, policy) in [("coast", coast), ("log", expert)] {
        let mut actions = vec![0.0; env.n_envs() * env.action_len()];
        let (mut earned, mut episodes, mut failures) = (0.0, 0, 0);
        env.reset(Seed(0))?;
        for _ in 0..64 {
            policy(&env, &mut actions)?;
            env.step(&actions)?;
            earned += env.rewards().iter().sum::<f32>();
            episodes += env.finished().len();
            failures += env.terminated().iter().filter(|failed| **failed).count();
        }
        println!("{name:>6}: {episodes} episodes, {failures} failed, {earned:.0} earned in all");
    }
    Ok(())
}
