//! Whether every record of a file or directory is sound.
//!
//! What breaks a promise of the format or of [`Scenario`] is **broken**. What is legal but odd (two
//! cars that overlap, a car that jumps) is **suspicious**: real recordings have some of it.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use gump_geometry::DVec2;
use gump_scene::{Agent, AgentKind, Frame, Scenario};
use serde::Serialize;

use crate::{DataError, ReadOptions, ScenarioRecord, open_with};

/// How bad a finding is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// Legal but odd.
    Suspicious,
    /// Unusable as it is.
    Broken,
}

/// One thing that is wrong.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Finding {
    /// How bad it is.
    pub severity: Severity,
    /// What kind of problem, the key in [`Verification::counts`].
    pub problem: &'static str,
    /// The scenario's id; empty if the record could not be read.
    pub scenario: String,
    /// The problem in a sentence.
    pub detail: String,
}

/// What a check of a file or directory found.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Verification {
    /// Scenarios that could be read.
    pub scenarios: usize,
    /// Findings by kind of problem.
    pub counts: BTreeMap<&'static str, usize>,
    /// The findings, in file order.
    pub findings: Vec<Finding>,
}

impl Verification {
    /// True if anything is broken.
    pub fn is_broken(&self) -> bool {
        let broken = |finding: &Finding| finding.severity == Severity::Broken;
        self.findings.iter().any(broken)
    }

    fn add(&mut self, finding: Finding) {
        *self.counts.entry(finding.problem).or_default() += 1;
        self.findings.push(finding);
    }
}

/// Reads every record, checksums included, and checks each scenario.
///
/// # Errors
/// Those of [`crate::open`]; broken records are findings.
pub fn verify(path: &Path) -> Result<Verification, DataError> {
    let mut result = Verification::default();
    let mut ids = BTreeSet::new();
    for record in open_with(path, ReadOptions::ALL)? {
        match record {
            Ok(record) => {
                result.scenarios += 1;
                let id = record.scenario.id.clone();
                if !ids.insert(id.clone()) {
                    let detail = format!("expected unique scenario ids, found {id} twice");
                    let doubled = found(Severity::Broken, "scenario id occurs twice", detail);
                    result.add(Finding {
                        scenario: id.clone(),
                        ..doubled
                    });
                }
                for finding in scenario_findings(&record) {
                    result.add(Finding {
                        scenario: id.clone(),
                        ..finding
                    });
                }
            }
            Err(error) => {
                result.add(found(
                    Severity::Broken,
                    "unreadable record",
                    error.to_string(),
                ));
            }
        }
    }
    Ok(result)
}

fn found(severity: Severity, problem: &'static str, detail: String) -> Finding {
    Finding {
        severity,
        problem,
        scenario: String::new(),
        detail,
    }
}

/// Everything odd about one scenario, without its id.
fn scenario_findings(record: &ScenarioRecord) -> Vec<Finding> {
    let scenario = &record.scenario;
    let mut findings = Vec::new();
    let mut suspect = |problem, detail| {
        findings.push(found(Severity::Suspicious, problem, detail));
    };
    overlapping_starts(scenario, &mut suspect);
    motion(scenario, &mut suspect);
    roles(scenario, &mut suspect);
    lights(scenario, &mut suspect);
    if scenario.route.is_none() {
        let detail = format!("the log of ego {} follows no lane", scenario.ego);
        suspect("missing route", detail);
    }
    if scenario.map.lanes().is_empty() {
        suspect("map without lanes", "expected lanes, found none".into());
    }
    for what in DEAD_LINKS {
        if let Some(n) = record.report.dropped.get(what) {
            suspect(what, format!("found {n}"));
        }
    }
    findings
}

/// Reasons in a reader's report that mean references to nothing.
const DEAD_LINKS: [&str; 2] = [
    "link to a lane that is not in the map",
    "neighbour that is not in the map",
];

/// Boxes may interpenetrate this much before it counts, metres: the precision of annotation.
pub(crate) const OVERLAP_TOLERANCE: f64 = 0.1;

fn overlapping_starts(scenario: &Scenario, suspect: &mut impl FnMut(&'static str, String)) {
    let agents = scenario.present().now().agents();
    for (i, a) in agents.iter().enumerate() {
        for b in &agents[i + 1..] {
            let (box_a, box_b) = (a.oriented_box(), b.oriented_box());
            if box_a.overlaps(&box_b) {
                let depth = -box_a.signed_distance(&box_b);
                if depth > OVERLAP_TOLERANCE {
                    let (a, b) = (a.id, b.id);
                    suspect(
                        "overlapping start",
                        format!("agents {a} and {b} by {depth:.2} m"),
                    );
                }
            }
        }
    }
}

/// No agent of this kind goes faster in traffic, metres per second: 288 km/h for vehicles, the
/// fastest sprint ever run (12.4 m/s) for pedestrians, a fast descent for bicycles.
fn top_speed(kind: AgentKind) -> f64 {
    match kind {
        AgentKind::Vehicle
        | AgentKind::TrafficCone
        | AgentKind::Barrier
        | AgentKind::Sign
        | AgentKind::Other => 80.0,
        AgentKind::Pedestrian => 12.5,
        AgentKind::Bicycle => 30.0,
    }
}

/// An agent may end a step this far from where its velocity leads, metres, beside what the
/// hardest braking or turning explains.
const JUMP: f64 = 1.0;
/// The hardest braking or turning that explains a deviation, metres per second squared.
const HARDEST: f64 = 15.0;

fn motion(scenario: &Scenario, suspect: &mut impl FnMut(&'static str, String)) {
    for (step, frame) in scenario.log.iter().enumerate() {
        for agent in frame.agents() {
            let speed = agent.state.speed();
            if speed > top_speed(agent.kind) {
                let (id, kind) = (agent.id, agent.kind.name());
                suspect(
                    "impossible speed",
                    format!("{kind} {id} at {speed:.1} m/s in frame {step}"),
                );
            }
        }
    }
    for (step, pair) in scenario.log.windows(2).enumerate() {
        for (id, jump) in jumps(&pair[0], &pair[1], scenario.dt) {
            suspect(
                "jump",
                format!("agent {id} by {jump:.1} m before frame {}", step + 1),
            );
        }
    }
}

fn jumps<'a>(
    before: &'a Frame,
    after: &'a Frame,
    dt: f64,
) -> impl Iterator<Item = (gump_scene::AgentId, f64)> + 'a {
    let deviation = move |a: &Agent, b: &Agent| -> DVec2 {
        let mean_velocity = (a.state.velocity + b.state.velocity) / 2.0;
        b.state.pose.position - a.state.pose.position - mean_velocity * dt
    };
    before.agents().iter().filter_map(move |a| {
        let off = deviation(a, after.agent(a.id)?).length();
        (off > JUMP + HARDEST * dt * dt / 2.0).then_some((a.id, off))
    })
}

fn roles(scenario: &Scenario, suspect: &mut impl FnMut(&'static str, String)) {
    let present = scenario.present().now();
    for id in &scenario.targets {
        if present.agent(*id).is_none() {
            suspect(
                "absent target",
                format!("agent {id} is not there at the present"),
            );
        }
    }
    for id in &scenario.objects_of_interest {
        if !scenario.log.iter().any(|frame| frame.agent(*id).is_some()) {
            suspect(
                "unknown object of interest",
                format!("agent {id} is never there"),
            );
        }
    }
}

fn lights(scenario: &Scenario, suspect: &mut impl FnMut(&'static str, String)) {
    let lit: BTreeSet<_> = scenario
        .log
        .iter()
        .flat_map(|frame| frame.lights().iter().map(|light| light.lane))
        .collect();
    for lane in &lit {
        if scenario.map.lane(*lane).is_none() {
            suspect(
                "light of an unknown lane",
                format!("lane {lane} is not in the map"),
            );
        }
    }
    let dark = scenario
        .log
        .iter()
        .filter(|frame| frame.lights().is_empty());
    let n_dark = dark.count();
    if !lit.is_empty() && n_dark > 0 {
        suspect(
            "missing lights",
            format!("in {n_dark} of {} frames", scenario.log.len()),
        );
    }
}
