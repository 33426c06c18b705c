//! `bench device`: a self-test of a device. Runs the same network over the same scene on the CPU
//! and on the device of `--device`, and measures how far their outputs differ and how fast each
//! simulates.
//!
//! On a CPU, the engine is compared with the tensor library's operations, which are what other
//! devices run.

use std::time::Instant;

use anyhow::Context as _;
use gump_engine::{SamplingConfig, TransformerWorld};
use gump_model::config::ModelConfig;
use gump_model::{Device, Network};
use gump_rollout::{Start, WorldModel as _};
use serde::Serialize;
use serde_json::json;

use crate::run::{Common, Run, stop_if_interrupted};

/// Arguments of `bench device`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// Sizes of the network
    #[arg(
        long,
        value_name = "NAME,...",
        value_delimiter = ',',
        default_value = "tiny,small"
    )]
    sizes: Vec<String>,
    /// Agents in the scene
    #[arg(long, value_name = "N", default_value_t = 32)]
    agents: usize,
    /// Futures simulated together
    #[arg(long, value_name = "N", default_value_t = 32)]
    futures: usize,
    /// Frames per measurement, half a second each
    #[arg(long, value_name = "N", default_value_t = 4)]
    frames: usize,
    /// The largest difference between the two that passes, relative to the largest number
    #[arg(long, value_name = "X", default_value_t = 1e-3)]
    tolerance: f32,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let mut rows = Vec::new();
        let mut worst = 0f32;
        for size in &self.sizes {
            let row = run.phase(size, |run| self.compare(run, size, &mut worst))?;
            rows.push(row);
        }
        run.result("rows", rows)?;
        run.result("largest_difference", worst)?;
        anyhow::ensure!(
            worst <= self.tolerance,
            "the device differs from the CPU by {worst:e} of the largest number, at most {:e} was expected",
            self.tolerance
        );
        Ok(())
    }

    fn compare(&self, run: &Run, size: &str, worst: &mut f32) -> anyhow::Result<serde_json::Value> {
        let scenario = super::crowd(self.agents)?;
        let config = ModelConfig::preset(size).with_context(|| {
            let known = ModelConfig::PRESETS.join(", ");
            format!("--sizes: expected one of {known}, found {size}")
        })?;
        let network = |device: &Device| Network::random(config.clone(), run.seed(), device);
        let sampling = SamplingConfig::default();
        let cpu = TransformerWorld::new(network(&Device::Cpu)?, sampling.clone());
        let other = TransformerWorld::reference(network(run.device())?, sampling);
        let outputs = [
            cpu.probe(scenario.present())?,
            other.probe(scenario.present())?,
        ];
        let difference = relative_difference(&outputs[0], &outputs[1]);
        *worst = worst.max(difference);
        let rate = |world: &TransformerWorld| -> anyhow::Result<f64> {
            let start = Start {
                scene: scenario.present(),
                n_futures: self.futures,
                seed: run.seed(),
            };
            let failed = |error| anyhow::anyhow!("{error}");
            let mut session = world.open(&[start]).map_err(failed)?;
            session.step(None).map_err(failed)?;
            let began = Instant::now();
            for _ in 0..self.frames {
                stop_if_interrupted()?;
                session.step(None).map_err(failed)?;
            }
            let frames = (self.frames * self.futures) as f64;
            Ok(frames / began.elapsed().as_secs_f64())
        };
        let (engine, device) = (rate(&cpu)?, rate(&other)?);
        Ok(json!({
            "size": size,
            "agents": self.agents,
            "futures": self.futures,
            "ratio": device / engine,
            "cpu_frames_per_second": engine,
            "device_frames_per_second": device,
            "difference": difference,
        }))
    }
}

/// The largest difference, as a part of the largest number.
fn relative_difference(a: &[f32], b: &[f32]) -> f32 {
    let largest = a.iter().fold(f32::MIN_POSITIVE, |m, x| m.max(x.abs()));
    let pairs = a.iter().zip(b).map(|(a, b)| (a - b).abs());
    pairs.fold(0.0, f32::max) / largest
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_are_relative_to_the_largest_number() {
        assert_eq!(relative_difference(&[4.0, -8.0], &[4.0, -8.0]), 0.0);
        assert_eq!(relative_difference(&[4.0, -8.0], &[3.0, -8.0]), 0.125);
    }
}
