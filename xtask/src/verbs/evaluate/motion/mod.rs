//! `evaluate motion`: motion prediction as the Waymo challenge measures it, of predictions in a
//! file or of a world's futures.

mod report;

use std::num::NonZeroUsize;
use std::path::PathBuf;

use gump_data::ReadOptions;
use gump_eval::EvalError;
use gump_eval::benchmarks::{ScenarioSet, ScenarioSetName};
use gump_eval::motion::PredictionSource;
use gump_eval::results::{Header, ResultStore};
use gump_eval::shard::Shard;
use gump_eval::worlds::WorldName;
use gump_wosac::motion::{MotionConfig, ShapeRules};
use serde::Serialize;

use super::exclusions;
use crate::choices::{SHAPES, one_of};
use crate::cli::WrongArguments;
use crate::run::{Common, Run};
use crate::sampling::Sampling;
use crate::sharding::shard;
use crate::{benchmark, futures};

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
    source: PredictionArgs,
    /// Predictions of the network's trajectory heads instead of futures; only of sequence networks
    #[arg(long, requires = "world", conflicts_with_all = OF_FUTURES)]
    heads: bool,
    /// Futures of the world that are condensed to the six modes of a prediction
    #[arg(long, value_name = "N", default_value = "32")]
    futures: NonZeroUsize,
    /// Definition of the path shapes that mAP is averaged over
    #[arg(long, value_parser = one_of(SHAPES), default_value_t = ShapeRules::Current)]
    shapes: ShapeRules,
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
struct PredictionArgs {
    /// A `MotionChallengeSubmission` or `ScenarioRollouts` message, or a folder of such files
    #[arg(long, value_name = "PATH")]
    rollouts: Option<PathBuf>,
    /// log, idm, constant-velocity or model:WEIGHTS
    #[arg(long, value_name = "W")]
    world: Option<WorldName>,
}

/// The challenge's settings with a definition of path shapes.
fn config(shapes: ShapeRules) -> MotionConfig {
    MotionConfig {
        shapes,
        ..MotionConfig::challenge()
    }
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        futures::check_number("--futures", self.futures.get())?;
        let config = config(self.shapes);
        let mut source = run.phase("load", |run| self.predictions(run))?;
        let scenarios = benchmark::find(run, &self.scenarios)?;
        let header = self.header(run, &scenarios, source.decoding())?;
        let mut store = ResultStore::open(run.out(), &header)?;
        let exclusions = run.phase("evaluate", |run| {
            let progress = run.progress("measuring", 0, "scenarios");
            let records = self.open(&scenarios)?;
            Ok(source.fill(&mut store, records, &config, &progress)?)
        })?;
        let entries = store.close()?;
        exclusions::report(run, &exclusions, entries.len())?;
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
