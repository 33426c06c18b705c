//! Convex quadrilaterals: boxes, stretches of a road, the joints between them.
//!
//! Distances and intersections of anything wider than a line are put together from these.

use glam::DVec2;

use crate::{OrientedBox, Polygon, project_on_segment, segments_intersect};

/// Four corners of a convex shape, in either direction; corners may coincide.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Quad {
    corners: [DVec2; 4],
    min: DVec2,
    max: DVec2,
}

impl Quad {
    /// Takes the corners in order.
    #[inline]
    pub fn new(corners: [DVec2; 4]) -> Self {
        let [a, b, c, d] = corners;
        Self {
            corners,
            min: a.min(b).min(c.min(d)),
            max: a.max(b).max(c.max(d)),
        }
    }

    /// The corners in order.
    #[inline]
    pub fn corners(&self) -> &[DVec2; 4] {
        &self.corners
    }

    /// The corners of the axis-aligned bounding box, (min, max).
    #[inline]
    pub fn bounds(&self) -> (DVec2, DVec2) {
        (self.min, self.max)
    }

    /// Mean of the corners.
    #[inline]
    pub fn center(&self) -> DVec2 {
        self.corners.iter().copied().sum::<DVec2>() / 4.0
    }

    /// True if the shapes share a point; touching counts.
    #[inline]
    pub fn intersects(&self, other: &Self) -> bool {
        self.bounds_intersect(other) && !self.is_separated(other) && !other.is_separated(self)
    }

    /// True if the shapes share a point; touching counts.
    pub fn intersects_polygon(&self, polygon: &Polygon) -> bool {
        let (min, max) = polygon.bounds();
        if self.min.cmpgt(max).any() || self.max.cmplt(min).any() {
            return false;
        }
        // Most of a long polygon is far away: bounds reject it at once.
        let is_near =
            |low: DVec2, high: DVec2| low.cmple(self.max).all() && high.cmpge(self.min).all();
        let mut points = polygon.ring().iter();
        let mut edges = polygon.edges();
        self.corners.iter().any(|&corner| polygon.contains(corner))
            || points.any(|&point| is_near(point, point) && self.contains(point))
            || edges.any(|(a, b)| {
                is_near(a.min(b), a.max(b))
                    && self.edges().any(|(c, d)| segments_intersect(a, b, c, d))
            })
    }

    /// True if `point` is inside or on the border.
    #[inline]
    pub fn contains(&self, point: DVec2) -> bool {
        let side = |(a, b): (DVec2, DVec2)| (b - a).perp_dot(point - a);
        self.edges().map(side).all(|side| side >= 0.0)
            || self.edges().map(side).all(|side| side <= 0.0)
    }

    /// Distance in metres, 0 if the shapes intersect.
    #[inline]
    pub fn distance(&self, other: &Self) -> f64 {
        if self.intersects(other) {
            return 0.0;
        }
        // Roots are taken once: the least distance has the least square.
        self.distance_squared_apart(other, f64::INFINITY).sqrt()
    }

    /// The square of the distance of shapes that do not intersect, square metres; `least` where that
    /// is less. Coordinates are at most 10^7 m.
    ///
    /// Quicker than [`Quad::distance`] to find the nearest of many.
    #[inline]
    pub fn distance_squared_apart(&self, other: &Self, least: f64) -> f64 {
        other.nearest_corner(self, self.nearest_corner(other, least))
    }

    /// The least square of a distance from a corner of `other` to an edge, or `least`.
    #[inline]
    fn nearest_corner(&self, other: &Self, mut least: f64) -> f64 {
        for (a, b) in self.edges() {
            let along = b - a;
            let square = along.length_squared();
            // A corner whose line is farther cannot be nearer. The margin is what rounding may make
            // of a point on an edge, and more.
            let limit = (least * (1.0 + 1e-6) + 1e-9) * square;
            for &p in &other.corners {
                let across = along.perp_dot(p - a);
                if across * across > limit {
                    continue;
                }
                // As `project_on_segment`, dividing only where it matters.
                let s = (p - a).dot(along);
                let foot = if s <= 0.0 {
                    a
                } else if s >= square {
                    b
                } else {
                    a.lerp(b, s / square)
                };
                least = least.min(p.distance_squared(foot));
            }
        }
        least
    }

    /// Distance in metres, 0 if the shapes intersect.
    pub fn distance_to_polygon(&self, polygon: &Polygon) -> f64 {
        if self.intersects_polygon(polygon) {
            return 0.0;
        }
        let square = |p: DVec2, a: DVec2, b: DVec2| {
            p.distance_squared(a.lerp(b, project_on_segment(p, a, b)))
        };
        let mut least = f64::INFINITY;
        for (a, b) in polygon.edges() {
            let gap = self.gap_to_bounds(a.min(b), a.max(b)).length_squared();
            // Rounding must not make the nearest edge look farther than another one.
            if gap * (1.0 - 1e-9) > least {
                continue;
            }
            for (c, d) in self.edges() {
                least = least.min(square(c, a, b)).min(square(a, c, d));
            }
        }
        least.sqrt()
    }

    /// A lower bound of [`Quad::distance_to_polygon`], metres: the gap between the bounding boxes.
    pub fn gap_to_polygon_at_least(&self, polygon: &Polygon) -> f64 {
        let (min, max) = polygon.bounds();
        self.gap_to_bounds(min, max).length()
    }

    /// A lower bound of [`Quad::distance`], metres: the gap between the bounding boxes.
    #[inline]
    pub fn gap_at_least(&self, other: &Self) -> f64 {
        self.gap_to_bounds(other.min, other.max).length()
    }

    /// Along both axes.
    #[inline]
    fn gap_to_bounds(&self, min: DVec2, max: DVec2) -> DVec2 {
        (min - self.max).max(self.min - max).max(DVec2::ZERO)
    }

    #[inline]
    fn bounds_intersect(&self, other: &Self) -> bool {
        self.min.cmple(other.max).all() && other.min.cmple(self.max).all()
    }

    /// True if an edge of this shape has all of `other` strictly on its outer side.
    fn is_separated(&self, other: &Self) -> bool {
        (0..4).any(|i| {
            let [a, b, c, d] = [0, 1, 2, 3].map(|j| self.corners[(i + j) % 4]);
            let normal = (b - a).perp();
            let side = |p: DVec2| normal.dot(p - a);
            // Both ends of the edge are at exactly 0.
            let (c, d) = (side(c), side(d));
            let (low, high) = (c.min(d).min(0.0), c.max(d).max(0.0));
            let [p, q, r, s] = other.corners.map(side);
            let other_low = p.min(q).min(r.min(s));
            let other_high = p.max(q).max(r.max(s));
            normal != DVec2::ZERO && (other_low > high || other_high < low)
        })
    }

    #[inline]
    fn edges(&self) -> impl Iterator<Item = (DVec2, DVec2)> + '_ {
        (0..4).map(|i| (self.corners[i], self.corners[(i + 1) % 4]))
    }
}

impl From<&OrientedBox> for Quad {
    fn from(value: &OrientedBox) -> Self {
        Self::new(value.corners())
    }
}

/// The pieces of a line made `2 * half_width` wide: a rectangle per segment, and at every bend the
/// joint that closes its outer side.
///
/// The ends are cut off square at the first and the last point; `overhang` metres are added to
/// both. Segments without length give no piece.
pub fn widen(points: &[DVec2], half_width: f64, overhang: f64) -> Vec<Quad> {
    let mut pieces = Vec::with_capacity(2 * points.len());
    let mut before: Option<DVec2> = None;
    let last = points.len().saturating_sub(2);
    for (i, pair) in points.windows(2).enumerate() {
        let Some(along) = (pair[1] - pair[0]).try_normalize() else {
            continue;
        };
        let side = along.perp() * half_width;
        if let Some(joint) = before.and_then(|before| joint(pair[0], before, side)) {
            pieces.push(joint);
        }
        let start = pair[0] - along * if before.is_none() { overhang } else { 0.0 };
        let end = pair[1] + along * if i == last { overhang } else { 0.0 };
        pieces.push(Quad::new([
            start + side,
            end + side,
            end - side,
            start - side,
        ]));
        before = Some(side);
    }
    pieces
}

/// The wedge between two rectangles that meet at `point`, on the outer side of the bend.
///
/// `before` and `after` point from the line to the left borders. The arc is approximated by its
/// middle: 2 mm at a bend of 20 degrees and a half width of 1 m.
pub fn joint(point: DVec2, before: DVec2, after: DVec2) -> Option<Quad> {
    let turn = before.perp_dot(after);
    if turn.abs() <= 1e-9 * before.length_squared() {
        return None;
    }
    // Turning left opens the right side.
    let sign = if turn > 0.0 { -1.0 } else { 1.0 };
    let (from, to) = (before * sign, after * sign);
    let middle = (from + to).try_normalize()? * before.length();
    Some(Quad::new([point, point + from, point + middle, point + to]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Pose, distance_to_segment};
    use approx::assert_abs_diff_eq;
    use glam::dvec2;

    fn car(x: f64, y: f64, heading: f64) -> OrientedBox {
        OrientedBox {
            pose: Pose::new(x, y, heading),
            length: 4.0,
            width: 2.0,
        }
    }

    #[test]
    fn boxes_as_quads_agree_with_boxes() {
        let mut seen = [false; 2];
        for i in 0..400 {
            let f = f64::from(i);
            let other = car((f * 0.7).sin() * 5.0, (f * 1.3).cos() * 4.0, f * 0.37);
            let own = car(0.0, 0.0, 0.3);
            let expected = own.signed_distance(&other).max(0.0);
            let found = Quad::from(&own).distance(&Quad::from(&other));
            assert_abs_diff_eq!(found, expected, epsilon = 1e-9);
            seen[usize::from(found > 0.0)] = true;
            assert!(Quad::from(&own).gap_at_least(&Quad::from(&other)) <= found + 1e-12);
        }
        assert_eq!(seen, [true, true]);
    }

    #[test]
    fn the_nearest_corner_is_that_of_a_plain_search() {
        // As far from the origin as maps in UTM are.
        let far = [DVec2::ZERO, dvec2(5.8e5, 4.2e6)];
        let mut apart = 0;
        for i in 0..2000 {
            let f = f64::from(i);
            let at = far[i as usize % 2];
            let place = |x: f64, y: f64, h: f64| {
                let shape = car(x + at.x, y + at.y, h);
                let width = [2.0, 0.0, 2.0][i as usize % 3];
                Quad::from(&OrientedBox { width, ..shape })
            };
            // Many are side by side, as on roads.
            let (own, other) = if i % 5 == 0 {
                (place(0.0, 0.0, 0.4), place(f % 7.0, f % 11.0 - 5.0, 0.4))
            } else {
                let (x, y) = ((f * 0.7).sin() * 9.0, (f * 1.3).cos() * 8.0);
                (place(0.0, 0.0, 0.3), place(x, y, f * 0.37))
            };
            if own.intersects(&other) {
                continue;
            }
            apart += 1;
            let mut plain = f64::INFINITY;
            for (from, to) in [(&own, &other), (&other, &own)] {
                for (a, b) in to.edges() {
                    for &p in from.corners() {
                        let foot = a.lerp(b, project_on_segment(p, a, b));
                        plain = plain.min(p.distance_squared(foot));
                    }
                }
            }
            for least in [f64::INFINITY, 4.0, plain, plain * (1.0 + 1e-12)] {
                assert_eq!(own.distance_squared_apart(&other, least), plain.min(least));
            }
            assert_eq!(own.distance(&other), plain.sqrt());
        }
        assert!(apart > 1000);
    }

    #[test]
    fn touching_is_intersecting() {
        let (a, b) = (
            Quad::from(&car(0.0, 0.0, 0.0)),
            Quad::from(&car(4.0, 0.0, 0.0)),
        );
        assert!(a.intersects(&b) && a.contains(dvec2(2.0, 1.0)));
        assert!(!a.intersects(&Quad::from(&car(4.0 + 1e-9, 0.0, 0.0))));
    }

    #[test]
    fn polygons_are_met_inside_outside_and_around() {
        let ring = |s: f64| vec![dvec2(-s, -s), dvec2(s, -s), dvec2(s, s), dvec2(-s, s)];
        let check = |size: f64, x: f64, distance: f64| {
            let polygon = Polygon::new(ring(size)).unwrap();
            let quad = Quad::from(&car(x, 0.0, 0.0));
            assert_abs_diff_eq!(quad.distance_to_polygon(&polygon), distance);
            assert_eq!(quad.intersects_polygon(&polygon), distance == 0.0);
        };
        check(10.0, 0.0, 0.0);
        check(0.1, 0.0, 0.0);
        check(10.0, 11.0, 0.0);
        check(10.0, 15.0, 3.0);
    }

    #[test]
    fn bounds_leave_no_edge_of_a_long_polygon_out() {
        // A bent strip, as a lane through a junction is.
        let at = |i: i32, radius: f64| {
            let angle = f64::from(i) * 0.05;
            dvec2(radius * angle.cos(), radius * angle.sin())
        };
        let outer = (0..=30).map(|i| at(i, 22.0));
        let ring: Vec<DVec2> = outer.chain((0..=30).rev().map(|i| at(i, 18.0))).collect();
        let polygon = Polygon::new(ring).unwrap();
        let mut seen = [false; 2];
        for i in 0..500 {
            let f = f64::from(i);
            let quad = Quad::from(&car(f % 37.0 - 6.0, f * 0.7 % 31.0 - 4.0, f * 0.61));
            let pairs = || {
                let edges = polygon.edges();
                edges.flat_map(|edge| quad.edges().map(move |own| (edge, own)))
            };
            let crosses = pairs().any(|((a, b), (c, d))| segments_intersect(a, b, c, d));
            let meets = crosses
                || quad.corners().iter().any(|&p| polygon.contains(p))
                || polygon.ring().iter().any(|&p| quad.contains(p));
            let apart = pairs()
                .map(|((a, b), (c, d))| {
                    distance_to_segment(c, a, b).min(distance_to_segment(a, c, d))
                })
                .fold(f64::INFINITY, f64::min);
            let distance = if meets { 0.0 } else { apart };
            assert_eq!(quad.intersects_polygon(&polygon), meets);
            assert_eq!(quad.distance_to_polygon(&polygon), distance);
            assert!(quad.gap_to_polygon_at_least(&polygon) <= distance);
            seen[usize::from(meets)] = true;
        }
        assert_eq!(seen, [true, true]);
    }

    #[test]
    fn a_wide_line_is_closed_on_the_outside_of_its_bends() {
        let points = [dvec2(0.0, 0.0), dvec2(10.0, 0.0), dvec2(10.0, 10.0)];
        let inside = |p: DVec2, overhang: f64| {
            widen(&points, 1.0, overhang)
                .iter()
                .any(|piece| piece.contains(p))
        };
        assert!(inside(dvec2(10.6, -0.6), 0.0) && !inside(dvec2(10.9, -0.9), 0.0));
        assert!(!inside(dvec2(-0.5, 0.0), 0.0) && inside(dvec2(-0.5, 0.0), 1.0));
        assert!(!inside(dvec2(10.0, 10.5), 0.0) && inside(dvec2(10.0, 10.5), 1.0));
    }
}
