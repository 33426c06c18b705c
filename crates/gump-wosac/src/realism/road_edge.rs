//! Signed distance to the road edge: negative on the road, positive off it.

use super::assemble::SimulatedAgents;
use super::blocks::{Blocks, Bounds};
use super::box_distance::{FAR, box_corners};
use super::config::Algorithm;
use super::input::State;

/// Factor of height differences relative to distances on the ground, since 2024: for bridges.
/// Source, as of the ring: the challenge's published metric code.
const ELEVATION_STRETCH: f32 = 3.0;

/// A polyline whose ends are within this is a ring, metres squared.
const RING_GAP_SQUARED: f32 = 1.0;

/// One stretch of an edge, straight.
#[derive(Clone, Copy, Debug)]
struct Segment {
    start: [f32; 3],
    along: [f32; 3],
    /// The segments that end and start here; the segment itself where there is none.
    previous: usize,
    next: usize,
    /// True where the edge turns left at its start, at its end.
    convex_start: bool,
    convex_end: bool,
}

/// All edges of a map, ready for queries.
#[derive(Clone, Debug)]
pub(crate) struct RoadEdges {
    segments: Vec<Segment>,
    lookup: Lookup,
}

#[derive(Clone, Debug)]
enum Lookup {
    /// Since 2024: the nearest segment in space, height stretched.
    Space { blocks: Blocks, stretch: f32 },
    /// 2023: the nearest segment of each edge on the ground (first segment, its boxes), of these
    /// the smallest distance.
    Ground(Vec<(usize, Blocks)>),
}

impl RoadEdges {
    /// Edges of fewer than two points do not count.
    pub(crate) fn new(edges: &[Vec<[f32; 3]>], algorithm: Algorithm) -> Self {
        if algorithm.is_2023() {
            Self::on_ground(edges)
        } else {
            Self::in_space(edges, ELEVATION_STRETCH, true)
        }
    }

    fn on_ground(edges: &[Vec<[f32; 3]>]) -> Self {
        let flat = |edge: &Vec<[f32; 3]>| edge.iter().map(|&[x, y, _]| [x, y, 0.0]).collect();
        let edges: Vec<Vec<[f32; 3]>> = edges.iter().map(flat).collect();
        let (mut segments, mut parts) = (Vec::new(), Vec::new());
        for edge in edges.iter().filter(|edge| edge.len() >= 2) {
            let first = segments.len();
            push(&mut segments, edge, is_ring(edge));
            let bounds: Vec<_> = segments[first..].iter().map(|s| bounds(s, 0.0)).collect();
            parts.push((first, Blocks::new(&bounds)));
        }
        Self {
            segments,
            lookup: Lookup::Ground(parts),
        }
    }

    fn in_space(edges: &[Vec<[f32; 3]>], stretch: f32, rings: bool) -> Self {
        // The reference pads edges to the longest and wraps round into the padding, so only rings
        // as long as the longest edge are closed.
        let longest = edges.iter().map(Vec::len).max().unwrap_or(0);
        let mut segments = Vec::new();
        for edge in edges.iter().filter(|edge| edge.len() >= 2) {
            push(
                &mut segments,
                edge,
                rings && edge.len() == longest && is_ring(edge),
            );
        }
        let bounds: Vec<_> = segments.iter().map(|s| bounds(s, stretch)).collect();
        let blocks = Blocks::new(&bounds);
        Self {
            segments,
            lookup: Lookup::Space { blocks, stretch },
        }
    }

    /// Signed distance on the ground; `hints` are the results of the last queries.
    pub(crate) fn signed_distance(&self, point: [f32; 3], hints: &mut Vec<usize>) -> f32 {
        match &self.lookup {
            Lookup::Space { blocks, stretch } => {
                hints.resize(1, 0);
                let query = [point[0], point[1], point[2] * stretch];
                let cost = |i: usize| self.segments[i].offset(point).in_space(*stretch);
                let Some((i, _)) = blocks.nearest(query, hints[0], cost) else {
                    return FAR;
                };
                hints[0] = i;
                let offset = self.segments[i].offset(point);
                self.sign(i, point, offset.t, offset.t > 1.0) * offset.on_ground()
            }
            Lookup::Ground(parts) => {
                hints.resize(parts.len(), 0);
                let point = [point[0], point[1], 0.0];
                let mut nearest = FAR;
                for ((first, blocks), hint) in parts.iter().zip(hints) {
                    let cost = |i: usize| self.segments[first + i].offset(point).on_ground();
                    let Some((i, distance)) = blocks.nearest(point, *hint, cost) else {
                        continue;
                    };
                    *hint = i;
                    let t = self.segments[first + i].offset(point).t;
                    // The sign is 0 on the line itself, and 0 then wins over every other edge.
                    let value = self.sign(first + i, point, t, t >= 1.0) * distance;
                    if value.abs() < nearest.abs() {
                        nearest = value;
                    }
                }
                nearest
            }
        }
    }

    /// On which side of the edge the point is: 1 right, -1 left, 0 on it; `t` is its position along
    /// segment `i`.
    fn sign(&self, i: usize, point: [f32; 3], t: f32, is_past_end: bool) -> f32 {
        let segment = &self.segments[i];
        let own = segment.side(point);
        let (neighbor, convex) = if t < 0.0 {
            (segment.previous, segment.convex_start)
        } else if is_past_end {
            (segment.next, segment.convex_end)
        } else {
            return own;
        };
        let other = self.segments[neighbor].side(point);
        if neighbor == i {
            own
        } else if convex {
            own.max(other)
        } else {
            own.min(other)
        }
    }
}

/// From the nearest place on a segment to a point.
struct Offset {
    /// Position along the segment's line, 0 at its start and 1 at its end, not limited.
    t: f32,
    rest: [f32; 3],
}

impl Offset {
    fn on_ground(&self) -> f32 {
        let [x, y, _] = self.rest;
        (x * x + y * y).sqrt()
    }

    fn in_space(&self, stretch: f32) -> f32 {
        let [x, y, z] = self.rest;
        let z = z * stretch;
        (x * x + y * y + z * z).sqrt()
    }
}

impl Segment {
    fn relative(&self, point: [f32; 3]) -> [f32; 3] {
        std::array::from_fn(|i| point[i] - self.start[i])
    }

    #[inline]
    fn offset(&self, point: [f32; 3]) -> Offset {
        let v = self.relative(point);
        let d = self.along;
        let squared = d[0] * d[0] + d[1] * d[1];
        let t = if squared == 0.0 {
            0.0
        } else {
            (v[0] * d[0] + v[1] * d[1]) / squared
        };
        let on = t.clamp(0.0, 1.0);
        Offset {
            t,
            rest: std::array::from_fn(|i| v[i] - d[i] * on),
        }
    }

    fn side(&self, point: [f32; 3]) -> f32 {
        let v = self.relative(point);
        sign(v[0] * self.along[1] - v[1] * self.along[0])
    }
}

fn sign(x: f32) -> f32 {
    if x == 0.0 { 0.0 } else { x.signum() }
}

fn bounds(segment: &Segment, stretch: f32) -> Bounds {
    let [x, y, z] = segment.start;
    let [dx, dy, dz] = segment.along;
    let (from, to) = (z * stretch, (z + dz) * stretch);
    Bounds::of([x, y, from], [x + dx, y + dy, to])
}

fn is_ring(edge: &[[f32; 3]]) -> bool {
    let (first, last) = (edge[0], edge[edge.len() - 1]);
    let gap: [f32; 3] = std::array::from_fn(|i| first[i] - last[i]);
    gap[0] * gap[0] + gap[1] * gap[1] + gap[2] * gap[2] < RING_GAP_SQUARED
}

fn push(segments: &mut Vec<Segment>, edge: &[[f32; 3]], closed: bool) {
    let (first, n) = (segments.len(), edge.len() - 1);
    let along = |i: usize| -> [f32; 3] { std::array::from_fn(|k| edge[i + 1][k] - edge[i][k]) };
    let is_convex = |i: usize, j: usize| {
        let (a, b) = (along(i), along(j));
        a[0] * b[1] - a[1] * b[0] > 0.0
    };
    for (i, &start) in edge[..n].iter().enumerate() {
        let previous = match i {
            0 if closed => n - 1,
            0 => 0,
            _ => i - 1,
        };
        let next = match i + 1 {
            end if end == n && closed => 0,
            end if end == n => i,
            end => end,
        };
        segments.push(Segment {
            start,
            along: along(i),
            previous: first + previous,
            next: first + next,
            convex_start: is_convex(previous, i),
            convex_end: is_convex(i, next),
        });
    }
}

/// Distance of the outermost bottom corner of one agent at the steps from `first`, metres; -[`FAR`]
/// where it is not valid.
pub(crate) fn outermost(
    simulated: &SimulatedAgents,
    agent: usize,
    first: usize,
    edges: &RoadEdges,
) -> Vec<f32> {
    // Each corner has its own hints: it moves little from step to step.
    let mut hints: [Vec<usize>; 4] = Default::default();
    let states = &simulated.states(agent)[first..];
    let outermost = |state: &State| {
        if !state.valid {
            return -FAR;
        }
        let ([x, y, z], [length, width, height]) = (state.position, state.size);
        let corners = box_corners([x, y], state.heading, length, width);
        let bottom = z - height / 2.0;
        let distances = corners.iter().zip(&mut hints);
        distances
            .map(|(&[x, y], hints)| edges.signed_distance([x, y, bottom], hints))
            .fold(f32::NEG_INFINITY, f32::max)
    };
    states.iter().map(outermost).collect()
}

#[cfg(test)]
impl RoadEdges {
    /// Edges under other rules than a year's, as the unit goldens have them.
    pub(crate) fn under_rules(edges: &[Vec<[f32; 3]>], stretch: f32, rings: bool) -> Self {
        Self::in_space(edges, stretch, rings)
    }
}
