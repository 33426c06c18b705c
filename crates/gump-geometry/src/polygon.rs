//! Polygons, with holes where a format has them: crosswalks, drivable areas, lane surfaces.

use glam::DVec2;

use crate::{distance_to_segment, segments_intersect};

/// A closed ring of at least three points, less the holes in it; the last point of each ring is
/// joined to its first.
#[derive(Clone, Debug, PartialEq)]
pub struct Polygon {
    ring: Vec<DVec2>,
    holes: Vec<Vec<DVec2>>,
    min: DVec2,
    max: DVec2,
}

impl Polygon {
    /// Builds a polygon; `None` if fewer than three points remain after a closing duplicate is
    /// dropped.
    pub fn new(ring: Vec<DVec2>) -> Option<Self> {
        Self::with_holes(ring, Vec::new())
    }

    /// Builds a polygon with holes; `None` as for [`Polygon::new`]. Holes of fewer than three
    /// points are dropped. That holes lie inside and apart from each other is not checked.
    pub fn with_holes(ring: Vec<DVec2>, holes: Vec<Vec<DVec2>>) -> Option<Self> {
        let ring = open_ring(ring)?;
        let min = ring.iter().copied().reduce(DVec2::min)?;
        let max = ring.iter().copied().reduce(DVec2::max)?;
        Some(Self {
            ring,
            holes: holes.into_iter().filter_map(open_ring).collect(),
            min,
            max,
        })
    }

    /// The corners of the outer ring in order, not repeated at the end.
    pub fn ring(&self) -> &[DVec2] {
        &self.ring
    }

    /// The corners of each hole, as in [`Polygon::ring`].
    pub fn holes(&self) -> &[Vec<DVec2>] {
        &self.holes
    }

    /// The corners of the axis-aligned bounding box, (min, max).
    pub fn bounds(&self) -> (DVec2, DVec2) {
        (self.min, self.max)
    }

    /// Signed area in square metres, positive if the outer ring is counter-clockwise.
    pub fn signed_area(&self) -> f64 {
        let outer = signed_area(&self.ring);
        let holes: f64 = self.holes.iter().map(|hole| signed_area(hole).abs()).sum();
        outer - holes * outer.signum()
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

    /// True if `point` is inside and not on the border.
    ///
    /// Source: `contains` of the simple-features standard, which nuPlan's map queries use.
    pub fn contains_strictly(&self, point: DVec2) -> bool {
        self.contains(point)
            && !self.edges().any(|(a, b)| {
                let within = point.cmpge(a.min(b)).all() && point.cmple(a.max(b)).all();
                within && (b - a).perp_dot(point - a) == 0.0
            })
    }

    /// True if the polygons share a point; touching counts.
    pub fn intersects(&self, other: &Self) -> bool {
        if self.max.cmplt(other.min).any() || other.max.cmplt(self.min).any() {
            return false;
        }
        let crosses = |(a, b): (DVec2, DVec2)| {
            let (low, high) = (a.min(b), a.max(b));
            let near = low.cmple(other.max).all() && high.cmpge(other.min).all();
            near && other.edges().any(|(c, d)| segments_intersect(a, b, c, d))
        };
        self.contains(other.ring[0]) || other.contains(self.ring[0]) || self.edges().any(crosses)
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

    /// The edges of the outer ring in order, the closing one last, then those of the holes.
    pub fn edges(&self) -> impl Iterator<Item = (DVec2, DVec2)> + '_ {
        let holes = self.holes.iter().flat_map(|hole| ring_edges(hole));
        ring_edges(&self.ring).chain(holes)
    }
}

/// Without the closing duplicate; `None` if fewer than three points remain.
fn open_ring(mut ring: Vec<DVec2>) -> Option<Vec<DVec2>> {
    if ring.len() > 1 && ring.first() == ring.last() {
        ring.pop();
    }
    (ring.len() >= 3).then_some(ring)
}

fn ring_edges(ring: &[DVec2]) -> impl Iterator<Item = (DVec2, DVec2)> + '_ {
    let n = ring.len();
    (0..n).map(move |i| (ring[i], ring[(i + 1) % n]))
}

fn signed_area(ring: &[DVec2]) -> f64 {
    // Relative to the first corner: world coordinates are large and would cancel.
    let origin = ring[0];
    let doubled: f64 = ring_edges(ring)
        .map(|(a, b)| (a - origin).perp_dot(b - origin))
        .sum();
    doubled / 2.0
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
    fn the_border_is_not_strictly_inside() {
        let inside = |x, y| square().contains_strictly(dvec2(x, y));
        assert!(inside(1.0, 1.0) && !inside(5.0, 1.0));
        for (x, y) in [(0.0, 1.0), (4.0, 1.0), (2.0, 0.0), (2.0, 4.0), (0.0, 0.0)] {
            assert!(!inside(x, y), "({x}, {y}) is on the border");
        }
    }

    fn square_with_hole() -> Polygon {
        let hole = [(1.0, 1.0), (3.0, 1.0), (3.0, 3.0), (1.0, 3.0)];
        let hole = hole.map(|(x, y)| dvec2(x, y)).to_vec();
        Polygon::with_holes(square().ring().to_vec(), vec![hole]).unwrap()
    }

    #[test]
    fn a_hole_is_outside() {
        let ring = square_with_hole();
        assert_eq!(ring.signed_area(), 12.0);
        assert!(ring.contains(dvec2(0.5, 2.0)) && !ring.contains(dvec2(2.0, 2.0)));
        assert_eq!(ring.signed_distance(dvec2(2.0, 1.5)), 0.5);
    }

    #[test]
    fn polygons_intersect_when_they_share_a_point() {
        let moved = |x: f64, y: f64, scale: f64| {
            let corner = |p: &DVec2| *p * scale + dvec2(x, y);
            Polygon::new(square().ring().iter().map(corner).collect()).unwrap()
        };
        assert!(square().intersects(&moved(4.0, 0.0, 1.0)), "touching");
        assert!(square().intersects(&moved(1.0, 1.0, 0.1)), "within");
        assert!(moved(1.0, 1.0, 0.1).intersects(&square()), "around");
        assert!(square().intersects(&moved(3.0, -1.0, 1.0)), "crossing");
        assert!(!square().intersects(&moved(4.1, 0.0, 1.0)), "apart");
        assert!(
            !square_with_hole().intersects(&moved(1.5, 1.5, 0.2)),
            "in the hole"
        );
    }

    #[test]
    fn distance_is_negative_inside() {
        assert_eq!(square().signed_distance(dvec2(1.0, 2.0)), -1.0);
        assert_eq!(square().signed_distance(dvec2(7.0, 8.0)), 5.0);
        assert!(!square().contains(dvec2(4.5, 2.0)));
    }
}
