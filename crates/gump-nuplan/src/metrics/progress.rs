//! Progress of the ego relative to the expert.

use gump_geometry::{DVec2, Polygon, Polyline};
use gump_scene::{MapGraph, RoadblockId};

use super::history::SimulationHistory;
use super::lanes::{Lanes, followed_lanes};
use gump_metrics::gained;

/// Lower progress counts as this, metres; going back by more gives a score of 0.
///
/// Source: nuPlan's challenges (the devkit's prose says 0.1).
const LEAST: f64 = 2.0;
/// The minimum ratio that counts as making progress.
///
/// Source: nuPlan's challenges and the paper.
const MAKING_PROGRESS: f64 = 0.2;

/// Progress of the ego and of the expert.
#[derive(Clone, Debug, PartialEq)]
pub struct ExpertProgress {
    /// Ratio of the ego's progress to the expert's, in [0, 1]; 1 without a route.
    pub ratio: f64,
    /// Metres of the ego along the expert's route.
    pub ego: f64,
    /// Metres of the expert along its route.
    pub expert: f64,
    /// Per sample, metres of the ego since the previous sample.
    pub series: Vec<f64>,
}

impl ExpertProgress {
    /// 1 if the ego makes progress, else 0.
    pub fn making_progress(&self) -> f64 {
        f64::from(self.ratio >= MAKING_PROGRESS)
    }
}

/// Measures the progress of a drive along the expert's route.
///
/// On maps with roadblocks the route is a chain of roadblocks, each with the centre line that the
/// expert followed in it. On other maps it is the expert's own path.
///
/// Source: nuPlan's `ego_progress_along_expert_route`; for other maps ours.
pub fn expert_progress(drive: &SimulationHistory<'_>) -> ExpertProgress {
    let (ego, expert) = (drive.centres(), drive.expert_centres());
    let (series, expert_series) = if drive.map.roadblocks().is_empty() {
        let path = Polyline::new(expert.clone());
        let along = |points| path.as_ref().map(|path| progress_on_path(path, points));
        (along(&ego), along(&expert))
    } else {
        let route = simplified(followed_lanes(drive.map, &expert));
        let chain = chain(drive.map, &route);
        let along =
            |points: &[DVec2]| (!chain.is_empty()).then(|| progress_on_chain(&chain, points));
        (along(&ego), along(&expert))
    };
    let (Some(series), Some(expert_series)) = (series, expert_series) else {
        return ExpertProgress {
            ratio: 1.0,
            ego: 0.0,
            expert: 0.0,
            series: vec![0.0; ego.len()],
        };
    };
    let (ego, expert): (f64, f64) = (series.iter().sum(), expert_series.iter().sum());
    let ratio = if ego < -LEAST {
        0.0
    } else {
        (ego.max(LEAST) / expert.max(LEAST)).min(1.0)
    };
    ExpertProgress {
        ratio,
        ego,
        expert,
        series,
    }
}

/// The lists of a route without repetition: a list is kept if it shares no lane with the last kept
/// one.
fn simplified(route: Vec<Lanes<'_>>) -> Vec<Lanes<'_>> {
    let mut kept: Vec<Lanes<'_>> = Vec::new();
    for lanes in route {
        let shares = |last: &Lanes<'_>| last.iter().any(|a| lanes.iter().any(|b| a.id == b.id));
        if !lanes.is_empty() && !kept.last().is_some_and(shares) {
            kept.push(lanes);
        }
    }
    kept
}

/// One roadblock of a route and the path through it.
struct Block<'a> {
    id: RoadblockId,
    outline: &'a Polygon,
    baseline: &'a Polyline,
}

fn chain<'a>(map: &'a MapGraph, route: &[Lanes<'a>]) -> Vec<Block<'a>> {
    let mut chain: Vec<Block<'a>> = Vec::new();
    for lane in route.iter().filter_map(|lanes| lanes.first()) {
        let Some(block) = lane.roadblock.and_then(|id| map.roadblock(id)) else {
            continue;
        };
        if chain.last().is_none_or(|last| last.id != block.id) {
            chain.push(Block {
                id: block.id,
                outline: &block.outline,
                baseline: &lane.centerline,
            });
        }
    }
    chain
}

/// Metres since the previous point, along a chain of roadblocks that is not empty.
///
/// An ego outside the chain makes no progress; when it returns to the same block the missing
/// progress is added.
fn progress_on_chain(chain: &[Block<'_>], points: &[DVec2]) -> Vec<f64> {
    let along = |block: &Block<'_>, point: DVec2| block.baseline.project(point).arc_length;
    let mut current = 0;
    let mut before = points.first().map_or(0.0, |&p| along(&chain[0], p));
    let steps = points.iter().enumerate().map(|(k, &point)| {
        if k == 0 {
            return 0.0;
        }
        if chain[current].outline.contains_strictly(point) {
            let now = along(&chain[current], point);
            let gained = now - before;
            before = now;
            return gained;
        }
        let ahead = (current + 1..chain.len()).find(|&i| chain[i].outline.contains_strictly(point));
        let Some(next) = ahead else {
            return 0.0;
        };
        let skipped = (current + 1..next).map(|i| {
            let (last, first) = (
                end(chain[i - 1].baseline),
                chain[i + 1].baseline.points()[0],
            );
            along(&chain[i], first) - along(&chain[i], last)
        });
        let rest = chain[current].baseline.length() - before;
        let now = along(&chain[next], point);
        let gained = now - along(&chain[next], end(chain[next - 1].baseline));
        let skipped: f64 = skipped.sum();
        (current, before) = (next, now);
        rest + gained + skipped
    });
    steps.collect()
}

fn end(line: &Polyline) -> DVec2 {
    line.points()[line.points().len() - 1]
}

/// Metres since the previous point, along a path.
fn progress_on_path(path: &Polyline, points: &[DVec2]) -> Vec<f64> {
    let steps = points.windows(2).map(|pair| gained(path, pair[0], pair[1]));
    let first = points.first().map(|_| 0.0);
    first.into_iter().chain(steps).collect()
}
