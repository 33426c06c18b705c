//! Compliance with the speed limit.

use gump_scene::{Lane, MapGraph};

use super::history::SimulationHistory;
use super::lanes::Lanes;
use super::statistics::mean_step;

/// A mean excess of this scores 0, metres per second.
///
/// Source: nuPlan's challenges.
pub const MAX_OVERSPEED: f64 = 2.23;

/// Excess over the speed limit.
#[derive(Clone, Debug, PartialEq)]
pub struct SpeedLimit {
    /// 1 if never too fast; falls with the mean excess to 0.
    pub score: f64,
    /// Per sample, metres per second above the limit, 0 where it is kept or not known.
    pub excess: Vec<f64>,
}

/// Evaluates a drive; `followed` are the lanes of its samples.
///
/// Inside an intersection the highest limit of the lanes before and after counts. Where no limit is
/// stated there is no excess.
///
/// Source: nuPlan's `speed_limit_compliance`.
pub fn speed_limit(drive: &SimulationHistory<'_>, followed: &[Lanes<'_>]) -> SpeedLimit {
    let excess = |(sample, lanes): (&super::Sample, &Lanes<'_>)| {
        let limit = limit(drive.map, lanes);
        limit.map_or(0.0, |limit| (sample.ego.speed() - limit).max(0.0))
    };
    let excess: Vec<f64> = drive.samples.iter().zip(followed).map(excess).collect();
    let times_us = drive.times_us();
    let dt = mean_step(&times_us);
    let duration = dt * times_us.len().saturating_sub(1) as f64;
    let total: f64 = excess.iter().sum();
    let score = if total > 0.0 && duration > 0.0 {
        (1.0 - total * dt / (MAX_OVERSPEED * duration)).max(0.0)
    } else {
        1.0
    };
    SpeedLimit { score, excess }
}

/// The limit on these lanes, metres per second, if it is stated.
fn limit(map: &MapGraph, lanes: &[&Lane]) -> Option<f64> {
    let first = lanes.first()?;
    if !first.in_intersection {
        return first.speed_limit.filter(|limit| *limit > 0.0);
    }
    let around = lanes
        .iter()
        .flat_map(|lane| map.predecessors(lane.id).chain(map.successors(lane.id)));
    around
        .map(|lane| lane.speed_limit.filter(|limit| *limit > 0.0))
        .try_fold(None, |highest: Option<f64>, limit| {
            let limit = limit?;
            Some(Some(highest.map_or(limit, |highest| highest.max(limit))))
        })
        .flatten()
}
