//! Data of a page beside the positions of agents: metrics over time, predicted next states, and
//! the candidate paths of a planner.

use std::collections::BTreeMap;

use gump_geometry::{DVec2, wrap_angle};
use gump_scene::{AgentId, AgentState};

use super::pack::{CENTI, Packer, heading_units, units};

/// A metric of one agent over time; values are kept to two decimals.
#[derive(Clone, Debug, PartialEq)]
pub struct MetricTrack {
    /// Name and unit, such as "time to collision, s".
    pub name: String,
    /// The agent.
    pub agent: AgentId,
    /// Index of the future, in the order added; `None` for the log.
    pub future: Option<usize>,
    /// The frame of the first value: of the log, or of the future, whose frame 0 is the present.
    pub first: usize,
    /// One value per frame from there on; `None` where undefined.
    pub values: Vec<Option<f64>>,
}

/// A path that a planner considered.
#[derive(Clone, Debug, PartialEq)]
pub struct CandidatePath {
    /// Name, as shown on the page.
    pub name: String,
    /// Score, higher is better; `None` if the path was not scored.
    pub score: Option<f64>,
    /// Terms of the score by name, which the page shows for the chosen candidate.
    pub parts: Vec<(String, f64)>,
    /// Whether the planner chose it.
    pub is_chosen: bool,
    /// Box centres of the ego, world frame, metres.
    pub path: Vec<DVec2>,
}

/// Distribution of the state of an agent a moment later, as draws from it.
///
/// The page keeps the number of draws in each cell of 10 cm along and across the mean heading, in
/// each step of 0.5 m/s of speed, and in each step of 2° of heading.
#[derive(Clone, Debug, PartialEq)]
pub struct HeatMap {
    /// The agent.
    pub agent: AgentId,
    /// Index of the future, in the order added.
    pub future: usize,
    /// Time from which it is predicted, seconds from the present.
    pub from_s: f64,
    /// Time from then to the draws, seconds.
    pub ahead_s: f64,
    /// States, world frame.
    pub draws: Vec<AgentState>,
}

// The resolution of heat maps, chosen by eye; finer ones make pages larger.
/// Side of a cell, metres.
pub(super) const CELL: f64 = 0.1;
/// Width of a bar of speeds, metres per second.
pub(super) const SPEED: f64 = 0.5;
/// Width of a bar of turns, degrees.
pub(super) const TURN_DEG: f64 = 2.0;

impl MetricTrack {
    /// Number of the metric among all, agent, take, first frame, how many values; then stretches
    /// without a gap: values skipped, how many, the values. `None` if nothing is defined.
    pub(super) fn pack(&self, packer: &mut Packer, name: usize, agent: usize) {
        let take = self.future.map_or(0, |future| future + 1);
        for number in [name, agent, take, self.first] {
            packer.unsigned(number as u64);
        }
        let mut stretches: Vec<(usize, Vec<i64>)> = Vec::new();
        for (i, value) in self.values.iter().enumerate() {
            let Some(value) = value.filter(|value| value.is_finite()) else {
                continue;
            };
            let value = units(value, CENTI);
            match stretches.last_mut() {
                Some((start, values)) if *start + values.len() == i => values.push(value),
                _ => stretches.push((i, vec![value])),
            }
        }
        packer.unsigned(stretches.len() as u64);
        let mut end = 0;
        for (start, values) in stretches {
            packer.unsigned((start - end) as u64);
            packer.unsigned(values.len() as u64);
            end = start + values.len();
            packer.line(values.into_iter());
        }
    }
}

impl HeatMap {
    /// Agent, take, start and length in milliseconds, number of draws; mean place and heading;
    /// cells sorted from right to left and back to front as steps from the one before and their
    /// counts; bars of speed and of turns from the mean heading, the first bar's number first.
    pub(super) fn pack(&self, packer: &mut Packer, agent: usize, origin: DVec2) {
        let n = self.draws.len();
        let milliseconds = |s: f64| (s * 1000.0).round().max(0.0) as u64;
        for number in [
            agent as u64,
            self.future as u64 + 1,
            milliseconds(self.from_s),
            milliseconds(self.ahead_s),
            n as u64,
        ] {
            packer.unsigned(number);
        }
        if n == 0 {
            return;
        }
        let places = self.draws.iter().map(|draw| draw.pose.position);
        let centre = places.sum::<DVec2>() / n as f64;
        let directions = self.draws.iter().map(|draw| draw.pose.direction());
        let forward = directions
            .sum::<DVec2>()
            .try_normalize()
            .unwrap_or(DVec2::X);
        for number in [
            units(centre.x - origin.x, CENTI),
            units(centre.y - origin.y, CENTI),
            heading_units(forward.to_angle()),
        ] {
            packer.signed(number);
        }
        let cells = self.draws.iter().map(|draw| {
            let off = draw.pose.position - centre;
            [off.dot(forward.perp()), off.dot(forward)].map(|x| (x / CELL).floor() as i64)
        });
        let cells = counted(cells);
        packer.unsigned(cells.len() as u64);
        let mut before = [0, 0];
        for (cell, count) in cells {
            packer.signed(cell[0] - before[0]);
            packer.signed(cell[1] - before[1]);
            packer.unsigned(count);
            before = cell;
        }
        let bar = |x: f64, width: f64| (x / width).floor() as i64;
        bars(packer, self.draws.iter().map(|d| bar(d.speed(), SPEED)));
        let turns = self.draws.iter().map(|draw| {
            let turn = wrap_angle(draw.pose.heading - forward.to_angle());
            bar(turn.to_degrees() + TURN_DEG / 2.0, TURN_DEG)
        });
        bars(packer, turns);
    }
}

/// Counts how often each value occurs, sorted.
fn counted<T: Ord>(values: impl Iterator<Item = T>) -> BTreeMap<T, u64> {
    let mut counts = BTreeMap::new();
    for value in values {
        *counts.entry(value).or_default() += 1;
    }
    counts
}

/// Writes the first bar, the number of bars up to the last, and the height of each.
fn bars(packer: &mut Packer, numbers: impl Iterator<Item = i64>) {
    let counts = counted(numbers);
    let first = counts.keys().next().copied().unwrap_or(0);
    let last = counts.keys().last().copied().unwrap_or(-1);
    packer.signed(first);
    packer.unsigned((last - first + 1) as u64);
    for bar in first..=last {
        packer.unsigned(counts.get(&bar).copied().unwrap_or(0));
    }
}
