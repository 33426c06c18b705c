//! `train`: a world model from scenarios.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use gump_model::checkpoint::{self, Precision};
use gump_model::train::StepReport;
use gump_model::{
    ClosedLoopConfig, Device, LossParts, ModelConfig, RunConfig, TrainConfig, Trainer,
};
use gump_scene::Scenario;
use serde::Serialize;
use serde_json::{Map, Value, json};
use toml::Table;

use crate::cli::WrongArguments;
use crate::config;
use crate::dataset::{self, Part, Split, Training};
use crate::losses::Losses;
use crate::run::{self, Common, Run};

/// Time between checkpoints: what a crash may cost.
const CHECKPOINT_EVERY: Duration = Duration::from_secs(60);
/// Validations in a run, evenly spread.
const VALIDATIONS: usize = 10;
/// Validation samples, at most.
const VALIDATION_SAMPLES: usize = 64;
/// Steps over which the first and the last loss are averaged.
const WINDOW: usize = 20;

/// Arguments of `train`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// A folder with a manifest.toml, or any file or folder of scenarios; a cache is not held in
    /// memory
    #[arg(long, value_name = "PATH")]
    data: PathBuf,
    /// Scenarios to validate on [default: the manifest's]
    #[arg(long, value_name = "PATH")]
    validation: Option<PathBuf>,
    /// Weights to go on from, with a fresh optimiser and schedule
    #[arg(long, value_name = "FILE", conflicts_with = "resume")]
    from: Option<PathBuf>,
    /// The size of the model: tiny, small, base or medium [default: tiny]
    #[arg(long, value_name = "NAME")]
    model: Option<String>,
    /// Optimiser steps
    #[arg(long, value_name = "N")]
    steps: Option<usize>,
    /// Samples per step
    #[arg(long, value_name = "N")]
    batch: Option<usize>,
    /// Stop after this step, to go on with --resume
    #[arg(long, value_name = "N")]
    stop_at: Option<usize>,
    /// Go on with the run in --out, with the configuration it began with
    #[arg(long)]
    resume: bool,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let config = self.config()?;
        let (training, validation) = run.phase("read", |run| self.read(run))?;
        let checkpoint = run.path("checkpoint.safetensors");
        let mut losses = Losses::default();
        let mut trainer = if self.resume {
            let trainer = Trainer::resume(&checkpoint, training, &Device::Cpu)?;
            self.check_resumed(trainer.config())?;
            losses = Losses::read(&run.path("losses.csv"), trainer.steps_done())?;
            trainer
        } else if let Some(weights) = &self.from {
            let network = checkpoint::load(weights, &Device::Cpu)?;
            if *network.config() != config.model()? {
                let wrong = format!(
                    "{} holds another model than the configuration",
                    weights.display()
                );
                return Err(WrongArguments(wrong).into());
            }
            run.phase("drive", |_| {
                let trainer = Trainer::continuing(network, config.train.clone(), training);
                trainer.map_err(anyhow::Error::from)
            })?
        } else {
            Trainer::new(
                config.model()?,
                config.train.clone(),
                training,
                &Device::Cpu,
            )?
        };
        run.setting("model", trainer.network().config())?;
        run.setting("train", trainer.config())?;
        run.reseed(trainer.config().seed);
        let resumed_at = trainer.steps_done();
        let began = Instant::now();
        let trained = run.phase("train", |run| {
            let stop_at = self.stop_at.unwrap_or(usize::MAX);
            learn(run, &mut trainer, &mut losses, &validation, stop_at)
        });
        // A failed step changes nothing, so what was learned before it is worth keeping.
        run.phase("write", |run| write(run, &trainer, &losses))?;
        trained?;
        run.result("parameters", trainer.network().parameters().count())?;
        let tokens = losses.tokens_since(resumed_at);
        run.result("steps", trainer.steps_done())?;
        run.result(
            "tokens_per_second",
            tokens as f64 / began.elapsed().as_secs_f64(),
        )?;
        run.result("loss_first", losses.mean_of_first(WINDOW))?;
        run.result("loss_last", losses.mean_of_last(WINDOW))?;
        run.result("validation_loss", losses.last_validation())?;
        run.result("resumed", self.resume)?;
        if let Some(last) = losses.last() {
            run.result("loss_per_field", per_field(last))?;
        }
        run.result("weights", run.path("weights.safetensors"))
    }

    /// The run as flags and file describe it.
    ///
    /// Error: [`WrongArguments`] for a key that does not exist or does not fit.
    fn config(&self) -> anyhow::Result<RunConfig> {
        let mut table = match &self.common.config {
            Some(path) => {
                let tables = config::tables(path)?;
                config::check_keys(path, &tables, &known_keys()?)?;
                tables
            }
            None => Table::new(),
        };
        if let Some(name) = &self.model {
            table.insert("model".into(), name.clone().into());
        }
        table.entry("model").or_insert_with(|| "tiny".into());
        let wrong = |error: String| WrongArguments(error.trim().replace('\n', " "));
        let mut config =
            RunConfig::from_toml(&table.to_string()).map_err(|error| wrong(error.to_string()))?;
        config.train.steps = self.steps.unwrap_or(config.train.steps);
        config.train.batch = self.batch.unwrap_or(config.train.batch);
        config.train.seed = self.common.seed.unwrap_or(config.train.seed);
        let model = config.model().map_err(|error| wrong(error.to_string()))?;
        model.validate().map_err(|error| wrong(error.to_string()))?;
        Ok(config)
    }

    /// A run keeps the schedule it began with; asking for another one is a mistake.
    fn check_resumed(&self, begun: &TrainConfig) -> anyhow::Result<()> {
        for (flag, asked, begun) in [
            ("--steps", self.steps, begun.steps),
            ("--batch", self.batch, begun.batch),
        ] {
            if let Some(asked) = asked.filter(|&asked| asked != begun) {
                let wrong = format!("{flag} {asked}: the run to resume began with {begun}");
                return Err(WrongArguments(wrong).into());
            }
        }
        Ok(())
    }

    fn read(&self, run: &Run) -> anyhow::Result<(Training, Vec<Scenario>)> {
        let progress = run.progress("reading", 0, "scenarios");
        let training = Training::open(&dataset::parts(&self.data, Split::Train)?, &progress)?;
        let validation = match &self.validation {
            Some(path) => vec![Part::whole(path)],
            None => dataset::parts(&self.data, Split::Validation)?,
        };
        let validation = dataset::read_first(VALIDATION_SAMPLES, &validation, &progress)?;
        Ok((training, validation))
    }
}

fn known_keys() -> anyhow::Result<Table> {
    let mut known = Table::new();
    known.insert("model".into(), Table::try_from(ModelConfig::tiny())?.into());
    let train = TrainConfig {
        closed_loop: Some(ClosedLoopConfig::default()),
        ..TrainConfig::default()
    };
    known.insert("train".into(), Table::try_from(train)?.into());
    Ok(known)
}

/// Steps until the run is done, it is to stop, or Ctrl-C.
fn learn(
    run: &Run,
    trainer: &mut Trainer,
    losses: &mut Losses,
    validation: &[Scenario],
    stop_at: usize,
) -> anyhow::Result<()> {
    let total = trainer.config().steps;
    let progress = run.progress("training", total as u64, "steps");
    progress.advance(trainer.steps_done() as u64);
    let validate_every = (total / VALIDATIONS).max(1);
    let mut saved = Instant::now();
    while trainer.steps_done() < total.min(stop_at) {
        let step = trainer.steps_done();
        anyhow::ensure!(
            !run::interrupted(),
            "stopped by Ctrl-C after step {step} of {total}, go on with --resume"
        );
        let report = trainer.step()?;
        progress.message(&format!("training, loss {:.3}", report.loss.total));
        progress.advance(1);
        let done = report.step;
        losses.push(report);
        if !validation.is_empty() && (done.is_multiple_of(validate_every) || done == total) {
            let loss = trainer.validate(validation, VALIDATION_SAMPLES)?;
            losses.push_validation(done, loss.total);
        }
        if saved.elapsed() > CHECKPOINT_EVERY {
            write(run, trainer, losses)?;
            saved = Instant::now();
        }
    }
    Ok(())
}

/// The checkpoint to resume from, the weights to use, and the losses as data and as a picture.
fn write(run: &Run, trainer: &Trainer, losses: &Losses) -> anyhow::Result<()> {
    // First the losses: rows beyond the checkpoint are cut off when the run is resumed.
    losses.write(&run.path("losses.csv"))?;
    trainer.save(&run.path("checkpoint.safetensors"))?;
    let weights = run.path("weights.safetensors");
    checkpoint::save(trainer.network(), &weights, Precision::Half)?;
    if let Some(chart) = losses.chart() {
        chart.save(&run.path("losses"))?;
    }
    Ok(())
}

/// Loss by part and by field of the state, nats.
fn per_field(report: &StepReport) -> Value {
    let LossParts {
        state,
        fields,
        control,
        lights,
        classes,
        trajectory,
        reconstruction,
        ..
    } = &report.loss;
    let mut parts: Map<String, Value> = Map::new();
    for (name, loss) in crate::losses::field_names(fields.len())
        .into_iter()
        .zip(fields)
    {
        parts.insert(name, json!(loss));
    }
    parts.insert("state".into(), json!(state));
    parts.insert("control".into(), json!(control));
    parts.insert("lights".into(), json!(lights));
    parts.insert("classes".into(), json!(classes));
    parts.insert("trajectory".into(), json!(trajectory));
    parts.insert("reconstruction".into(), json!(reconstruction));
    Value::Object(parts)
}
