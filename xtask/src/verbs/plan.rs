//! `plan`: one planner through one scenario, with everything it considered.

use gump_eval::planners::{PlannerName, PlanningWorld, TimedDriver};
use gump_eval::recordings;
use gump_eval::recordings::Case;
use gump_eval::worlds::WorldName;
use gump_nuplan::closed_loop::{Driver, Mission, Moment};
use gump_nuplan::tracking::Trajectory;
use gump_planner::closed_loop::{Scored, drive_and_score};
use gump_planner::{Candidate, Decision, Explain};
use gump_rollout::BoxError;
use gump_scene::{Frame, Scenario};
use serde::Serialize;
use serde_json::{Value, json};

use super::evaluate::Driving;
use super::explain;
use crate::cli::WrongArguments;
use crate::futures;
use crate::planners::{ImaginationArgs, PlannerParser};
use crate::run::{Common, Run};
use crate::sampling::Sampling;

/// Arguments of `plan`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// PATH, PATH#INDEX or PATH#SCENARIO_ID
    #[arg(long, value_name = "S")]
    scenario: String,
    /// Who plans
    #[arg(long, value_parser = PlannerParser, value_name = "P", default_value_t = PlannerName::Interactive)]
    planner: PlannerName,
    /// Whom it meets, and what it imagines in: log, idm, constant-velocity or model:WEIGHTS
    #[arg(long, value_name = "W", default_value = "idm")]
    world: WorldName,
    /// Write a page on the decision of a step [default: the first]
    #[arg(long, value_name = "STEP", num_args = 0..=1, default_missing_value = "0")]
    explain: Option<usize>,
    #[command(flatten)]
    #[serde(flatten)]
    driving: Driving,
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

/// A driver that notes what it considered.
struct Noted<'a> {
    inner: Box<dyn Explain + 'a>,
    steps: Vec<Vec<Candidate>>,
    /// The step to explain, and then its past with the decision.
    explain: Option<usize>,
    explained: Option<(Vec<Frame>, Decision)>,
}

impl Driver for Noted<'_> {
    fn name(&self) -> &str {
        self.inner.name()
    }

    fn start(&mut self, mission: &Mission<'_>) -> Result<(), BoxError> {
        self.inner.start(mission)
    }

    fn drive(&mut self, moment: &Moment<'_>) -> Result<Trajectory, BoxError> {
        let plan = self.inner.drive(moment)?;
        self.steps.push(self.inner.candidates());
        if self.explain == Some(moment.iteration) {
            let past = moment.scene.history.to_vec();
            let decision = self.inner.decision().cloned();
            self.explained = decision.map(|decision| (past, decision));
        }
        Ok(plan)
    }
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        self.driving.check()?;
        let sampling = self.sampling.resolve()?;
        self.check_explain(None)?;
        let case = run.phase("read", |_| Ok(recordings::find(&self.scenario)?))?;
        self.check_explain(Some(case.recording.scenario()))?;
        let surroundings = run.phase("load", |run| {
            Ok(PlanningWorld::load(run.device(), &self.world, &sampling)?)
        })?;
        let seed = run.seed();
        let imagined = run.phase("load", |run| {
            Ok(PlanningWorld::load_imagination(
                run.device(),
                &self.world,
                &sampling,
            )?)
        })?;
        let imagination = imagined.imagination();
        let inner = self
            .planner
            .build(&case, imagination, seed, &self.thinking.config()?)?;
        let mut noted = Noted {
            inner,
            steps: Vec::new(),
            explain: self.explain,
            explained: None,
        };
        let mut timed = TimedDriver::new(&mut noted, self.driving.budget());
        let mut traffic = surroundings.traffic(seed);
        let config = self.driving.config();
        let scored = run.phase("drive", |_| {
            let (recording, map) = (&case.recording, &case.map);
            Ok(drive_and_score(
                recording,
                map,
                &mut *traffic,
                &mut timed,
                &config,
            )?)
        })?;
        let milliseconds = timed.milliseconds_per_step();
        let scenario = case.recording.scenario();
        run.phase("write", |run| {
            let label = format!("{} among {}", self.planner.name(), self.world);
            let film = futures::film(scenario, &[(&label, &scored.driven.rollout)])?;
            film.save(&run.path("film.gif"))?;
            write_candidates(run, &noted.steps)?;
            self.explain(run, &case, &noted)
        })?;
        run.result("scenario", &scenario.id)?;
        run.result("planner", self.planner.name())?;
        run.result("world", self.world.to_string())?;
        run.result("steps", scored.driven.ego.len())?;
        run.result("milliseconds_per_step", milliseconds)?;
        tell(run, &scored)?;
        let first = noted.steps.first().map_or(&[][..], |step| step);
        run.result("candidates", first.iter().map(row).collect::<Vec<_>>())
    }
}

impl Args {
    /// Refuses to explain what there will be no decision of, before anything is driven.
    ///
    /// Error: [`WrongArguments`] for a planner that imagines nothing, and for a step beyond the
    /// drive through a scenario.
    fn check_explain(&self, scenario: Option<&Scenario>) -> anyhow::Result<()> {
        let Some(step) = self.explain else {
            return Ok(());
        };
        let wrong = if self.planner != PlannerName::Interactive {
            format!(
                "--explain {step}: expected a planner that imagines before it decides, \
                 interactive, found {}",
                self.planner.name()
            )
        } else if let Some(scenario) = scenario {
            let recorded = scenario.log.len() - scenario.now - 1;
            let steps = recorded.min((self.driving.seconds / scenario.dt).round() as usize);
            if step < steps {
                return Ok(());
            }
            format!(
                "--explain {step}: expected a step of the drive, 0 to {}, found {step}",
                steps.saturating_sub(1)
            )
        } else {
            return Ok(());
        };
        Err(WrongArguments(wrong).into())
    }

    /// Writes the page of the decision that was asked for.
    ///
    /// Error: a planner that imagines nothing, a step that is no decision's.
    fn explain(&self, run: &mut Run, case: &Case, noted: &Noted<'_>) -> anyhow::Result<()> {
        let Some(step) = self.explain else {
            return Ok(());
        };
        let Some((past, decision)) = &noted.explained else {
            let wrong = format!(
                "--explain {step}: expected a step of the drive and a planner that imagines, \
                 found {} steps of {}",
                noted.steps.len(),
                self.planner.name()
            );
            return Err(WrongArguments(wrong).into());
        };
        let scenario = Scenario {
            now: past.len() - 1,
            log: past.clone(),
            ..case.recording.scenario().clone()
        };
        explain::write(run, &scenario, case.recording.vehicle(), decision)?;
        run.result("decision", explain::summary(decision))
    }
}

fn tell(run: &mut Run, scored: &Scored) -> anyhow::Result<()> {
    run.result("score", scored.score)?;
    for (name, score) in scored.metrics.scores() {
        run.result(&name, score)?;
    }
    Ok(())
}

/// A candidate as a row of the table: the first step's are shown, the file has all.
fn row(candidate: &Candidate) -> Value {
    let mut row = json!({
        "candidate": candidate.name,
        "chosen": if candidate.chosen { "yes" } else { "" },
        "score": candidate.score,
    });
    for &(name, value) in &candidate.parts {
        row[name] = json!(value);
    }
    row
}

/// `candidates.json`: per step every candidate, with its poses to the centimetre.
fn write_candidates(run: &Run, steps: &[Vec<Candidate>]) -> anyhow::Result<()> {
    let rounded = |x: f64, unit: f64| (x / unit).round() * unit;
    let all: Vec<Vec<Value>> = steps
        .iter()
        .map(|step| {
            let full = step.iter().map(|candidate| {
                let mut told = row(candidate);
                let poses = candidate.poses.iter().map(|pose| {
                    let p = pose.position;
                    [
                        rounded(p.x, 0.01),
                        rounded(p.y, 0.01),
                        rounded(pose.heading, 1e-4),
                    ]
                });
                told["poses"] = json!(poses.collect::<Vec<_>>());
                told
            });
            full.collect()
        })
        .collect();
    let path = run.path("candidates.json");
    gump_data::write_atomically(&path, |file| {
        serde_json::to_writer(file, &all)
            .map_err(|error| anyhow::anyhow!("cannot write {}: {error}", path.display()))
    })
}
