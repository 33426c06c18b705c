//! `evaluate motion`: motion prediction as the Waymo challenge measures it, of predictions in a
//! file or of a world's futures.

mod report;
mod scores;

use std::collections::BTreeSet;
use std::num::NonZeroUsize;
use std::path::PathBuf;

use gump_data::ReadOptions;
use gump_eval::EvalError;
use gump_eval::benchmarks::{ScenarioSet, ScenarioSetName};
use gump_eval::motion::PredictionSource;
use gump_eval::results::{Entry, Header, ResultStore};
use gump_eval::shard::Shard;
use gump_eval::worlds::WorldName;
use gump_wosac::motion::{
    MotionConfig, MotionProblem, PredictionScore, ShapeRules, evaluate_predictions,
};
use serde::{Deserialize, Serialize};

use self::scores::Scores;
use super::left_out::LeftOut;
use crate::benchmark;
use crate::cli::WrongArguments;
use crate::run::{self, Common, Run};
use crate::sampling::Sampling;
use crate::sharding::shard;

pub(crate) use self::report::report_merged;

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
    scenarios: ScenarioSetName,
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

/// Source of the predictions.
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

/// Definition of path shapes.
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
        let mut source = run.phase("load", |run| self.predictions(run))?;
        let scenarios = benchmark::find(run, &self.scenarios)?;
        let header = self.header(run, &scenarios, source.decoding())?;
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
            let absent = source.drop_absent(&mut scenario);
            let predictions = run.phase("predict", |run| {
                let frames = source.frames(&scenario, &config);
                let progress = run.simulating(frames);
                Ok(source.predict(&scenario, index, &config, &progress)?)
            });
            let scores = predictions.and_then(|predicted| {
                run.phase("score", |_| {
                    let predictions = &predicted.predictions;
                    let scores = evaluate_predictions(&scenario, predictions, &config);
                    Ok((scores.map_err(EvalError::from)?, predicted.digest))
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
        source.check_all_used(&ids)?;
        let entries = ledger.close()?;
        left_out.report(run, entries.len())?;
        report::report(run, &scenarios.name, &entries, &config, source.decoding())
    }

    fn open(&self, scenarios: &ScenarioSet) -> anyhow::Result<gump_data::Reader> {
        // Only worlds look at the map.
        let options = match self.source.world {
            Some(_) => ReadOptions::ALL,
            None => ReadOptions::STATED,
        };
        Ok(scenarios.open(options)?)
    }

    fn predictions(&self, run: &Run) -> anyhow::Result<PredictionSource<'_>> {
        Ok(match (&self.source.rollouts, &self.source.world) {
            (Some(path), _) => PredictionSource::files(path)?,
            (None, Some(WorldName::Model(path))) if self.heads => {
                match PredictionSource::heads(path, run.device()) {
                    Err(EvalError::Argument(why)) => {
                        return Err(WrongArguments(format!("--heads: {why}")).into());
                    }
                    heads => heads?,
                }
            }
            (None, Some(name)) if self.heads => {
                let wrong = format!("--heads: expected --world model:WEIGHTS, found {name}");
                return Err(WrongArguments(wrong).into());
            }
            (None, Some(name)) => {
                let (decoding, n) = (self.sampling.decoding(name)?, self.futures.get());
                PredictionSource::world(run.device(), name, decoding, n, run.seed())
            }
            (None, None) => anyhow::bail!("expected --rollouts or --world"),
        })
    }

    /// Everything that the scores of a scenario depend on.
    fn header(&self, run: &Run, scenarios: &ScenarioSet, decoding: &str) -> anyhow::Result<Header> {
        let mut settings = toml::Table::new();
        let mut set = |key: &str, value: toml::Value| settings.insert(key.into(), value);
        set("scenarios", scenarios.name.clone().into());
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
    let Some(EvalError::Motion(error)) = error.downcast_ref().map(EvalError::cause) else {
        return false;
    };
    matches!(
        error.problem,
        MotionProblem::ShortLog { .. } | MotionProblem::TimeStep { .. }
    )
}
