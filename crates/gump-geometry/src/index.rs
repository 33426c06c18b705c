//! Look-up of points, segments and boxes by place, by an R-tree.

use glam::DVec2;
use rstar::primitives::{GeomWithData, Line, Rectangle};
use rstar::{AABB, PointDistance, RTree};

/// Points with an index each, for k-nearest queries.
#[derive(Clone, Debug, Default)]
pub struct PointIndex {
    tree: RTree<GeomWithData<[f64; 2], usize>>,
}

impl PointIndex {
    /// Builds the index; point `i` is reported as `i`.
    pub fn new(points: impl IntoIterator<Item = DVec2>) -> Self {
        let entries = points
            .into_iter()
            .enumerate()
            .map(|(i, p)| GeomWithData::new(p.to_array(), i));
        Self {
            tree: RTree::bulk_load(entries.collect()),
        }
    }

    /// Up to `k` nearest points as (index, distance in metres), nearest first.
    pub fn nearest(&self, point: DVec2, k: usize) -> impl Iterator<Item = (usize, f64)> + '_ {
        self.tree
            .nearest_neighbor_iter_with_distance_2(point.to_array())
            .take(k)
            .map(|(entry, d2)| (entry.data, d2.sqrt()))
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.tree.size()
    }

    /// True if there is nothing to find.
    pub fn is_empty(&self) -> bool {
        self.tree.size() == 0
    }
}

/// Segments with a payload each, for distance queries.
#[derive(Clone, Debug)]
pub struct SegmentIndex<T> {
    tree: RTree<GeomWithData<Line<[f64; 2]>, T>>,
}

impl<T: Copy> SegmentIndex<T> {
    /// Builds the index from (start, end, payload).
    pub fn new(segments: impl IntoIterator<Item = (DVec2, DVec2, T)>) -> Self {
        let entries = segments
            .into_iter()
            .map(|(a, b, data)| GeomWithData::new(Line::new(a.to_array(), b.to_array()), data));
        Self {
            tree: RTree::bulk_load(entries.collect()),
        }
    }

    /// Segments within `radius` metres of `point` as (payload, distance), nearest first.
    pub fn within(&self, point: DVec2, radius: f64) -> impl Iterator<Item = (T, f64)> + '_ {
        self.nearest(point)
            .take_while(move |(_, distance)| *distance <= radius)
    }

    /// All segments as (payload, distance in metres), nearest first, lazily.
    pub fn nearest(&self, point: DVec2) -> impl Iterator<Item = (T, f64)> + '_ {
        let query = point.to_array();
        self.tree
            .nearest_neighbor_iter(query)
            .map(move |entry| (entry.data, entry.geom().distance_2(&query).sqrt()))
    }

    /// True if there is nothing to find.
    pub fn is_empty(&self) -> bool {
        self.tree.size() == 0
    }
}

/// Axis-aligned boxes with a payload each, to find the few polygons worth an exact test.
#[derive(Clone, Debug)]
pub struct BoxIndex<T> {
    tree: RTree<GeomWithData<Rectangle<[f64; 2]>, T>>,
}

impl<T: Copy> BoxIndex<T> {
    /// Builds the index from (minimum corner, maximum corner, payload).
    pub fn new(boxes: impl IntoIterator<Item = (DVec2, DVec2, T)>) -> Self {
        let entries = boxes.into_iter().map(|(min, max, data)| {
            let corners = Rectangle::from_corners(min.to_array(), max.to_array());
            GeomWithData::new(corners, data)
        });
        Self {
            tree: RTree::bulk_load(entries.collect()),
        }
    }

    /// Payloads of the boxes that share a point with the box from `min` to `max`, in no promised
    /// order; a query of one point is `intersecting(p, p)`.
    pub fn intersecting(&self, min: DVec2, max: DVec2) -> impl Iterator<Item = T> + '_ {
        let envelope = AABB::from_corners(min.to_array(), max.to_array());
        self.tree
            .locate_in_envelope_intersecting(envelope)
            .map(|entry| entry.data)
    }

    /// All boxes as (payload, distance in metres, 0 inside), nearest first, lazily.
    pub fn nearest(&self, point: DVec2) -> impl Iterator<Item = (T, f64)> + '_ {
        self.tree
            .nearest_neighbor_iter_with_distance_2(point.to_array())
            .map(|(entry, d2)| (entry.data, d2.sqrt()))
    }
}

impl<T> Default for BoxIndex<T> {
    fn default() -> Self {
        Self {
            tree: RTree::new_with_params(),
        }
    }
}

impl<T> Default for SegmentIndex<T> {
    fn default() -> Self {
        Self {
            tree: RTree::new_with_params(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::dvec2;

    #[test]
    fn points_come_nearest_first() {
        let index = PointIndex::new([dvec2(5.0, 0.0), dvec2(1.0, 0.0), dvec2(3.0, 0.0)]);
        let found: Vec<_> = index.nearest(DVec2::ZERO, 2).collect();
        assert_eq!(found, [(1, 1.0), (2, 3.0)]);
    }

    #[test]
    fn boxes_are_found_by_touch_and_by_distance() {
        let first = (dvec2(0.0, 0.0), dvec2(2.0, 2.0), 1);
        let second = (dvec2(2.0, 0.0), dvec2(4.0, 2.0), 2);
        let index = BoxIndex::new([first, second]);
        let at = |p: DVec2| {
            let mut found: Vec<_> = index.intersecting(p, p).collect();
            found.sort_unstable();
            found
        };
        assert_eq!(at(dvec2(1.0, 1.0)), [1]);
        assert_eq!(at(dvec2(2.0, 1.0)), [1, 2]);
        assert!(at(dvec2(5.0, 1.0)).is_empty());
        let nearest: Vec<_> = index.nearest(dvec2(7.0, 6.0)).collect();
        assert_eq!(nearest[0], (2, 5.0));
    }

    #[test]
    fn segments_are_found_by_distance_not_by_box() {
        let diagonal = (dvec2(0.0, 0.0), dvec2(10.0, 10.0), 'd');
        let level = (dvec2(0.0, 4.0), dvec2(2.0, 4.0), 'l');
        let index = SegmentIndex::new([diagonal, level]);
        // (1, 9) lies inside the diagonal's bounding box but nearer to the level segment.
        let found: Vec<_> = index.within(dvec2(1.0, 9.0), 5.1).map(|(c, _)| c).collect();
        assert_eq!(found, ['l']);
    }
}
