//! Boxes with a heading, the shape of every agent.

use glam::{DVec2, dvec2};

use crate::{Pose, cross, distance_to_segment};

/// A rectangle centred on a pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OrientedBox {
    /// Centre and heading.
    pub pose: Pose,
    /// Extent along the heading, metres.
    pub length: f64,
    /// Extent across the heading, metres.
    pub width: f64,
}

impl OrientedBox {
    /// The corners, counter-clockwise from front left.
    pub fn corners(&self) -> [DVec2; 4] {
        let (l, w) = (self.length / 2.0, self.width / 2.0);
        [dvec2(l, w), dvec2(-l, w), dvec2(-l, -w), dvec2(l, -w)].map(|corner| self.pose * corner)
    }

    /// True if `point` is inside or on the border.
    pub fn contains(&self, point: DVec2) -> bool {
        let local = self.pose.inverse() * point;
        local.x.abs() <= self.length / 2.0 && local.y.abs() <= self.width / 2.0
    }

    /// True if the interiors intersect; touching boxes do not overlap.
    pub fn overlaps(&self, other: &Self) -> bool {
        self.is_near(other) && self.separation(other) < 0.0
    }

    /// True if the boxes share a point; touching boxes do, unless corner to corner along their
    /// diagonals.
    pub fn touches(&self, other: &Self) -> bool {
        self.is_near(other) && self.separation(other) <= 0.0
    }

    /// True if the circles around the boxes overlap.
    fn is_near(&self, other: &Self) -> bool {
        let reach = (self.length.hypot(self.width) + other.length.hypot(other.width)) / 2.0;
        self.pose.position.distance_squared(other.pose.position) < reach * reach
    }

    /// Signed distance in metres: the gap between the boxes, or minus the smallest translation
    /// that would separate them.
    pub fn signed_distance(&self, other: &Self) -> f64 {
        let separation = self.separation(other);
        if separation <= 0.0 {
            return separation;
        }
        // Disjoint rectangles are nearest at a corner of one and an edge of the other.
        let (a, b) = (self.corners(), other.corners());
        corner_edge_distance(&a, &b).min(corner_edge_distance(&b, &a))
    }

    /// The largest gap over the four axes of the boxes; negative if they overlap.
    fn separation(&self, other: &Self) -> f64 {
        let (a, b) = (self.corners(), other.corners());
        let forward = [self.pose.direction(), other.pose.direction()];
        let axes = [forward[0], forward[0].perp(), forward[1], forward[1].perp()];
        let project = |corners: &[DVec2; 4], axis: DVec2| {
            let values = corners.map(|corner| (corner - self.pose.position).dot(axis));
            let low = values.into_iter().fold(f64::INFINITY, f64::min);
            let high = values.into_iter().fold(f64::NEG_INFINITY, f64::max);
            (low, high)
        };
        axes.into_iter()
            .map(|axis| {
                let ((a_low, a_high), (b_low, b_high)) = (project(&a, axis), project(&b, axis));
                (b_low - a_high).max(a_low - b_high)
            })
            .fold(f64::NEG_INFINITY, f64::max)
    }

    /// True if any edge of the box crosses the segment `a`–`b`, or contains it.
    pub fn intersects_segment(&self, a: DVec2, b: DVec2) -> bool {
        let corners = self.corners();
        self.contains(a)
            || self.contains(b)
            || (0..4).any(|i| crate::segments_intersect(corners[i], corners[(i + 1) % 4], a, b))
    }

    /// True if the corners run counter-clockwise, i.e. length and width are positive.
    pub fn is_valid(&self) -> bool {
        let [a, b, c, _] = self.corners();
        self.pose.is_finite() && cross(b - a, c - b) > 0.0
    }
}

fn corner_edge_distance(corners: &[DVec2; 4], edges: &[DVec2; 4]) -> f64 {
    let mut best = f64::INFINITY;
    for &corner in corners {
        for i in 0..4 {
            best = best.min(distance_to_segment(corner, edges[i], edges[(i + 1) % 4]));
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;

    fn car(x: f64, y: f64, heading: f64) -> OrientedBox {
        OrientedBox {
            pose: Pose::new(x, y, heading),
            length: 4.0,
            width: 2.0,
        }
    }

    #[test]
    fn touching_is_not_overlapping() {
        assert!(!car(0.0, 0.0, 0.0).overlaps(&car(4.0, 0.0, 0.0)));
        assert!(car(0.0, 0.0, 0.0).touches(&car(4.0, 0.0, 0.0)));
        assert!(!car(0.0, 0.0, 0.0).touches(&car(4.01, 0.0, 0.0)));
        assert!(car(0.0, 0.0, 0.0).overlaps(&car(3.99, 0.0, 0.0)));
    }

    #[test]
    fn signed_distance_is_gap_or_depth() {
        let check = |other, expected| {
            assert_abs_diff_eq!(
                car(0.0, 0.0, 0.0).signed_distance(&other),
                expected,
                epsilon = 1e-12
            );
        };
        check(car(7.0, 0.0, 0.0), 3.0);
        check(car(7.0, 6.0, 0.0), 5.0);
        check(car(0.0, 1.5, 0.0), -0.5);
        check(
            car(6.0, 0.0, std::f64::consts::FRAC_PI_4),
            6.0 - 2.0 - 3.0 / 2f64.sqrt(),
        );
    }

    #[test]
    fn contains_respects_heading() {
        let turned = car(0.0, 0.0, std::f64::consts::FRAC_PI_2);
        assert!(turned.contains(dvec2(0.9, 1.9)) && !turned.contains(dvec2(1.9, 0.9)));
        assert!(turned.is_valid());
        assert!(turned.intersects_segment(dvec2(-5.0, 0.0), dvec2(5.0, 0.0)));
    }
}
