//! Summary statistics of a file or directory; `xtask` prints them.

use std::collections::BTreeMap;
use std::path::Path;

use gump_scene::{AgentId, AgentKind, AreaKind, LaneKind, LightState, Scenario};
use serde::Serialize;

use crate::{DataError, ReadOptions, ReadReport, open_with};

/// Content of a file or directory.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Summary {
    /// The name of the format.
    pub format: String,
    /// Number of readable scenarios.
    pub scenarios: usize,
    /// Errors of unreadable records, as sentences.
    pub unreadable: Vec<String>,
    /// The id of the first scenario.
    pub first_id: Option<String>,
    /// Tracks by class, over all scenarios.
    pub tracks: BTreeMap<&'static str, usize>,
    /// Agents present at the present step by class, over all scenarios.
    pub agents_now: BTreeMap<&'static str, usize>,
    /// Number of prediction targets.
    pub targets: usize,
    /// Shortest and longest scenario, seconds from first to last frame.
    pub duration_s: Option<[f64; 2]>,
    /// Lowest and highest rate, frames per second.
    pub rate_hz: Option<[f64; 2]>,
    /// Fewest and most seconds before the present.
    pub history_s: Option<[f64; 2]>,
    /// Map features by type, over all scenarios.
    pub map: BTreeMap<&'static str, usize>,
    /// Total length of lanes, metres.
    pub lane_length_m: f64,
    /// Scenarios with at least one light.
    pub with_lights: usize,
    /// Lanes with a light at the present step, by colour, over all scenarios.
    pub lights_now: BTreeMap<&'static str, usize>,
    /// Scenarios with a route of the ego, stated or inferred.
    pub with_route: usize,
    /// Scenarios by tag.
    pub tags: BTreeMap<&'static str, usize>,
    /// Dropped and inferred items, over all scenarios.
    #[serde(flatten)]
    pub report: ReadReport,
}

/// Reads every record and counts its content; unreadable records are listed, not fatal.
///
/// # Errors
/// Errors of [`crate::open`].
pub fn inspect(path: &Path, options: ReadOptions) -> Result<Summary, DataError> {
    inspect_with(path, options, |_| {})
}

/// As [`inspect`], with a function that modifies every scenario before it is counted, for instance
/// to add tags.
///
/// # Errors
/// Errors of [`crate::open`].
pub fn inspect_with(
    path: &Path,
    options: ReadOptions,
    complete: impl Fn(&mut Scenario),
) -> Result<Summary, DataError> {
    let mut reader = open_with(path, options)?;
    let mut summary = Summary {
        format: reader.format().into(),
        ..Summary::default()
    };
    for record in &mut reader {
        match record {
            Ok(mut record) => {
                complete(&mut record.scenario);
                summary.add(&record.scenario, &record.report);
            }
            Err(error) => summary.unreadable.push(error.to_string()),
        }
    }
    Ok(summary)
}

impl Summary {
    /// Adds one scenario to the counts.
    pub fn add(&mut self, scenario: &Scenario, report: &ReadReport) {
        self.scenarios += 1;
        self.first_id.get_or_insert_with(|| scenario.id.clone());
        self.targets += scenario.targets.len();
        self.with_route += usize::from(scenario.route.is_some());
        self.report.merge(report);
        for tag in &scenario.tags {
            *self.tags.entry(tag.name()).or_default() += 1;
        }
        self.add_agents(scenario);
        self.add_map(scenario);
        self.add_lights(scenario);
        let steps = scenario.log.len().saturating_sub(1);
        widen(&mut self.duration_s, steps as f64 * scenario.dt);
        widen(&mut self.rate_hz, 1.0 / scenario.dt);
        widen(&mut self.history_s, scenario.now as f64 * scenario.dt);
    }

    fn add_agents(&mut self, scenario: &Scenario) {
        let agents = scenario.log.iter().flat_map(|frame| frame.agents());
        let kinds: BTreeMap<AgentId, AgentKind> = agents.map(|a| (a.id, a.kind)).collect();
        for kind in kinds.values() {
            *self.tracks.entry(kind.name()).or_default() += 1;
        }
        for agent in scenario.present().now().agents() {
            *self.agents_now.entry(agent.kind.name()).or_default() += 1;
        }
    }

    fn add_map(&mut self, scenario: &Scenario) {
        let map = &scenario.map;
        let mut count = |name, n| {
            if n > 0 {
                *self.map.entry(name).or_default() += n;
            }
        };
        for lane in map.lanes() {
            count(lane_name(lane.kind), 1);
            count(
                "lane with a speed limit",
                usize::from(lane.speed_limit.is_some()),
            );
            count(
                "lane inside an intersection",
                usize::from(lane.in_intersection),
            );
            count("link between lanes", lane.successors.len());
        }
        for area in map.areas() {
            count(area_name(area.kind), 1);
        }
        count("roadblock", map.roadblocks().len());
        count("road line", map.road_lines().len());
        count("road edge", map.road_edges().len());
        count("stop sign", map.stop_signs().len());
        count("drivable surface", map.drivable().len());
        self.lane_length_m += map
            .lanes()
            .iter()
            .map(|l| l.centerline.length())
            .sum::<f64>();
    }

    fn add_lights(&mut self, scenario: &Scenario) {
        let any = scenario.log.iter().any(|frame| !frame.lights().is_empty());
        self.with_lights += usize::from(any);
        for light in scenario.present().now().lights() {
            let name = match light.state {
                LightState::Green => "green",
                LightState::Yellow => "yellow",
                LightState::Red => "red",
                LightState::Unknown => "unknown",
            };
            *self.lights_now.entry(name).or_default() += 1;
        }
    }
}

fn widen(range: &mut Option<[f64; 2]>, value: f64) {
    let [low, high] = range.unwrap_or([value; 2]);
    *range = Some([low.min(value), high.max(value)]);
}

fn lane_name(kind: LaneKind) -> &'static str {
    match kind {
        LaneKind::Freeway => "freeway lane",
        LaneKind::SurfaceStreet => "street lane",
        LaneKind::BikeLane => "bicycle lane",
        LaneKind::Undefined => "lane of no stated kind",
    }
}

fn area_name(kind: AreaKind) -> &'static str {
    match kind {
        AreaKind::Crosswalk => "crosswalk",
        AreaKind::SpeedBump => "speed bump",
        AreaKind::Driveway => "driveway",
        AreaKind::StopLine => "stop line",
        AreaKind::TurnStop => "turn stop",
        AreaKind::Intersection => "intersection area",
        AreaKind::Walkway => "walkway",
        AreaKind::Carpark => "car park",
    }
}
