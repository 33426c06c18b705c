//! Cost of a decision among learned drivers, by phase.

use std::time::{Duration, Instant};

use gump_engine::{Precision, SamplingConfig};
use gump_eval::planners::PlanningWorld;
use gump_eval::recordings;
use gump_nuplan::closed_loop::{
    DriveConfig, Driver, PlannerInitialization, PlannerInput, Replayed, drive,
};
use gump_nuplan::tracking::Trajectory;
use gump_planner::{Explain, InteractiveDriver, InteractiveDriverConfig, Phases};
use gump_rollout::BoxError;
use serde_json::{Value, json};

use crate::run::Run;
use crate::shipped;

/// Seconds between two looks at the recording.
const DT: f64 = 0.1;

/// A driver that notes where its time went.
struct Watched<'w> {
    inner: InteractiveDriver<'w>,
    /// Of every decision, the whole and what its planner knows of it.
    decisions: Vec<(Duration, Phases)>,
}

impl Driver for Watched<'_> {
    fn name(&self) -> &str {
        self.inner.name()
    }

    fn start(&mut self, initialization: &PlannerInitialization<'_>) -> Result<(), BoxError> {
        self.inner.start(initialization)
    }

    fn drive(&mut self, input: &PlannerInput<'_>) -> Result<Trajectory, BoxError> {
        let began = Instant::now();
        let plan = self.inner.drive(input)?;
        let phases = self.inner.decision().map(|decision| decision.phases);
        self.decisions
            .push((began.elapsed(), phases.unwrap_or_default()));
        Ok(plan)
    }
}

/// Median milliseconds of every phase over `n` decisions with the shipped weights in the shipped
/// scenario: 20 candidates (more beside other lanes), 4 futures of 4 s for the finalists, the 12
/// nearest agents. One decision before them is a warm-up.
///
/// Error: no shipped weights, or a drive that fails.
pub(crate) fn rows(run: &Run, n: usize, precision: Precision) -> anyhow::Result<Vec<Value>> {
    shipped::check_weights()?;
    let case = recordings::find(&shipped::scenario())?;
    let sampling = SamplingConfig {
        precision,
        ..SamplingConfig::default()
    };
    let world = PlanningWorld::load_imagination(run.device(), &shipped::world(), &sampling)?;
    let config = InteractiveDriverConfig {
        replan_every: 1,
        seed: run.seed(),
        ..InteractiveDriverConfig::default()
    };
    let began = Instant::now();
    let planner = InteractiveDriver::new(world.imagination(), config)?;
    let mut watched = Watched {
        inner: planner.with_clock(|| began.elapsed()),
        decisions: Vec::new(),
    };
    let config = DriveConfig {
        seconds: (n + 1) as f64 * DT,
        ..DriveConfig::default()
    };
    drive(&case.recording, &mut Replayed, &mut watched, &config)?;
    let decisions = &watched.decisions[1.min(watched.decisions.len())..];
    let median = |part: &dyn Fn(&(Duration, Phases)) -> Duration| {
        let mut all: Vec<Duration> = decisions.iter().map(part).collect();
        all.sort_unstable();
        let middle = all.get(all.len() / 2).copied();
        middle.map(|time| time.as_secs_f64() * 1e3)
    };
    let row = |what: &str, part: &dyn Fn(&(Duration, Phases)) -> Duration| json!({ "phase": what, "milliseconds": median(part) });
    Ok(vec![
        row("the way, the road, who is there", &|(whole, phases)| {
            whole.saturating_sub(phases.total())
        }),
        row("opening the world: map, history", &|(_, phases)| {
            phases.open
        }),
        row("the world's frames", &|(_, phases)| phases.frames),
        row("policies and tracking", &|(_, phases)| phases.policies),
        row("judging", &|(_, phases)| phases.score),
        row("a decision", &|(whole, _)| *whole),
    ])
}
