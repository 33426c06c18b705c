//! `evaluate closed-loop`: how well a planner drives, as nuPlan scores it.

use std::num::NonZeroUsize;
use std::sync::Mutex;
use std::time::Duration;

use gump_eval::planners::{PlannerName, PlanningWorld, TimedDriver};
use gump_eval::recordings;
use gump_eval::recordings::{Case, Named};
use gump_eval::worlds::WorldName;
use gump_metrics::interval;
use gump_nuplan::closed_loop::{DriveConfig, Tracking};
use gump_nuplan::metrics::MetricScores;
use gump_planner::closed_loop::{Scored, drive_and_score, evaluate};
use gump_planner::{Explain, PdmClosed, PdmConfig, ProposalKind};
use gump_rollout::WorldModel;
use gump_scene::Seed;
use gump_viz::Bars;
use serde::Serialize;
use serde_json::{Value, json};

use super::ranking;
use crate::benchmark::{Found, Scenes};
use crate::cli::WrongArguments;
use crate::planners::{Chosen, ChosenParser, ImaginationArgs};
use crate::run::{Common, Run, interrupted};
use crate::sampling::Sampling;
use crate::{charts, futures, tables};

/// Columns of the table, by nuPlan's names of the metrics.
pub(super) const COLUMNS: [(&str, &str); 8] = [
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
    /// A file or folder of scenarios, or LIST.toml#SPLIT of datasets/benchmarks
    #[arg(long, value_name = "PATH")]
    scenarios: Scenes,
    /// Who plans; several, apart by commas, for several rows
    #[arg(long, value_parser = ChosenParser, value_name = "P", required = true, num_args = 1.., value_delimiter = ',')]
    planner: Vec<Chosen>,
    /// log, idm, constant-velocity or model:WEIGHTS; several, apart by commas, for several tables
    #[arg(long, value_name = "W", default_value = "idm", num_args = 1.., value_delimiter = ',')]
    world: Vec<WorldName>,
    /// What planners imagine in [default: the learned world of --world, else idm]
    #[arg(long, value_name = "W")]
    imagination: Option<WorldName>,
    #[command(flatten)]
    #[serde(flatten)]
    driving: Driving,
    #[command(flatten)]
    #[serde(flatten)]
    thinking: ImaginationArgs,
    /// At most so many scenarios [default: all]
    #[arg(long, value_name = "N")]
    limit: Option<NonZeroUsize>,
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
}

/// One drive by one planner.
pub(crate) struct Finished {
    /// What it came to.
    pub(crate) scored: Scored,
    /// Milliseconds per plan.
    pub(crate) milliseconds: f64,
}

/// What one scenario got.
#[derive(Clone)]
pub(super) struct Entry {
    id: String,
    log_name: String,
    scenario_type: String,
    outcome: Result<(f64, MetricScores, f64), String>,
}

/// A row of a world's table: one planner, every scenario.
pub(super) struct Drives {
    /// Who drove.
    pub(super) planner: String,
    entries: Vec<Entry>,
}

impl Drives {
    /// The scores of the scenarios, in their order; `None` where one failed.
    pub(super) fn scores(&self) -> impl Iterator<Item = Option<f64>> + '_ {
        let score = |entry: &Entry| entry.outcome.as_ref().ok().map(|(score, ..)| *score);
        self.entries.iter().map(score)
    }
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        self.driving.check()?;
        self.planner.iter().try_for_each(Chosen::check)?;
        let sampling = self.sampling.resolve()?;
        let found = run.phase("find", |_| self.scenarios.find())?;
        run.result("set", &found.set)?;
        let learned = |world: &&WorldName| matches!(world, WorldName::Model(_));
        let imagination = self
            .imagination
            .as_ref()
            .or_else(|| self.world.iter().find(learned));
        let imagination = imagination.unwrap_or(&WorldName::Idm);
        let imagined = run.phase("load", |run| {
            Ok(PlanningWorld::load_imagination(
                run.device(),
                imagination,
                &sampling,
            )?)
        })?;
        let (mut rows, mut scenarios) = (Vec::new(), Vec::new());
        let mut worlds = Vec::new();
        for world in &self.world {
            let surroundings = run.phase("load", |run| {
                Ok(PlanningWorld::load(run.device(), world, &sampling)?)
            })?;
            let mut drives = Vec::new();
            for planner in &self.planner {
                let drive = Drive {
                    args: self,
                    found: &found,
                    world,
                    surroundings: &surroundings,
                    imagination: imagined.imagination(),
                };
                drives.extend(run.phase("drive", |run| drive.all(run, planner))?);
            }
            let told = drives.iter().map(|drives| row(drives, world, run.seed()));
            let told: Vec<Value> = told.collect();
            if self.world.len() > 1 {
                run.say(&ranking::table_of(world, &told, run.width()));
            }
            rows.extend(told);
            let entries = drives
                .iter()
                .flat_map(|d| d.entries.iter().map(|e| e.tell(&d.planner, world)));
            scenarios.extend(entries);
            worlds.push((world.to_string(), drives));
        }
        run.phase("write", |run| {
            Ok(nuplan_table(&worlds).write(&run.path("nuplan.parquet"))?)
        })?;
        run.result("imagination", imagination)?;
        let names: Vec<String> = self.world.iter().map(ToString::to_string).collect();
        charts::save(run, "scores", &chart(&rows, &names))?;
        run.result("rows", rows)?;
        ranking::tell(run, &worlds)?;
        run.result("scenarios", &scenarios)?;
        super::any_succeeded(&scenarios)
    }

    /// Scenarios to drive through.
    fn limit(&self) -> usize {
        self.limit.map_or(usize::MAX, NonZeroUsize::get)
    }
}

/// Makes the driver of a case.
type Build<'b, 'd> = &'b (dyn Fn(&Case, Seed) -> anyhow::Result<Box<dyn Explain + 'd>> + Sync);

/// What the drives of one row share.
struct Drive<'a> {
    args: &'a Args,
    found: &'a Found,
    world: &'a WorldName,
    surroundings: &'a PlanningWorld,
    imagination: &'a dyn WorldModel,
}

impl Drive<'_> {
    /// The rows of a planner; nearly all have one.
    fn all(&self, run: &Run, planner: &Chosen) -> anyhow::Result<Vec<Drives>> {
        let name = planner.to_string();
        let thinking = self.args.thinking.config()?;
        let entries = match planner {
            Chosen::Ours(PlannerName::Proposals) => return self.proposals(run),
            Chosen::Ours(planner) => self.through(run, &name, &|case, seed| {
                planner
                    .build(case, self.imagination, seed, &thinking)
                    .map_err(Into::into)
            })?,
            Chosen::Remote(address) => self.remote(run, &name, address)?,
        };
        Ok(vec![Drives {
            planner: name,
            entries,
        }])
    }

    /// Drives by a planner in another process, one after another as it plans for one at a time.
    #[cfg(feature = "grpc")]
    fn remote(&self, run: &Run, name: &str, address: &str) -> anyhow::Result<Vec<Entry>> {
        let limit = self.args.driving.budget();
        self.turns(run, name, false, &|case, _| {
            let driver = crate::remote::RemoteDriver::new(address, &case.map_name, limit);
            Ok(Box::new(driver))
        })
    }

    #[cfg(not(feature = "grpc"))]
    fn remote(&self, _: &Run, _: &str, address: &str) -> anyhow::Result<Vec<Entry>> {
        Chosen::Remote(address.into()).check()?;
        Ok(Vec::new())
    }

    /// Every proposal alone, as two rows.
    fn proposals(&self, run: &Run) -> anyhow::Result<Vec<Drives>> {
        let all = PdmConfig::default();
        let mut alone = Vec::new();
        for &lateral_offset in &all.lateral_offsets {
            for &speed_fraction in &all.speed_fractions {
                let kind = ProposalKind::Idm {
                    speed_fraction,
                    lateral_offset,
                };
                let name = kind.to_string();
                let entries = self.through(run, &name, &|_, _| {
                    let only = PdmConfig {
                        speed_fractions: vec![speed_fraction],
                        lateral_offsets: vec![lateral_offset],
                        ..PdmConfig::default()
                    };
                    Ok(Box::new(PdmClosed::new(only)?))
                })?;
                alone.push(Drives {
                    planner: name,
                    entries,
                });
            }
        }
        Ok(best_and_oracle(alone))
    }

    /// Drives every scenario, several side by side; those that fail say why.
    fn through<'d>(
        &self,
        run: &Run,
        name: &str,
        build: Build<'_, 'd>,
    ) -> anyhow::Result<Vec<Entry>> {
        self.turns(run, name, true, build)
    }

    /// As [`Drive::through`], side by side or one after another.
    fn turns<'d>(
        &self,
        run: &Run,
        name: &str,
        side_by_side: bool,
        build: Build<'_, 'd>,
    ) -> anyhow::Result<Vec<Entry>> {
        let args = self.args;
        let cases = recordings::open_all(&self.found.paths)?;
        let cases = cases.take(args.limit()).take_while(|_| !interrupted());
        let label = format!("{name} among {}", self.world);
        let total = args.limit.map_or(0, NonZeroUsize::get) as u64;
        let progress = run.progress(&label, total, "scenarios");
        let film_error = Mutex::new(None);
        let work = |i: usize, named: Named| {
            let seed = run.seed().fork(i as u64);
            let finished = named.case.map_err(anyhow::Error::from).and_then(|case| {
                let mut driver = build(&case, seed)?;
                let finished = drive_one(&case, &mut *driver, self.surroundings, args, seed)?;
                if i < args.films {
                    let file = format!("{i}-{}-{}.gif", file_name(name), short(self.world));
                    if let Err(error) = film(run, &case, &finished.scored, &label, &file) {
                        *film_error.lock().expect("nobody panics while holding it") = Some(error);
                    }
                }
                Ok(finished)
            });
            progress.advance(1);
            Entry {
                id: named.id,
                log_name: named.log_name,
                scenario_type: named.scenario_type,
                outcome: match finished {
                    Ok(f) => Ok((f.scored.score, f.scored.metrics.scores(), f.milliseconds)),
                    Err(error) => Err(format!("{error:#}")),
                },
            }
        };
        let entries = match side_by_side {
            true => evaluate(cases, work),
            false => cases.enumerate().map(|(i, named)| work(i, named)).collect(),
        };
        let failed = film_error
            .into_inner()
            .expect("nobody panics while holding it");
        crate::run::stop_if_interrupted()?;
        failed.map_or(Ok(entries), Err)
    }
}

/// Of proposals that were each driven to the end: the one that is best on average, and the best of
/// every scenario, which no one who does not know the outcome can choose.
fn best_and_oracle(mut alone: Vec<Drives>) -> Vec<Drives> {
    let average = |drives: &Drives| mean(&drives.scores().flatten().collect::<Vec<_>>());
    let value = |drives: &Drives| average(drives).unwrap_or(f64::NEG_INFINITY);
    let best = (0..alone.len()).fold(0, |best, i| {
        if value(&alone[i]) > value(&alone[best]) {
            i
        } else {
            best
        }
    });
    let n = alone[best].entries.len();
    let oracle = (0..n).map(|scene| {
        let entries = alone.iter().map(|drives| &drives.entries[scene]);
        let mut finished: Vec<&Entry> = entries.collect();
        let score = |entry: &Entry| entry.outcome.as_ref().map_or(-1.0, |(score, ..)| *score);
        // The first of the best: the sort is stable.
        finished.sort_by(|a, b| score(b).total_cmp(&score(a)));
        finished[0].clone()
    });
    let oracle = Drives {
        planner: "oracle of the proposals".into(),
        entries: oracle.collect(),
    };
    let mut best = alone.swap_remove(best);
    best.planner = format!("best proposal: {}", best.planner);
    vec![best, oracle]
}

/// A name without what file systems dislike.
fn file_name(name: &str) -> String {
    let plain = |c: char| if c.is_ascii_alphanumeric() { c } else { '-' };
    name.chars().map(plain).collect()
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
fn drive_one(
    case: &Case,
    driver: &mut dyn Explain,
    surroundings: &PlanningWorld,
    args: &Args,
    seed: Seed,
) -> anyhow::Result<Finished> {
    let mut timed = TimedDriver::new(driver, args.driving.budget());
    let mut traffic = surroundings.traffic(seed);
    let config = args.driving.config();
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

/// Every drive that reached its end, as nuPlan's own tables show it.
fn nuplan_table(worlds: &[(String, Vec<Drives>)]) -> gump_data::Table {
    let mut nuplan = tables::NuPlan::default();
    for (world, drives) in worlds {
        for Drives { planner, entries } in drives {
            let driven = entries.iter().filter_map(|entry| {
                let (score, metrics, _) = entry.outcome.as_ref().ok()?;
                Some(tables::Driven {
                    scenario: &entry.id,
                    log_name: &entry.log_name,
                    scenario_type: &entry.scenario_type,
                    score: *score,
                    metrics,
                })
            });
            nuplan.add(planner, world, &driven.collect::<Vec<_>>());
        }
    }
    nuplan.table()
}

/// Means over the scenarios that were driven to the end; how many were not stands beside them.
fn row(drives: &Drives, world: &WorldName, seed: Seed) -> Value {
    let entries = &drives.entries;
    let done: Vec<_> = entries
        .iter()
        .filter_map(|e| e.outcome.as_ref().ok())
        .collect();
    let scores: Vec<f64> = done.iter().map(|(score, ..)| *score).collect();
    let span = interval(&scores, seed);
    let mut row = json!({
        "planner": drives.planner,
        "world": world.to_string(),
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
pub(super) fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}
