//! `bench planning`: planner, traffic and a whole scored drive, and a decision among learned drivers.

use std::fmt::Write as _;
use std::num::NonZeroUsize;
use std::time::Instant;

use anyhow::Context as _;
use gump_engine::Precision;
use gump_eval::planners::TimedDriver;
use gump_nuplan::closed_loop::{DriveConfig, Recording, Replayed, derive_roadblocks, drive};
use gump_nuplan::reactive_agents::NuplanIdm;
use gump_planner::PdmClosed;
use gump_planner::closed_loop::drive_and_score;
use serde::Serialize;
use serde_json::{Value, json};

use super::decision;
use crate::choices::{PRECISIONS, one_of};
use crate::run::{Common, Run};

/// Milliseconds of a PDM-Closed step in its authors' Python.
///
/// Source: Dauner et al. 2023, on real maps with up to some fifty agents.
const PYTHON_PDM_MS: f64 = 91.0;
/// Milliseconds of CPU of nuplan-devkit on a two-core machine, on a small map with 18 objects:
/// a step of PDM-Closed, a step of reactive traffic with the controller, the controller alone, and
/// all closed-loop metrics of a scenario.
const DEVKIT_PDM_MS: f64 = 61.475;
const DEVKIT_PROPAGATE_MS: f64 = 8.839;
const DEVKIT_CONTROLLER_MS: f64 = 4.821;
const DEVKIT_METRICS_MS: f64 = 168.85;
/// Reactive agents in the devkit's measurement.
const DEVKIT_AGENTS: f64 = 9.0;
const DEVKIT_STEPS: f64 = 150.0;

/// Arguments of `bench planning`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// Vehicles besides the ego
    #[arg(long, value_name = "N", default_value_t = 50)]
    agents: usize,
    /// Decisions of the interactive planner among learned drivers to time
    #[arg(long, value_name = "N", default_value = "5")]
    decisions: NonZeroUsize,
    /// Number format of the learned drivers' weights
    #[arg(long, value_parser = one_of(PRECISIONS), default_value_t = Precision::F32)]
    precision: Precision,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let recording = recording(self.agents)?;
        let map = &recording.scenario().map;
        let config = DriveConfig::default();

        let mut planner = PdmClosed::default();
        let mut timed = TimedDriver::new(&mut planner, None);
        let began = Instant::now();
        let mut traffic = NuplanIdm::default();
        let scored = drive_and_score(&recording, map, &mut traffic, &mut timed, &config)?;
        let whole_s = began.elapsed().as_secs_f64();
        let pdm_ms = timed.milliseconds_per_step();
        let steps = scored.driven.ego.len() as f64;

        // The same drive without a planner that thinks: what is left is traffic and controller.
        let mut log = gump_planner::LogDriver::new(&recording, &[]);
        let began = Instant::now();
        drive(&recording, &mut Replayed, &mut log, &config)?;
        let replayed_s = began.elapsed().as_secs_f64();
        let mut traffic = NuplanIdm::default();
        let began = Instant::now();
        let driven = drive(&recording, &mut traffic, &mut log, &config)?;
        let reactive_s = (began.elapsed().as_secs_f64() - replayed_s).max(1e-9);
        let agents = driven.rollout.last().now().agents().len() - 1;
        let agent_steps = agents as f64 * steps / reactive_s;

        let devkit_whole_s =
            (DEVKIT_STEPS * (DEVKIT_PDM_MS + DEVKIT_PROPAGATE_MS) + DEVKIT_METRICS_MS) * 1e-3;
        let devkit_agent_steps =
            DEVKIT_AGENTS / ((DEVKIT_PROPAGATE_MS - DEVKIT_CONTROLLER_MS) * 1e-3);
        run.result("agents", self.agents)?;
        run.result("steps", steps)?;
        run.result(
            "rows",
            [
                row(
                    "PDM-Closed, ms a step",
                    PYTHON_PDM_MS / pdm_ms,
                    pdm_ms,
                    PYTHON_PDM_MS,
                ),
                row(
                    "drive and score, s",
                    devkit_whole_s / whole_s,
                    whole_s,
                    devkit_whole_s,
                ),
                row(
                    "reactive agent-steps per second",
                    agent_steps / devkit_agent_steps,
                    agent_steps,
                    devkit_agent_steps,
                ),
            ],
        )?;
        run.result(
            "decision",
            decision::rows(run, self.decisions.get(), self.precision)?,
        )
    }
}

fn row(what: &str, ratio: f64, ours: f64, reference: f64) -> Value {
    json!({ "what": what, "ratio": ratio, "ours": ours, "reference": reference })
}

/// Fifteen seconds on a curved road of four lanes with `n_agents` vehicles.
fn recording(n_agents: usize) -> anyhow::Result<Recording> {
    const RADIUS: f64 = 400.0;
    const LANES: usize = 4;
    let at = |lane: usize, s: f64| {
        let (angle, r) = (s / RADIUS, RADIUS - 3.5 * lane as f64);
        (r * angle.sin(), RADIUS - r * angle.cos(), angle)
    };
    let mut text = String::from("history 2.2 future 15.1 dt 0.1\n");
    for lane in 0..LANES {
        write!(text, "lane {}:", lane + 1)?;
        for i in 0..=500 {
            let (x, y, _) = at(lane, f64::from(i));
            write!(text, " {x:.4},{y:.4}")?;
        }
        text.push_str(" speed 12");
        if lane > 0 {
            write!(text, " right {lane}")?;
        }
        if lane + 1 < LANES {
            write!(text, " left {}", lane + 2)?;
        }
        text.push('\n');
    }
    let mut place = |what: &str, lane: usize, s: f64| -> anyhow::Result<()> {
        let (x, y, h) = at(lane, s);
        let (vx, vy) = (8.0 * h.cos(), 8.0 * h.sin());
        writeln!(
            text,
            "{what}: {x:.4},{y:.4} heading {h:.6} velocity {vx:.4},{vy:.4}"
        )?;
        Ok(())
    };
    place("ego vehicle 0", 1, 100.0)?;
    for i in 0..n_agents {
        let (lane, row) = (i % LANES, i / LANES);
        let s = 60.0 + 10.0 * row as f64;
        // The ego's own place stays free.
        let s = if lane == 1 && s >= 95.0 { s + 10.0 } else { s };
        place(&format!("agent vehicle {}", i + 1), lane, s)?;
    }
    text.push_str("route 2\n");
    let mut scenario = gump_scene::fixture::scenario(&text)
        .map_err(|what| anyhow::anyhow!("{what}"))
        .context("the bench's own scene")?;
    derive_roadblocks(&mut scenario);
    Ok(Recording::of_boxes(scenario)?)
}
