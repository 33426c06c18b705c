//! `evaluate behaviour`: what a driver would notice, counted in worlds and in the log.
//!
//! Scenarios stream through one at a time; of each the ledger keeps what the log shows and what the
//! futures of every world show, as counts. What is counted and per what is in
//! `gump_metrics::behaviour`; `tell` makes the report.

mod tell;

use std::num::NonZeroUsize;

use anyhow::Context as _;
use gump_data::ReadOptions;
use gump_eval::benchmarks::{ScenarioSet, ScenarioSetName};
use gump_eval::results::{Entry, Header, ResultStore};
use gump_eval::shard::Shard;
use gump_eval::worlds::{WorldName, Worlds};
use gump_metrics::behaviour::{Behaviour, Class, Count, Key, Measure, Tally};
use serde::{Deserialize, Serialize};

use super::ways::{Named, Way, ways};
use crate::benchmark;
use crate::imagine::imagine;
use crate::run::{Common, Run, interrupted};
use crate::sampling::Sampling;
use crate::sharding::shard;
pub(crate) use tell::tell_merged;

/// Name of the benchmark in ledgers.
pub(crate) const BENCHMARK: &str = "behaviour";

/// How far can be looked, seconds.
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

/// What the counts of a scenario depend on, beside the scenario.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Settings {
    /// The set, or the name of the file or folder.
    scenarios: String,
    seconds: u32,
    futures: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    limit: Option<usize>,
    /// How learned worlds decode, as JSON.
    sampling: String,
    seed: String,
    worlds: Vec<Named>,
}

/// What one scenario shows.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Counted {
    log: Cells,
    /// In the order of the settings.
    worlds: Vec<Cells>,
}

/// A tally as it is written.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Cells {
    #[serde(default)]
    cells: Vec<Cell>,
}

/// One line of a tally.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Cell {
    measure: String,
    class: String,
    seconds: u32,
    events: f64,
    of: f64,
}

impl Cells {
    fn of(tally: &Tally) -> Self {
        let cell = |(key, count): (&Key, &Count)| Cell {
            measure: key.measure.name().into(),
            class: key.class.name().into(),
            seconds: key.seconds,
            events: count.events,
            of: count.of,
        };
        let cells = tally.0.iter().map(cell).collect();
        Self { cells }
    }

    /// Error: a measure or a class that is not known.
    fn tally(&self) -> anyhow::Result<Tally> {
        let mut tally = Tally::default();
        for cell in &self.cells {
            let measure = Measure::of_name(&cell.measure);
            let class = Class::of_name(&cell.class);
            let (measure, class) = measure.zip(class).with_context(|| {
                format!(
                    "expected a known measure and class in the ledger, found {} of {}",
                    cell.measure, cell.class
                )
            })?;
            let key = Key {
                measure,
                class,
                seconds: cell.seconds,
            };
            let (events, of) = (cell.events, cell.of);
            tally.add(key, Count { events, of });
        }
        Ok(tally)
    }
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let ways = ways(&self.world, &self.sampling)?;
        let scenarios = benchmark::find(run, &self.scenarios)?;
        let settings = self.settings(run, &scenarios, &ways)?;
        let header = Header {
            benchmark: BENCHMARK.into(),
            shard: self.shard,
            settings: toml::Table::try_from(&settings)?,
        };
        let mut worlds: Vec<Worlds<'_>> = ways
            .iter()
            .map(|way| Worlds::new(run.device(), &way.world, way.decoding.sampling.clone()))
            .collect();
        let mut ledger = ResultStore::open(run.out(), &header)?;
        let limit = self.limit.map_or(usize::MAX, NonZeroUsize::get);
        run.phase("count", |run| {
            let progress = run.progress("counting", 0, "scenarios");
            let records = scenarios.open(ReadOptions::ALL)?;
            for (index, record) in records.enumerate().take(limit) {
                if !self.shard.holds(index) || ledger.has(index) {
                    continue;
                }
                let scenario = record?.scenario;
                let behaviour = self.behaviour(&scenario);
                let counted = ways.iter().zip(&mut worlds).map(|(way, worlds)| {
                    let world = worlds.of(&scenario)?;
                    let n = way.futures(self.futures.get());
                    let frames = way.decoding.frames(self.seconds.into());
                    let seed = run.seed().fork(index as u64);
                    let imagined = imagine(run, world, &scenario, n, &frames, seed)?;
                    Ok(Cells::of(&behaviour.tally(&imagined.rollouts)))
                });
                let counted = counted.collect::<anyhow::Result<Vec<Cells>>>();
                let scores = Counted {
                    log: Cells::of(&behaviour.log().tally),
                    worlds: counted
                        .with_context(|| format!("cannot evaluate scenario {}", scenario.id))?,
                };
                ledger.add(Entry {
                    index,
                    id: scenario.id.clone(),
                    scores,
                })?;
                progress.advance(1);
                anyhow::ensure!(
                    !interrupted(),
                    "stopped by Ctrl-C; the same command resumes after scenario {index}"
                );
            }
            Ok(())
        })?;
        let entries = ledger.close()?;
        anyhow::ensure!(
            !entries.is_empty(),
            "expected scenarios in shard {}, found none: {}",
            self.shard,
            scenarios.name
        );
        tell::tell(run, &settings, &entries)
    }

    fn behaviour<'a>(&self, scenario: &'a gump_scene::Scenario) -> Behaviour<'a> {
        let behaviour = Behaviour::new(scenario, self.seconds);
        match self.sampling.draw.has_life() {
            true => behaviour.with_newcomers(),
            false => behaviour,
        }
    }

    fn settings(
        &self,
        run: &Run,
        scenarios: &ScenarioSet,
        ways: &[Way],
    ) -> anyhow::Result<Settings> {
        Ok(Settings {
            scenarios: scenarios.name.clone(),
            seconds: self.seconds,
            futures: self.futures.get(),
            limit: self.limit.map(NonZeroUsize::get),
            sampling: serde_json::to_string(&self.sampling)?,
            seed: run.seed().0.to_string(),
            worlds: ways.iter().map(Way::named).collect(),
        })
    }
}
