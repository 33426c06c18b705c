//! `evaluate closed-loop`: how well a planner drives, as nuPlan scores it.
//!
//! The drives are of [`gump_eval::closed_loop`]; `report` sums them up, and `planners` are those of
//! the command line.

mod planners;
mod report;

use std::num::NonZeroUsize;
use std::time::Duration;

use gump_eval::benchmarks::{ScenarioSet, ScenarioSetName};
use gump_eval::closed_loop::{
    BENCHMARK, ClosedLoopEvaluation, ClosedLoopSettings, ScenarioDrives, VisitedDrive, checksums,
};
use gump_eval::planners::PlanningWorld;
use gump_eval::recordings;
use gump_eval::results::{Header, ResultStore};
use gump_eval::shard::Shard;
use gump_eval::worlds::WorldName;
use gump_nuplan::closed_loop::{DriveConfig, Tracking};
use gump_rollout::BoxError;
use serde::Serialize;

use self::planners::{Remote, evaluated};
use crate::choices::{CONTROLLERS, one_of};
use crate::cli::WrongArguments;
use crate::planners::{Chosen, ChosenParser, ImaginationArgs};
use crate::run::{Common, Run};
use crate::sampling::Sampling;
use crate::sharding::shard;
use crate::{benchmark, films};
pub(crate) use report::report_merged;
pub(super) use report::{COLUMNS, PlannerDrives, mean};

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

/// Settings of a planner's drives.
#[derive(Clone, Debug, Serialize, clap::Args)]
pub(crate) struct Driving {
    /// Seconds to drive; a recording may be shorter
    #[arg(long, value_name = "S", default_value_t = 15.0)]
    pub(crate) seconds: f64,
    /// Controller that tracks the plans
    #[arg(long, value_parser = one_of(CONTROLLERS), default_value_t = Tracking::TwoStage)]
    controller: Tracking,
    /// Time limit per planning step; a planner that exceeds it fails [default: no limit]
    #[arg(long, value_name = "MS")]
    budget_ms: Option<f64>,
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

    /// Converts the arguments to a [`DriveConfig`].
    pub(crate) fn config(&self) -> DriveConfig {
        DriveConfig {
            tracking: self.controller,
            seconds: self.seconds,
            keep_plans: false,
        }
    }

    /// The longest a step may take.
    pub(crate) fn budget(&self) -> Option<Duration> {
        self.budget_ms.map(|ms| Duration::from_secs_f64(ms * 1e-3))
    }
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        self.driving.check()?;
        if self.imagination == Some(WorldName::Log) {
            let wrong =
                "--imagination: expected idm, constant-velocity or model:WEIGHTS, found log";
            return Err(WrongArguments(wrong.into()).into());
        }
        self.planner.iter().try_for_each(Chosen::check)?;
        let thinking = self.thinking.config()?;
        let worlds = self.world.iter().chain([self.imagination()]);
        let sampling = self.sampling.resolve_for(&worlds.collect::<Vec<_>>())?;
        let found = benchmark::find(run, &self.scenarios)?;
        let imagined = run.phase("load", |run| {
            let name = self.imagination();
            Ok(PlanningWorld::load_imagination(
                run.device(),
                name,
                &self.thinking.sampling(&sampling),
            )?)
        })?;
        let worlds = run.phase("load", |run| {
            let load = |world: &WorldName| {
                let loaded = PlanningWorld::load(run.device(), world, &sampling)?;
                Ok((world.clone(), loaded))
            };
            let worlds = self.world.iter().map(load);
            worlds.collect::<anyhow::Result<Vec<_>>>()
        })?;
        let ids = run.phase("find", |_| Ok(recordings::ids(&found.paths, self.limit())?))?;
        let settings = self.settings(run, &found, &ids)?;
        let header = Header {
            benchmark: BENCHMARK.into(),
            shard: self.shard,
            settings: toml::Table::try_from(&settings)?,
        };
        let remotes = Remote::of(&self.planner, self.driving.budget());
        let evaluation = ClosedLoopEvaluation {
            planners: &evaluated(&self.planner, &remotes),
            worlds: &worlds,
            imagination: imagined.imagination(),
            config: &thinking,
            drive: self.driving.config(),
            budget: self.driving.budget(),
            seed: run.seed(),
        };
        let store: ResultStore<ScenarioDrives> = ResultStore::open(run.out(), &header)?;
        let entries = run.phase("drive", |run| {
            let cases = recordings::open_all(&found.paths)?.take(self.limit());
            let is_left = |index: &usize| store.is_wanted(*index);
            let left = (0..ids.len()).filter(is_left).count();
            let progress = run.progress("driving", left as u64, "scenarios");
            let visit = |drive: VisitedDrive<'_>| match drive.index < self.films {
                true => film(run, &drive),
                false => Ok(()),
            };
            Ok(evaluation.fill(store, cases, &progress, &visit)?)
        })?;
        anyhow::ensure!(
            !entries.is_empty(),
            "expected scenarios in shard {}, found none: {}",
            self.shard,
            self.scenarios
        );
        report::report(run, &settings, &entries)
    }

    /// The world that planners roll out.
    fn imagination(&self) -> &WorldName {
        let learned = |world: &&WorldName| matches!(world, WorldName::Model(_));
        let met = || self.world.iter().find(learned);
        let named = self.imagination.as_ref().or_else(met);
        named.unwrap_or(&WorldName::Idm)
    }

    fn limit(&self) -> usize {
        self.limit.map_or(usize::MAX, NonZeroUsize::get)
    }

    fn settings(
        &self,
        run: &Run,
        found: &ScenarioSet,
        ids: &[String],
    ) -> anyhow::Result<ClosedLoopSettings> {
        let worlds = self.world.iter().chain([self.imagination()]);
        Ok(ClosedLoopSettings {
            scenarios: found.name.clone(),
            limit: self.limit.map(NonZeroUsize::get),
            worlds: self.world.iter().map(ToString::to_string).collect(),
            planners: self.planner.iter().map(ToString::to_string).collect(),
            imagination: self.imagination().to_string(),
            driving: serde_json::to_string(&self.driving)?,
            imagining: serde_json::to_string(&self.thinking)?,
            sampling: serde_json::to_string(&self.sampling)?,
            seed: run.seed().0.to_string(),
            checksums: checksums(ids, worlds)?,
        })
    }
}

/// Writes a film of a drive beside the log.
fn film(run: &Run, drive: &VisitedDrive<'_>) -> Result<(), BoxError> {
    let (planner, world) = (drive.planner, drive.world);
    let folder = run.path("films");
    std::fs::create_dir_all(&folder)?;
    let label = films::label(planner, world);
    let film = films::film(
        drive.case.recording.scenario(),
        &[(label.as_str(), &drive.scored.driven.rollout)],
    )?;
    let name = format!(
        "{}-{}-{}.gif",
        drive.index,
        file_name(planner),
        films::short(world)
    );
    Ok(film.save(&folder.join(name))?)
}

/// A name without what file systems dislike.
fn file_name(name: &str) -> String {
    let plain = |c: char| if c.is_ascii_alphanumeric() { c } else { '-' };
    name.chars().map(plain).collect()
}
