//! `evaluate closed-loop`: how well a planner drives, as nuPlan scores it.
//!
//! Scenarios stream through, several side by side; of each the ledger keeps what every planner got
//! in every world, so that a stopped run goes on and shards add up to one run. `drive` drives,
//! `tell` makes the report.

mod drive;
mod tell;

use std::collections::BTreeMap;
use std::num::NonZeroUsize;
use std::sync::Mutex;
use std::time::Duration;

use gump_eval::benchmarks::{ScenarioSet, ScenarioSetName};
use gump_eval::planners::PlanningWorld;
use gump_eval::recordings;
use gump_eval::results::{Entry, Header, ResultStore};
use gump_eval::shard::Shard;
use gump_eval::worlds::WorldName;
use gump_nuplan::closed_loop::{DriveConfig, Tracking};
use gump_planner::closed_loop::evaluate;
use serde::{Deserialize, Serialize};

use crate::benchmark;
use crate::cli::WrongArguments;
use crate::planners::{Chosen, ChosenParser, ImaginationArgs};
use crate::run::{Common, Run, interrupted, stop_if_interrupted};
use crate::sampling::Sampling;
use crate::sharding::shard;
pub(crate) use tell::tell_merged;
pub(super) use tell::{COLUMNS, Drives, mean};

/// Name of the benchmark in ledgers.
pub(crate) const BENCHMARK: &str = "closed-loop";

/// Arguments of `evaluate closed-loop`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// A file or folder of scenarios, or LIST.toml#SPLIT of datasets/benchmarks
    #[arg(long, value_name = "PATH")]
    scenarios: ScenarioSetName,
    /// Planners to evaluate, comma-separated, one row each
    #[arg(long, value_parser = ChosenParser, value_name = "P", required = true, num_args = 1.., value_delimiter = ',')]
    planner: Vec<Chosen>,
    /// log, idm, constant-velocity or model:WEIGHTS; comma-separated, one table each
    #[arg(long, value_name = "W", default_value = "idm", num_args = 1.., value_delimiter = ',')]
    world: Vec<WorldName>,
    /// Traffic model of planners' rollouts [default: the learned world of --world, else idm]
    #[arg(long, value_name = "W")]
    imagination: Option<WorldName>,
    #[command(flatten)]
    #[serde(flatten)]
    driving: Driving,
    #[command(flatten)]
    #[serde(flatten)]
    thinking: ImaginationArgs,
    /// Maximum number of scenarios [default: all]
    #[arg(long, value_name = "N")]
    limit: Option<NonZeroUsize>,
    /// Evaluate shard K of N; auto: the shard that a cluster's variables name. Merge shards with
    /// `evaluate merge`
    #[arg(long, value_name = "K/N|auto", default_value = "1/1", value_parser = shard)]
    shard: Shard,
    /// Films of the first N scenarios
    #[arg(long, value_name = "N", default_value_t = 2)]
    films: usize,
    #[command(flatten)]
    #[serde(flatten)]
    sampling: Sampling,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

/// How a planner is let drive.
#[derive(Clone, Debug, Serialize, clap::Args)]
pub(crate) struct Driving {
    /// Seconds to drive; a recording may be shorter
    #[arg(long, value_name = "S", default_value_t = 15.0)]
    pub(crate) seconds: f64,
    /// Controller that tracks the plans
    #[arg(long, value_enum, default_value_t = TrackingName::TwoStage)]
    controller: TrackingName,
    /// Time limit per planning step; a planner that exceeds it fails [default: no limit]
    #[arg(long, value_name = "MS")]
    budget_ms: Option<f64>,
}

#[derive(Clone, Copy, Debug, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
enum TrackingName {
    /// LQR tracker with a kinematic bicycle model
    TwoStage,
    /// Perfect tracking of the plan
    Perfect,
}

impl Driving {
    /// Error: [`WrongArguments`] for a number out of its range.
    pub(crate) fn check(&self) -> anyhow::Result<()> {
        let positive = |x: f64| x > 0.0 && x.is_finite();
        // A drive is judged by its changes, so it has two steps of a tenth of a second at least.
        if !(0.2..=3600.0).contains(&self.seconds) {
            let wrong = format!(
                "--seconds: expected a number from 0.2 to 3600, found {}",
                self.seconds
            );
            return Err(WrongArguments(wrong).into());
        }
        if let Some(budget) = self.budget_ms.filter(|&budget| !positive(budget)) {
            let wrong = format!("--budget-ms: expected a number above 0, found {budget}");
            return Err(WrongArguments(wrong).into());
        }
        Ok(())
    }

    /// The same for the loop.
    pub(crate) fn config(&self) -> DriveConfig {
        DriveConfig {
            tracking: match self.controller {
                TrackingName::TwoStage => Tracking::TwoStage,
                TrackingName::Perfect => Tracking::Perfect,
            },
            seconds: self.seconds,
            keep_plans: false,
        }
    }

    /// The longest a step may take.
    pub(crate) fn budget(&self) -> Option<Duration> {
        self.budget_ms.map(|ms| Duration::from_secs_f64(ms * 1e-3))
    }
}

/// What the outcomes of a scenario depend on, beside the scenario.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Settings {
    /// The set, or the name of the file or folder.
    scenarios: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    limit: Option<usize>,
    worlds: Vec<String>,
    planners: Vec<String>,
    imagination: String,
    /// How planners are let drive, how they think and how learned worlds decode, as JSON.
    driving: String,
    thinking: String,
    sampling: String,
    seed: String,
}

/// What every planner got in every world in one scenario.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Driven {
    log_name: String,
    scenario_type: String,
    /// World by world, in each the planners in their order.
    outcomes: Vec<Outcome>,
}

/// One drive.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Outcome {
    world: String,
    planner: String,
    /// Whether the planner is one of the proposals, of which the best and the oracle are told.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    proposal: bool,
    /// Of a drive that reached its end.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    finished: Option<Finished>,
    /// Why it did not.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    error: Option<String>,
}

/// A drive that reached its end.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Finished {
    /// nuPlan's score, 0 to 1.
    score: f64,
    /// Milliseconds per plan.
    milliseconds: f64,
    /// nuPlan's metrics that apply, by their names.
    metrics: BTreeMap<String, f64>,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        self.driving.check()?;
        self.planner.iter().try_for_each(Chosen::check)?;
        let thinking = self.thinking.config()?;
        let sampling = self.sampling.resolve()?;
        let found = benchmark::find(run, &self.scenarios)?;
        let settings = self.settings(run, &found)?;
        let header = Header {
            benchmark: BENCHMARK.into(),
            shard: self.shard,
            settings: toml::Table::try_from(&settings)?,
        };
        let imagined = run.phase("load", |run| {
            let name = self.imagination();
            Ok(PlanningWorld::load_imagination(
                run.device(),
                name,
                &self.thinking.sampling(&sampling),
            )?)
        })?;
        let worlds = run.phase("load", |run| {
            let load = |world| {
                let loaded = PlanningWorld::load(run.device(), world, &sampling);
                loaded.map_err(anyhow::Error::from)
            };
            self.world
                .iter()
                .map(load)
                .collect::<anyhow::Result<Vec<_>>>()
        })?;
        let drives = drive::Drives {
            args: self,
            worlds: &worlds,
            imagination: imagined.imagination(),
            thinking: &thinking,
        };
        let ledger = ResultStore::open(run.out(), &header)?;
        let entries = run.phase("drive", |run| self.drive(run, &found, &drives, ledger))?;
        anyhow::ensure!(
            !entries.is_empty(),
            "expected scenarios in shard {}, found none: {}",
            self.shard,
            self.scenarios
        );
        tell::tell(run, &settings, &entries)
    }

    /// Drives through those scenarios of the shard that the ledger does not have.
    fn drive(
        &self,
        run: &Run,
        found: &ScenarioSet,
        drives: &drive::Drives<'_>,
        ledger: ResultStore<Driven>,
    ) -> anyhow::Result<Vec<Entry<Driven>>> {
        let kept = ledger.indices();
        let limit = self.limit.map_or(usize::MAX, NonZeroUsize::get);
        let cases = recordings::open_all(&found.paths)?.enumerate().take(limit);
        let cases = cases
            .filter(|(index, _)| self.shard.holds(*index) && !kept.contains(index))
            .take_while(|_| !interrupted());
        let progress = run.progress("driving", 0, "scenarios");
        let ledger = Mutex::new(ledger);
        let work = |index: usize, named: recordings::Named| {
            let entry = Entry {
                index,
                id: named.id.clone(),
                scores: drives.through(run, index, named)?,
            };
            // One that was stopped in its middle is not done.
            stop_if_interrupted()?;
            progress.advance(1);
            let mut ledger = ledger.lock().expect("nobody panics while holding it");
            Ok(ledger.add(entry)?)
        };
        // A planner in another process plans for one at a time.
        let one_by_one = self.planner.iter().any(Chosen::is_remote);
        let done: Vec<anyhow::Result<()>> = match one_by_one {
            true => cases.map(|(index, named)| work(index, named)).collect(),
            false => evaluate(cases, |_, (index, named)| work(index, named)),
        };
        done.into_iter().collect::<anyhow::Result<()>>()?;
        anyhow::ensure!(
            !interrupted(),
            "stopped by Ctrl-C; the same command resumes where this one stopped"
        );
        let ledger = ledger.into_inner().expect("nobody panics while holding it");
        Ok(ledger.close()?)
    }

    /// What planners imagine in.
    fn imagination(&self) -> &WorldName {
        let learned = |world: &&WorldName| matches!(world, WorldName::Model(_));
        let met = || self.world.iter().find(learned);
        let named = self.imagination.as_ref().or_else(met);
        named.unwrap_or(&WorldName::Idm)
    }

    fn settings(&self, run: &Run, found: &ScenarioSet) -> anyhow::Result<Settings> {
        Ok(Settings {
            scenarios: found.name.clone(),
            limit: self.limit.map(NonZeroUsize::get),
            worlds: self.world.iter().map(ToString::to_string).collect(),
            planners: self.planner.iter().map(ToString::to_string).collect(),
            imagination: self.imagination().to_string(),
            driving: serde_json::to_string(&self.driving)?,
            thinking: serde_json::to_string(&self.thinking)?,
            sampling: serde_json::to_string(&self.sampling)?,
            seed: run.seed().0.to_string(),
        })
    }
}
