//! `evaluate open-loop`: how near a planner's plans are to what was driven, as nuPlan scores it.

use std::num::NonZeroUsize;

use gump_eval::EvalError;
use gump_eval::benchmarks::{ScenarioSet, ScenarioSetName};
use gump_eval::open_loop::{OpenLoopOutcome, numbers, plan};
use gump_eval::planners::{PlannerName, PlanningWorld};
use gump_eval::recordings;
use gump_eval::worlds::WorldName;
use gump_metrics::interval;
use serde::Serialize;
use serde_json::{Value, json};

use super::closed_loop::mean;
use super::warnings::{self, failed_drives, few_scenarios, missing_intervals};
use crate::cli::WrongArguments;
use crate::planners::{ImaginationArgs, planner};
use crate::run::{Common, Run};
use crate::sampling::Sampling;
use crate::{benchmark, charts};

/// Arguments of `evaluate open-loop`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// A file or folder of scenarios, or LIST.toml#SPLIT of datasets/benchmarks
    #[arg(long, value_name = "PATH")]
    scenarios: ScenarioSetName,
    /// Planners to evaluate, comma-separated, one row each
    #[arg(long, value_parser = planner(), value_name = "P", required = true, num_args = 1.., value_delimiter = ',')]
    planner: Vec<PlannerName>,
    /// Traffic model of planners' rollouts: idm or model:WEIGHTS
    #[arg(long, value_name = "W", default_value = "idm")]
    world: WorldName,
    /// Maximum number of scenarios [default: all]
    #[arg(long, value_name = "N")]
    limit: Option<NonZeroUsize>,
    #[command(flatten)]
    #[serde(flatten)]
    thinking: ImaginationArgs,
    #[command(flatten)]
    #[serde(flatten)]
    sampling: Sampling,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        if matches!(self.world, WorldName::Log | WorldName::ConstantVelocity) {
            let found = &self.world;
            let wrong = format!(
                "--world: expected idm or model:WEIGHTS for the planner's rollouts, found {found}"
            );
            return Err(WrongArguments(wrong).into());
        }
        let sampling = self.sampling.resolve_for(&[&self.world])?;
        self.thinking.config()?;
        let surroundings = run.phase("load", |run| {
            Ok(PlanningWorld::load_imagination(
                run.device(),
                &self.world,
                &self.thinking.sampling(&sampling),
            )?)
        })?;
        let found = benchmark::find(run, &self.scenarios)?;
        run.result("set", &found.name)?;
        let (mut rows, mut scenarios) = (Vec::new(), Vec::new());
        let (mut unreadable, mut read) = (Vec::new(), 0);
        let ids = run.phase("find", |_| Ok(recordings::ids(&found.paths, self.limit())?))?;
        let total = ids.len();
        for &planner in &self.planner {
            let outcomes = run.phase("plan", |run| {
                self.plan(run, &found, total, planner, &surroundings)
            })?;
            read = outcomes.len();
            let (broken, outcomes): (Vec<_>, Vec<_>) = outcomes.into_iter().partition(is_broken);
            // The same ones for every planner.
            unreadable = broken;
            rows.push(row(planner.name(), &outcomes, run));
            scenarios.extend(
                outcomes
                    .iter()
                    .map(|outcome| entry(planner.name(), outcome)),
            );
        }
        let scores = |row: usize, _| {
            let row: &Value = &rows[row];
            charts::bar(&row["score"], &row["low"], &row["high"])
        };
        let names = rows.iter().filter_map(|row| row["planner"].as_str());
        let label = "open-loop score, 0 to 1, with 95 % intervals over scenarios";
        let names = names.map(String::from).collect();
        let chart = charts::bars(label, names, vec!["score".into()], scores);
        charts::save(run, "scores", &chart)?;
        let mut sentences = Vec::from_iter(failed_drives(&rows));
        sentences.extend(missing_intervals(&rows));
        if let Some(note) = few_scenarios(&rows) {
            run.print(&note);
        }
        run.result("rows", rows)?;
        warnings::report(run, &sentences)?;
        run.result("scenarios", &scenarios)?;
        let unreadable = unreadable.iter().filter_map(|outcome| {
            let why = outcome.compared.as_ref().err()?.to_string();
            Some((outcome.id.as_str(), why))
        });
        super::all_readable(run, &unreadable.collect::<Vec<_>>(), read)?;
        super::any_succeeded(&scenarios)
    }

    fn limit(&self) -> usize {
        self.limit.map_or(usize::MAX, NonZeroUsize::get)
    }

    fn plan(
        &self,
        run: &Run,
        found: &ScenarioSet,
        total: usize,
        planner: PlannerName,
        surroundings: &PlanningWorld,
    ) -> anyhow::Result<Vec<OpenLoopOutcome>> {
        let cases = recordings::open_all(&found.paths)?.take(self.limit());
        let progress = run.progress(planner.name(), total as u64, "scenarios");
        let (imagination, config) = (surroundings.imagination(), self.thinking.config()?);
        Ok(plan(
            cases,
            planner,
            imagination,
            &config,
            run.seed(),
            &progress,
        )?)
    }
}

/// Whether the scenario could not be read.
fn is_broken(outcome: &OpenLoopOutcome) -> bool {
    let error = outcome.compared.as_ref().err();
    error.is_some_and(|error| matches!(error.cause(), EvalError::Data(_)))
}

/// One planner in one scenario.
fn entry(planner: &str, outcome: &OpenLoopOutcome) -> Value {
    let mut entry = json!({ "id": outcome.id, "planner": planner });
    match &outcome.compared {
        Ok(open) => {
            for (name, value) in numbers(open) {
                entry[name] = json!(value);
            }
        }
        Err(error) => entry["error"] = json!(error.sentence()),
    }
    entry
}

/// One planner over all scenarios.
fn row(planner: &str, outcomes: &[OpenLoopOutcome], run: &Run) -> Value {
    let done: Vec<_> = outcomes
        .iter()
        .filter_map(|outcome| outcome.compared.as_ref().ok())
        .map(numbers)
        .collect();
    let mut row = json!({
        "planner": planner,
        "scenarios": outcomes.len(),
        "failed": outcomes.len() - done.len(),
    });
    for column in 0..6 {
        let values: Vec<f64> = done.iter().map(|numbers| numbers[column].1).collect();
        let name = done.first().map_or("score", |numbers| numbers[column].0);
        row[name] = json!(mean(&values));
        if column == 0 {
            let span = interval(&values, run.seed());
            row["low"] = json!(span.map(|span| span.low));
            row["high"] = json!(span.map(|span| span.high));
        }
    }
    row
}
