//! `bench train`: what a training step costs, in f32 and bfloat16, and in PyTorch.
//!
//! Weights are random and the batch is one of shipped scenes, the same in every step and in both
//! implementations. Before anything is compared, the losses of both must agree.

use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Context as _;
use gump_eval::datasets::{self, Part};
use gump_model::config::ModelConfig;
use gump_train::{Batch, SampleConfig, TrainConfig, Trainer};
use serde::Serialize;
use serde_json::{Value, json};

use super::torch::{Timed, Torch};
use crate::machine::{cpu_seconds, peak_rss_mb};
use crate::run::{Common, Run, stop_if_interrupted};
use crate::shipped;

/// The shipped file that the batch is drawn from.
const SCENES: &str = "sumo-made.tfrecord.gz";
/// Number formats: as printed, and whether products are in bfloat16.
const PRECISIONS: [(&str, bool); 2] = [("f32", false), ("bf16", true)];

/// Arguments of `bench train`.
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
    /// Samples per step
    #[arg(long, value_name = "N", default_value = "4")]
    batch: NonZeroUsize,
    /// Agents of a sample, at most
    #[arg(long, value_name = "N", default_value = "40")]
    agents: NonZeroUsize,
    /// Steps per measurement, after one to warm up
    #[arg(long, value_name = "N", default_value = "4")]
    steps: NonZeroUsize,
    /// Measurements, alternating between implementations; the median is reported
    #[arg(long, value_name = "N", default_value = "3")]
    rounds: NonZeroUsize,
    /// Python with PyTorch, whose time for the same steps is measured in the same run
    #[arg(long, value_name = "PYTHON")]
    torch: Option<PathBuf>,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

/// Seconds of some steps.
#[derive(Clone, Copy)]
struct Cost {
    wall: f64,
    cpu: f64,
}

/// Measurements of one implementation in one number format.
#[derive(Default)]
struct Costs(Vec<Cost>);

impl Costs {
    /// The median of a measurement per step.
    fn median(&self, part: impl Fn(&Cost) -> f64, steps: usize) -> Option<f64> {
        let middle = super::median(self.0.iter().map(part).collect())?;
        Some(middle / steps as f64)
    }
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let torch = self.torch.as_deref().map(Torch::find).transpose()?;
        run.setting("torch_version", torch.as_ref().map(|torch| &torch.version))?;
        let mut rows = Vec::new();
        for size in &self.sizes {
            let config = super::preset(size)?;
            let more = run.phase(size, |run| self.rows(run, size, &config, torch.as_ref()))?;
            rows.extend(more);
            run.result("rows", &rows)?;
        }
        run.result("peak_rss_mb", peak_rss_mb())
    }

    /// One thread, then the requested number.
    fn rows(
        &self,
        run: &mut Run,
        size: &str,
        config: &ModelConfig,
        torch: Option<&Torch>,
    ) -> anyhow::Result<Vec<Value>> {
        let file = run.path(&format!("{size}.safetensors"));
        let all = run.threads();
        let mut rows = Vec::new();
        for threads in [1, all].into_iter().take(all.min(2)) {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .context("cannot start threads")?;
            let more = pool.install(|| self.compare(run, size, config, torch, &file))?;
            rows.extend(more);
        }
        if torch.is_some() {
            std::fs::remove_file(&file)
                .with_context(|| format!("cannot remove {}", file.display()))?;
        }
        Ok(rows)
    }

    /// Both number formats on the threads of the present pool.
    fn compare(
        &self,
        run: &mut Run,
        size: &str,
        config: &ModelConfig,
        torch: Option<&Torch>,
        file: &Path,
    ) -> anyhow::Result<Vec<Value>> {
        let mut trainers = Vec::new();
        for (_, mixed) in PRECISIONS {
            trainers.push(self.trainer(run, config, mixed)?);
        }
        let batch = trainers[0].batch(0)?;
        if torch.is_some() {
            trainers[0].export(&batch, file)?;
        }
        let expected = Expected {
            loss: trainers[0].loss_of(&batch)?,
            parameters: trainers[0].network().parameters().count(),
        };
        let mut ours: [Costs; 2] = Default::default();
        let mut theirs: [Costs; 2] = Default::default();
        for _ in 0..self.rounds.get() {
            for (i, (precision, _)) in PRECISIONS.into_iter().enumerate() {
                ours[i].0.push(self.measure(&mut trainers[i], &batch)?);
                if let Some(torch) = torch {
                    let timed = self.in_torch(torch, file, precision)?;
                    expected.check(&timed, precision)?;
                    run.setting("torch_capability", &timed.capability)?;
                    theirs[i].0.push(Cost {
                        wall: timed.seconds,
                        cpu: timed.cpu_seconds,
                    });
                }
            }
        }
        let (steps, threads) = (self.steps.get(), rayon::current_num_threads());
        let mut rows = Vec::new();
        for (i, (precision, _)) in PRECISIONS.into_iter().enumerate() {
            let own = ours[i].median(|cost| cost.cpu, steps);
            let wall = ours[i].median(|cost| cost.wall, steps);
            let torch_cpu = theirs[i].median(|cost| cost.cpu, steps);
            let torch_wall = theirs[i].median(|cost| cost.wall, steps);
            let ratio = torch_cpu.zip(own).map(|(torch, own)| torch / own);
            rows.push(json!({
                "size": size,
                "threads": threads,
                "precision": precision,
                "ratio": ratio,
                "cpu_milliseconds_per_step": own.map(|cpu| 1e3 * cpu),
                "torch_cpu_milliseconds_per_step": torch_cpu.map(|cpu| 1e3 * cpu),
                "milliseconds_per_step": wall.map(|wall| 1e3 * wall),
                "torch_milliseconds_per_step": torch_wall.map(|wall| 1e3 * wall),
                "tokens": batch.tokens(),
                "tokens_per_second": wall.map(|wall| batch.tokens() as f64 / wall),
            }));
        }
        Ok(rows)
    }

    fn trainer(&self, run: &Run, model: &ModelConfig, mixed: bool) -> anyhow::Result<Trainer> {
        let config = TrainConfig {
            batch: self.batch.get(),
            seed: run.seed().0,
            mixed_precision: mixed,
            sample: SampleConfig {
                max_agents: self.agents.get(),
                ..SampleConfig::default()
            },
            ..TrainConfig::default()
        };
        let progress = run.progress("reading", 0, "scenarios");
        let file = [Part::whole(&shipped::data().join(SCENES))];
        let scenes = datasets::read_first(2 * self.batch.get(), &file, &progress)?;
        Ok(Trainer::new(model.clone(), config, scenes, run.device())?)
    }

    /// Some steps, after one to warm up.
    fn measure(&self, trainer: &mut Trainer, batch: &Batch) -> anyhow::Result<Cost> {
        trainer.step_on(batch)?;
        let (cpu, began) = (cpu_seconds(), Instant::now());
        for _ in 0..self.steps.get() {
            stop_if_interrupted()?;
            trainer.step_on(batch)?;
        }
        let wall = began.elapsed().as_secs_f64();
        let cpu = cpu_seconds()
            .zip(cpu)
            .map_or(wall, |(after, before)| after - before);
        Ok(Cost { wall, cpu })
    }

    fn in_torch(&self, torch: &Torch, file: &Path, precision: &str) -> anyhow::Result<Timed> {
        stop_if_interrupted()?;
        let (file, steps) = (file.display().to_string(), self.steps.to_string());
        let arguments = [&file, "--precision", precision, "--steps", &steps];
        let threads = rayon::current_num_threads();
        torch.time("train_step.py", threads, &arguments)
    }
}

/// Loss and size that the same network must have in PyTorch.
struct Expected {
    loss: f64,
    parameters: usize,
}

impl Expected {
    /// Error: PyTorch computed another network.
    fn check(&self, timed: &Timed, precision: &str) -> anyhow::Result<()> {
        let Self { loss, parameters } = *self;
        let off = (timed.loss - loss).abs() / loss.abs();
        let is_near = off <= tolerance(precision);
        if timed.parameters == parameters && is_near {
            return Ok(());
        }
        anyhow::bail!(
            "the network in PyTorch is another one: {} parameters and loss {}, ours has \
             {parameters} and {loss}",
            timed.parameters,
            timed.loss
        );
    }
}

/// Largest relative difference between the losses of the two implementations.
fn tolerance(precision: &str) -> f64 {
    match precision {
        "f32" => 1e-4,
        // The two round at different places.
        _ => 0.02,
    }
}
