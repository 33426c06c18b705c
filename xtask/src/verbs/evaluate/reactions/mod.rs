//! `evaluate reactions`: which agents run into an ego that leaves its log.
//!
//! The evaluation is [`gump_eval::reactions`]; `report` sums its results up.

mod report;

use std::num::NonZeroUsize;

use gump_data::ReadOptions;
use gump_eval::benchmarks::{ScenarioSet, ScenarioSetName};
use gump_eval::decoding::DecodedWorld;
use gump_eval::reactions::{
    BENCHMARK, ReactionConfig, ReactionEvaluation, ReactionSettings, ScenarioReactions, any_scored,
};
use gump_eval::results::{Header, ResultStore};
use gump_eval::shard::Shard;
use gump_eval::worlds::WorldName;
use gump_metrics::reactions::Manoeuvre;
use serde::Serialize;

use super::columns::columns;
use crate::run::{Common, Run};
use crate::sampling::Sampling;
use crate::sharding::shard;
use crate::{benchmark, futures, shipped};
pub(crate) use report::report_merged;

/// Arguments of `evaluate reactions`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// File or directory of recorded scenarios, or LIST.toml#SPLIT of datasets/benchmarks
    #[arg(long, value_name = "PATH")]
    scenarios: ScenarioSetName,
    /// log, idm, constant-velocity or model:WEIGHTS; comma-separated
    #[arg(long, value_name = "W", default_values_t = worlds(), num_args = 1.., value_delimiter = ',')]
    world: Vec<WorldName>,
    /// log, brake, stop, speed-up, change-lane or run-light; comma-separated [default: all]
    #[arg(long, value_name = "M", num_args = 1.., value_delimiter = ',', value_parser = manoeuvre)]
    manoeuvre: Vec<&'static str>,
    /// Seconds to evaluate; the log must be as long
    #[arg(long, value_name = "S", default_value_t = 8, value_parser = clap::value_parser!(u32).range(2..=60))]
    seconds: u32,
    /// Futures of each manoeuvre; deterministic worlds have one
    #[arg(long, value_name = "N", default_value = "4")]
    futures: NonZeroUsize,
    /// Use only the first N scenarios [default: all]
    #[arg(long, value_name = "N")]
    limit: Option<NonZeroUsize>,
    /// Evaluate shard K of N; auto: the shard that a cluster's variables name. Merge shards with
    /// `evaluate merge`
    #[arg(long, value_name = "K/N|auto", default_value = "1/1", value_parser = shard)]
    shard: Shard,
    #[command(flatten)]
    #[serde(flatten)]
    sampling: Sampling,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

/// Every world that there is.
fn worlds() -> [WorldName; 4] {
    let rules = [WorldName::Log, WorldName::Idm, WorldName::ConstantVelocity];
    let [log, idm, constant] = rules;
    [log, idm, constant, shipped::world()]
}

fn manoeuvre(name: &str) -> Result<&'static str, String> {
    let known = Manoeuvre::of_name(name).map(Manoeuvre::name);
    known.ok_or_else(|| {
        let names = Manoeuvre::ALL.map(Manoeuvre::name);
        format!("expected {}", names.join(", "))
    })
}

impl Args {
    #[expect(
        clippy::result_large_err,
        reason = "the store takes the error of the library as it is, once for each scenario"
    )]
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        futures::check_number("--futures", self.futures.get())?;
        let columns = columns(&self.world, &self.sampling)?;
        let scenarios = benchmark::find(run, &self.scenarios)?;
        let settings = self.settings(run, &scenarios, &columns)?;
        let header = Header {
            benchmark: BENCHMARK.into(),
            shard: self.shard,
            settings: toml::Table::try_from(&settings)?,
        };
        let config = ReactionConfig {
            manoeuvres: self.manoeuvres().collect(),
            seconds: self.seconds,
            futures: self.futures.get(),
            seed: run.seed(),
        };
        let mut evaluation = ReactionEvaluation::new(run.device(), &columns, config);
        let mut store: ResultStore<ScenarioReactions> = ResultStore::open(run.out(), &header)?;
        run.phase("drive", |run| {
            let progress = run.progress("driving", 0, "scenarios");
            let limit = self.limit.map_or(usize::MAX, NonZeroUsize::get);
            let records = scenarios.open(ReadOptions::ALL)?.take(limit);
            Ok(store.fill(records, &progress, |index, scenario| {
                evaluation.score(index, scenario, &progress)
            })?)
        })?;
        let entries = store.close()?;
        anyhow::ensure!(
            !entries.is_empty(),
            "expected scenarios in shard {}, found none: {}",
            self.shard,
            scenarios.name
        );
        if self.shard == Shard::WHOLE {
            any_scored(&entries)?;
        }
        report::report(run, &settings, &entries)
    }

    /// The requested manoeuvres, in the order of tables.
    fn manoeuvres(&self) -> impl Iterator<Item = Manoeuvre> + '_ {
        let is_chosen =
            |one: &Manoeuvre| self.manoeuvre.is_empty() || self.manoeuvre.contains(&one.name());
        Manoeuvre::ALL.into_iter().filter(is_chosen)
    }

    fn settings(
        &self,
        run: &Run,
        scenarios: &ScenarioSet,
        columns: &[DecodedWorld],
    ) -> anyhow::Result<ReactionSettings> {
        Ok(ReactionSettings {
            scenarios: scenarios.name.clone(),
            manoeuvres: self.manoeuvres().map(|one| one.name().into()).collect(),
            seconds: self.seconds,
            futures: self.futures.get(),
            limit: self.limit.map(NonZeroUsize::get),
            sampling: serde_json::to_string(&self.sampling)?,
            seed: run.seed().0.to_string(),
            worlds: columns.iter().map(DecodedWorld::name).collect(),
        })
    }
}
