//! The strip of road that a vehicle will sweep, cut into convex pieces.

use gump_geometry::{DVec2, Polygon, Quad, joint};

use crate::path::Path;

/// Segments that share bounds; a matter of speed alone, like the next. No measurement is recorded.
const CHUNK: usize = 16;
/// Pieces of a footprint that share bounds.
const BLOCK: usize = 8;
/// Margin of the bounds along a chunk, metres: far above the rounding errors at coordinates of
/// 10^7 m.
const SLACK: f64 = 1e-6;

/// The corners of an axis-aligned bounding box, (min, max).
type Bounds = (DVec2, DVec2);

const NOWHERE: Bounds = (DVec2::INFINITY, DVec2::NEG_INFINITY);

/// A path widened to the width of a vehicle. Pieces are cut once per path, not once per step.
#[derive(Clone, Debug)]
pub(super) struct Corridor {
    path: Path,
    half_width: f64,
    /// The rectangle of each segment.
    stretches: Vec<Quad>,
    /// The piece that closes the bend at the start of each segment.
    joints: Vec<Option<Quad>>,
    /// Bounds of each segment with its joint.
    cells: Vec<Bounds>,
    /// Bounds of all that follows the start of each segment.
    bounds: Vec<Bounds>,
    /// Every few segments with their joints.
    chunks: Vec<Chunk>,
}

/// Position of a vehicle in its corridor.
#[derive(Clone, Copy, Debug)]
pub(super) struct Start {
    /// Arc length, metres.
    from: f64,
    /// The segment that holds it.
    segment: usize,
}

/// Bounds of a few segments with their joints.
#[derive(Clone, Copy, Debug)]
struct Chunk {
    bounds: Bounds,
    /// Unit vector from the start to the end; the x axis where there is no such direction.
    along: DVec2,
    /// The least and the greatest coordinates along and across that direction.
    low: DVec2,
    high: DVec2,
    /// The rectangle that these bound.
    strip: Quad,
    /// Whether every segment has a length and a width.
    is_solid: bool,
}

impl Chunk {
    fn around(pieces: &[Quad], joints: &[Option<Quad>], margin: f64) -> Self {
        let margin = DVec2::splat(margin);
        let ends = pieces[pieces.len() - 1].center() - pieces[0].center();
        let along = ends.try_normalize().unwrap_or(DVec2::X);
        let all = pieces.iter().chain(joints.iter().flatten());
        let extents = all.map(|piece| extent(along, piece));
        let (low, high) = extents.fold(NOWHERE, union);
        let (low, high) = (low - SLACK, high + SLACK);
        let at = |x: f64, y: f64| along * x + along.perp() * y;
        let bounds = pieces.iter().map(Quad::bounds).fold(NOWHERE, union);
        Self {
            bounds: (bounds.0 - margin, bounds.1 + margin),
            along,
            low,
            high,
            strip: Quad::new([
                at(low.x, low.y),
                at(high.x, low.y),
                at(high.x, high.y),
                at(low.x, high.y),
            ]),
            is_solid: pieces.iter().all(is_solid),
        }
    }

    /// True only if a shape shares no point with any piece of the chunk.
    #[inline]
    fn is_clear_of(&self, quad: &Quad) -> bool {
        !overlap((self.low, self.high), extent(self.along, quad))
    }

    /// True only if no two pieces of the chunks share a point.
    fn is_clear_of_all(&self, other: &Self) -> bool {
        self.is_clear_of(&other.strip) || other.is_clear_of(&self.strip)
    }
}

/// The least and the greatest coordinates of a shape along and across a direction.
#[inline]
fn extent(along: DVec2, quad: &Quad) -> Bounds {
    let corners = quad.corners().iter();
    let turned = corners.map(|&p| DVec2::new(along.dot(p), along.perp_dot(p)));
    turned.fold(NOWHERE, |(low, high), p| (low.min(p), high.max(p)))
}

/// Whether a rectangle has a length and a width.
fn is_solid(quad: &Quad) -> bool {
    let [a, b, c, _] = *quad.corners();
    a.distance_squared(b) > SLACK && b.distance_squared(c) > SLACK
}

impl Corridor {
    pub(super) fn new(path: Path, half_width: f64) -> Self {
        let points = path.line().points();
        let sides: Vec<DVec2> = points
            .windows(2)
            .map(|pair| (pair[1] - pair[0]).normalize_or_zero().perp() * half_width)
            .collect();
        let stretches: Vec<Quad> = points
            .windows(2)
            .zip(&sides)
            .map(|(pair, &side)| stretch(pair[0], pair[1], side))
            .collect();
        let joints: Vec<Option<Quad>> = (0..sides.len())
            .map(|i| joint(points[i], *sides.get(i.checked_sub(1)?)?, sides[i]))
            .collect();
        let mut bounds = Vec::with_capacity(stretches.len());
        let mut all = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        // Joints stay within half a width of their point, so this margin covers them.
        let margin = DVec2::splat(half_width);
        for pair in points.windows(2).rev() {
            for point in pair {
                all = (all.0.min(*point - margin), all.1.max(*point + margin));
            }
            bounds.push(all);
        }
        bounds.reverse();
        let chunks = stretches.chunks(CHUNK).zip(joints.chunks(CHUNK));
        let chunks = chunks.map(|(pieces, joints)| Chunk::around(pieces, joints, half_width));
        let chunks = chunks.collect();
        let cells = stretches.iter().zip(&joints).map(|(piece, joint)| {
            let joint: Option<&Quad> = joint.as_ref();
            joint.map_or(piece.bounds(), |j| union(piece.bounds(), j.bounds()))
        });
        let cells = cells.collect();
        Self {
            cells,
            chunks,
            path,
            half_width,
            stretches,
            joints,
            bounds,
        }
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Arc length `s`, clamped to the path.
    pub(super) fn start(&self, s: f64) -> Start {
        let from = s.clamp(0.0, self.path.length());
        Start {
            from,
            segment: self.segment(from),
        }
    }

    /// Bounds of the corridor from `start` on.
    pub(super) fn bounds_from(&self, start: Start) -> Bounds {
        self.bounds[start.segment]
    }

    /// The pieces between two arc lengths, with flat ends, appended to `pieces`; both are clamped
    /// to the path.
    pub(super) fn pieces(&self, from: f64, to: f64, pieces: &mut Vec<Quad>) {
        let length = self.path.length();
        let (from, to) = (from.clamp(0.0, length), to.clamp(0.0, length));
        if from >= to {
            return;
        }
        let (first, last) = (self.segment(from), self.segment(to));
        let points = self.path.line().points();
        let arc = self.path.line().arc_lengths();
        for i in first..=last {
            let whole = from <= arc[i] && arc[i + 1] <= to;
            if i > first {
                pieces.extend(self.joints[i]);
            }
            if whole {
                pieces.push(self.stretches[i]);
                continue;
            }
            let along = points[i + 1] - points[i];
            let step = arc[i + 1] - arc[i];
            let place = |s: f64| points[i] + along * ((s - arc[i]) / step).clamp(0.0, 1.0);
            let (start, end) = (place(from), place(to));
            if start != end {
                let side = along.perp() * (self.half_width / step);
                pieces.push(stretch(start, end, side));
            }
        }
    }

    /// True if a footprint reaches into the corridor anywhere from `start` on.
    pub(super) fn is_touched(&self, start: Start, footprint: &Footprint) -> bool {
        let bounds = footprint.bounds;
        let touches = |piece: &Quad| {
            overlap(piece.bounds(), bounds)
                && footprint
                    .near(piece.bounds())
                    .any(|body| body.intersects(piece))
        };
        self.has_piece(start, bounds, |_| true, touches)
    }

    /// True if the first piece of a footprint reaches into the corridor anywhere from `start` on.
    pub(super) fn is_touched_by_body(&self, start: Start, footprint: &Footprint) -> bool {
        let body = &footprint.pieces[0];
        // What bounds along the chunk keep apart, the test of two shapes finds apart too, as long as
        // one of them has a length and a width.
        let is_near = |chunk: &Chunk| !footprint.is_solid || !chunk.is_clear_of(body);
        self.has_piece(start, body.bounds(), is_near, |piece| {
            body.intersects(piece)
        })
    }

    /// True for any piece from `start` on that `touches`, among those that overlap `bounds` and
    /// whose chunk is near.
    fn has_piece(
        &self,
        start: Start,
        bounds: Bounds,
        is_near: impl Fn(&Chunk) -> bool,
        touches: impl Fn(&Quad) -> bool,
    ) -> bool {
        let Start { from, segment } = start;
        if from >= self.path.length() {
            return false;
        }
        for (i, chunk) in self.chunks(segment) {
            if !overlap(chunk.bounds, bounds) || !is_near(chunk) {
                continue;
            }
            for i in self.segments(i, segment) {
                if i == segment {
                    if self.rest_of(i, from).is_some_and(|piece| touches(&piece)) {
                        return true;
                    }
                } else if overlap(self.cells[i], bounds)
                    && (touches(&self.stretches[i])
                        || self.joints[i].as_ref().is_some_and(&touches))
                {
                    return true;
                }
            }
        }
        false
    }

    /// True if what follows arc length `from` shares a point with what follows `other_from` of
    /// another corridor.
    pub(super) fn meets(&self, from: f64, other: &Self, other_from: f64) -> bool {
        let (start, other_start) = (self.segment(from), other.segment(other_from));
        if !overlap(self.bounds[start], other.bounds[other_start]) {
            return false;
        }
        let bounds = other.bounds[other_start];
        self.chunks(start).any(|(chunk, own)| {
            overlap(own.bounds, bounds)
                && other.chunks(other_start).any(|(other_chunk, theirs)| {
                    overlap(own.bounds, theirs.bounds)
                        && !(own.is_solid && theirs.is_solid && own.is_clear_of_all(theirs))
                        && other.segments(other_chunk, other_start).any(|j| {
                            overlap(own.bounds, other.cells[j])
                                && self.meets_segment(chunk, start, other, j)
                        })
                })
        })
    }

    /// True if a segment of a chunk, from `start` on, shares a point with segment `j` of another
    /// corridor.
    fn meets_segment(&self, chunk: usize, start: usize, other: &Self, j: usize) -> bool {
        let own = &self.chunks[chunk];
        std::iter::once(&other.stretches[j])
            .chain(&other.joints[j])
            .any(|piece| {
                overlap(own.bounds, piece.bounds())
                    && !(own.is_solid && is_solid(&other.stretches[j]) && own.is_clear_of(piece))
                    && self.segments(chunk, start).any(|i| {
                        overlap(self.cells[i], piece.bounds())
                            && (self.stretches[i].intersects(piece)
                                || self.joints[i].as_ref().is_some_and(|p| p.intersects(piece)))
                    })
            })
    }

    /// The part of segment `i` after arc length `from`.
    fn rest_of(&self, i: usize, from: f64) -> Option<Quad> {
        let arc = self.path.line().arc_lengths();
        if from <= arc[i] {
            return Some(self.stretches[i]);
        }
        let points = self.path.line().points();
        let (along, step) = (points[i + 1] - points[i], arc[i + 1] - arc[i]);
        let start = points[i] + along * ((from - arc[i]) / step).clamp(0.0, 1.0);
        let side = along.perp() * (self.half_width / step);
        (start != points[i + 1]).then(|| stretch(start, points[i + 1], side))
    }

    /// The chunks from that of segment `start` on, with their indices.
    fn chunks(&self, start: usize) -> impl Iterator<Item = (usize, &Chunk)> + '_ {
        let chunks = self.chunks.iter().enumerate();
        chunks.skip(start / CHUNK)
    }

    /// The segments of a chunk from `start` on.
    fn segments(&self, chunk: usize, start: usize) -> std::ops::Range<usize> {
        (chunk * CHUNK).max(start)..((chunk + 1) * CHUNK).min(self.stretches.len())
    }

    /// Index of the segment that holds arc length `s`.
    fn segment(&self, s: f64) -> usize {
        let arc = self.path.line().arc_lengths();
        arc.partition_point(|&a| a <= s)
            .saturating_sub(1)
            .min(self.stretches.len() - 1)
    }
}

#[inline]
fn overlap(a: Bounds, b: Bounds) -> bool {
    a.0.cmple(b.1).all() && b.0.cmple(a.1).all()
}

#[inline]
fn union(a: Bounds, b: Bounds) -> Bounds {
    (a.0.min(b.0), a.1.max(b.1))
}

/// Square metres between two boxes along the axes.
#[inline]
fn gap_squared(a: Bounds, b: Bounds) -> f64 {
    (b.0 - a.1).max(a.0 - b.1).max(DVec2::ZERO).length_squared()
}

fn stretch(start: DVec2, end: DVec2, side: DVec2) -> Quad {
    Quad::new([start + side, end + side, end - side, start - side])
}

/// The area of a body: convex pieces with common bounds.
#[derive(Clone, Debug)]
pub(super) struct Footprint {
    pieces: Vec<Quad>,
    /// Bounds of every few pieces.
    blocks: Vec<Bounds>,
    bounds: Bounds,
    /// Whether the first piece has a length and a width.
    is_solid: bool,
}

impl Footprint {
    pub(super) fn new(pieces: Vec<Quad>) -> Self {
        let mut footprint = Self {
            pieces,
            blocks: Vec::new(),
            bounds: NOWHERE,
            is_solid: false,
        };
        footprint.measure();
        footprint
    }

    /// Becomes a box and the road of a corridor between two arc lengths.
    pub(super) fn sweep(&mut self, body: Quad, corridor: &Corridor, from: f64, to: f64) {
        self.pieces.clear();
        self.pieces.push(body);
        corridor.pieces(from, to, &mut self.pieces);
        self.measure();
    }

    #[cfg(test)]
    pub(super) fn pieces(&self) -> &[Quad] {
        &self.pieces
    }

    /// Recomputes the bounds after the pieces were changed.
    fn measure(&mut self) {
        self.blocks.clear();
        self.bounds = NOWHERE;
        for block in self.pieces.chunks(BLOCK) {
            let bounds = block.iter().map(Quad::bounds).fold(NOWHERE, union);
            self.blocks.push(bounds);
            self.bounds = union(self.bounds, bounds);
        }
        self.is_solid = self.pieces.first().is_some_and(is_solid);
    }

    /// The pieces whose bounds, or those of some around them, overlap.
    #[inline]
    fn near(&self, bounds: Bounds) -> impl Iterator<Item = &Quad> {
        let blocks = self.pieces.chunks(BLOCK).zip(&self.blocks);
        let near = blocks.filter(move |(_, of_block)| overlap(**of_block, bounds));
        near.flat_map(|(pieces, _)| pieces)
    }

    pub(super) fn is_within(&self, bounds: Bounds) -> bool {
        overlap(self.bounds, bounds)
    }

    /// The square of a lower bound of [`Footprint::distance`], square metres: of the gap between
    /// the bounding boxes.
    pub(super) fn gap_squared(&self, other: &Self) -> f64 {
        gap_squared(self.bounds, other.bounds)
    }

    /// Metres between two footprints, 0 if they intersect.
    pub(super) fn distance(&self, other: &Self) -> f64 {
        // Most queries overlap, which is faster to find out than the distance.
        if self.intersects(other) {
            return 0.0;
        }
        // Together with its square: a root is taken only if the squares do not decide.
        let (mut least, mut square) = (f64::INFINITY, f64::INFINITY);
        let is_nearer = |gap: f64, least: f64, square: f64| gap < square && gap.sqrt() < least;
        // From the front, since what counts is mostly ahead: then most pairs are too far to look at.
        for own in self.pieces.iter().rev() {
            let bounds = own.bounds();
            if !is_nearer(gap_squared(bounds, other.bounds), least, square) {
                continue;
            }
            for (pieces, of_block) in other.pieces.chunks(BLOCK).zip(&other.blocks) {
                if !is_nearer(gap_squared(bounds, *of_block), least, square) {
                    continue;
                }
                for piece in pieces {
                    if is_nearer(gap_squared(bounds, piece.bounds()), least, square) {
                        square = own.distance_squared_apart(piece, square);
                        least = square.sqrt();
                    }
                }
            }
        }
        least
    }

    fn intersects(&self, other: &Self) -> bool {
        self.near(other.bounds)
            .any(|own| other.near(own.bounds()).any(|piece| own.intersects(piece)))
    }

    pub(super) fn distance_to_polygon(&self, polygon: &Polygon) -> f64 {
        let distances = self
            .pieces
            .iter()
            .map(|own| own.distance_to_polygon(polygon));
        distances.fold(f64::INFINITY, f64::min)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;
    use gump_geometry::{OrientedBox, Pose, dvec2, widen};

    fn intersect(a: &Footprint, b: &[Quad]) -> bool {
        let meets = |own: &Quad| b.iter().any(|piece| own.intersects(piece));
        a.pieces.iter().any(meets)
    }

    fn bend() -> Corridor {
        let poses: Vec<Pose> = (0..=16)
            .map(|i| {
                let a = f64::from(i) * 0.1;
                Pose::new(20.0 * a.sin(), 20.0 * (1.0 - a.cos()), a)
            })
            .collect();
        Corridor::new(Path::through(&poses).unwrap(), 1.0)
    }

    #[test]
    fn pieces_are_those_of_the_widened_line() {
        let corridor = bend();
        let mut pieces = Vec::new();
        corridor.pieces(0.0, f64::INFINITY, &mut pieces);
        let expected = widen(corridor.path().line().points(), 1.0, 0.0);
        assert_eq!(pieces.len(), expected.len());
        for (found, expected) in pieces.iter().zip(&expected) {
            assert_abs_diff_eq!(found.distance(expected), 0.0);
            assert_abs_diff_eq!(
                found.center().distance(expected.center()),
                0.0,
                epsilon = 1e-9
            );
        }
        let bounds = corridor.bounds_from(corridor.start(0.0));
        assert!(Footprint::new(pieces).is_within(bounds));
    }

    #[test]
    fn ends_are_cut_where_asked() {
        let poses = [
            Pose::new(0.0, 0.0, 0.0),
            Pose::new(10.0, 0.0, 0.0),
            Pose::new(30.0, 0.0, 0.0),
        ];
        let corridor = Corridor::new(Path::through(&poses).unwrap(), 1.0);
        let check = |from: f64, to: f64, expected: Option<(f64, f64)>| {
            let mut pieces = Vec::new();
            corridor.pieces(from, to, &mut pieces);
            let footprint = Footprint::new(pieces);
            let found = (!footprint.pieces.is_empty())
                .then_some((footprint.bounds.0.x, footprint.bounds.1.x));
            assert_eq!(found, expected);
        };
        check(2.0, 8.0, Some((2.0, 8.0)));
        check(2.0, 18.0, Some((2.0, 18.0)));
        check(10.0, 18.0, Some((10.0, 18.0)));
        check(-5.0, 99.0, Some((0.0, 30.0)));
        check(30.0, 35.0, None);
    }

    #[test]
    fn what_touches_is_what_the_pieces_say() {
        let corridor = bend();
        let (mut touched, mut free) = (0, 0);
        for i in 0..400 {
            let (x, y) = (f64::from(i % 20) * 1.3 - 3.0, f64::from(i / 20) * 1.3 - 3.0);
            let footprint = Footprint::new(widen(&[dvec2(x, y), dvec2(x + 2.0, y)], 0.5, 0.0));
            for from in [-1.0, 0.0, 3.3, 17.0, 31.0, 99.0] {
                let mut pieces = Vec::new();
                corridor.pieces(from, f64::INFINITY, &mut pieces);
                let slow = intersect(&footprint, &pieces);
                assert_eq!(
                    corridor.is_touched(corridor.start(from), &footprint),
                    slow,
                    "{x} {y} {from}"
                );
                *if slow { &mut touched } else { &mut free } += 1;
            }
        }
        assert!(touched > 100 && free > 100);
    }

    #[test]
    fn corridors_meet_where_their_pieces_do() {
        let bend = bend();
        let mut found = [0, 0];
        for i in 0..300 {
            let (x, y) = (f64::from(i % 20) * 2.0 - 9.0, f64::from(i / 20) * 2.0 - 5.0);
            let a = f64::from(i) * 0.37;
            let poses = [0.0, 0.7, 5.0, 9.0].map(|s| Pose::new(x, y, a) * Pose::new(s, 0.0, 0.0));
            let other = Corridor::new(Path::through(&poses).unwrap(), 0.9);
            for (from, other_from) in [(0.0, 0.0), (12.0, 0.0), (0.0, 5.0), (25.0, 5.0)] {
                // Segments count whole, so what is behind their starts may be found as well.
                let start = |c: &Corridor, s| c.path.line().arc_lengths()[c.segment(s)];
                let (mut own, mut theirs) = (Vec::new(), Vec::new());
                bend.pieces(start(&bend, from), f64::INFINITY, &mut own);
                other.pieces(start(&other, other_from), f64::INFINITY, &mut theirs);
                let slow = intersect(&Footprint::new(own), &theirs);
                let meets = bend.meets(from, &other, other_from);
                assert!(meets || !slow, "{i} {from} {other_from}");
                found[usize::from(meets)] += 1;
            }
        }
        assert!(found[0] > 100 && found[1] > 100, "{found:?}");
    }

    #[test]
    fn footprints_measure_their_gap() {
        let at = |x: f64| {
            Footprint::new(widen(
                &[dvec2(x, 0.0), dvec2(x + 2.0, 0.0), dvec2(x + 4.0, 0.0)],
                1.0,
                0.0,
            ))
        };
        assert_eq!(at(0.0).distance(&at(7.0)), 3.0);
        assert_eq!(at(0.0).distance(&at(4.0)), 0.0);
        assert!(intersect(&at(0.0), &at(4.0).pieces) && !intersect(&at(0.0), &at(4.5).pieces));
    }

    #[test]
    fn bodies_beside_the_corridor_are_found_clear_of_it() {
        let corridor = bend();
        let start = corridor.start(3.3);
        let mut pieces = Vec::new();
        corridor.pieces(3.3, f64::INFINITY, &mut pieces);
        let (mut touched, mut cleared) = (0, 0);
        for i in 0..2000 {
            let f = f64::from(i);
            let shape = OrientedBox {
                pose: Pose::new(f * 0.73 % 26.0 - 3.0, f * 0.31 % 24.0 - 4.0, f * 0.17),
                // Every tenth is a line, to which the bounds along chunks do not apply.
                length: 4.0,
                width: if i % 10 == 0 { 0.0 } else { 1.8 },
            };
            let body = Quad::from(&shape);
            let slow = pieces.iter().any(|piece| piece.intersects(&body));
            let footprint = Footprint::new(vec![body]);
            assert_eq!(footprint.is_solid, i % 10 != 0);
            assert_eq!(corridor.is_touched_by_body(start, &footprint), slow, "{i}");
            touched += usize::from(slow);
            let near = |chunk: &Chunk| overlap(chunk.bounds, body.bounds());
            let clear = |chunk: &Chunk| chunk.is_clear_of(&body);
            let chunk = &corridor.chunks[0];
            cleared += usize::from(near(chunk) && clear(chunk));
            for piece in corridor
                .stretches
                .iter()
                .chain(corridor.joints.iter().flatten())
            {
                assert!(!clear(chunk) || !piece.intersects(&body));
            }
        }
        assert!(touched > 200 && cleared > 200, "{touched} {cleared}");
    }

    #[test]
    fn parallel_corridors_do_not_meet() {
        let lane = |radius: f64| {
            let at = |i: i32| {
                let angle = f64::from(i) * 0.02;
                Pose::new(radius * angle.sin(), -radius * angle.cos(), angle)
            };
            let poses: Vec<Pose> = (0..=60).map(at).collect();
            Corridor::new(Path::through(&poses).unwrap(), 1.0)
        };
        let inner = lane(100.0);
        for (radius, meet) in [(103.5, false), (102.1, false), (101.5, true), (100.0, true)] {
            let outer = lane(radius);
            let pairs = || {
                let theirs = || outer.stretches.iter().chain(outer.joints.iter().flatten());
                let own = inner.stretches.iter().chain(inner.joints.iter().flatten());
                own.flat_map(move |a| theirs().map(move |b| (a, b)))
            };
            assert_eq!(pairs().any(|(a, b)| a.intersects(b)), meet);
            assert_eq!(inner.meets(0.0, &outer, 0.0), meet, "{radius}");
            assert_eq!(outer.meets(0.0, &inner, 0.0), meet, "{radius}");
        }
        let beside = &lane(103.5).chunks[1];
        assert!(overlap(beside.bounds, inner.chunks[1].bounds));
        assert!(inner.chunks[1].is_clear_of_all(beside));
    }
}
