//! `bench wosac`: seconds to score one scenario, against the official evaluator's.

use std::num::NonZeroUsize;
use std::path::PathBuf;
use std::time::Instant;

use anyhow::Context as _;
use gump_data::ReadOptions;
use gump_eval::realism::recordings;
use gump_scene::Seed;
use gump_wosac::realism::{Config, Log, Mode, Rollouts, Year, score};
use rand::Rng as _;
use serde::Serialize;
use serde_json::json;

use crate::run::{Common, Run, stop_if_interrupted};
use crate::shipped;

/// Arguments of `bench wosac`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// File of recorded scenarios, the first of which is timed [default: the shipped ones]
    #[arg(long, value_name = "PATH")]
    scenarios: Option<PathBuf>,
    /// Rollouts to score
    #[arg(long, value_name = "N", default_value = "32")]
    rollouts: NonZeroUsize,
    /// Repetitions; the median is reported
    #[arg(long, value_name = "N", default_value = "7")]
    repeat: NonZeroUsize,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

/// Seconds of processor time that the official evaluator took for 32 rollouts under the settings
/// of 2025, medians of three processes on two cores: wheel 1.6.7, TensorFlow 2.12. Its wall time
/// was 1.6 to 5 times as long on the shared machine it was measured on.
const OFFICIAL: [(&str, f64); 2] = [("637f20cafde22ff8", 51.49), ("ee519cf571686d19", 109.82)];

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let path = match &self.scenarios {
            Some(path) => path.clone(),
            None => shipped::data().join("procedural.tfrecord.gz"),
        };
        run.setting("scenarios", &path)?;
        let first = recordings(std::slice::from_ref(&path), ReadOptions::STATED, |index| {
            index == 0
        })?
        .next();
        let log = first.context("expected a scenario, found none")??.log;
        let official = OFFICIAL.iter().find(|(id, _)| *id == log.scenario);
        let official = official.filter(|_| self.rollouts.get() == 32).map(|o| o.1);
        run.result("scenario", &log.scenario)?;
        run.result(
            "agents",
            log.tracks.iter().filter(|t| t.is_simulated()).count(),
        )?;
        run.result("scored", log.targets.len() + 1)?;
        run.result("rollouts", self.rollouts.get())?;
        let mut rows = Vec::new();
        for year in Year::ALL {
            let config = Config::of(year);
            let rollouts = wandering(&log, self.rollouts.get(), config.mode, run.seed());
            let mut seconds = Vec::new();
            for _ in 0..self.repeat.get() {
                stop_if_interrupted()?;
                let began = Instant::now();
                score(&log, &rollouts, &config)?;
                seconds.push(began.elapsed().as_secs_f64());
            }
            seconds.sort_by(f64::total_cmp);
            let median = seconds[seconds.len() / 2];
            let official = official.filter(|_| year == Year::Y2025);
            rows.push(json!({
                "ratio": official.map(|official| official / median),
                "year": year.name(),
                "seconds_per_scenario": median,
                "fastest": seconds[0],
                "official_cpu_seconds": official,
            }));
        }
        run.result("rows", rows)
    }
}

/// The log with a different drift for every agent and rollout, so that no two are alike.
fn wandering(log: &Log, n: usize, mode: Mode, seed: Seed) -> Rollouts {
    let oracle = log.oracle(1, mode == Mode::Generation);
    let mut rng = seed.rng();
    let futures = (0..n).map(|_| {
        let mut future = oracle.futures[0].clone();
        for drive in &mut future {
            let drift: [f32; 2] = [rng.random_range(-0.05..0.05), rng.random_range(-0.05..0.05)];
            for (step, (x, y)) in drive.x.iter_mut().zip(&mut drive.y).enumerate() {
                *x += drift[0] * step as f32;
                *y += drift[1] * step as f32;
            }
        }
        future
    });
    Rollouts::new(log.scenario.clone(), futures.collect())
}
