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
    /// 2023: the nearest segment of each edge on the ground, of these the smallest distance.
    Ground(Vec<Part>),
}

/// One edge of 2023.
#[derive(Clone, Debug)]
struct Part {
    /// Index of its first segment.
    first: usize,
    blocks: Blocks,
    /// Segments on whose straight extension, far from the edge, its distance is 0.
    rays: Vec<usize>,
    /// A segment without length has distance 0 wherever it is the nearest.
    is_zero_anywhere: bool,
}

/// What a query found, for the next one with a point near by.
#[derive(Clone, Debug, Default)]
pub(crate) struct Hints {
    /// The nearest segment: of all edges, in 2023 of each.
    segments: Vec<usize>,
    near: Option<Near>,
}

/// The edges and rays of 2023 that matter within [`NEAR`] of a place.
#[derive(Clone, Debug)]
struct Near {
    at: [f32; 2],
    parts: Vec<usize>,
    rays: Vec<usize>,
}

/// How far a point may move before edges are looked for again, metres: 6 is the fastest of 2, 3, 4, 6
/// and 8 for recorded scenes.
const NEAR: f32 = 6.0;
/// Larger than rounding errors of distances, metres.
const MARGIN: f32 = 0.05;
/// Cosine of the change of direction from which on a joint can be the nearest place of an edge to
/// a point on the extension of one of its segments; 0 without rounding.
const SHARP_TURN: f32 = 0.5;
/// A segment shorter than this hardly tells its joints apart, metres.
const SHORT: f32 = 0.05;

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
            let own = first..segments.len();
            let bounds: Vec<_> = segments[first..].iter().map(|s| bounds(s, 0.0)).collect();
            parts.push(Part {
                first,
                blocks: Blocks::new(&bounds),
                rays: own.filter(|&i| has_ray(&segments, i)).collect(),
                is_zero_anywhere: segments[first..].iter().any(|s| s.length() == 0.0),
            });
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

    /// Signed distance on the ground; `hints` are the results of the last query.
    pub(crate) fn signed_distance(&self, point: [f32; 3], hints: &mut Hints) -> f32 {
        match &self.lookup {
            Lookup::Space { blocks, stretch } => {
                hints.segments.resize(1, 0);
                let query = [point[0], point[1], point[2] * stretch];
                let cost = |i: usize| self.segments[i].offset(point).in_space(*stretch);
                let Some((i, _)) = blocks.nearest(query, hints.segments[0], cost) else {
                    return FAR;
                };
                hints.segments[0] = i;
                let offset = self.segments[i].offset(point);
                self.sign(i, point, offset.t, offset.t > 1.0) * offset.on_ground()
            }
            Lookup::Ground(parts) => {
                hints.segments.resize(parts.len(), 0);
                self.on_ground_near([point[0], point[1], 0.0], parts, hints)
            }
        }
    }

    /// The distance of 2023. The sign is 0 on the line itself, and 0 then wins over every other
    /// edge. Far edges can only matter by that, on one of their rays.
    fn on_ground_near(&self, point: [f32; 3], parts: &[Part], hints: &mut Hints) -> f32 {
        let is_near = |near: &Near| {
            let [x, y] = [point[0] - near.at[0], point[1] - near.at[1]];
            x * x + y * y < NEAR * NEAR
        };
        let is_on_ray = |near: &Near| {
            let mut rays = near.rays.iter();
            rays.any(|&i| self.segments[i].side(point) == 0.0)
        };
        let known = hints.near.as_ref().filter(|near| is_near(near));
        if let Some(near) = known.filter(|near| !is_on_ray(near)) {
            let parts = near.parts.iter().map(|&k| (k, &parts[k]));
            return self.smallest(point, parts, &mut hints.segments, |_, _| {});
        }
        let mut distances = vec![FAR; parts.len()];
        let all = parts.iter().enumerate();
        let found = self.smallest(point, all, &mut hints.segments, |k, distance| {
            distances[k] = distance;
        });
        let least = distances.iter().copied().fold(FAR, f32::min);
        let matters = |k: usize| {
            parts[k].is_zero_anywhere || distances[k] < least + 2.0 * NEAR + 2.0 * MARGIN
        };
        let rays = parts.iter().flat_map(|part| &part.rays).copied();
        hints.near = Some(Near {
            at: [point[0], point[1]],
            parts: (0..parts.len()).filter(|&k| matters(k)).collect(),
            rays: rays
                .filter(|&i| self.segments[i].distance_from_line(point) < NEAR + MARGIN)
                .collect(),
        });
        found
    }

    /// The smallest of the signed distances from some edges; tells of each its index and distance.
    fn smallest<'a>(
        &self,
        point: [f32; 3],
        parts: impl Iterator<Item = (usize, &'a Part)>,
        hints: &mut [usize],
        mut tell: impl FnMut(usize, f32),
    ) -> f32 {
        let mut nearest = FAR;
        for (k, Part { first, blocks, .. }) in parts {
            let cost = |i: usize| self.segments[first + i].offset(point).on_ground();
            let Some((i, distance)) = blocks.nearest(point, hints[k], cost) else {
                continue;
            };
            hints[k] = i;
            tell(k, distance);
            let t = self.segments[first + i].offset(point).t;
            let value = self.sign(first + i, point, t, t >= 1.0) * distance;
            if value.abs() < nearest.abs() {
                nearest = value;
            }
        }
        nearest
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

    /// Length on the ground.
    fn length(&self) -> f32 {
        self.along[0].hypot(self.along[1])
    }

    /// Distance from the straight line through the segment.
    fn distance_from_line(&self, point: [f32; 3]) -> f32 {
        let v = self.relative(point);
        (v[0] * self.along[1] - v[1] * self.along[0]).abs() / self.length()
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

/// Whether a point far from the edge can be on the extension of segment `i` and have this segment
/// or its neighbour as the nearest of the edge: at an open end, at a sharp turn, and, up to
/// rounding, beside a very short segment. Segments without length are treated apart.
fn has_ray(segments: &[Segment], i: usize) -> bool {
    if segments[i].length() == 0.0 {
        return false;
    }
    let turns = |j: usize| {
        let (a, b) = (segments[i].along, segments[j].along);
        let (long, short) = (segments[i].length(), segments[j].length());
        j == i || long.min(short) < SHORT || a[0] * b[0] + a[1] * b[1] < SHARP_TURN * long * short
    };
    turns(segments[i].previous) || turns(segments[i].next)
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
    let mut hints: [Hints; 4] = Default::default();
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
