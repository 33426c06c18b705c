//! `evaluate wosac`: realism as the Waymo Sim Agents Challenge measures it.
//!
//! Scenarios stream through one at a time; each gets three scores (what is evaluated, the log
//! itself as an oracle, constant velocity), which the ledger keeps. Scenarios, their rollouts and
//! their scores are [`gump_eval::realism`]'s; `report` sums them up.

mod report;
mod worst;

use std::fs::File;
use std::io::Write as _;
use std::num::NonZeroUsize;
use std::path::PathBuf;

use gump_eval::benchmarks::{ScenarioSet, ScenarioSetName};
use gump_eval::realism::{RealismEvaluation, RolloutSource, VisitedRollouts};
use gump_eval::results::{Header, ResultStore};
use gump_eval::shard::Shard;
use gump_eval::worlds::WorldName;
use gump_rollout::BoxError;
use gump_wosac::realism::{Attribution, Config, Mode, Year};
use serde::{Deserialize, Serialize};

use super::exclusions;
use crate::choices::{YEARS, one_of};
use crate::cli::WrongArguments;
use crate::run::{Common, Run};
use crate::sampling::Sampling;
use crate::sharding::shard;
use crate::{benchmark, futures, tables};
pub(crate) use report::report_merged;
use worst::Worst;

/// Name of the benchmark in ledgers.
pub(crate) const BENCHMARK: &str = "wosac";

/// Arguments of `evaluate wosac`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// File or directory of recorded scenarios, or LIST.toml#SPLIT of datasets/benchmarks
    #[arg(long, value_name = "PATH")]
    scenarios: ScenarioSetName,
    /// log, idm, constant-velocity or model:WEIGHTS
    #[arg(long, value_name = "W")]
    world: Option<WorldName>,
    /// File or directory of ScenarioRollouts messages or of a submission's shards, or a file of
    /// arrays (.npy, .npz, .parquet)
    #[arg(long, value_name = "PATH", conflicts_with = "world")]
    rollouts: Option<PathBuf>,
    /// Year of the challenge
    #[arg(long, value_parser = one_of(YEARS), default_value_t = Year::Y2025)]
    year: Year,
    /// Rollouts of each scenario
    #[arg(long, value_name = "N", default_value = "32")]
    rollouts_per_scenario: NonZeroUsize,
    /// Evaluate shard K of N; auto: the shard that a cluster's variables name. Merge shards with
    /// `evaluate merge`
    #[arg(long, value_name = "K/N|auto", value_parser = shard)]
    shard: Option<Shard>,
    /// Also report what lowered the scores of the first row and when, in explain.jsonl,
    /// agents.parquet and the largest losses in the report, and implausible actions in
    /// conduct.parquet
    #[arg(long)]
    explain: bool,
    #[command(flatten)]
    #[serde(flatten)]
    sampling: Sampling,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

/// Everything but the scenario that the scores of a scenario depend on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Settings {
    /// The world under evaluation, or "rollouts".
    pub(crate) world: String,
    pub(crate) year: String,
    /// Number of rollouts that a world simulates per scenario.
    pub(crate) rollouts_per_scenario: usize,
    /// The set, without the folders that differ between machines.
    pub(crate) scenarios: String,
    rollouts: String,
    /// Sampling of a learned world, as JSON.
    sampling: String,
    seed: String,
}

/// Loss of score due to one agent in one scenario, as written to the files.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Explained {
    scenario: String,
    component: &'static str,
    agent: i64,
    class: &'static str,
    cost: f64,
    likelihood: f64,
    /// Seconds from the present.
    seconds: Option<f64>,
    logged: f64,
    imagined: f64,
}

/// Rollouts of every scenario that the challenge asks for.
const CHALLENGE: usize = 32;

/// Explanations shown in the report: what a person reads. Chosen by hand.
const N_EXPLAINED: usize = 20;

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        futures::check_number("--rollouts-per-scenario", self.rollouts_per_scenario.get())?;
        let shard = self.shard.unwrap_or(Shard::WHOLE);
        let scenarios = benchmark::find(run, &self.scenarios)?;
        let settings = self.settings(run, &scenarios)?;
        let header = Header {
            benchmark: BENCHMARK.into(),
            shard,
            settings: toml::Table::try_from(&settings)?,
        };
        let config = Config::of(self.year);
        let mut sources = self.sources(run)?;
        let mut store = ResultStore::open(run.out(), &header)?;
        let mut explained = Vec::new();
        let mut worst = self.explain.then(Worst::default);
        let mut fewest = usize::MAX;
        let exclusions = run.phase("evaluate", |run| {
            let mut log = match self.explain {
                true => Some(File::create(run.path("explain.jsonl"))?),
                false => None,
            };
            let mut visit = |visited: VisitedRollouts<'_>| {
                fewest = visited.found.rollouts.count().min(fewest);
                // Explanations are of the first decoding.
                let (Some(log), 0) = (&mut log, visited.source) else {
                    return Ok(());
                };
                let attributions = visited.evaluation.explain();
                if let Some(worst) = worst.as_mut().filter(|_| config.mode == Mode::SimAgents) {
                    worst.add(
                        &visited.recorded.scenario,
                        &visited.found.rollouts,
                        visited.evaluation,
                        &attributions,
                    );
                }
                let scenario = &visited.recorded.log.scenario;
                note(log, scenario, &config, &attributions, &mut explained)
            };
            let progress = run.progress("evaluating", 0, "scenarios");
            let evaluation = RealismEvaluation {
                config: &config,
                n_rollouts: self.rollouts_per_scenario.get(),
                device: run.device(),
            };
            Ok(evaluation.fill(
                &mut store,
                &scenarios.paths,
                &mut sources,
                &progress,
                &mut visit,
            )?)
        })?;
        let entries = store.close()?;
        exclusions::report(run, &exclusions, entries.len())?;
        anyhow::ensure!(
            !entries.is_empty(),
            "expected scenarios in shard {shard}, found none: {}",
            self.scenarios
        );
        report::report(run, &settings, &entries)?;
        if self.world.is_some() {
            // Scenarios of an earlier run of the same evaluation had as many.
            fewest = fewest.min(self.rollouts_per_scenario.get());
        }
        if fewest < CHALLENGE {
            let note = format!(
                "note: expected {CHALLENGE} rollouts per scenario, as the challenge asks for, \
                 found {fewest}: scores of other numbers of rollouts do not compare"
            );
            run.print(&note);
            run.result_hidden("note", note)?;
        }
        if self.explain {
            run.result("explain", &explained)?;
            tabulate(run)?;
        }
        if let Some(worst) = worst {
            worst.report(run)?;
        }
        Ok(())
    }

    /// The sources of rollouts, one per decoding; at least one.
    fn sources(&self, run: &mut Run) -> anyhow::Result<Vec<RolloutSource>> {
        match (&self.world, &self.rollouts) {
            (_, Some(path)) => {
                let index = |_: &mut Run| Ok(RolloutSource::files(path)?);
                Ok(vec![run.phase("index rollouts", index)?])
            }
            (Some(world), None) => {
                let (n, seed) = (self.rollouts_per_scenario.get(), run.seed());
                self.sampling.check(&[world])?;
                let decodings = self.sampling.decodings(world)?.into_iter();
                let sources =
                    decodings.map(|way| RolloutSource::world(world.clone(), way, n, seed));
                Ok(sources.collect())
            }
            (None, None) => {
                let wrong = "expected --world or --rollouts, found neither";
                Err(WrongArguments(wrong.into()).into())
            }
        }
    }

    fn settings(&self, run: &Run, scenarios: &ScenarioSet) -> anyhow::Result<Settings> {
        let name = |path: &PathBuf| {
            let name = path.file_name().unwrap_or_default();
            name.to_string_lossy().into_owned()
        };
        let world = self.world.as_ref().map(ToString::to_string);
        Ok(Settings {
            world: world.unwrap_or_else(|| "rollouts".into()),
            year: self.year.name().into(),
            rollouts_per_scenario: self.rollouts_per_scenario.get(),
            scenarios: scenarios.name.clone(),
            rollouts: self.rollouts.as_ref().map(name).unwrap_or_default(),
            sampling: serde_json::to_string(&self.sampling)?,
            seed: run.seed().0.to_string(),
        })
    }
}

/// Writes the attributions of a scenario's lost score, and keeps the largest of all scenarios.
fn note(
    log: &mut File,
    scenario: &str,
    config: &Config,
    attributions: &[Attribution],
    largest: &mut Vec<Explained>,
) -> Result<(), BoxError> {
    // Steps count from the first scored one: that after the present, or that 1 s before it.
    let first = match config.mode {
        Mode::SimAgents => 1.0,
        Mode::Generation => -10.0,
    };
    for attribution in attributions {
        let explained = Explained {
            scenario: scenario.into(),
            component: attribution.component.name(),
            agent: attribution.agent.0,
            class: attribution.kind.name(),
            cost: attribution.cost,
            likelihood: attribution.likelihood,
            seconds: attribution.step.map(|step| (first + step as f64) / 10.0),
            logged: attribution.logged,
            imagined: attribution.imagined,
        };
        writeln!(log, "{}", serde_json::to_string(&explained)?)?;
        largest.push(explained);
    }
    largest.sort_by(|a, b| b.cost.total_cmp(&a.cost));
    largest.truncate(N_EXPLAINED);
    Ok(())
}

/// Writes all rows of `explain.jsonl` as a table.
fn tabulate(run: &Run) -> anyhow::Result<()> {
    let noted = std::fs::read_to_string(run.path("explain.jsonl"))?;
    let rows = noted.lines().map(serde_json::from_str);
    let rows = rows.collect::<Result<Vec<_>, _>>()?;
    Ok(tables::of_rows(&rows).write(&run.path("agents.parquet"))?)
}
