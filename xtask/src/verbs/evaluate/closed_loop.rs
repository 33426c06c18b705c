//! `evaluate closed-loop`: how well a planner drives, as nuPlan scores it.

use std::path::PathBuf;
use std::sync::Mutex;
use std::time::Duration;

use gump_metrics::interval;
use gump_metrics::nuplan::MetricScores;
use gump_planner::closed_loop::{Scored, drive_and_score, evaluate};
use gump_rollout::closed_loop::{DriveConfig, Tracking};
use gump_scene::Seed;
use serde::Serialize;
use serde_json::{Value, json};

use crate::cli::WrongArguments;
use crate::futures;
use crate::planners::{PlannerName, Surroundings, Timed};
use crate::recordings::{self, Case, Named};
use crate::run::{Common, Run, interrupted};
use crate::worlds::{Sampling, WorldName};

/// Columns of the table, by nuPlan's names of the metrics.
const COLUMNS: [(&str, &str); 8] = [
    ("no_at_fault_collisions", "no_ego_at_fault_collisions"),
    ("drivable_area", "drivable_area_compliance"),
    ("driving_direction", "driving_direction_compliance"),
    ("making_progress", "ego_is_making_progress"),
    ("time_to_collision", "time_to_collision_within_bound"),
    ("speed_limit", "speed_limit_compliance"),
    ("progress", "ego_progress_along_expert_route"),
    ("comfort", "ego_is_comfortable"),
];

/// Arguments of `evaluate closed-loop`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// A file or folder of scenarios
    #[arg(long, value_name = "PATH")]
    scenarios: PathBuf,
    /// Who plans; several for several rows
    #[arg(long, value_enum, value_name = "P", required = true, num_args = 1..)]
    planner: Vec<PlannerName>,
    /// log, idm, constant-velocity or model:WEIGHTS; several for several rows
    #[arg(long, value_name = "W", default_value = "idm", num_args = 1..)]
    world: Vec<WorldName>,
    #[command(flatten)]
    #[serde(flatten)]
    driving: Driving,
    /// At most so many scenarios [default: all]
    #[arg(long, value_name = "N")]
    limit: Option<usize>,
    /// Films of the first so many scenarios
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
    /// How far to drive; a recording may be shorter
    #[arg(long, value_name = "S", default_value_t = 15.0)]
    pub(crate) seconds: f64,
    /// How the ego follows its plans
    #[arg(long, value_enum, default_value_t = TrackingName::TwoStage)]
    controller: TrackingName,
    /// The interactive planner plans at every N-th step
    #[arg(long, value_name = "N", default_value_t = 5)]
    replan_every: usize,
    /// A planner that takes longer for a step has failed [default: no limit]
    #[arg(long, value_name = "MS")]
    budget_ms: Option<f64>,
}

#[derive(Clone, Copy, Debug, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
enum TrackingName {
    /// An LQR tracker steers a kinematic bicycle
    TwoStage,
    /// It is where the plan says
    Perfect,
}

impl Driving {
    /// Error: [`WrongArguments`] for a number out of its range.
    pub(crate) fn check(&self) -> anyhow::Result<()> {
        let positive = |x: f64| x > 0.0 && x.is_finite();
        if !positive(self.seconds) {
            let wrong = format!(
                "--seconds: expected a number above 0, found {}",
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

    /// Steps between the plans of the interactive planner.
    pub(crate) fn replan_every(&self) -> usize {
        self.replan_every
    }
}

/// One drive by one planner.
pub(crate) struct Finished {
    /// What it came to.
    pub(crate) scored: Scored,
    /// Milliseconds per plan.
    pub(crate) milliseconds: f64,
}

/// What one scenario got.
struct Entry {
    id: String,
    outcome: Result<(f64, MetricScores, f64), String>,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        self.driving.check()?;
        let sampling = self.sampling.resolve()?;
        let (mut rows, mut scenarios) = (Vec::new(), Vec::new());
        for world in &self.world {
            let surroundings = run.phase("load", |_| Surroundings::load(world, &sampling))?;
            for &planner in &self.planner {
                let entries = run.phase("drive", |run| {
                    self.drive(run, planner, &surroundings, world)
                })?;
                let row = row(planner.name(), &world.to_string(), &entries, run.seed());
                rows.push(row);
                scenarios.extend(entries.iter().map(|e| e.tell(planner.name(), world)));
            }
        }
        run.result("rows", rows)?;
        run.result("scenarios", &scenarios)?;
        let all_failed = scenarios.iter().all(|entry| entry["error"].is_string());
        anyhow::ensure!(
            !all_failed,
            "every scenario failed, see the errors in the report"
        );
        Ok(())
    }

    /// Drives every scenario; those that fail say why.
    fn drive(
        &self,
        run: &Run,
        planner: PlannerName,
        surroundings: &Surroundings,
        world: &WorldName,
    ) -> anyhow::Result<Vec<Entry>> {
        let cases = recordings::open(&self.scenarios)?;
        let cases = cases
            .take(self.limit.unwrap_or(usize::MAX))
            .take_while(|_| !interrupted());
        let label = format!("{} among {world}", planner.name());
        let progress = run.progress(&label, self.limit.unwrap_or(0) as u64, "scenarios");
        let film_error = Mutex::new(None);
        let entries = evaluate(cases, |i, named: Named| {
            let seed = run.seed().fork(i as u64);
            let finished = named.case.and_then(|case| {
                let finished = drive_one(&case, planner, surroundings, &self.driving, seed)?;
                if i < self.films {
                    let name = format!("{i}-{}-{}.gif", planner.name(), short(world));
                    if let Err(error) = film(run, &case, &finished.scored, &label, &name) {
                        *film_error.lock().expect("nobody panics while holding it") = Some(error);
                    }
                }
                Ok(finished)
            });
            progress.advance(1);
            Entry {
                id: named.id,
                outcome: match finished {
                    Ok(f) => Ok((f.scored.score, f.scored.metrics.scores(), f.milliseconds)),
                    Err(error) => Err(format!("{error:#}")),
                },
            }
        });
        let failed = film_error
            .into_inner()
            .expect("nobody panics while holding it");
        crate::run::stop_if_interrupted()?;
        failed.map_or(Ok(entries), Err)
    }
}

/// A film of what was driven beside the log.
fn film(run: &Run, case: &Case, scored: &Scored, label: &str, name: &str) -> anyhow::Result<()> {
    let folder = run.path("films");
    std::fs::create_dir_all(&folder)?;
    let film = futures::film(
        case.recording.scenario(),
        &[(label, &scored.driven.rollout)],
    )?;
    Ok(film.save(&folder.join(name))?)
}

/// A world's name as part of a file's.
pub(crate) fn short(world: &WorldName) -> String {
    match world {
        WorldName::Model(_) => "model".into(),
        other => other.to_string(),
    }
}

/// One planner through one case.
///
/// Error: what the planner, the traffic or the recording fail at.
pub(crate) fn drive_one(
    case: &Case,
    planner: PlannerName,
    surroundings: &Surroundings,
    driving: &Driving,
    seed: Seed,
) -> anyhow::Result<Finished> {
    let imagination = surroundings.imagination();
    let mut driver = planner.build(case, imagination, seed, driving.replan_every())?;
    let mut timed = Timed::new(&mut *driver, driving.budget());
    let mut traffic = surroundings.traffic(seed);
    let config = driving.config();
    let scored = drive_and_score(
        &case.recording,
        &case.map,
        &mut *traffic,
        &mut timed,
        &config,
    )?;
    let milliseconds = timed.milliseconds_per_step();
    Ok(Finished {
        scored,
        milliseconds,
    })
}

impl Entry {
    fn tell(&self, planner: &str, world: &WorldName) -> Value {
        let mut told = json!({
            "id": self.id,
            "planner": planner,
            "world": world.to_string(),
        });
        match &self.outcome {
            Ok((score, metrics, _)) => {
                told["score"] = json!(score);
                for (column, metric) in COLUMNS {
                    told[column] = json!(metrics.get(metric).copied().flatten());
                }
            }
            Err(error) => told["error"] = json!(error),
        }
        told
    }
}

/// Means over the scenarios that were driven to the end; how many were not stands beside them.
fn row(planner: &str, world: &str, entries: &[Entry], seed: Seed) -> Value {
    let done: Vec<_> = entries
        .iter()
        .filter_map(|e| e.outcome.as_ref().ok())
        .collect();
    let scores: Vec<f64> = done.iter().map(|(score, ..)| *score).collect();
    let span = interval(&scores, seed);
    let mut row = json!({
        "planner": planner,
        "world": world,
        "scenarios": entries.len(),
        "failed": entries.len() - done.len(),
        "score": mean(&scores),
        "low": span.map(|span| span.low),
        "high": span.map(|span| span.high),
    });
    for (column, metric) in COLUMNS {
        let of_metric = done
            .iter()
            .filter_map(|(_, m, _)| m.get(metric).copied().flatten());
        row[column] = json!(mean(&of_metric.collect::<Vec<_>>()));
    }
    let times: Vec<f64> = done.iter().map(|(.., ms)| *ms).collect();
    row["milliseconds_per_step"] = json!(mean(&times));
    row
}

/// Mean; `None` of nothing.
pub(super) fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}
