//! The output of a reader: a scenario, and a report of dropped and inferred items.

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
    /// Dropped and inferred items.
    pub report: ReadReport,
    /// Start of its record, bytes from the start of the (uncompressed) content.
    pub offset: u64,
    /// The file it came from.
    pub path: Arc<PathBuf>,
}

/// Boxes may overlap this much before it counts, metres: the precision of annotation.
pub(crate) const OVERLAP_TOLERANCE: f64 = 0.1;

/// Items that a reader dropped and inferred, by reason, with counts.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct ReadReport {
    /// Stated by the format but not in the scenario.
    pub dropped: BTreeMap<&'static str, usize>,
    /// In the scenario but not stated by the format.
    pub inferred: BTreeMap<&'static str, usize>,
    /// Single damaged items that were dropped, each with its place; at most [`MAX_NOTES`].
    #[serde(skip)]
    pub notes: Vec<Note>,
}

/// One damaged item that was dropped.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Note {
    /// The reason, a key of [`ReadReport::dropped`].
    pub reason: &'static str,
    /// Its identity, and the problem.
    pub detail: String,
}

/// Maximum number of damaged items that are listed one by one; all are counted. Chosen by hand.
pub const MAX_NOTES: usize = 200;

impl ReadReport {
    /// Counts `n` dropped items; zero counts leave no entry.
    pub fn drop(&mut self, reason: &'static str, n: usize) {
        add(&mut self.dropped, reason, n);
    }

    /// Counts one damaged item as dropped and lists it.
    pub fn drop_damaged(&mut self, reason: &'static str, detail: impl FnOnce() -> String) {
        self.drop(reason, 1);
        if self.notes.len() < MAX_NOTES {
            let detail = detail();
            self.notes.push(Note { reason, detail });
        }
    }

    /// Counts `n` inferred items; zero counts leave no entry.
    pub fn infer(&mut self, what: &'static str, n: usize) {
        add(&mut self.inferred, what, n);
    }

    /// Adds the counts of another report, without its notes.
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

/// The gaps of a format that a reader fills by inference.
///
/// The default fills all of them: planners need routes and drivable surfaces. Smoothing changes
/// stated values and is off by default.
///
/// # Information about the future in the present
///
/// States, sizes and lights up to the present are inferred only from frames up to the present: two
/// recordings that are equal until then have equal pasts. Four items do use the future, each with
/// its own option: the route ([`gump_scene::SceneState::unguided`] removes it), the prediction
/// targets (not part of a scene), the choice of the ego where a format does not state it, and
/// smoothing. Stated values are kept, even if their authors used the future: a map that is cut out
/// along the ego's path, or a size that is the same in all frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ReadOptions {
    /// Links and neighbours of lanes, from the centre lines, where a format states no links at all.
    pub infer_lane_graph: bool,
    /// Speed limits of lanes without one, from the lanes before, after and beside.
    pub infer_speed_limits: bool,
    /// Lane widths from the lines and lanes beside them; otherwise every lane has the default.
    pub infer_widths: bool,
    /// Lanes inside intersections, from the lanes they cross, fork from and join.
    pub infer_intersections: bool,
    /// Drivable surfaces from lanes and road edges; otherwise a map without stated surfaces has
    /// none, so that nothing counts as off-road.
    pub infer_drivable: bool,
    /// Road edges along the border of the drivable surface, where a format states none.
    pub infer_edges: bool,
    /// The lane of a light with a stated position only.
    pub infer_light_lanes: bool,
    /// The lanes of stop signs, where a format states only their positions.
    pub infer_stop_sign_lanes: bool,
    /// Colours of lights for up to four seconds between two observations of the same colour, in
    /// recordings that lose sight of lights (Waymo's); up to the present, between two observations
    /// up to the present. Official metrics use the recorded values.
    pub infer_light_gaps: bool,
    /// The ego's route from its logged path, **including the future**: it reveals where the ego
    /// went, as a navigation system would, but not when or how.
    pub infer_route: bool,
    /// The ego, where a format does not state it; otherwise such a record is refused.
    pub infer_ego: bool,
    /// Prediction targets, in formats without them: up to eight moving agents near the ego that are
    /// present for at least half of the future; otherwise none.
    pub infer_targets: bool,
    /// Sizes of agents by their class; otherwise agents without a size are dropped.
    pub infer_sizes: bool,
    /// Velocities from positions and headings from velocities; otherwise states without them are
    /// dropped.
    pub infer_motion: bool,
    /// Elevations of agents from the map; otherwise 0.
    pub infer_elevation: bool,
    /// Replaces tracks by a smoothed version, with consistent velocities and headings: for noisy
    /// recordings such as NGSIM. Uses 0.3 s on both sides, **at the present too**. Never on by
    /// default.
    pub smooth: bool,
    /// Gives a recording without agents (a map alone) one parked vehicle on its longest lane as the
    /// ego; otherwise it is refused. Never on by default.
    pub park_an_ego: bool,
}

impl ReadOptions {
    /// No inference.
    pub const STATED: Self = Self {
        infer_lane_graph: false,
        infer_speed_limits: false,
        infer_widths: false,
        infer_intersections: false,
        infer_drivable: false,
        infer_edges: false,
        infer_light_lanes: false,
        infer_stop_sign_lanes: false,
        infer_light_gaps: false,
        infer_route: false,
        infer_ego: false,
        infer_targets: false,
        infer_sizes: false,
        infer_motion: false,
        infer_elevation: false,
        smooth: false,
        park_an_ego: false,
    };
    /// Fills every gap; no smoothing.
    pub const ALL: Self = Self {
        infer_lane_graph: true,
        infer_speed_limits: true,
        infer_widths: true,
        infer_intersections: true,
        infer_drivable: true,
        infer_edges: true,
        infer_light_lanes: true,
        infer_stop_sign_lanes: true,
        infer_light_gaps: true,
        infer_route: true,
        infer_ego: true,
        infer_targets: true,
        infer_sizes: true,
        infer_motion: true,
        infer_elevation: true,
        smooth: false,
        park_an_ego: false,
    };
}

impl Default for ReadOptions {
    fn default() -> Self {
        Self::ALL
    }
}
