//! Simple polygons: crosswalks, drivable areas, lane surfaces.

use glam::DVec2;

use crate::distance_to_segment;

/// A closed ring of at least three points; the last point is joined to the first.
#[derive(Clone, Debug, PartialEq)]
pub struct Polygon {
    ring: Vec<DVec2>,
    min: DVec2,
    max: DVec2,
}

impl Polygon {
    /// Builds a polygon; `None` if fewer than three points remain after a closing duplicate is
    /// dropped.
    pub fn new(mut ring: Vec<DVec2>) -> Option<Self> {
        if ring.len() > 1 && ring.first() == ring.last() {
            ring.pop();
        }
        if ring.len() < 3 {
            return None;
        }
        let min = ring.iter().copied().reduce(DVec2::min)?;
        let max = ring.iter().copied().reduce(DVec2::max)?;
        Some(Self { ring, min, max })
    }

    /// The corners in order, not repeated at the end.
    pub fn ring(&self) -> &[DVec2] {
        &self.ring
    }

    /// The corners of the axis-aligned bounding box, (min, max).
    pub fn bounds(&self) -> (DVec2, DVec2) {
        (self.min, self.max)
    }

    /// Signed area in square metres, positive if counter-clockwise.
    pub fn signed_area(&self) -> f64 {
        // Relative to the first corner: world coordinates are large and would cancel.
        let origin = self.ring[0];
        self.edges()
            .map(|(a, b)| (a - origin).perp_dot(b - origin))
            .sum::<f64>()
            / 2.0
    }

    /// True if `point` is inside by the even-odd rule; points on the border may go either way.
    pub fn contains(&self, point: DVec2) -> bool {
        if point.cmplt(self.min).any() || point.cmpgt(self.max).any() {
            return false;
        }
        let mut inside = false;
        for (a, b) in self.edges() {
            if (a.y > point.y) != (b.y > point.y)
                && point.x < a.x + (point.y - a.y) / (b.y - a.y) * (b.x - a.x)
            {
                inside = !inside;
            }
        }
        inside
    }

    /// Signed distance to the border in metres: negative inside, positive outside.
    pub fn signed_distance(&self, point: DVec2) -> f64 {
        let distance = self
            .edges()
            .map(|(a, b)| distance_to_segment(point, a, b))
            .fold(f64::INFINITY, f64::min);
        if self.contains(point) {
            -distance
        } else {
            distance
        }
    }

    /// The edges in order, the closing one last.
    pub fn edges(&self) -> impl Iterator<Item = (DVec2, DVec2)> + '_ {
        let n = self.ring.len();
        (0..n).map(move |i| (self.ring[i], self.ring[(i + 1) % n]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::dvec2;

    fn square() -> Polygon {
        let ring = vec![
            dvec2(0.0, 0.0),
            dvec2(4.0, 0.0),
            dvec2(4.0, 4.0),
            dvec2(0.0, 4.0),
            dvec2(0.0, 0.0),
        ];
        Polygon::new(ring).unwrap()
    }

    #[test]
    fn the_closing_point_is_dropped() {
        assert_eq!(square().ring().len(), 4);
        assert_eq!(square().signed_area(), 16.0);
        assert!(Polygon::new(vec![dvec2(0.0, 0.0), dvec2(1.0, 0.0), dvec2(0.0, 0.0)]).is_none());
    }

    #[test]
    fn distance_is_negative_inside() {
        assert_eq!(square().signed_distance(dvec2(1.0, 2.0)), -1.0);
        assert_eq!(square().signed_distance(dvec2(7.0, 8.0)), 5.0);
        assert!(!square().contains(dvec2(4.5, 2.0)));
    }
}
