//! The report of closed-loop drives.

use std::path::PathBuf;

use anyhow::Context as _;
use gump_eval::closed_loop::{ClosedLoopSettings, DriveOutcome, ScenarioDrives};
use gump_eval::results::{self, Entry, MissingShards};
use gump_eval::worlds::WorldName;
use gump_metrics::interval;
use gump_nuplan::metrics::MetricScores;
use gump_scene::Seed;
use gump_viz::Bars;
use serde_json::{Value, json};

use crate::run::Run;
use crate::verbs::evaluate::warnings::{self, failed_drives, few_scenarios, missing_intervals};
use crate::verbs::evaluate::{all_readable, any_succeeded, ranking};
use crate::{charts, tables};

/// Columns of the table, by nuPlan's names of the metrics.
pub(in crate::verbs::evaluate) const COLUMNS: [(&str, &str); 8] = [
    ("no_at_fault_collisions", "no_ego_at_fault_collisions"),
    ("drivable_area", "drivable_area_compliance"),
    ("driving_direction", "driving_direction_compliance"),
    ("making_progress", "ego_is_making_progress"),
    ("time_to_collision", "time_to_collision_within_bound"),
    ("speed_limit", "speed_limit_compliance"),
    ("progress", "ego_progress_along_expert_route"),
    ("comfort", "ego_is_comfortable"),
];

/// A row of a world's table: one planner, every scenario.
pub(in crate::verbs::evaluate) struct PlannerDrives<'a> {
    /// Name of the planner.
    pub(in crate::verbs::evaluate) planner: String,
    /// Scenario by scenario.
    drives: Vec<(&'a Entry<ScenarioDrives>, &'a DriveOutcome)>,
}

impl PlannerDrives<'_> {
    /// The scenarios, in their order, with their scores; `None` where one failed.
    pub(in crate::verbs::evaluate) fn scenes(
        &self,
    ) -> impl Iterator<Item = (&Entry<ScenarioDrives>, Option<f64>)> {
        self.drives
            .iter()
            .map(|(entry, _)| *entry)
            .zip(self.scores())
    }

    /// The scores of the scenarios, in their order; `None` where one failed.
    pub(in crate::verbs::evaluate) fn scores(&self) -> impl Iterator<Item = Option<f64>> + '_ {
        let outcomes = self.drives.iter().map(|(_, outcome)| outcome);
        outcomes.map(|outcome| outcome.finished.as_ref().map(|finished| finished.score))
    }
}

/// Reports on the shards in some folders.
pub(crate) fn report_merged(
    run: &mut Run,
    folders: &[PathBuf],
    missing: MissingShards,
) -> anyhow::Result<()> {
    let (header, entries) = results::merge::<ScenarioDrives>(folders, missing)?;
    let settings: ClosedLoopSettings = header.settings.try_into()?;
    // Intervals of the same draws as those of the evaluation on one machine.
    run.reseed(settings.seed.parse().context("the seed in the ledger")?);
    report(run, &settings, &entries)
}

/// Fills the report of a run.
pub(super) fn report(
    run: &mut Run,
    settings: &ClosedLoopSettings,
    entries: &[Entry<ScenarioDrives>],
) -> anyhow::Result<()> {
    run.result("set", &settings.scenarios)?;
    let (mut rows, mut scenarios) = (Vec::new(), Vec::new());
    let mut worlds = Vec::new();
    for name in &settings.worlds {
        let drives = of_world(entries, name);
        let world: WorldName = name.parse().map_err(anyhow::Error::msg)?;
        let world_rows = drives.iter().map(|drives| row(drives, name, run.seed()));
        let world_rows: Vec<Value> = world_rows.collect();
        if settings.worlds.len() > 1 {
            run.print(&ranking::table_of(&world, &world_rows, run.width()));
        }
        rows.extend(world_rows);
        let of_row = |row: &PlannerDrives<'_>| -> Vec<Value> {
            let drives = row.drives.iter();
            let values = drives.map(|(entry, outcome)| outcome_row(entry, outcome, &row.planner));
            values.collect()
        };
        scenarios.extend(drives.iter().flat_map(of_row));
        worlds.push((name.clone(), drives));
    }
    run.phase("write", |run| {
        Ok(nuplan_table(&worlds).write(&run.path("nuplan.parquet"))?)
    })?;
    run.result("imagination", &settings.imagination)?;
    charts::save(run, "scores", &chart(&rows, &settings.worlds))?;
    let mut sentences = Vec::from_iter(failed_drives(&rows));
    sentences.extend(missing_intervals(&rows));
    if let Some(note) = few_scenarios(&rows) {
        run.print(&note);
    }
    run.result("rows", rows)?;
    sentences.extend(ranking::report(run, &worlds)?);
    warnings::report(run, &sentences)?;
    run.result("scenarios", &scenarios)?;
    let unreadable = entries.iter().filter_map(|entry| {
        let why = entry.scores.unreadable.clone()?;
        Some((entry.id.as_str(), why))
    });
    all_readable(run, &unreadable.collect::<Vec<_>>(), entries.len())?;
    any_succeeded(&scenarios)
}

/// The rows of a world's table, planners in their order.
fn of_world<'a>(entries: &'a [Entry<ScenarioDrives>], world: &str) -> Vec<PlannerDrives<'a>> {
    let mut rows: Vec<(bool, PlannerDrives<'a>)> = Vec::new();
    for entry in entries {
        let of_world = entry.scores.outcomes.iter();
        for outcome in of_world.filter(|outcome| outcome.world == world) {
            let known = rows
                .iter_mut()
                .find(|(_, row)| row.planner == outcome.planner);
            match known {
                Some((_, row)) => row.drives.push((entry, outcome)),
                None => {
                    let row = PlannerDrives {
                        planner: outcome.planner.clone(),
                        drives: vec![(entry, outcome)],
                    };
                    rows.push((outcome.proposal, row));
                }
            }
        }
    }
    let place = rows.iter().position(|(proposal, _)| *proposal);
    let (alone, mut others): (Vec<_>, Vec<_>) = rows.into_iter().partition(|(alone, _)| *alone);
    if let Some(place) = place {
        let alone = alone.into_iter().map(|(_, row)| row).collect();
        let two = best_and_oracle(alone).into_iter().map(|row| (false, row));
        others.splice(place..place, two);
    }
    others.into_iter().map(|(_, row)| row).collect()
}

/// Of proposals that were each driven to the end: the one that is best on average, and the best one
/// of every scenario, which can only be chosen in hindsight.
fn best_and_oracle(mut alone: Vec<PlannerDrives<'_>>) -> Vec<PlannerDrives<'_>> {
    let average = |drives: &PlannerDrives<'_>| mean(&drives.scores().flatten().collect::<Vec<_>>());
    let value = |drives: &PlannerDrives<'_>| average(drives).unwrap_or(f64::NEG_INFINITY);
    let best = (0..alone.len()).fold(0, |best, i| {
        if value(&alone[i]) > value(&alone[best]) {
            i
        } else {
            best
        }
    });
    let n = alone[best].drives.len();
    let oracle = (0..n).map(|scene| {
        let mut drives: Vec<_> = alone.iter().map(|row| row.drives[scene]).collect();
        let score = |outcome: &DriveOutcome| outcome.finished.as_ref().map_or(-1.0, |f| f.score);
        // The first of the best: the sort is stable.
        drives.sort_by(|a, b| score(b.1).total_cmp(&score(a.1)));
        drives[0]
    });
    let oracle = PlannerDrives {
        planner: "oracle of the proposals".into(),
        drives: oracle.collect(),
    };
    let mut best = alone.swap_remove(best);
    best.planner = format!("best proposal: {}", best.planner);
    vec![best, oracle]
}

fn outcome_row(entry: &Entry<ScenarioDrives>, outcome: &DriveOutcome, planner: &str) -> Value {
    let mut row = json!({
        "id": entry.id,
        "planner": planner,
        "world": outcome.world,
    });
    if let Some(finished) = &outcome.finished {
        row["score"] = json!(finished.score);
        for (column, metric) in COLUMNS {
            row[column] = json!(finished.metrics.get(metric));
        }
    }
    if let Some(error) = &outcome.error {
        row["error"] = json!(error);
    }
    row
}

/// Every drive that reached its end, as nuPlan's own tables show it.
fn nuplan_table(worlds: &[(String, Vec<PlannerDrives<'_>>)]) -> gump_data::Table {
    let mut nuplan = tables::NuPlan::default();
    for (world, rows) in worlds {
        for row in rows {
            let finished: Vec<(&Entry<ScenarioDrives>, f64, MetricScores)> = row
                .drives
                .iter()
                .filter_map(|(entry, outcome)| {
                    let finished = outcome.finished.as_ref()?;
                    let metrics = finished.metrics.iter();
                    let metrics = metrics.map(|(name, value)| (name.clone(), Some(*value)));
                    Some((*entry, finished.score, metrics.collect()))
                })
                .collect();
            let driven = finished
                .iter()
                .map(|(entry, score, metrics)| tables::Driven {
                    scenario: &entry.id,
                    log_name: &entry.scores.log_name,
                    scenario_type: &entry.scores.scenario_type,
                    score: *score,
                    metrics,
                });
            nuplan.add(&row.planner, world, &driven.collect::<Vec<_>>());
        }
    }
    nuplan.table()
}

/// Means over the scenarios that were driven to the end, with the number of those that failed.
fn row(row: &PlannerDrives<'_>, world: &str, seed: Seed) -> Value {
    let outcomes = row.drives.iter().map(|(_, outcome)| outcome);
    let done: Vec<_> = outcomes.filter_map(|o| o.finished.as_ref()).collect();
    let scores: Vec<f64> = done.iter().map(|finished| finished.score).collect();
    let span = interval(&scores, seed);
    let mut line = json!({
        "planner": row.planner,
        "world": world,
        "scenarios": row.drives.len(),
        "failed": row.drives.len() - done.len(),
        "score": mean(&scores),
        "low": span.map(|span| span.low),
        "high": span.map(|span| span.high),
    });
    for (column, metric) in COLUMNS {
        let of_metric = done.iter().filter_map(|f| f.metrics.get(metric).copied());
        line[column] = json!(mean(&of_metric.collect::<Vec<_>>()));
    }
    let times: Vec<f64> = done.iter().map(|finished| finished.milliseconds).collect();
    line["milliseconds_per_step"] = json!(mean(&times));
    line
}

/// The score of every planner in every world.
fn chart(rows: &[Value], worlds: &[String]) -> Bars {
    let mut planners: Vec<&Value> = Vec::new();
    for row in rows.iter().filter(|row| row["world"] == worlds[0]) {
        planners.push(&row["planner"]);
    }
    let names = planners.iter().filter_map(|planner| planner.as_str());
    let names = names.map(String::from).collect();
    let legend = worlds.iter().map(|world| charts::legend(world)).collect();
    let label = "nuPlan score, 0 to 1, with 95 % intervals over scenarios";
    charts::bars(label, names, legend, |planner, world| {
        let is =
            |row: &&Value| row["planner"] == *planners[planner] && row["world"] == worlds[world];
        let row = rows.iter().find(is)?;
        charts::bar(&row["score"], &row["low"], &row["high"])
    })
}

/// Mean; `None` of nothing.
pub(in crate::verbs::evaluate) fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}
