//! The strip of road that a vehicle will sweep, cut into convex pieces.

use gump_geometry::{DVec2, Polygon, Quad, joint};

use crate::path::Path;

/// Segments that share bounds.
const CHUNK: usize = 16;

/// A path widened to the width of a vehicle. Pieces are cut once per path, not once per step.
#[derive(Clone, Debug)]
pub(super) struct Corridor {
    path: Path,
    half_width: f64,
    /// The rectangle of each segment.
    stretches: Vec<Quad>,
    /// The piece that closes the bend at the start of each segment.
    joints: Vec<Option<Quad>>,
    /// Bounds of all that follows the start of each segment.
    bounds: Vec<(DVec2, DVec2)>,
    /// Bounds of every few segments with their joints.
    chunks: Vec<(DVec2, DVec2)>,
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
        let joints = (0..sides.len())
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
        let none = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        let chunks = stretches.chunks(CHUNK).map(|chunk| {
            let (low, high) = chunk
                .iter()
                .map(Quad::bounds)
                .fold(none, |all, (min, max)| (all.0.min(min), all.1.max(max)));
            (low - margin, high + margin)
        });
        let chunks = chunks.collect();
        Self {
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

    /// Bounds of the corridor from arc length `s` on.
    pub(super) fn bounds_from(&self, s: f64) -> (DVec2, DVec2) {
        self.bounds[self.segment(s)]
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

    /// True if a footprint reaches into the corridor anywhere from arc length `from` on.
    pub(super) fn is_touched(&self, from: f64, footprint: &Footprint) -> bool {
        self.is_touched_by(from, &footprint.pieces, (footprint.min, footprint.max))
    }

    /// True if any of `bodies`, which lie within `bounds`, reaches into the corridor anywhere from
    /// arc length `from` on.
    pub(super) fn is_touched_by(&self, from: f64, bodies: &[Quad], bounds: (DVec2, DVec2)) -> bool {
        let length = self.path.length();
        let from = from.clamp(0.0, length);
        if from >= length {
            return false;
        }
        let first = self.segment(from);
        let touches = |piece: &Quad| {
            overlap(piece.bounds(), bounds) && bodies.iter().any(|body| body.intersects(piece))
        };
        if self
            .rest_of(first, from)
            .is_some_and(|piece| touches(&piece))
        {
            return true;
        }
        let start = first + 1;
        self.chunks(start).any(|(chunk, of_chunk)| {
            overlap(of_chunk, bounds)
                && self.segments(chunk, start).any(|i| {
                    touches(&self.stretches[i]) || self.joints[i].as_ref().is_some_and(touches)
                })
        })
    }

    /// True if what follows arc length `from` shares a point with what follows `other_from` of
    /// another corridor.
    pub(super) fn meets(&self, from: f64, other: &Self, other_from: f64) -> bool {
        let (start, other_start) = (self.segment(from), other.segment(other_from));
        if !overlap(self.bounds[start], other.bounds[other_start]) {
            return false;
        }
        let bounds = other.bounds[other_start];
        let mut near = self.chunks(start).filter(|(_, b)| overlap(*b, bounds));
        near.any(|(chunk, own)| {
            let mut theirs = other.chunks(other_start).filter(|(_, b)| overlap(*b, own));
            theirs.any(|(other_chunk, _)| {
                other.segments(other_chunk, other_start).any(|j| {
                    let pieces = std::iter::once(&other.stretches[j]).chain(&other.joints[j]);
                    pieces.into_iter().any(|piece| {
                        overlap(piece.bounds(), own)
                            && self.segments(chunk, start).any(|i| {
                                self.stretches[i].intersects(piece)
                                    || self.joints[i].as_ref().is_some_and(|p| p.intersects(piece))
                            })
                    })
                })
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

    /// The chunks from that of segment `start` on, with their bounds.
    fn chunks(&self, start: usize) -> impl Iterator<Item = (usize, (DVec2, DVec2))> + '_ {
        let chunks = self.chunks.iter().copied().enumerate();
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
fn overlap(a: (DVec2, DVec2), b: (DVec2, DVec2)) -> bool {
    a.0.cmple(b.1).all() && b.0.cmple(a.1).all()
}

/// Metres between two boxes along the axes.
#[inline]
fn gap(a: (DVec2, DVec2), b: (DVec2, DVec2)) -> f64 {
    (b.0 - a.1).max(a.0 - b.1).max(DVec2::ZERO).length()
}

fn stretch(start: DVec2, end: DVec2, side: DVec2) -> Quad {
    Quad::new([start + side, end + side, end - side, start - side])
}

/// The area of a body: convex pieces with common bounds.
#[derive(Clone, Debug)]
pub(super) struct Footprint {
    pub(super) pieces: Vec<Quad>,
    min: DVec2,
    max: DVec2,
}

impl Footprint {
    pub(super) fn new(pieces: Vec<Quad>) -> Self {
        let mut footprint = Self {
            pieces,
            min: DVec2::INFINITY,
            max: DVec2::NEG_INFINITY,
        };
        footprint.measure();
        footprint
    }

    /// Recomputes the bounds after the pieces were changed.
    pub(super) fn measure(&mut self) {
        (self.min, self.max) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        for piece in &self.pieces {
            let (min, max) = piece.bounds();
            (self.min, self.max) = (self.min.min(min), self.max.max(max));
        }
    }

    pub(super) fn is_within(&self, bounds: (DVec2, DVec2)) -> bool {
        overlap((self.min, self.max), bounds)
    }

    /// A lower bound of [`Footprint::distance`], metres: the gap between the bounding boxes.
    pub(super) fn gap_at_least(&self, other: &Self) -> f64 {
        gap((self.min, self.max), (other.min, other.max))
    }

    /// Metres between two footprints, 0 if they intersect.
    pub(super) fn distance(&self, other: &Self) -> f64 {
        // Most that is asked for overlaps, which is found out sooner than how far away it is.
        if self.intersects(other) {
            return 0.0;
        }
        let bounds = (other.min, other.max);
        let mut least = f64::INFINITY;
        // From the front, since what counts is mostly ahead: then most pairs are too far to look at.
        for own in self.pieces.iter().rev() {
            if gap(own.bounds(), bounds) >= least {
                continue;
            }
            for piece in &other.pieces {
                if own.gap_at_least(piece) < least {
                    least = least.min(own.distance(piece));
                }
            }
        }
        least
    }

    fn intersects(&self, other: &Self) -> bool {
        let theirs = (other.min, other.max);
        let near = |own: &&Quad| overlap(own.bounds(), theirs);
        let meets = |own: &Quad| other.pieces.iter().any(|piece| own.intersects(piece));
        self.is_within(theirs) && self.pieces.iter().filter(near).any(meets)
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
    use gump_geometry::{Pose, dvec2, widen};

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
        let bounds = corridor.bounds_from(0.0);
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
            let found =
                (!footprint.pieces.is_empty()).then_some((footprint.min.x, footprint.max.x));
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
                    corridor.is_touched(from, &footprint),
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
}
