//! Agents that pass a red light.
//!
//! The nearest-lane search has two quirks of the reference that affect its results: it adds where
//! one would expect a difference, and lanes shorter than the longest end with a segment to the
//! origin of the world.

use std::collections::{BTreeMap, BTreeSet};

use super::assemble::SimulatedAgents;
use super::blocks::{Blocks, Bounds};
use super::input::{Log, Signal, SignalLane};

#[derive(Clone, Copy, Debug)]
struct Segment {
    start: [f32; 2],
    along: [f32; 2],
}

impl Segment {
    /// Position of a point along the line through the segment, 0 at the start and 1 at the end.
    fn parameter(&self, point: [f32; 2]) -> f32 {
        let d = self.along;
        let v = [point[0] - self.start[0], point[1] - self.start[1]];
        let squared = d[0] * d[0] + d[1] * d[1];
        if squared == 0.0 {
            0.0
        } else {
            (v[0] * d[0] + v[1] * d[1]) / squared
        }
    }

    /// The reference's distance: a sum instead of a difference.
    fn distance(&self, point: [f32; 2]) -> f32 {
        let on = self.parameter(point).clamp(0.0, 1.0);
        let x = (point[0] - self.start[0]) + self.along[0] * on;
        let y = (point[1] - self.start[1]) + self.along[1] * on;
        (x * x + y * y).sqrt()
    }

    /// Around the places from which that distance is measured: the segment mirrored at its start.
    fn bounds(&self) -> Bounds {
        let ([x, y], [dx, dy]) = (self.start, self.along);
        Bounds::of([x, y, 0.0], [x - dx, y - dy, 0.0])
    }
}

/// A signal that controls a known lane, at one step.
#[derive(Clone, Copy, Debug)]
struct Gate {
    segment: Segment,
    /// Position of the stop point along the segment's line.
    stop: f32,
    is_red: bool,
}

/// Lanes and signals of a scenario, ready for queries.
#[derive(Clone, Debug)]
pub(crate) struct Lights {
    segments: Vec<Segment>,
    /// The lane each segment belongs to.
    lane_of: Vec<i64>,
    blocks: Blocks,
    /// Per signal: its lane, and its state at every step.
    signals: Vec<(i64, Vec<Gate>)>,
}

impl Lights {
    /// `None` if there are no lanes or no signals.
    pub(crate) fn new(log: &Log) -> Option<Self> {
        let lanes: Vec<&SignalLane> = log.lanes.iter().filter(|l| l.points.len() >= 2).collect();
        let longest = lanes.iter().map(|lane| lane.points.len()).max()?;
        let (mut segments, mut lane_of) = (Vec::new(), Vec::new());
        let mut ranges = BTreeMap::new();
        for lane in &lanes {
            let first = segments.len();
            segments.extend(padded(lane, longest));
            lane_of.resize(segments.len(), lane.id);
            ranges.insert(lane.id, first..segments.len());
        }
        let controlled: BTreeSet<i64> = log.signals.iter().flatten().map(|s| s.lane).collect();
        let signals = controlled.into_iter().filter_map(|lane| {
            let own = &segments[ranges.get(&lane)?.clone()];
            Some((
                lane,
                log.signals
                    .iter()
                    .map(|step| gate(lane, step, own))
                    .collect(),
            ))
        });
        let signals: Vec<_> = signals.collect();
        let bounds: Vec<_> = segments.iter().map(Segment::bounds).collect();
        (!signals.is_empty()).then(|| Self {
            blocks: Blocks::new(&bounds),
            segments,
            lane_of,
            signals,
        })
    }

    /// Whether agent `agent` passes a red light at each step from `first`.
    pub(crate) fn violations(
        &self,
        simulated: &SimulatedAgents,
        agent: usize,
        first: usize,
    ) -> Vec<bool> {
        let states = simulated.states(agent);
        let place = |step: usize| [states[step].position[0], states[step].position[1]];
        let mut violations = vec![false; states.len() - first];
        let mut hint = 0;
        for step in first.max(1)..states.len() {
            if !states[step].valid {
                continue;
            }
            let crosses = |gates: &[Gate]| {
                let (before, now) = (&gates[step - 1], &gates[step]);
                now.is_red
                    && before.segment.parameter(place(step - 1)) < before.stop
                    && now.segment.parameter(place(step)) > now.stop
            };
            let crossed = self.signals.iter().filter(|(_, gates)| crosses(gates));
            for (lane, _) in crossed {
                violations[step - first] |= self.nearest(place(step), &mut hint).0 == *lane;
            }
        }
        violations
    }

    /// The nearest lane by the reference's search, and the index of the segment among all.
    pub(crate) fn nearest(&self, point: [f32; 2], hint: &mut usize) -> (i64, usize) {
        let cost = |i: usize| self.segments[i].distance(point);
        let nearest = self.blocks.nearest([point[0], point[1], 0.0], *hint, cost);
        *hint = nearest.map_or(0, |(i, _)| i);
        (self.lane_of[*hint], *hint)
    }
}

/// Segments that start at a real point; the last goes to the origin if the lane is padded.
fn padded(lane: &SignalLane, longest: usize) -> impl Iterator<Item = Segment> {
    let n = lane.points.len().min(longest - 1);
    (0..n).map(|i| {
        let start = lane.points[i];
        let end = lane.points.get(i + 1).copied().unwrap_or([0.0; 2]);
        Segment {
            start,
            along: [end[0] - start[0], end[1] - start[1]],
        }
    })
}

fn gate(lane: i64, step: &[Signal], segments: &[Segment]) -> Gate {
    let signal = step.iter().rev().find(|signal| signal.lane == lane);
    let stop_point = signal.map_or([0.0; 2], |signal| signal.stop_point);
    let closer = |a: Segment, b: Segment| {
        if b.distance(stop_point) < a.distance(stop_point) {
            b
        } else {
            a
        }
    };
    let nearest = segments.iter().copied().reduce(closer);
    let segment = nearest.expect("a lane of two points has a segment");
    Gate {
        segment,
        stop: segment.parameter(stop_point),
        is_red: signal.is_some_and(|signal| signal.stop),
    }
}
