//! `evaluate wosac`: realism as the Waymo Sim Agents Challenge measures it.
//!
//! Scenarios stream through one at a time; each gets three scores (what is evaluated, the log
//! itself as an oracle, constant velocity), which the ledger keeps. Scenarios, their rollouts and
//! their scores are [`gump_eval::realism`]'s; `report` sums them up.

mod report;
mod worst;

use std::io::Write as _;
use std::num::NonZeroUsize;
use std::path::PathBuf;

use anyhow::Context as _;
use gump_eval::EvalError;
use gump_eval::benchmarks::{ScenarioSet, ScenarioSetName};
use gump_eval::realism::{
    FoundRollouts, Recorded, RolloutSource, ScenarioScores, evaluate, recordings,
};
use gump_eval::results::{Entry, Header, ResultStore};
use gump_eval::shard::Shard;
use gump_eval::worlds::WorldName;
use gump_wosac::realism::{Attribution, Config, Mode, WosacError, Year};
use serde::{Deserialize, Serialize};

use super::left_out::LeftOut;
use crate::benchmark;
use crate::cli::WrongArguments;
use crate::run::{Common, Run, interrupted};
use crate::sampling::Sampling;
use crate::sharding::shard;
use crate::tables;
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
    #[arg(long, value_enum, default_value_t = YearName::Y2025)]
    year: YearName,
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

/// [`Year`] as an argument.
#[derive(Clone, Copy, Debug, Serialize, Deserialize, clap::ValueEnum)]
pub(crate) enum YearName {
    /// As first published: leaderboard V0
    #[serde(rename = "2023-v0")]
    #[value(name = "2023-v0")]
    Y2023V0,
    /// Leaderboard V1
    #[serde(rename = "2023")]
    #[value(name = "2023")]
    Y2023,
    #[serde(rename = "2024")]
    #[value(name = "2024")]
    Y2024,
    /// Simulated agents
    #[serde(rename = "2025")]
    #[value(name = "2025")]
    Y2025,
    /// Scenario generation
    #[serde(rename = "2025-generation")]
    #[value(name = "2025-generation")]
    Y2025Generation,
}

impl YearName {
    fn year(self) -> Year {
        match self {
            Self::Y2023V0 => Year::Y2023V0,
            Self::Y2023 => Year::Y2023,
            Self::Y2024 => Year::Y2024,
            Self::Y2025 => Year::Y2025,
            Self::Y2025Generation => Year::Y2025Generation,
        }
    }
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

/// Explanations shown in the report.
const N_EXPLAINED: usize = 20;

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let shard = self.shard.unwrap_or(Shard::WHOLE);
        let scenarios = benchmark::find(run, &self.scenarios)?;
        let settings = self.settings(run, &scenarios)?;
        let header = Header {
            benchmark: BENCHMARK.into(),
            shard,
            settings: toml::Table::try_from(&settings)?,
        };
        let config = Config::of(self.year.year());
        let mut sources = self.sources(run)?;
        let options = sources[0].read_options();
        let mut ledger = ResultStore::open(run.out(), &header)?;
        let (mut explained, mut left_out) = (Vec::new(), LeftOut::default());
        let mut worst = self.explain.then(Worst::default);
        let mut fewest = usize::MAX;
        run.phase("evaluate", |run| {
            let mut log = match self.explain {
                true => Some(std::fs::File::create(run.path("explain.jsonl"))?),
                false => None,
            };
            let progress = run.progress("evaluating", 0, "scenarios");
            let kept = ledger.indices();
            let wanted = move |index| shard.holds(index) && !kept.contains(&index);
            for recorded in recordings(&scenarios.paths, options, wanted)? {
                let scored = recorded.map_err(Into::into).and_then(|recorded: Recorded| {
                    let seen = (worst.as_mut(), &mut fewest);
                    let scored = self.evaluate(run, &config, &recorded, &mut sources, seen)?;
                    Ok((recorded, scored))
                });
                let scored = left_out.sift(scored, is_of_another_length)?;
                let Some((recorded, (entry, attributions))) = scored else {
                    continue;
                };
                ledger.add(entry)?;
                if let Some(log) = &mut log {
                    note(
                        log,
                        &recorded.log.scenario,
                        &config,
                        &attributions,
                        &mut explained,
                    )?;
                }
                progress.advance(1);
                anyhow::ensure!(
                    !interrupted(),
                    "stopped by Ctrl-C; the same command resumes after scenario {}",
                    recorded.index
                );
            }
            Ok(())
        })?;
        let entries = ledger.close()?;
        left_out.report(run, entries.len())?;
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
            year: self.year.year().name().into(),
            rollouts_per_scenario: self.rollouts_per_scenario.get(),
            scenarios: scenarios.name.clone(),
            rollouts: self.rollouts.as_ref().map(name).unwrap_or_default(),
            sampling: serde_json::to_string(&self.sampling)?,
            seed: run.seed().0.to_string(),
        })
    }

    fn evaluate(
        &self,
        run: &Run,
        config: &Config,
        recorded: &Recorded,
        sources: &mut [RolloutSource],
        (mut worst, fewest): (Option<&mut Worst>, &mut usize),
    ) -> anyhow::Result<(Entry<ScenarioScores>, Vec<Attribution>)> {
        let n = self.rollouts_per_scenario.get();
        let id = &recorded.log.scenario;
        let found = sources.iter_mut().map(|source| {
            let found = rollouts(run, source, recorded, config.mode);
            found.with_context(|| format!("cannot evaluate scenario {id}"))
        });
        let found = found.collect::<anyhow::Result<Vec<_>>>()?;
        let mut attributions = None;
        let scores = evaluate(recorded, found, n, config, |found, evaluation| {
            *fewest = found.rollouts.count().min(*fewest);
            if attributions.is_none() {
                let of_first = evaluation.explain();
                if let Some(worst) = worst.take().filter(|_| config.mode == Mode::SimAgents) {
                    worst.add(&recorded.scenario, &found.rollouts, evaluation, &of_first);
                }
                attributions = Some(of_first);
            }
        })?;
        let entry = Entry {
            index: recorded.index,
            id: id.clone(),
            scores,
        };
        Ok((entry, attributions.unwrap_or_default()))
    }
}

/// Rollouts of one scenario, with a progress bar where they are simulated.
///
/// Error: as [`RolloutSource::rollouts`].
pub(crate) fn rollouts(
    run: &Run,
    source: &mut RolloutSource,
    recorded: &Recorded,
    mode: Mode,
) -> anyhow::Result<FoundRollouts> {
    let progress = run.simulating(source.frames(&recorded.scenario));
    Ok(source.rollouts(run.device(), recorded, mode, &progress)?)
}

/// Writes the attributions of a scenario's lost score, and keeps the largest of all scenarios.
fn note(
    log: &mut std::fs::File,
    scenario: &str,
    config: &Config,
    attributions: &[Attribution],
    largest: &mut Vec<Explained>,
) -> anyhow::Result<()> {
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

/// Whether the log does not have the challenge's second of past and eight seconds of future.
fn is_of_another_length(error: &anyhow::Error) -> bool {
    let found = error.downcast_ref().map(EvalError::cause);
    matches!(found, Some(EvalError::Realism(WosacError::Clock { .. })))
}
