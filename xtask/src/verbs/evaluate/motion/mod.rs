//! `evaluate motion`: motion prediction as the Waymo challenge measures it, of predictions in a
//! file or of a world's futures.

mod scores;
mod source;
mod tell;

use std::collections::BTreeSet;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};

use gump_data::ReadOptions;
use gump_engine::{SamplingConfig, TransformerWorld};
use gump_eval::results::{Entry, Header, ResultStore};
use gump_eval::shard::Shard;
use gump_eval::worlds::{WorldName, Worlds};
use gump_model::{Device, checkpoint, relative};
use gump_scene::{AgentId, PredictedMode, Prediction, Scenario};
use gump_wosac::motion::{
    MotionConfig, MotionError, MotionProblem, PredictionScore, ShapeRules, evaluate_predictions,
    forecast,
};
use serde::{Deserialize, Serialize};

use self::scores::Scores;
use self::source::Predictions;
use super::left_out::LeftOut;
use crate::benchmark::{Found, Scenes};
use crate::cli::WrongArguments;
use crate::decoding::Decoding;
use crate::futures;
use crate::imagine::imagine;
use crate::run::{self, Common, Run};
use crate::sampling::Sampling;
use crate::sharding::shard;

pub(crate) use self::tell::tell_merged;

/// Name of the benchmark in ledgers.
pub(crate) const NAME: &str = "motion";

/// Flags about futures, of which the trajectory heads have none.
const OF_FUTURES: [&str; 15] = [
    "futures",
    "mode",
    "cache",
    "precision",
    "temperature",
    "top_k",
    "top_p",
    "decay",
    "redraws",
    "no_limits",
    "raw",
    "paper",
    "ruled",
    "life",
    "lights",
];

/// Arguments of `evaluate motion`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// Scenarios with their futures: a file, a folder, or LIST.toml#SPLIT of datasets/benchmarks
    #[arg(long, value_name = "PATH")]
    scenarios: Scenes,
    #[command(flatten)]
    #[serde(flatten)]
    source: Source,
    /// Predictions of the network's trajectory heads instead of futures; only of sequence networks
    #[arg(long, requires = "world", conflicts_with_all = OF_FUTURES)]
    heads: bool,
    /// Futures of the world that are condensed to the six modes of a prediction
    #[arg(long, value_name = "N", default_value = "32")]
    futures: NonZeroUsize,
    /// Definition of the path shapes that mAP is averaged over
    #[arg(long, value_enum, default_value_t = Shapes::Current)]
    shapes: Shapes,
    /// Only every N-th scenario from the K-th; see `evaluate merge`
    #[arg(long, value_name = "K/N|auto", default_value = "1/1", value_parser = shard)]
    shard: Shard,
    #[command(flatten)]
    #[serde(flatten)]
    sampling: Sampling,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

/// What is measured.
#[derive(Debug, Serialize, clap::Args)]
#[group(required = true, multiple = false)]
struct Source {
    /// A `MotionChallengeSubmission` or `ScenarioRollouts` message, or a folder of such files
    #[arg(long, value_name = "PATH")]
    rollouts: Option<PathBuf>,
    /// log, idm, constant-velocity or model:WEIGHTS
    #[arg(long, value_name = "W")]
    world: Option<WorldName>,
}

/// Which definition of path shapes.
#[derive(Clone, Copy, Debug, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
enum Shapes {
    /// Since March 2024.
    Current,
    /// Leaderboards of 2021 to 2023.
    #[value(name = "until-2023")]
    #[serde(rename = "until-2023")]
    Until2023,
}

impl Shapes {
    fn config(self) -> MotionConfig {
        MotionConfig {
            shapes: match self {
                Self::Current => ShapeRules::Current,
                Self::Until2023 => ShapeRules::Until2023,
            },
            ..MotionConfig::challenge()
        }
    }
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let config = self.shapes.config();
        let mut forecaster = run.phase("load", |run| self.forecaster(run.device()))?;
        let scenarios = run.phase("find", |_| self.scenarios.find())?;
        let header = self.header(run, &scenarios, forecaster.decoding())?;
        let mut ledger = ResultStore::open(run.out(), &header)?;
        let (mut ids, mut left_out) = (BTreeSet::new(), LeftOut::default());
        let progress = run.progress("measuring", 0, "scenarios");
        let mut records = self.open(&scenarios)?.enumerate();
        while let Some((index, record)) = run.phase("read", |_| Ok(records.next()))? {
            run::stop_if_interrupted()?;
            let mut scenario = record?.scenario;
            ids.insert(scenario.id.clone());
            if !self.shard.holds(index) || ledger.has(index) {
                continue;
            }
            let absent = forecaster.drop_absent(&mut scenario);
            let predictions = run.phase("predict", |run| {
                forecaster.predict(run, &scenario, &config, index)
            });
            let scores = predictions.and_then(|(predictions, digest)| {
                run.phase("score", |_| {
                    let scores = evaluate_predictions(&scenario, &predictions, &config)?;
                    Ok((scores, digest))
                })
            });
            let scores: Option<(Vec<PredictionScore>, Option<String>)> =
                left_out.sift(scores, is_of_another_length)?;
            let Some((scores, digest)) = scores else {
                continue;
            };
            let scores = Scores::new(&scores, absent, digest);
            let id = scenario.id;
            ledger.add(Entry { index, id, scores })?;
            progress.advance(1);
        }
        drop(progress);
        forecaster.check_all_used(&ids)?;
        let entries = ledger.close()?;
        left_out.tell(run, entries.len())?;
        tell::tell(
            run,
            &scenarios.set,
            &entries,
            &config,
            forecaster.decoding(),
        )
    }

    fn open(&self, scenarios: &Found) -> anyhow::Result<gump_data::Reader> {
        // Only worlds look at the map.
        let options = match self.source.world {
            Some(_) => ReadOptions::ALL,
            None => ReadOptions::STATED,
        };
        Ok(scenarios.open(options)?)
    }

    fn forecaster(&self, device: &Device) -> anyhow::Result<Forecaster<'_>> {
        Ok(match (&self.source.rollouts, &self.source.world) {
            (Some(path), _) => Forecaster::File(Predictions::read(path)?, path),
            (None, Some(name)) if self.heads => {
                let WorldName::Model(path) = name else {
                    let wrong = format!("--heads: expected --world model:WEIGHTS, found {name}");
                    return Err(WrongArguments(wrong).into());
                };
                Forecaster::heads(path, device)?
            }
            (None, Some(name)) => {
                let decoding = self.sampling.decoding(name)?;
                Forecaster::World {
                    worlds: Box::new(Worlds::new(device, name, decoding.sampling.clone())),
                    n_futures: self.futures.get(),
                    decoding,
                }
            }
            (None, None) => anyhow::bail!("expected --rollouts or --world"),
        })
    }

    /// Everything that the scores of a scenario depend on.
    fn header(&self, run: &Run, scenarios: &Found, decoding: &str) -> anyhow::Result<Header> {
        let mut settings = toml::Table::new();
        let mut set = |key: &str, value: toml::Value| settings.insert(key.into(), value);
        set("scenarios", scenarios.set.clone().into());
        set("shapes", toml::Value::try_from(self.shapes)?);
        set("decoding", decoding.into());
        set("seed", i64::try_from(run.seed().0)?.into());
        if let Some(path) = &self.source.rollouts {
            set("rollouts", path.display().to_string().into());
        }
        if let Some(world) = &self.source.world {
            set("world", world.to_string().into());
            set("heads", self.heads.into());
            set("futures", i64::try_from(self.futures.get())?.into());
            set("sampling", toml::Value::try_from(&self.sampling)?);
        }
        Ok(Header {
            benchmark: NAME.into(),
            shard: self.shard,
            settings,
        })
    }
}

/// True if the recording does not reach as far as the benchmark looks, or not in its steps.
fn is_of_another_length(error: &anyhow::Error) -> bool {
    let found = error.downcast_ref::<MotionError>();
    matches!(
        found.map(|error| &error.problem),
        Some(MotionProblem::ShortLog { .. } | MotionProblem::TimeStep { .. })
    )
}

/// Where predictions come from.
enum Forecaster<'a> {
    /// A file.
    File(Predictions, &'a Path),
    /// The trajectory heads of a network.
    Heads(Box<TransformerWorld>),
    /// Futures of a world.
    World {
        worlds: Box<Worlds<'a>>,
        n_futures: usize,
        decoding: Decoding,
    },
}

impl Forecaster<'_> {
    /// Error: [`WrongArguments`] for a network without heads, weights that cannot be read.
    fn heads(path: &Path, device: &Device) -> anyhow::Result<Self> {
        let without = |what: &str| {
            let wrong = format!(
                "--heads: expected a sequence network with trajectory heads, found {what}: {}",
                path.display()
            );
            WrongArguments(wrong)
        };
        if relative::is_relative(path)? {
            return Err(without("a relative network").into());
        }
        let network = checkpoint::load(path, device)?;
        if network.trajectory_heads.is_empty() {
            return Err(without("one without").into());
        }
        let world = TransformerWorld::plain(network, SamplingConfig::default());
        Ok(Self::Heads(Box::new(world)))
    }

    /// Leaves out targets that nobody can imagine because they are absent now; how many.
    ///
    /// A file is held to all targets, as the challenge holds it.
    fn drop_absent(&self, scenario: &mut Scenario) -> usize {
        let before = scenario.targets.len();
        if !matches!(self, Self::File(..)) {
            let now = &scenario.log[scenario.now];
            scenario.targets.retain(|&id| now.agent(id).is_some());
        }
        before - scenario.targets.len()
    }

    /// How its futures are made; a file does not tell.
    fn decoding(&self) -> &'static str {
        match self {
            Self::File(..) | Self::Heads(_) => Decoding::NONE,
            Self::World { decoding, .. } => decoding.name,
        }
    }

    /// Predictions, and the digest of what they come from: futures, or the heads' predictions.
    fn predict(
        &mut self,
        run: &Run,
        scenario: &Scenario,
        config: &MotionConfig,
        index: usize,
    ) -> anyhow::Result<(Vec<Prediction>, Option<String>)> {
        match self {
            Self::File(predictions, path) => Ok((predictions.of(scenario, config, path)?, None)),
            Self::Heads(world) => {
                let predictions = by_heads(world, scenario, config)?;
                let digest = futures::digest_of_predictions(&predictions);
                Ok((predictions, Some(digest)))
            }
            Self::World { .. } if scenario.targets.is_empty() => Ok((Vec::new(), None)),
            Self::World {
                worlds,
                n_futures,
                decoding,
            } => {
                let frames = decoding.frames(config.n_steps as f64 * config.step_seconds);
                let seed = run.seed().fork(index as u64);
                let world = worlds.of(scenario)?;
                let imagined = imagine(run, world, scenario, *n_futures, &frames, seed)?;
                let digest = futures::digest(&imagined.rollouts);
                let predictions = forecast(scenario, &imagined.rollouts, config)?;
                Ok((predictions, Some(digest)))
            }
        }
    }

    /// Refuses predictions of scenarios that are not there.
    fn check_all_used(&self, ids: &BTreeSet<String>) -> anyhow::Result<()> {
        match self {
            Self::File(predictions, path) => predictions.check_all_known(ids, path),
            Self::Heads(_) | Self::World { .. } => Ok(()),
        }
    }
}

/// The heads' predictions of every target. Targets outside the network's window keep their velocity.
fn by_heads(
    world: &TransformerWorld,
    scenario: &Scenario,
    config: &MotionConfig,
) -> anyhow::Result<Vec<Prediction>> {
    // The route is derived from where the ego drives later.
    let present = scenario.present().unguided();
    let predicted = world.predict_trajectories(present)?;
    let of = |&agent: &AgentId| {
        let own = predicted.iter().find(|found| found.agent == agent);
        let modes = match own {
            Some(own) => own
                .modes
                .iter()
                .map(|mode| PredictedMode {
                    confidence: mode.probability,
                    paths: vec![
                        mode.positions
                            .iter()
                            .take(config.n_steps)
                            .copied()
                            .collect(),
                    ],
                })
                .collect(),
            None => {
                let now = present.now().agent(agent).map(|agent| agent.state);
                let state = now.unwrap_or_default();
                let place = |step: usize| {
                    let seconds = (step + 1) as f64 * config.step_seconds;
                    state.pose.position + state.velocity * seconds
                };
                vec![PredictedMode {
                    confidence: 1.0,
                    paths: vec![(0..config.n_steps).map(place).collect()],
                }]
            }
        };
        Prediction {
            agents: vec![agent],
            modes,
        }
    };
    Ok(scenario.targets.iter().map(of).collect())
}
