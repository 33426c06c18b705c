//! What a reader yields: a scenario, and an account of what was left out and what was added.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

use gump_scene::Scenario;
use serde::Serialize;

/// One scenario of a file.
#[derive(Clone, Debug)]
pub struct ScenarioRecord {
    /// The scenario, validated.
    pub scenario: Scenario,
    /// What was left out and what was added.
    pub report: ReadReport,
    /// Where its record starts, bytes from the start of the (uncompressed) content.
    pub offset: u64,
    /// The file it came from.
    pub path: Arc<PathBuf>,
}

/// What a reader left out and what it added, by reason, with counts.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct ReadReport {
    /// Stated by the format but not in the scenario.
    pub dropped: BTreeMap<&'static str, usize>,
    /// In the scenario but not stated by the format.
    pub inferred: BTreeMap<&'static str, usize>,
}

impl ReadReport {
    /// Counts `n` things left out; zero counts leave no entry.
    pub fn drop(&mut self, reason: &'static str, n: usize) {
        add(&mut self.dropped, reason, n);
    }

    /// Counts `n` things added; zero counts leave no entry.
    pub fn infer(&mut self, what: &'static str, n: usize) {
        add(&mut self.inferred, what, n);
    }

    /// Adds the counts of another report.
    pub fn merge(&mut self, other: &Self) {
        for (reason, n) in &other.dropped {
            self.drop(reason, *n);
        }
        for (what, n) in &other.inferred {
            self.infer(what, *n);
        }
    }
}

fn add(counts: &mut BTreeMap<&'static str, usize>, key: &'static str, n: usize) {
    if n > 0 {
        *counts.entry(key).or_default() += n;
    }
}

/// Which gaps of a format a reader may fill by inference.
///
/// The default fills all of them: planners need routes and drivable surfaces.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ReadOptions {
    /// Lane widths from the lines and lanes beside them; otherwise every lane has the default.
    pub infer_widths: bool,
    /// Which lanes lie inside an intersection, from the lanes they cross, fork from and join.
    pub infer_intersections: bool,
    /// Drivable surfaces from lanes and road edges; otherwise a map without stated surfaces has
    /// none, which means that nothing is off-road.
    pub infer_drivable: bool,
    /// The ego's route from its logged path, **future included**: it tells where the ego went,
    /// as a navigation system would; it does not tell when or how.
    pub infer_route: bool,
}

impl ReadOptions {
    /// Takes only what a format states.
    pub const STATED: Self = Self {
        infer_widths: false,
        infer_intersections: false,
        infer_drivable: false,
        infer_route: false,
    };
    /// Fills every gap that can be filled.
    pub const ALL: Self = Self {
        infer_widths: true,
        infer_intersections: true,
        infer_drivable: true,
        infer_route: true,
    };
}

impl Default for ReadOptions {
    fn default() -> Self {
        Self::ALL
    }
}
