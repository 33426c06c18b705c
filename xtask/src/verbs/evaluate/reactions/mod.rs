//! `evaluate reactions`: the ego leaves its log; who runs into it.
//!
//! Scenarios stream through one at a time; in each the ego tries every manoeuvre in every world, and
//! the ledger keeps who ran into it. Manoeuvres, whom they concern and what counts are in
//! `gump_metrics::reactions`; `cells` is the form of the ledger, `tell` makes the report.

mod cells;
mod tell;

use std::num::NonZeroUsize;

use anyhow::Context as _;
use gump_data::ReadOptions;
use gump_eval::benchmarks::{ScenarioSet, ScenarioSetName};
use gump_eval::results::{Entry, Header, ResultStore};
use gump_eval::shard::Shard;
use gump_eval::worlds::{WorldName, Worlds};
use gump_metrics::reactions::{Attempt, Manoeuvre, Reactions};
use gump_rollout::Scripted;
use gump_scene::{Scenario, Seed};
use serde::Serialize;

use super::ways::{Way, ways};
use crate::imagine::imagine_around;
use crate::run::{Common, Run, interrupted};
use crate::sampling::Sampling;
use crate::sharding::shard;
use crate::{benchmark, shipped};
use cells::{Scored, Seen, Settings, Tried};
pub(crate) use tell::tell_merged;

/// Name of the benchmark in ledgers.
pub(crate) const BENCHMARK: &str = "reactions";

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
        run.phase("drive", |run| {
            let progress = run.progress("driving", 0, "scenarios");
            let records = scenarios.open(ReadOptions::ALL)?;
            for (index, record) in records.enumerate().take(limit) {
                if !self.shard.holds(index) || ledger.has(index) {
                    continue;
                }
                let scenario = record?.scenario;
                let seed = run.seed().fork(index as u64);
                let scores = self
                    .score(run, &scenario, &ways, &mut worlds, seed)
                    .with_context(|| format!("cannot evaluate scenario {}", scenario.id))?;
                let id = scenario.id.clone();
                ledger.add(Entry { index, id, scores })?;
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
        if self.shard == Shard::WHOLE {
            tell::any_scored(&entries)?;
        }
        tell::tell(run, &settings, &entries)
    }

    /// The manoeuvres asked for, in the order of tables.
    fn manoeuvres(&self) -> impl Iterator<Item = Manoeuvre> + '_ {
        let asked =
            |one: &Manoeuvre| self.manoeuvre.is_empty() || self.manoeuvre.contains(&one.name());
        Manoeuvre::ALL.into_iter().filter(asked)
    }

    /// Every manoeuvre in every world.
    fn score(
        &self,
        run: &Run,
        scenario: &Scenario,
        ways: &[Way],
        worlds: &mut [Worlds<'_>],
        seed: Seed,
    ) -> anyhow::Result<Scored> {
        let reactions = match Reactions::new(scenario, self.seconds.into()) {
            Ok(reactions) => reactions,
            Err(unfit) => return Ok(Scored::unfit(&unfit)),
        };
        let mut tried = Vec::new();
        for manoeuvre in self.manoeuvres() {
            let attempt = match reactions.attempt(manoeuvre) {
                Ok(attempt) => attempt,
                Err(reason) => {
                    tried.push(Tried::not_scored(manoeuvre, reason));
                    continue;
                }
            };
            let mut seen = Vec::with_capacity(ways.len());
            for (way, worlds) in ways.iter().zip(&mut *worlds) {
                seen.push(self.drive(run, scenario, &attempt, way, worlds, seed)?);
            }
            tried.push(Tried::scored(manoeuvre, &attempt, seen));
        }
        Ok(Scored { unfit: None, tried })
    }

    /// One manoeuvre in one world.
    fn drive(
        &self,
        run: &Run,
        scenario: &Scenario,
        attempt: &Attempt<'_>,
        way: &Way,
        worlds: &mut Worlds<'_>,
        seed: Seed,
    ) -> anyhow::Result<Seen> {
        let world = worlds.of(scenario)?;
        let n = way.futures(self.futures.get());
        let frames = way.decoding.frames(self.seconds.into());
        let mut ego = Scripted::new(attempt.plan(), scenario.dt);
        let driver = Some(&mut ego as &mut dyn gump_rollout::Policy);
        let imagined = imagine_around(run, world, scenario, n, &frames, seed, driver)?;
        Ok(Seen::of(attempt, &imagined.rollouts))
    }

    fn settings(
        &self,
        run: &Run,
        scenarios: &ScenarioSet,
        ways: &[Way],
    ) -> anyhow::Result<Settings> {
        Ok(Settings {
            scenarios: scenarios.name.clone(),
            manoeuvres: self.manoeuvres().map(|one| one.name().into()).collect(),
            seconds: self.seconds,
            futures: self.futures.get(),
            limit: self.limit.map(NonZeroUsize::get),
            sampling: serde_json::to_string(&self.sampling)?,
            seed: run.seed().0.to_string(),
            worlds: ways.iter().map(Way::named).collect(),
        })
    }
}
