//! Measurements of many predictions, pooled by kind of agent and horizon, and their table.

use std::collections::BTreeMap;

use gump_scene::AgentKind;

use super::config::MotionConfig;
use super::evaluate::{HorizonScore, PredictionScore};
use super::mean::Mean;
use super::precision::PrecisionSamples;
use super::shape::Shape;

/// Measurements pooled by kind of agent and index of the horizon.
///
/// Merging tallies in any order, from any number of machines, gives the same numbers.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MotionTally {
    /// One cell for every kind that occurs and every horizon.
    pub cells: BTreeMap<(AgentKind, usize), MotionCell>,
}

/// Measurements of one kind of agent at one horizon.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MotionCell {
    /// Average displacement of every prediction's best mode, metres.
    pub min_ade: Mean,
    /// Displacement at the horizon of every prediction's best mode, metres.
    pub min_fde: Mean,
    /// 1 for a prediction without a mode that matches the log, else 0.
    pub miss_rate: Mean,
    /// 1 for a prediction whose most confident mode overlaps another agent, else 0.
    pub overlap_rate: Mean,
    /// By shape of the recorded path; modes after the first match are false alarms.
    pub precision: BTreeMap<Shape, PrecisionSamples>,
    /// By shape of the recorded path; further matches after the first are ignored.
    pub soft_precision: BTreeMap<Shape, PrecisionSamples>,
}

/// A row of the table: a mean over the measurements of its class and horizon.
///
/// A number is `None` where nothing could be measured; the official table has 0 there.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct MotionRow {
    /// The kind of agent; `None` is the mean over kinds that move, each counting the same.
    pub kind: Option<AgentKind>,
    /// Seconds after the present; `None` is the mean over horizons.
    pub seconds: Option<f64>,
    /// Number of pooled predictions; in a mean over horizons that of one horizon.
    pub predictions: u64,
    /// Average displacement of the best mode, metres.
    pub min_ade: Option<f64>,
    /// Displacement of the best mode at the horizon, metres.
    pub min_fde: Option<f64>,
    /// Share of predictions without a mode that matches the log, 0..1.
    pub miss_rate: Option<f64>,
    /// Share of predictions whose most confident mode overlaps another agent, 0..1.
    pub overlap_rate: Option<f64>,
    /// Mean average precision over shapes, 0..1.
    pub map: Option<f64>,
    /// The same with further matches ignored, 0..1.
    pub soft_map: Option<f64>,
}

impl MotionTally {
    /// The scores of some predictions as one tally.
    pub fn of<'a>(scores: impl IntoIterator<Item = &'a PredictionScore>) -> Self {
        let mut tally = Self::default();
        scores.into_iter().for_each(|score| tally.add(score));
        tally
    }

    /// Adds the score of one prediction.
    pub fn add(&mut self, score: &PredictionScore) {
        for (h, horizon) in score.horizons.iter().enumerate() {
            let cell = self.cells.entry((score.kind, h)).or_default();
            cell.add(score.shape, horizon);
        }
    }

    /// Adds the measurements of another tally.
    pub fn merge(&mut self, other: &Self) {
        for (key, cell) in &other.cells {
            self.cells.entry(*key).or_default().merge(cell);
        }
    }

    /// All kinds of agents as one.
    ///
    /// The official code can pool so; its leaderboard does not, see [`rows`](Self::rows).
    pub fn pooled(&self) -> BTreeMap<usize, MotionCell> {
        let mut pooled: BTreeMap<usize, MotionCell> = BTreeMap::new();
        for (&(_, horizon), cell) in &self.cells {
            pooled.entry(horizon).or_default().merge(cell);
        }
        pooled
    }

    /// The table: every kind that occurs at every horizon and over all horizons, then the means
    /// over vehicles, pedestrians and bicycles. The last row is what a leaderboard ranks.
    ///
    /// `config` must be the one used for the measurements.
    pub fn rows(&self, config: &MotionConfig) -> Vec<MotionRow> {
        let mut kinds: Vec<AgentKind> = self.cells.keys().map(|&(kind, _)| kind).collect();
        kinds.dedup();
        let mut rows = Vec::new();
        for &kind in &kinds {
            let at_horizons: Vec<MotionRow> = (0..config.horizons.len())
                .filter_map(|h| {
                    let cell = self.cells.get(&(kind, h))?;
                    let seconds = config.seconds(&config.horizons[h]);
                    Some(cell.row(Some(kind), Some(seconds)))
                })
                .collect();
            let over_horizons = MotionRow {
                kind: Some(kind),
                ..MotionRow::mean(&at_horizons)
            };
            rows.extend(at_horizons);
            rows.push(over_horizons);
        }
        let moving = |row: &&MotionRow| row.kind.is_some_and(|k| AgentKind::MOVING.contains(&k));
        let mut means = Vec::new();
        let seconds = config.horizons.iter().map(|h| Some(config.seconds(h)));
        for seconds in seconds.chain([None]) {
            let same = rows.iter().filter(moving).filter(|r| r.seconds == seconds);
            let same: Vec<MotionRow> = same.copied().collect();
            means.push(MotionRow {
                seconds,
                predictions: same.iter().map(|row| row.predictions).sum(),
                ..MotionRow::mean(&same)
            });
        }
        rows.extend(means);
        rows
    }
}

impl MotionCell {
    fn add(&mut self, shape: Option<Shape>, score: &HorizonScore) {
        let missed = score.missed().map(f64::from);
        score.min_ade.into_iter().for_each(|x| self.min_ade.add(x));
        score.min_fde.into_iter().for_each(|x| self.min_fde.add(x));
        missed.into_iter().for_each(|x| self.miss_rate.add(x));
        self.overlap_rate.add(f64::from(score.overlaps));
        if let Some(shape) = shape {
            let samples = self.precision.entry(shape).or_default();
            samples.add(&score.modes, true);
            let samples = self.soft_precision.entry(shape).or_default();
            samples.add(&score.modes, false);
        }
    }

    /// Adds the measurements of another cell.
    pub fn merge(&mut self, other: &Self) {
        self.min_ade.merge(&other.min_ade);
        self.min_fde.merge(&other.min_fde);
        self.miss_rate.merge(&other.miss_rate);
        self.overlap_rate.merge(&other.overlap_rate);
        for (shape, samples) in &other.precision {
            self.precision.entry(*shape).or_default().merge(samples);
        }
        for (shape, samples) in &other.soft_precision {
            let own = self.soft_precision.entry(*shape).or_default();
            own.merge(samples);
        }
    }

    /// The means of its measurements.
    pub fn row(&self, kind: Option<AgentKind>, seconds: Option<f64>) -> MotionRow {
        MotionRow {
            kind,
            seconds,
            predictions: self.overlap_rate.count(),
            min_ade: self.min_ade.value(),
            min_fde: self.min_fde.value(),
            miss_rate: self.miss_rate.value(),
            overlap_rate: self.overlap_rate.value(),
            map: mean_average_precision(&self.precision),
            soft_map: mean_average_precision(&self.soft_precision),
        }
    }
}

impl MotionRow {
    /// The numbers of the row, named as in reports.
    pub fn numbers(&self) -> [(&'static str, Option<f64>); 6] {
        [
            ("min_ade", self.min_ade),
            ("min_fde", self.min_fde),
            ("miss_rate", self.miss_rate),
            ("overlap_rate", self.overlap_rate),
            ("map", self.map),
            ("soft_map", self.soft_map),
        ]
    }

    /// The mean of rows, each number over those that have it.
    fn mean(rows: &[Self]) -> Self {
        let over = |number: fn(&Self) -> Option<f64>| mean(rows.iter().filter_map(number));
        Self {
            kind: None,
            seconds: None,
            predictions: rows.iter().map(|row| row.predictions).max().unwrap_or(0),
            min_ade: over(|row| row.min_ade),
            min_fde: over(|row| row.min_fde),
            miss_rate: over(|row| row.miss_rate),
            overlap_rate: over(|row| row.overlap_rate),
            map: over(|row| row.map),
            soft_map: over(|row| row.soft_map),
        }
    }
}

/// The mean over shapes that have samples.
fn mean_average_precision(by_shape: &BTreeMap<Shape, PrecisionSamples>) -> Option<f64> {
    let areas = by_shape.values();
    mean(areas.filter_map(PrecisionSamples::average_precision))
}

fn mean(numbers: impl Iterator<Item = f64>) -> Option<f64> {
    let (mut sum, mut n) = (0.0, 0);
    for number in numbers {
        sum += number;
        n += 1;
    }
    (n > 0).then(|| sum / f64::from(n))
}
