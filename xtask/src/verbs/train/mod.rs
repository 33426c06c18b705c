//! `train`: a world model from scenarios, in one stage or several, by one process or several.

mod placement;
mod realism;
mod relative;
mod stages;

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use gump_engine::{SamplingConfig, TransformerWorld};
use gump_eval::datasets::{self, Part, Split};
use gump_eval::fresh::SceneStream;
use gump_eval::training_set::{self, TrainingSet};
use gump_kernels::Choice;
use gump_model::checkpoint::StorageType;
use gump_model::{Device, ModelConfig, Network, checkpoint};
use gump_rollout::WorldModel;
use gump_scene::{Scenario, Seed};
use gump_train::{LossParts, ProcessGroup as _, RunConfig, StepReport, Trainer};
use serde::Serialize;
use serde_json::{Map, Value, json};

use self::realism::Judge;
use self::stages::{Files, Stage};
use crate::benchmark;
use crate::cli::WrongArguments;
use crate::losses::Losses;
use crate::peers::{Processes, together};
use crate::run::{self, Common, Run};

/// Time between checkpoints: what a crash may cost.
const CHECKPOINT_EVERY: Duration = Duration::from_secs(60);
/// Validations in a run, evenly spread: enough for a curve. Chosen by hand.
const VALIDATIONS: usize = 10;
/// Validation samples, at most: each validation has to be quick beside training. Chosen by hand.
const VALIDATION_SAMPLES: usize = 64;
/// Most steps over which the first and the last loss are averaged, against the noise of batches; it is
/// a tenth of the steps, so that the two are of different steps. Chosen by hand.
const WINDOW: usize = 20;

/// The most samples of a step that can be meant.
const MOST_SAMPLES: usize = 65_536;

/// Files that a stage writes.
const CHECKPOINT: &str = "checkpoint.safetensors";
const WEIGHTS: &str = "weights.safetensors";
const LOSSES: &str = "losses.csv";

/// Arguments of `train`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// A folder with a manifest.toml, or any file or folder of scenarios; a cache is not held in
    /// memory; or `fresh:PROFILE` or `fresh:PROFILE:SEED`, synthetic scenes generated on the fly,
    /// each used once
    #[arg(long, value_name = "PATH")]
    data: PathBuf,
    /// Scenarios to validate on [default: the manifest's]
    #[arg(long, value_name = "PATH")]
    validation: Option<PathBuf>,
    /// Initial weights, with a new optimiser and schedule
    #[arg(long, value_name = "FILE", conflicts_with = "resume")]
    from: Option<PathBuf>,
    /// The size of the model: tiny, small, base or medium; or `relative`, the network with relative
    /// attention throughout; or `placement`, which places the vehicles of generated scenes [default:
    /// tiny]
    #[arg(long, value_name = "NAME")]
    model: Option<String>,
    /// Optimiser steps
    #[arg(long, value_name = "N")]
    steps: Option<usize>,
    /// Samples per step
    #[arg(long, value_name = "N")]
    batch: Option<usize>,
    /// Stop after this step; continue with --resume
    #[arg(long, value_name = "N")]
    stop_at: Option<usize>,
    /// Continue the run in --out with its original configuration; without it a folder with a run is
    /// refused
    #[arg(long)]
    resume: bool,
    /// Futures of each of up to 8 validation scenes for realism, evaluated ten times per run; 0
    /// reports the loss only
    #[arg(long, value_name = "N", default_value_t = 2)]
    realism_rollouts: usize,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

/// Initial state of a stage.
enum Begin {
    New,
    From(Box<Network>),
    Resume,
}

/// The first file with what an earlier run learned, in a folder or in that of a stage within it.
fn learned_in(out: &Path, names: &[&str]) -> Option<PathBuf> {
    let folders = std::fs::read_dir(out).into_iter().flatten().flatten();
    let is_stage = |entry: &std::fs::DirEntry| {
        let name = entry.file_name();
        name.to_string_lossy().starts_with(stages::FOLDER)
    };
    let stages = folders.filter(is_stage).map(|entry| entry.path());
    let mut files = std::iter::once(out.to_owned())
        .chain(stages)
        .flat_map(|folder| names.iter().map(move |name| folder.join(name)));
    files.find(|file| file.is_file())
}

/// Refuses a batch that cannot be meant.
///
/// Error: [`WrongArguments`].
fn check_batch(batch: usize) -> Result<(), WrongArguments> {
    match batch > MOST_SAMPLES {
        true => Err(WrongArguments(format!(
            "--batch: expected at most {MOST_SAMPLES} samples, found {batch}"
        ))),
        false => Ok(()),
    }
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        self.check(run)?;
        if self.model.as_deref() == Some(placement::NAME) {
            return together(|processes| placement::execute(self, run, processes));
        }
        if relative::is_requested(self)? {
            return together(|processes| relative::execute(self, run, processes));
        }
        let stages = self.stages()?;
        together(|processes| {
            if processes.rank() > 0 {
                run.follow();
            }
            self.learn_in(&stages, run, processes)
        })
    }

    /// Refuses arguments that cannot be trained with, before anything is read.
    ///
    /// Error: [`WrongArguments`].
    fn check(&self, run: &Run) -> anyhow::Result<()> {
        let known = ModelConfig::PRESETS
            .iter()
            .copied()
            .chain([relative::NAME, placement::NAME]);
        let wrong = match (&self.model, self.steps) {
            (Some(name), _) if !known.clone().any(|known| known == name) => {
                let known: Vec<&str> = known.collect();
                format!(
                    "--model: expected one of {}, found {name}",
                    known.join(", ")
                )
            }
            (_, Some(0)) => "--steps: expected at least 1, found 0".into(),
            _ if self.resume => match learned_in(run.out(), &[CHECKPOINT]) {
                Some(_) => return Ok(()),
                None => format!(
                    "--resume: expected a run in {}, found none",
                    run.out().display()
                ),
            },
            _ => match learned_in(run.out(), &[CHECKPOINT, WEIGHTS]) {
                Some(file) => run::would_replace(&file),
                None => return Ok(()),
            },
        };
        Err(WrongArguments(wrong).into())
    }

    /// One stage after the other; a resumed run begins with the last that was begun.
    fn learn_in(
        &self,
        stages: &[Stage],
        run: &mut Run,
        processes: &Processes,
    ) -> anyhow::Result<()> {
        let was_begun = |stage: &Stage| run.path(&stage.files.path(CHECKPOINT)).is_file();
        let mut resume = self.resume;
        let first = match self.resume {
            true => stages.iter().rposition(was_begun).unwrap_or(0),
            false => 0,
        };
        let mut network = match &self.from {
            Some(weights) => Some(load(weights, &stages[0], run.device())?),
            None => None,
        };
        for stage in &stages[first..] {
            let begin = match (resume, network) {
                (true, _) => Begin::Resume,
                (false, Some(network)) => Begin::From(Box::new(network)),
                (false, None) => Begin::New,
            };
            network = Some(self.learn(stage, begin, run, processes)?);
            resume = false;
        }
        let weights = run.path(WEIGHTS);
        if let Some(network) = network.filter(|_| stages.len() > 1 && processes.rank() == 0) {
            checkpoint::save(&network, &weights, StorageType::Half)?;
        }
        run.result("resumed", self.resume)?;
        run.result("weights", weights)
    }

    /// One stage; the network it ends with.
    fn learn(
        &self,
        stage: &Stage,
        begin: Begin,
        run: &mut Run,
        processes: &Processes,
    ) -> anyhow::Result<Network> {
        let (training, validation) = run.phase("read", |run| self.read(run, stage))?;
        let checkpoint = run.path(&stage.files.path(CHECKPOINT));
        let config = stage.config.train.clone();
        warn_of_slow_bfloat16(run, config.mixed_precision);
        let mut losses = Losses::default();
        let trainer = match begin {
            Begin::New => Trainer::new(stage.config.model()?, config, training, run.device())?,
            Begin::From(network) => run.phase("drive", |_| {
                Ok(Trainer::continuing(*network, config, training)?)
            })?,
            Begin::Resume => {
                let trainer = Trainer::resume(&checkpoint, training, run.device())?;
                self.check_resumed(&trainer, &stage.config)?;
                losses = Losses::read(&run.path(&stage.files.path(LOSSES)), trainer.steps_done())?;
                trainer
            }
        };
        let mut trainer = trainer.with_group(processes.clone())?;
        run.setting("model", trainer.network().config())?;
        run.setting("train", trainer.config())?;
        run.reseed(trainer.config().seed);
        let resumed_at = trainer.steps_done();
        let writes = processes.rank() == 0;
        if writes {
            let folder = run.path(&stage.files.path(""));
            std::fs::create_dir_all(&folder)
                .with_context(|| format!("cannot create the folder {}", folder.display()))?;
        }
        let seed = Seed(trainer.config().seed).fork(9);
        // One process evaluates for all: the simulations do not affect training.
        let rollouts = if writes { self.realism_rollouts } else { 0 };
        let judge = Judge::new(&validation, rollouts, seed);
        let held_out = HeldOut {
            scenarios: &validation,
            judge,
        };
        let began = Instant::now();
        let trained = run.phase("train", |run| {
            learn(
                run,
                &stage.files,
                &mut trainer,
                &mut losses,
                &held_out,
                writes,
            )
        });
        // A failed step changes nothing, so what was learned before it is worth keeping.
        if writes {
            run.phase("write", |run| write(run, &stage.files, &trainer, &losses))?;
        }
        trained?;
        run.result("parameters", trainer.network().parameters().count())?;
        report_run(run, &trainer, &losses, resumed_at, began)?;
        let judged = held_out.judge.as_ref().map_or(0, Judge::scenes);
        run.setting("realism_scenes", judged)?;
        if let Some(last) = losses.last() {
            run.result("loss_per_field", per_field(last))?;
        }
        Ok(trainer.into_network())
    }

    /// A run keeps the configuration it began with; asking for another one is a mistake.
    fn check_resumed(&self, trainer: &Trainer, requested: &RunConfig) -> anyhow::Result<()> {
        let begun = trainer.config();
        self.check_flags(begun.steps, begun.batch)?;
        let Some(path) = &self.common.config else {
            return Ok(());
        };
        let wrong = if *trainer.network().config() != requested.model()? {
            Some("another model than that of the run to resume".to_owned())
        } else {
            stages::difference(&requested.train, begun)?
        };
        match wrong {
            Some(wrong) => Err(WrongArguments(format!("{}: {wrong}", path.display())).into()),
            None => Ok(()),
        }
    }

    /// Error: [`WrongArguments`] if flags give other numbers than the run to resume began with.
    fn check_flags(&self, steps: usize, batch: usize) -> anyhow::Result<()> {
        for (flag, requested, begun) in [
            ("--steps", self.steps, steps),
            ("--batch", self.batch, batch),
        ] {
            if let Some(requested) = requested.filter(|&requested| requested != begun) {
                let wrong = format!("{flag} {requested}: the run to resume began with {begun}");
                return Err(WrongArguments(wrong).into());
            }
        }
        Ok(())
    }

    fn read(&self, run: &Run, stage: &Stage) -> anyhow::Result<(TrainingSet, Vec<Scenario>)> {
        self.read_data(run, &stage.data, stage.config.train.batch)
    }

    /// Reads the training data, for steps of `batch` samples, and the validation data.
    fn read_data(
        &self,
        run: &Run,
        data: &[PathBuf],
        batch: usize,
    ) -> anyhow::Result<(TrainingSet, Vec<Scenario>)> {
        let progress = run.progress("reading", 0, "scenarios");
        let mut training = Vec::with_capacity(data.len());
        let mut validation = Vec::new();
        for named in data {
            let (path, share) = training_set::with_share(named);
            let (source, held_out) = match SceneStream::of_name(&path)? {
                Some(stream) => {
                    let held_out = match &self.validation {
                        Some(_) => Vec::new(),
                        None => stream.validation(VALIDATION_SAMPLES / data.len()),
                    };
                    let of_batch = (batch as f64 * share).ceil() as usize;
                    (TrainingSet::fresh(stream, of_batch), held_out)
                }
                None => {
                    let source =
                        TrainingSet::open(&datasets::parts(&path, Split::Train)?, &progress)?;
                    let held_out = match &self.validation {
                        Some(_) => Vec::new(),
                        None => datasets::parts(&path, Split::Tune)?,
                    };
                    let most = VALIDATION_SAMPLES / data.len();
                    (source, datasets::read_first(most, &held_out, &progress)?)
                }
            };
            benchmark::warn_of_frozen(run, source.ids(), "what these weights score")?;
            validation.extend(held_out);
            training.push((share, source));
        }
        if let Some(path) = &self.validation {
            let whole = [Part::whole(path)];
            validation = datasets::read_first(VALIDATION_SAMPLES, &whole, &progress)?;
        }
        Ok((TrainingSet::mixed(training), validation))
    }
}

/// A network in training, of either architecture.
trait Learns {
    fn steps(&self) -> usize;
    fn steps_done(&self) -> usize;
    fn step(&mut self) -> anyhow::Result<StepReport>;
    /// Whether any process passes `true`.
    fn any(&self, value: bool) -> anyhow::Result<bool>;
    /// The loss on held-out scenarios, nats.
    fn validate(&self, scenarios: &[Scenario]) -> anyhow::Result<f64>;
    /// The current network as a world.
    fn world(&self) -> anyhow::Result<Box<dyn WorldModel>>;
    /// Writes the checkpoint to resume from and the weights to use.
    fn save(&self, checkpoint: &Path, weights: &Path) -> anyhow::Result<()>;
}

impl Learns for Trainer {
    fn steps(&self) -> usize {
        self.config().steps
    }

    fn steps_done(&self) -> usize {
        Trainer::steps_done(self)
    }

    fn step(&mut self) -> anyhow::Result<StepReport> {
        Ok(Trainer::step(self)?)
    }

    fn any(&self, value: bool) -> anyhow::Result<bool> {
        Ok(Trainer::any(self, value)?)
    }

    fn validate(&self, scenarios: &[Scenario]) -> anyhow::Result<f64> {
        Ok(Trainer::validate(self, scenarios, VALIDATION_SAMPLES)?.total)
    }

    fn world(&self) -> anyhow::Result<Box<dyn WorldModel>> {
        let world = TransformerWorld::new(self.snapshot()?, SamplingConfig::default());
        Ok(Box::new(world))
    }

    fn save(&self, checkpoint: &Path, weights: &Path) -> anyhow::Result<()> {
        Trainer::save(self, checkpoint)?;
        Ok(checkpoint::save(
            self.network(),
            weights,
            StorageType::Half,
        )?)
    }
}

/// Warns if matrix products in bfloat16 take longer than in f32 on this processor.
fn warn_of_slow_bfloat16(run: &Run, mixed_precision: bool) {
    let kernel = Choice::current().kernel;
    if mixed_precision && run.device().is_cpu() && !kernel.multiplies_bfloat16() {
        run.print(&format!(
            "note: mixed_precision takes longer than f32 with the kernel {}, which has no products \
             of bfloat16",
            kernel.name()
        ));
    }
}

/// The weights to go on from; those without marks of what is not known grow them where the
/// configuration has them.
///
/// Error: [`WrongArguments`] if they are of another model than the configuration.
fn load(weights: &Path, stage: &Stage, device: &Device) -> anyhow::Result<Network> {
    let network = checkpoint::load_to_grow(weights, &stage.config.model()?, device)?;
    network.ok_or_else(|| {
        let wrong = format!(
            "{} holds another model than the configuration",
            weights.display()
        );
        WrongArguments(wrong).into()
    })
}

/// Validation data of a stage.
struct HeldOut<'a> {
    scenarios: &'a [Scenario],
    /// Scores the network's simulations of them; `None` without rollouts, in processes that do not
    /// write, and without a scene that can be scored.
    judge: Option<Judge<'a>>,
}

/// Steps until the run is done, it is to stop, or Ctrl-C.
fn learn(
    run: &Run,
    files: &Files,
    trainer: &mut impl Learns,
    losses: &mut Losses,
    held_out: &HeldOut<'_>,
    writes: bool,
) -> anyhow::Result<()> {
    let total = trainer.steps();
    let progress = run.progress("training", total as u64, "steps");
    progress.advance(trainer.steps_done() as u64);
    let validate_every = (total / VALIDATIONS).max(1);
    let mut saved = Instant::now();
    while trainer.steps_done() < total.min(files.stop_at) {
        let step = trainer.steps_done();
        anyhow::ensure!(
            !trainer.any(run::interrupted())?,
            "stopped by Ctrl-C after step {step} of {total}, continue with --resume"
        );
        let report = trainer.step()?;
        progress.message(&format!("training, loss {:.3}", report.loss.total));
        progress.advance(1);
        let done = report.step;
        losses.push(report);
        let is_due = done.is_multiple_of(validate_every) || done == total;
        if is_due && !held_out.scenarios.is_empty() {
            let loss = trainer.validate(held_out.scenarios)?;
            let scores = match &held_out.judge {
                Some(judge) => judge.score(&*trainer.world()?)?,
                None => None,
            };
            losses.push_validation(done, loss, scores.as_ref());
        }
        if writes && saved.elapsed() > CHECKPOINT_EVERY {
            write(run, files, trainer, losses)?;
            saved = Instant::now();
        }
    }
    Ok(())
}

/// The checkpoint to resume from, the weights to use, and the losses as data and as a picture.
fn write(run: &Run, files: &Files, trainer: &impl Learns, losses: &Losses) -> anyhow::Result<()> {
    let path = |name: &str| run.path(&files.path(name));
    // First the losses: rows beyond the checkpoint are cut off when the run is resumed.
    losses.write(&path(LOSSES))?;
    trainer.save(&path(CHECKPOINT), &path(WEIGHTS))?;
    if let Some(chart) = losses.chart() {
        chart.save(&path("losses"))?;
    }
    if let Some(chart) = losses.realism_chart() {
        chart.save(&path("realism"))?;
    }
    if let Some(chart) = losses.rewards_chart() {
        chart.save(&path("rewards"))?;
    }
    Ok(())
}

/// Reports the results of a run, or of this part of it.
fn report_run(
    run: &mut Run,
    trainer: &impl Learns,
    losses: &Losses,
    resumed_at: usize,
    began: Instant,
) -> anyhow::Result<()> {
    let tokens = losses.tokens_since(resumed_at);
    run.result("steps", trainer.steps_done())?;
    run.result(
        "tokens_per_second",
        tokens as f64 / began.elapsed().as_secs_f64(),
    )?;
    let window = (losses.steps() / 10).clamp(1, WINDOW);
    run.result("loss_first", losses.mean_of_first(window))?;
    run.result("loss_last", losses.mean_of_last(window))?;
    run.print(&format!(
        "losses are in nats; loss_first and loss_last are means of the first and of the last {}",
        match window {
            1 => "step".into(),
            n => format!("{n} steps"),
        }
    ));
    run.result("validation_loss", losses.last_validation())?;
    run.result("validation_realism", losses.last_realism())
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
