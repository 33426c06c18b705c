//! `bench`: speed, side by side in one run; ratios first, then times.
//!
//! A new bench is a file here and a variant of [`Verb`]; Criterion benches live in the crates.

mod decision;
pub(crate) mod device;
pub(crate) mod engine;
mod planning;
mod torch;
pub(crate) mod train;
pub(crate) mod wosac;

use gump_model::config::ModelConfig;
use gump_scene::{Scenario, fixture};

use crate::cli::WrongArguments;

/// The benches.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Verb {
    /// Simulation: decoding orders, caches, batches and sizes, against the machine's own rate
    Engine(engine::Args),
    /// A training step in f32 and bfloat16, against the same network in PyTorch
    Train(train::Args),
    /// The chosen device against the CPU: agreement and speed
    Device(device::Args),
    /// Scoring the realism of 32 rollouts, against the official evaluator
    Wosac(wosac::Args),
    /// PDM-Closed, reactive traffic and a whole scored drive, against nuPlan's own times; a decision
    /// among learned drivers
    Planning(planning::Args),
}

/// The configuration of a size in `--sizes`.
///
/// Error: [`WrongArguments`] for one that does not exist.
fn preset(size: &str) -> anyhow::Result<ModelConfig> {
    let config = ModelConfig::preset(size).ok_or_else(|| {
        let known = ModelConfig::PRESETS.join(", ");
        WrongArguments(format!("--sizes: expected one of {known}, found {size}"))
    })?;
    Ok(config)
}

/// The middle of an odd number of measurements, the upper one of an even number; `None` of none.
fn median(mut all: Vec<f64>) -> Option<f64> {
    all.sort_by(f64::total_cmp);
    all.get(all.len() / 2).copied()
}

/// A made-up crossing of that many agents, all within the window of the tokens, with a second of
/// history.
fn crowd(n_agents: usize) -> anyhow::Result<Scenario> {
    let mut text = String::from(
        "lane 1: -100,0 100,0 speed 15\nlane 2: 0,-100 0,100 speed 15\n\
         ego vehicle 0: 0,0 velocity 6,0\n",
    );
    for i in 1..n_agents {
        let (column, row) = (i % 12, i / 12);
        let (x, y) = (10 * column as i64 - 55, 10 * row as i64 - 50);
        let kind = ["vehicle", "vehicle", "pedestrian", "bicycle"][i % 4];
        let velocity = [4.0, 0.0, 1.0, 3.0][i % 4];
        text += &format!("agent {kind} {i}: {x},{y} velocity {velocity},0\n");
    }
    fixture::scenario(&text).map_err(|error| anyhow::anyhow!(error))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_crowd_has_as_many_agents_as_asked_for() {
        for n in [1, 32, 128] {
            let scenario = crowd(n).unwrap();
            assert_eq!(scenario.present().now().agents().len(), n);
            let inside =
                |agent: &gump_scene::Agent| agent.state.pose.position.abs().max_element() < 80.0;
            assert!(scenario.present().now().agents().iter().all(inside));
        }
    }
}
