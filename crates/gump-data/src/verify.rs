//! Verification of every record of a file or directory.
//!
//! A violation of the format or of the invariants of [`Scenario`] is **broken**. Valid but unusual
//! content (two cars that overlap, a car that jumps) is **suspicious**: real recordings contain
//! some of it.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use gump_geometry::DVec2;
use gump_scene::{Agent, AgentKind, Frame, Scenario};
use serde::Serialize;

use crate::formats::registry::{self, Role};
use crate::io::files;
use crate::record::OVERLAP_TOLERANCE;
use crate::{DataError, ReadOptions, ReadReport, ScenarioRecord, open_with};

/// Severity of a finding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// Valid but unusual.
    Suspicious,
    /// Unusable.
    Broken,
}

/// One problem.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Finding {
    /// Its severity.
    pub severity: Severity,
    /// The kind of problem, the key in [`Verification::counts`].
    pub problem: &'static str,
    /// The scenario's id; empty if the record could not be read.
    pub scenario: String,
    /// The problem in a sentence.
    pub detail: String,
}

/// The result of a verification.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Verification {
    /// Number of readable scenarios.
    pub scenarios: usize,
    /// Findings by kind of problem.
    pub counts: BTreeMap<&'static str, usize>,
    /// The findings, in file order; at most [`MAX_FINDINGS`].
    pub findings: Vec<Finding>,
    /// Content by format name.
    pub formats: BTreeMap<&'static str, FormatCounts>,
    /// Files without scenarios, by kind.
    pub skipped: BTreeMap<&'static str, usize>,
    /// Dropped and inferred items, over all scenarios.
    #[serde(flatten)]
    pub report: ReadReport,
}

/// Content of the files of one format.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct FormatCounts {
    /// Files.
    pub files: usize,
    /// Their bytes as stored.
    pub bytes: u64,
    /// Scenarios that could be read.
    pub scenarios: usize,
    /// Agents over time.
    pub tracks: usize,
    /// Frames.
    pub frames: usize,
    /// Lanes.
    pub lanes: usize,
    /// Scenarios with a traffic light in any frame.
    pub with_lights: usize,
    /// Scenarios with a route, stated or inferred.
    pub with_route: usize,
    /// Dropped items.
    pub dropped: usize,
    /// Inferred items.
    pub inferred: usize,
    /// Findings of severity broken.
    pub broken: usize,
    /// Findings of severity suspicious.
    pub suspicious: usize,
}

/// Maximum number of findings that are listed; all are counted. Chosen by hand: a report of a few
/// megabytes.
pub const MAX_FINDINGS: usize = 20_000;

impl Verification {
    /// True if anything is broken.
    pub fn is_broken(&self) -> bool {
        self.formats.values().any(|counts| counts.broken > 0)
    }

    /// Adds the result of another verification.
    pub fn merge(&mut self, other: Self) {
        self.scenarios += other.scenarios;
        for (problem, n) in other.counts {
            *self.counts.entry(problem).or_default() += n;
        }
        let room = MAX_FINDINGS.saturating_sub(self.findings.len());
        self.findings.extend(other.findings.into_iter().take(room));
        for (name, counts) in other.formats {
            self.formats.entry(name).or_default().merge(counts);
        }
        for (what, n) in other.skipped {
            *self.skipped.entry(what).or_default() += n;
        }
        self.report.merge(&other.report);
    }

    fn add(&mut self, format: &'static str, finding: Finding) {
        let counts = self.formats.entry(format).or_default();
        match finding.severity {
            Severity::Broken => counts.broken += 1,
            Severity::Suspicious => counts.suspicious += 1,
        }
        *self.counts.entry(finding.problem).or_default() += 1;
        if self.findings.len() < MAX_FINDINGS {
            self.findings.push(finding);
        }
    }
}

impl FormatCounts {
    fn merge(&mut self, other: Self) {
        self.files += other.files;
        self.bytes += other.bytes;
        self.scenarios += other.scenarios;
        self.tracks += other.tracks;
        self.frames += other.frames;
        self.lanes += other.lanes;
        self.with_lights += other.with_lights;
        self.with_route += other.with_route;
        self.dropped += other.dropped;
        self.inferred += other.inferred;
        self.broken += other.broken;
        self.suspicious += other.suspicious;
    }

    fn add(&mut self, record: &ScenarioRecord) {
        let scenario = &record.scenario;
        let agents = scenario.log.iter().flat_map(Frame::agents);
        self.scenarios += 1;
        self.tracks += agents.map(|agent| agent.id).collect::<BTreeSet<_>>().len();
        self.frames += scenario.log.len();
        self.lanes += scenario.map.lanes().len();
        let lit = scenario.log.iter().any(|frame| !frame.lights().is_empty());
        self.with_lights += usize::from(lit);
        self.with_route += usize::from(scenario.route.is_some());
        self.dropped += record.report.dropped.values().sum::<usize>();
        self.inferred += record.report.inferred.values().sum::<usize>();
    }
}

/// Reads every record of a file, or of every file of a directory and its subdirectories, including
/// checksums, and checks each scenario.
///
/// # Errors
/// Those of [`crate::open`] for a file; in a directory files that cannot be opened are findings.
pub fn verify(path: &Path) -> Result<Verification, DataError> {
    if !path.is_dir() {
        return verify_file(path);
    }
    let mut result = Verification::default();
    for file in files::list(path)? {
        result.merge(verify_one_of_many(&file));
    }
    if result.formats.is_empty() {
        return Err(DataError::NoFiles {
            others: result.skipped.values().sum(),
            path: path.into(),
        });
    }
    Ok(result)
}

/// Checks one file among others: a file that cannot be opened is a finding, one without scenarios
/// is counted.
pub fn verify_one_of_many(file: &Path) -> Verification {
    let mut result = Verification::default();
    match registry::role(file) {
        Ok(Role::Companion(what) | Role::Unknown(what, _)) => {
            result.skipped.insert(what, 1);
            return result;
        }
        Ok(Role::Scenarios(format)) => match verify_file(file) {
            Ok(verification) => return verification,
            // Such a file is valid, but a user who keeps it there expects scenarios in it.
            Err(error @ DataError::NoScenarios { .. }) => {
                let (odd, detail) = (Severity::Suspicious, error.to_string());
                result.add(format.name, found(odd, "file without scenarios", detail));
            }
            Err(error) => result.add(format.name, unreadable("unreadable file", &error)),
        },
        Err(error) => result.add(UNKNOWN, unreadable("unreadable file", &error)),
    }
    for counts in result.formats.values_mut() {
        counts.files = 1;
    }
    result
}

/// The format name of files that are not recognised.
const UNKNOWN: &str = "unknown";

fn verify_file(path: &Path) -> Result<Verification, DataError> {
    let mut result = Verification::default();
    let mut ids = BTreeSet::new();
    let mut reader = open_with(path, ReadOptions::ALL)?;
    let format = reader.format();
    let bytes = std::fs::metadata(path).map_or(0, |metadata| metadata.len());
    let counts = result.formats.entry(format).or_default();
    (counts.files, counts.bytes) = (1, bytes);
    for record in &mut reader {
        match record {
            Ok(record) => add_record(&mut result, format, &record, &mut ids),
            Err(error) => result.add(format, unreadable("unreadable record", &error)),
        }
    }
    Ok(result)
}

fn unreadable(problem: &'static str, error: &DataError) -> Finding {
    found(Severity::Broken, problem, error.to_string())
}

fn add_record(
    result: &mut Verification,
    format: &'static str,
    record: &ScenarioRecord,
    ids: &mut BTreeSet<String>,
) {
    let id = &record.scenario.id;
    result.scenarios += 1;
    result.formats.entry(format).or_default().add(record);
    result.report.merge(&record.report);
    let named = |finding| Finding {
        scenario: id.clone(),
        ..finding
    };
    if !ids.insert(id.clone()) {
        let detail = format!("expected unique scenario ids, found {id} twice");
        let doubled = found(Severity::Broken, "scenario id occurs twice", detail);
        result.add(format, named(doubled));
    }
    for note in &record.report.notes {
        let damage = found(Severity::Suspicious, note.reason, note.detail.clone());
        result.add(format, named(damage));
    }
    for finding in scenario_findings(record) {
        result.add(format, named(finding));
    }
}

fn found(severity: Severity, problem: &'static str, detail: String) -> Finding {
    Finding {
        severity,
        problem,
        scenario: String::new(),
        detail,
    }
}

/// All unusual properties of one scenario, without its id.
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
/// hardest braking or turning explains: above the noise of trackers. Chosen by hand.
const JUMP: f64 = 1.0;
/// The hardest braking or turning that explains a deviation, metres per second squared: beyond what
/// tyres hold, so that what is found is no driving.
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
