//! Training of the placement network: the same files, flags and stages.

use std::path::Path;

use anyhow::Context as _;
use gump_model::placement::PlacementNetwork;
use gump_rollout::WorldModel;
use gump_scene::Scenario;
use gump_train::placement::{PlacementTrainConfig, PlacementTrainer};
use gump_train::{LossParts, ProcessGroup as _, StepReport};
use serde::Deserialize;
use toml::Table;

use super::stages::{self, Stage};
use super::{
    Args, CHECKPOINT, HeldOut, LOSSES, Learns, WEIGHTS, check_batch, learn, report_run, write,
};
use crate::cli::WrongArguments;
use crate::losses::Losses;
use crate::peers::Processes;
use crate::run::Run;

/// The name of the network in `--model`.
pub(super) const NAME: &str = "placement";

/// Configuration of a run.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    #[serde(rename = "model")]
    _model: String,
    #[serde(default)]
    train: PlacementTrainConfig,
}

/// Trains, in one stage.
///
/// Error: bad input, or a step that failed; what was learned before it is kept.
pub(super) fn execute(args: &Args, run: &mut Run, processes: &Processes) -> anyhow::Result<()> {
    let wrong = |what: &str| WrongArguments(format!("--model {NAME}: {what}"));
    if processes.size() > 1 {
        return Err(wrong(&format!(
            "trains in one process, found {}",
            processes.size()
        ))
        .into());
    }
    if args.from.is_some() {
        return Err(wrong("starts from random weights, found --from").into());
    }
    let mut stages = args.stages_of(&known_keys()?, |table| config(args, table))?;
    let n_stages = stages.len();
    let Some(stage) = stages.pop().filter(|_| n_stages == 1) else {
        return Err(wrong(&format!("trains in one stage, found {n_stages}")).into());
    };
    let config = stage.config.train.clone();
    let (training, validation) =
        run.phase("read", |run| args.read_data(run, &stage.data, config.batch))?;
    let checkpoint = run.path(&stage.files.path(CHECKPOINT));
    let mut losses = Losses::default();
    let mut trainer = if args.resume {
        let trainer = PlacementTrainer::resume(&checkpoint, training)?;
        check_resumed(args, &stage, &trainer)?;
        losses = Losses::read(&run.path(&stage.files.path(LOSSES)), trainer.steps_done())?;
        trainer
    } else {
        PlacementTrainer::new(config, training)?
    };
    run.setting("train", trainer.config())?;
    run.reseed(trainer.config().seed);
    let folder = run.path(&stage.files.path(""));
    std::fs::create_dir_all(&folder)
        .with_context(|| format!("cannot create the folder {}", folder.display()))?;
    let resumed_at = trainer.steps_done();
    let held_out = HeldOut {
        scenarios: &validation,
        judge: None,
    };
    let began = std::time::Instant::now();
    let files = &stage.files;
    let trained = run.phase("train", |run| {
        learn(run, files, &mut trainer, &mut losses, &held_out, true)
    });
    run.phase("write", |run| write(run, files, &trainer, &losses))?;
    trained?;
    if !validation.is_empty() {
        let [_, uniform] = trainer.validate(&validation)?;
        run.result("validation_loss_of_even_draws", uniform)?;
    }
    let network: &PlacementNetwork = trainer.network();
    run.result("parameters", network.parameters().count())?;
    report_run(run, &trainer, &losses, resumed_at, began)?;
    run.result("resumed", args.resume)?;
    run.result("weights", run.path(&stage.files.path(WEIGHTS)))
}

/// A run keeps the configuration it began with; asking for another one is a mistake.
fn check_resumed(
    args: &Args,
    stage: &Stage<Config>,
    trainer: &PlacementTrainer,
) -> anyhow::Result<()> {
    let begun = trainer.config();
    args.check_flags(begun.steps, begun.batch)?;
    let Some(path) = &args.common.config else {
        return Ok(());
    };
    match stages::difference(&stage.config.train, begun)? {
        Some(wrong) => Err(WrongArguments(format!("{}: {wrong}", path.display())).into()),
        None => Ok(()),
    }
}

fn config(args: &Args, table: &Table) -> anyhow::Result<Config> {
    let wrong = |error: String| WrongArguments(error.trim().replace('\n', " "));
    let mut table = table.clone();
    table.insert("model".into(), NAME.into());
    let mut config: Config =
        toml::from_str(&table.to_string()).map_err(|error| wrong(error.message().to_owned()))?;
    config.train.steps = args.steps.unwrap_or(config.train.steps);
    config.train.batch = args.batch.unwrap_or(config.train.batch);
    check_batch(config.train.batch)?;
    config.train.seed = args.common.seed.unwrap_or(config.train.seed);
    let checked = config.train.validate();
    checked.map_err(|error| wrong(error.to_string()))?;
    Ok(config)
}

fn known_keys() -> anyhow::Result<Table> {
    let mut known = Table::new();
    known.insert("model".into(), NAME.into());
    known.insert(
        "train".into(),
        Table::try_from(PlacementTrainConfig::default())?.into(),
    );
    Ok(known)
}

impl Learns for PlacementTrainer {
    fn steps(&self) -> usize {
        self.config().steps
    }

    fn steps_done(&self) -> usize {
        PlacementTrainer::steps_done(self)
    }

    fn step(&mut self) -> anyhow::Result<StepReport> {
        let step = PlacementTrainer::step(self)?;
        let loss = LossParts {
            total: step.loss,
            state: step.loss,
            ..LossParts::default()
        };
        Ok(StepReport {
            step: step.step,
            loss,
            learning_rate: step.learning_rate,
            gradient_norm: step.gradient_norm,
            tokens: step.vehicles,
            rollouts: None,
            entropy: None,
            kl: None,
            kl_weight: None,
        })
    }

    fn any(&self, value: bool) -> anyhow::Result<bool> {
        Ok(value)
    }

    fn validate(&self, scenarios: &[Scenario]) -> anyhow::Result<f64> {
        Ok(PlacementTrainer::validate(self, scenarios)?[0])
    }

    fn world(&self) -> anyhow::Result<Box<dyn WorldModel>> {
        anyhow::bail!("the placement network does not simulate")
    }

    fn save(&self, checkpoint: &Path, weights: &Path) -> anyhow::Result<()> {
        PlacementTrainer::save(self, checkpoint)?;
        Ok(self.network().save(weights)?)
    }
}
