//! Training of the network with relative attention: the same files, flags and stages.

use std::path::Path;

use anyhow::Context as _;
use gump_engine::relative::{RelativeSampling, RelativeWorld};
use gump_model::checkpoint::StorageType;
use gump_model::relative::{RelativeConfig, RelativeNetwork};
use gump_model::{Device, relative};
use gump_rollout::WorldModel;
use gump_scene::{Scenario, Seed};
use gump_train::relative::{RelativeDrives, RelativeRewards, RelativeTrainConfig, RelativeTrainer};
use gump_train::{LossParts, ProcessGroup as _, StepReport, TrainError};
use serde::Deserialize;
use serde_json::{Map, json};
use toml::Table;

use super::realism::Judge;
use super::stages::{self, Stage};
use super::{
    Args, CHECKPOINT, HeldOut, LOSSES, Learns, WEIGHTS, check_batch, learn, report_run,
    warn_of_slow_bfloat16, write,
};
use crate::cli::WrongArguments;
use crate::losses::Losses;
use crate::peers::Processes;
use crate::run::Run;

/// The weights of `--from`, if a stage goes back to them.
const INITIAL: &str = "initial-weights.safetensors";

/// The name of the architecture in `--model`.
pub(super) const NAME: &str = "relative";

/// Separates the stream of layers that are added.
const DEEPER: u64 = 11;

/// Configuration of a run of one stage.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    #[serde(rename = "model")]
    _model: String,
    #[serde(default)]
    relative: RelativeConfig,
    #[serde(default)]
    train: RelativeTrainConfig,
    #[serde(default)]
    weights: Weights,
}

/// What the weights of a run are.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct Weights {
    /// The mean of those of these stages, from 1 on, 0 being those of `--from`; without, the last one.
    mean_of: Vec<usize>,
}

/// Whether the arguments request this network: by name, or by the initial weights.
///
/// Error: weights that cannot be read.
pub(super) fn is_requested(args: &Args) -> anyhow::Result<bool> {
    match (&args.model, &args.from) {
        (Some(name), _) => Ok(name == NAME),
        (None, Some(weights)) => Ok(relative::is_relative(weights)?),
        (None, None) => Ok(false),
    }
}

/// Trains, in one stage or several.
///
/// Error: bad input, or a step that failed; what was learned before it is kept.
pub(super) fn execute(args: &Args, run: &mut Run, processes: &Processes) -> anyhow::Result<()> {
    if processes.size() > 1 {
        let wrong = format!(
            "--model relative: trains in one process, found {}",
            processes.size()
        );
        return Err(WrongArguments(wrong).into());
    }
    let stages = args.stages_of(&known_keys()?, |table| config(args, table))?;
    let mean_of = &stages[0].config.weights.mean_of;
    if mean_of.iter().any(|stage| *stage > stages.len()) {
        let wrong = format!(
            "weights.mean_of is {mean_of:?}, expected numbers of stages, 0 to {}",
            stages.len()
        );
        return Err(WrongArguments(wrong).into());
    }
    if !mean_of.is_empty() && stages[0].files.is_of_the_run() {
        let wrong = "weights.mean_of counts stages, found no [[stage]]";
        return Err(WrongArguments(wrong.into()).into());
    }
    let begins = stages.iter().filter_map(|stage| stage.from.as_ref());
    let returns = begins.chain([mean_of]).any(|stages| stages.contains(&0));
    if returns && args.from.is_none() && !args.resume {
        let wrong = "stage 0 is the weights of --from, found none";
        return Err(WrongArguments(wrong.into()).into());
    }
    let was_begun = |stage: &Stage<Config>| run.path(&stage.files.path(CHECKPOINT)).is_file();
    let mut resume = args.resume;
    let first = match args.resume {
        true => stages.iter().rposition(was_begun).unwrap_or(0),
        false => 0,
    };
    let mut network = match &args.from {
        Some(weights) => Some(from(weights, &stages[0].config, run.device())?),
        None => None,
    };
    let initial = run.path(INITIAL);
    if let Some(network) = network.as_ref().filter(|_| returns) {
        std::fs::create_dir_all(run.path(""))?;
        relative::save(network, &initial, StorageType::Half)?;
    }
    let mean = |of: &[usize], run: &Run| -> anyhow::Result<RelativeNetwork> {
        let load = |stage: &usize| {
            let path = match stage.checked_sub(1) {
                None => initial.clone(),
                Some(i) => run.path(&stages[i].files.path(WEIGHTS)),
            };
            relative::load(&path, run.device())
        };
        let networks = of.iter().map(load).collect::<Result<Vec<_>, _>>()?;
        Ok(RelativeNetwork::mean(&networks)?)
    };
    for stage in &stages[first..] {
        if let Some(of) = stage.from.as_ref().filter(|_| !resume) {
            network = Some(mean(of, run)?);
        }
        network = Some(train(args, stage, resume, network, run)?);
        resume = false;
    }
    let weights = run.path(WEIGHTS);
    // Without stages they are there.
    if !stages[0].files.is_of_the_run() {
        let last = [stages.len()];
        let of = if mean_of.is_empty() {
            &last[..]
        } else {
            mean_of
        };
        relative::save(&mean(of, run)?, &weights, StorageType::Half)?;
    }
    run.result("resumed", args.resume)?;
    run.result("weights", weights)
}

/// Loads the initial weights; layers that they lack are initialised to add nothing.
///
/// Error: [`WrongArguments`] if they differ from the configuration in anything but having fewer
/// layers.
fn from(weights: &Path, config: &Config, device: &Device) -> anyhow::Result<RelativeNetwork> {
    let network = relative::load(weights, device)?;
    let layers = config.relative.layers;
    let deeper = RelativeConfig {
        layers,
        ..network.config().clone()
    };
    if deeper != config.relative || layers < network.config().layers {
        let wrong = format!(
            "{} holds another model than the configuration",
            weights.display()
        );
        return Err(WrongArguments(wrong).into());
    }
    match layers == network.config().layers {
        true => Ok(network),
        false => Ok(network.deepened(layers, Seed(config.train.seed).fork(DEEPER))?),
    }
}

fn train(
    args: &Args,
    stage: &Stage<Config>,
    resume: bool,
    network: Option<RelativeNetwork>,
    run: &mut Run,
) -> anyhow::Result<RelativeNetwork> {
    let config = stage.config.train.clone();
    let batch = config.batch;
    warn_of_slow_bfloat16(run, config.mixed_precision);
    let (training, validation) =
        run.phase("read", |run| args.read_data(run, &stage.data, batch))?;
    let checkpoint = run.path(&stage.files.path(CHECKPOINT));
    let mut losses = Losses::default();
    let mut trainer = match (resume, network) {
        (true, _) => {
            let trainer = RelativeTrainer::resume(&checkpoint, training, run.device())?;
            check_resumed(args, stage, &trainer)?;
            let csv = run.path(&stage.files.path(LOSSES));
            losses = Losses::read(&csv, trainer.steps_done())?;
            trainer
        }
        (false, Some(network)) => RelativeTrainer::continuing(network, config, training)?,
        (false, None) => {
            let shape = stage.config.relative.clone();
            RelativeTrainer::new(shape, config, training, run.device())?
        }
    };
    run.setting("model", trainer.network().config())?;
    run.setting("train", trainer.config())?;
    run.reseed(trainer.config().seed);
    let folder = run.path(&stage.files.path(""));
    std::fs::create_dir_all(&folder)
        .with_context(|| format!("cannot create the folder {}", folder.display()))?;
    let resumed_at = trainer.steps_done();
    let seed = Seed(trainer.config().seed).fork(9);
    let held_out = HeldOut {
        scenarios: &validation,
        judge: Judge::new(&validation, args.realism_rollouts, seed),
    };
    let realism = trainer.config().realism.as_ref();
    if !resume && realism.is_some_and(|rewards| rewards.kl_bound.is_some()) {
        // A run that goes too far keeps its last checkpoint: there has to be one.
        write(run, &stage.files, &trainer, &losses)?;
    }
    let began = std::time::Instant::now();
    let trained = run.phase("train", |run| {
        learn(
            run,
            &stage.files,
            &mut trainer,
            &mut losses,
            &held_out,
            true,
        )
    });
    let error = trained.as_ref().err();
    match error.and_then(|error| error.downcast_ref::<TrainError>()) {
        // The network has just been found too far away: the last one written is nearer.
        Some(TrainError::TooFar { .. }) => losses.write(&run.path(&stage.files.path(LOSSES)))?,
        _ => run.phase("write", |run| write(run, &stage.files, &trainer, &losses))?,
    }
    trained?;
    run.result("parameters", trainer.network().parameters().count())?;
    report_run(run, &trainer, &losses, resumed_at, began)?;
    if trainer.config().realism.is_some() {
        run.result("reward_exclusions", trainer.reward_exclusions())?;
    }
    if let Some(last) = losses.last() {
        let names = ["stands", "ahead", "left", "turn"];
        let fields = names.iter().zip(&last.loss.fields);
        let by_field: Map<_, _> = fields
            .map(|(name, loss)| ((*name).to_owned(), json!(loss)))
            .collect();
        run.result("loss_per_field", by_field)?;
    }
    Ok(trainer.into_network())
}

/// A run keeps the configuration it began with; asking for another one is a mistake.
fn check_resumed(
    args: &Args,
    stage: &Stage<Config>,
    trainer: &RelativeTrainer,
) -> anyhow::Result<()> {
    let begun = trainer.config();
    args.check_flags(begun.steps, begun.batch)?;
    let Some(path) = &args.common.config else {
        return Ok(());
    };
    let wrong = if *trainer.network().config() != stage.config.relative {
        Some("another model than that of the run to resume".to_owned())
    } else {
        stages::difference(&stage.config.train, begun)?
    };
    match wrong {
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
    let checked = config.relative.validate().map_err(TrainError::from);
    checked
        .and_then(|()| config.train.validate())
        .map_err(|error| wrong(error.to_string()))?;
    Ok(config)
}

fn known_keys() -> anyhow::Result<Table> {
    let mut known = Table::new();
    known.insert("model".into(), NAME.into());
    let shape = Table::try_from(RelativeConfig::default())?;
    known.insert("relative".into(), shape.into());
    let weights = Table::from_iter([("mean_of".to_owned(), toml::Value::Array(Vec::new()))]);
    known.insert("weights".into(), weights.into());
    let realism = RelativeRewards {
        kl_target: Some(0.0),
        kl_bound: Some(0.0),
        ..RelativeRewards::default()
    };
    let train = RelativeTrainConfig {
        closed_loop: Some(RelativeDrives::default()),
        realism: Some(realism),
        ..RelativeTrainConfig::default()
    };
    known.insert("train".into(), Table::try_from(train)?.into());
    Ok(known)
}

impl Learns for RelativeTrainer {
    fn steps(&self) -> usize {
        self.config().steps
    }

    fn steps_done(&self) -> usize {
        RelativeTrainer::steps_done(self)
    }

    fn step(&mut self) -> anyhow::Result<StepReport> {
        let step = RelativeTrainer::step(self)?;
        let loss = LossParts {
            total: step.loss,
            state: step.loss,
            fields: step.fields.to_vec(),
            ..LossParts::default()
        };
        Ok(StepReport {
            step: step.step,
            loss,
            learning_rate: step.learning_rate,
            gradient_norm: step.gradient_norm,
            tokens: step.nodes,
            rollouts: step.rollouts,
            entropy: step.entropy,
            kl: step.kl,
            kl_weight: step.kl_weight,
        })
    }

    fn any(&self, value: bool) -> anyhow::Result<bool> {
        Ok(value)
    }

    fn validate(&self, scenarios: &[Scenario]) -> anyhow::Result<f64> {
        let fields = RelativeTrainer::validate(self, scenarios)?;
        Ok(fields.iter().sum())
    }

    fn world(&self) -> anyhow::Result<Box<dyn WorldModel>> {
        let world = RelativeWorld::new(self.network(), RelativeSampling::default())?;
        Ok(Box::new(world))
    }

    fn save(&self, checkpoint: &Path, weights: &Path) -> anyhow::Result<()> {
        RelativeTrainer::save(self, checkpoint)?;
        Ok(relative::save(self.network(), weights, StorageType::Half)?)
    }
}
