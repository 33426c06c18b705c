//! `evaluate behaviour`: what a driver would notice, counted in worlds and in the log.
//!
//! The counts are of [`gump_eval::behaviour`]; `report` sums them up.

mod report;

use std::num::NonZeroUsize;

use gump_data::ReadOptions;
use gump_eval::behaviour::{
    BENCHMARK, BehaviourConfig, BehaviourEvaluation, BehaviourSettings, ScenarioCounts,
};
use gump_eval::benchmarks::{ScenarioSet, ScenarioSetName};
use gump_eval::decoding::DecodedWorld;
use gump_eval::results::{Header, ResultStore};
use gump_eval::shard::Shard;
use gump_eval::worlds::WorldName;
use serde::Serialize;

use super::columns::columns;
use crate::run::{Common, Run};
use crate::sampling::Sampling;
use crate::sharding::shard;
use crate::{benchmark, futures};
pub(crate) use report::report_merged;

/// The possible horizons, seconds: that of the challenges, half a minute and a minute.
const HORIZONS: [u32; 3] = [8, 30, 60];

/// Arguments of `evaluate behaviour`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// File or directory of recorded scenarios, or LIST.toml#SPLIT of datasets/benchmarks
    #[arg(long, value_name = "PATH")]
    scenarios: ScenarioSetName,
    /// log, idm, constant-velocity or model:WEIGHTS; comma-separated
    #[arg(long, value_name = "W", required = true, num_args = 1.., value_delimiter = ',')]
    world: Vec<WorldName>,
    /// Seconds to evaluate: 8, 30 or 60; the log only as far as it goes
    #[arg(long, value_name = "S", default_value = "8", value_parser = horizon)]
    seconds: u32,
    /// Futures of each scenario; deterministic worlds have one
    #[arg(long, value_name = "N", default_value = "8")]
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

fn horizon(text: &str) -> Result<u32, String> {
    let known = text.parse().ok().filter(|s| HORIZONS.contains(s));
    known.ok_or_else(|| "expected 8, 30 or 60".into())
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
        let config = BehaviourConfig {
            seconds: self.seconds,
            futures: self.futures.get(),
            spawning: self.sampling.draw.has_life(),
            seed: run.seed(),
        };
        let mut evaluation = BehaviourEvaluation::new(run.device(), &columns, config);
        let mut store: ResultStore<ScenarioCounts> = ResultStore::open(run.out(), &header)?;
        run.phase("count", |run| {
            let progress = run.progress("counting", 0, "scenarios");
            let limit = self.limit.map_or(usize::MAX, NonZeroUsize::get);
            let records = scenarios.open(ReadOptions::ALL)?.take(limit);
            Ok(store.fill(records, &progress, |index, scenario| {
                evaluation.count(index, scenario, &progress)
            })?)
        })?;
        let entries = store.close()?;
        anyhow::ensure!(
            !entries.is_empty(),
            "expected scenarios in shard {}, found none: {}",
            self.shard,
            scenarios.name
        );
        report::report(run, &settings, &entries)
    }

    fn settings(
        &self,
        run: &Run,
        scenarios: &ScenarioSet,
        columns: &[DecodedWorld],
    ) -> anyhow::Result<BehaviourSettings> {
        Ok(BehaviourSettings {
            scenarios: scenarios.name.clone(),
            seconds: self.seconds,
            futures: self.futures.get(),
            limit: self.limit.map(NonZeroUsize::get),
            sampling: serde_json::to_string(&self.sampling)?,
            seed: run.seed().0.to_string(),
            worlds: columns.iter().map(DecodedWorld::name).collect(),
        })
    }
}
