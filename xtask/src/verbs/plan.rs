//! `plan`: one planner through one scenario, with everything it considered.

use std::fmt;
use std::str::FromStr;

use gump_eval::planners::{PlannerName, PlanningWorld, TimedDriver};
use gump_eval::recordings;
use gump_eval::recordings::Case;
use gump_eval::worlds::WorldName;
use gump_nuplan::closed_loop::{Driver, PlannerInitialization, PlannerInput};
use gump_nuplan::tracking::Trajectory;
use gump_planner::closed_loop::{Scored, drive_and_score};
use gump_planner::{Candidate, Decision, Explain};
use gump_rollout::BoxError;
use gump_scene::{Agent, Frame, Rollout, Scenario};
use serde::Serialize;
use serde_json::{Value, json};

use super::evaluate::Driving;
use super::explain;
use crate::cli::WrongArguments;
use crate::films::{self, FilmArgs};
use crate::planners::{ImaginationArgs, planner};
use crate::run::{Common, Run, stop_if_interrupted};
use crate::sampling::Sampling;

/// Arguments of `plan`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// PATH, PATH#INDEX or PATH#SCENARIO_ID
    #[arg(long, value_name = "S")]
    scenario: String,
    /// Planner that drives
    #[arg(long, value_parser = planner(), value_name = "P", default_value_t = PlannerName::Interactive)]
    planner: PlannerName,
    /// Traffic model of the drive and of the planner's rollouts: log (rollouts: idm), idm,
    /// constant-velocity or model:WEIGHTS
    #[arg(long, value_name = "W", default_value = "idm")]
    world: WorldName,
    /// Write a page that explains the decision of a step [default: the most decisive one]
    #[arg(long, value_name = "STEP", num_args = 0..=1, default_missing_value = "decisive")]
    explain: Option<Step>,
    #[command(flatten)]
    #[serde(flatten)]
    film: FilmArgs,
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

/// The decision to explain.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(into = "String")]
enum Step {
    /// The decision whose choice beats its alternatives by most.
    Decisive,
    /// The one that the ego followed at a step of the drive.
    Number(usize),
}

impl FromStr for Step {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "decisive" => Ok(Self::Decisive),
            _ => text
                .parse()
                .map(Self::Number)
                .map_err(|_| "expected a step of the drive, or decisive".into()),
        }
    }
}

impl fmt::Display for Step {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Decisive => f.write_str("decisive"),
            Self::Number(step) => write!(f, "{step}"),
        }
    }
}

impl From<Step> for String {
    fn from(step: Step) -> Self {
        step.to_string()
    }
}

/// A driver that notes what it considered.
struct Noted<'a> {
    inner: Box<dyn Explain + 'a>,
    steps: Vec<Vec<Candidate>>,
    explain: Option<Step>,
    /// The decision to explain as far as the drive has come.
    explained: Option<Noteworthy>,
}

/// A decision and when it was made.
struct Noteworthy {
    step: usize,
    past: Vec<Frame>,
    decision: Decision,
    /// Weight of the decision among those of the drive.
    weight: f64,
}

impl Noted<'_> {
    /// Keeps the decision of this moment if it is the one to explain so far.
    fn note(&mut self, input: &PlannerInput<'_>) {
        let (Some(explain), Some(decision)) = (self.explain, self.inner.decision()) else {
            return;
        };
        // Between two decisions the ego follows the older one, which began with others elsewhere.
        let now = input.scene.now();
        let is_here = |then: &Agent| {
            let position = |agent: &Agent| agent.state.pose.position;
            now.agent(then.id)
                .is_some_and(|agent| position(agent).distance(position(then)) < 1e-6)
        };
        let begins_now = |future: &Rollout| future.start().agents().iter().all(is_here);
        let is_new = decision.candidates[decision.chosen]
            .futures
            .first()
            .is_some_and(begins_now);
        let weight = explain::weight(decision);
        let is_requested = match explain {
            Step::Number(step) => input.iteration <= step,
            Step::Decisive => self.explained.as_ref().is_none_or(|e| weight > e.weight),
        };
        if is_requested && (is_new || self.explained.is_none()) {
            self.explained = Some(Noteworthy {
                step: input.iteration,
                past: input.scene.history.to_vec(),
                decision: decision.clone(),
                weight,
            });
        }
    }
}

impl Driver for Noted<'_> {
    fn name(&self) -> &str {
        self.inner.name()
    }

    fn start(&mut self, initialization: &PlannerInitialization<'_>) -> Result<(), BoxError> {
        self.inner.start(initialization)
    }

    fn drive(&mut self, input: &PlannerInput<'_>) -> Result<Trajectory, BoxError> {
        // A drive takes a minute; after Ctrl-C its remainder is of no use.
        stop_if_interrupted()?;
        let plan = self.inner.drive(input)?;
        self.steps.push(self.inner.candidates());
        self.note(input);
        Ok(plan)
    }
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        self.driving.check()?;
        self.film.check()?;
        let sampling = self.sampling.resolve_for(&[&self.world])?;
        let thinking = self.thinking.config()?;
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
                &self.thinking.sampling(&sampling),
            )?)
        })?;
        let imagination = imagined.imagination();
        let inner = self.planner.build(&case, imagination, seed, &thinking)?;
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
        let driven = self.steps(scenario) as f64 * scenario.dt;
        if driven + 0.5 * scenario.dt < self.driving.seconds {
            run.print(&format!(
                "drove {driven:.1} of {} s, the recording ends",
                self.driving.seconds
            ));
        }
        run.phase("write", |run| {
            let label = films::label(self.planner.name(), &self.world);
            self.film
                .write(run, scenario, &[(&label, &scored.driven.rollout)])?;
            write_candidates(run, &noted.steps)?;
            self.explain(run, &case, &noted)
        })?;
        run.result("scenario", &scenario.id)?;
        run.result("planner", self.planner.name())?;
        run.result("world", self.world.to_string())?;
        run.result("steps", scored.driven.ego.len())?;
        run.result("milliseconds_per_step", milliseconds)?;
        report(run, &scored)?;
        let step = noted
            .explained
            .as_ref()
            .map_or(0, |explained| explained.step);
        let shown = noted.steps.get(step).map_or(&[][..], |step| step);
        run.result("candidates_step", step)?;
        run.result("candidates", shown.iter().map(row).collect::<Vec<_>>())?;
        let page = match self.explain {
            Some(_) => "explain.html",
            None => "film.gif",
        };
        if run.path(page).is_file() {
            run.print(&format!("open {}", run.path(page).display()));
        }
        Ok(())
    }
}

impl Args {
    /// Refuses `--explain` where there will be no decision to explain, before anything is driven.
    ///
    /// Error: [`WrongArguments`] for a planner without rollouts, and for a step beyond the drive
    /// through a scenario.
    fn check_explain(&self, scenario: Option<&Scenario>) -> anyhow::Result<()> {
        let Some(requested) = self.explain else {
            return Ok(());
        };
        let wrong = if self.planner != PlannerName::Interactive {
            format!(
                "--explain {requested}: expected --planner interactive, which decides by rollouts, \
                 found {}",
                self.planner.name()
            )
        } else if let (Some(scenario), Step::Number(step)) = (scenario, requested) {
            let steps = self.steps(scenario);
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

    /// Steps of the drive: a recording may be shorter than what is to be driven.
    fn steps(&self, scenario: &Scenario) -> usize {
        let recorded = scenario.log.len() - scenario.now - 1;
        recorded.min((self.driving.seconds / scenario.dt).round() as usize)
    }

    /// Writes the page of the requested decision.
    ///
    /// Error: a planner without rollouts, a drive without a step.
    fn explain(&self, run: &mut Run, case: &Case, noted: &Noted<'_>) -> anyhow::Result<()> {
        let Some(requested) = self.explain else {
            return Ok(());
        };
        let Some(Noteworthy {
            step,
            past,
            decision,
            ..
        }) = &noted.explained
        else {
            let wrong = format!(
                "--explain {requested}: expected a step of the drive and --planner interactive, \
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
        let explained = explain::Explained {
            scenario: &scenario,
            vehicle: case.recording.vehicle(),
            decision,
            time: *step as f64 * scenario.dt,
        };
        explained.write(run)?;
        run.result("decision_step", step)?;
        run.result("decision", explain::summary(decision))
    }
}

fn report(run: &mut Run, scored: &Scored) -> anyhow::Result<()> {
    run.result("score", scored.score)?;
    for (name, score) in scored.metrics.scores() {
        run.result(&name, score)?;
    }
    Ok(())
}

/// A candidate as a row of the table: those of the first step are shown, or of the one explained;
/// the file has all.
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
                let mut value = row(candidate);
                let poses = candidate.poses.iter().map(|pose| {
                    let p = pose.position;
                    [
                        rounded(p.x, 0.01),
                        rounded(p.y, 0.01),
                        rounded(pose.heading, 1e-4),
                    ]
                });
                value["poses"] = json!(poses.collect::<Vec<_>>());
                value
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
