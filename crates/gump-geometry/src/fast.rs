//! Lines and polygons prepared for many questions: the same answers as the plain ones, sooner.

use glam::DVec2;

use crate::{Polygon, Polyline, Projection};

// Answers do not depend on these; no measurement of other sizes is recorded.
/// Segments that share a bounding box.
const CHUNK: usize = 12;
/// Rows that a polygon is cut into, for each of which the edges that reach into it are known.
const ROWS: usize = 32;

/// Bounding boxes over stretches of a [`Polyline`].
#[derive(Clone, Debug)]
pub struct LineIndex {
    chunks: Vec<(DVec2, DVec2)>,
}

impl LineIndex {
    /// Prepares a line.
    pub fn new(line: &Polyline) -> Self {
        let points = line.points();
        let n_segments = points.len() - 1;
        let bounds = |from: usize| {
            let chunk = &points[from..(from + CHUNK + 1).min(points.len())];
            let none = (DVec2::INFINITY, DVec2::NEG_INFINITY);
            chunk
                .iter()
                .fold(none, |(min, max), &p| (min.min(p), max.max(p)))
        };
        Self {
            chunks: (0..n_segments).step_by(CHUNK).map(bounds).collect(),
        }
    }

    /// Same as [`Polyline::project`] of `line`, which must be the line of this index.
    pub fn project(&self, line: &Polyline, point: DVec2) -> Projection {
        let gap = |&(min, max): &(DVec2, DVec2)| {
            (min - point)
                .max(point - max)
                .max(DVec2::ZERO)
                .length_squared()
        };
        let within = |chunk: usize| chunk * CHUNK..(chunk + 1) * CHUNK;
        let Some(nearest) = (0..self.chunks.len())
            .min_by(|&a, &b| gap(&self.chunks[a]).total_cmp(&gap(&self.chunks[b])))
        else {
            return line.project(point);
        };
        let reach = line.project_within(within(nearest), point).distance;
        // In order, so that of equally near feet the first one wins as it does without an index.
        let mut best: Option<Projection> = None;
        for (i, chunk) in self.chunks.iter().enumerate() {
            if gap(chunk) <= reach * reach * (1.0 + 1e-12) {
                let found = line.project_within(within(i), point);
                if best.is_none_or(|best| found.distance < best.distance) {
                    best = Some(found);
                }
            }
        }
        best.unwrap_or_else(|| line.project(point))
    }
}

/// A [`Polygon`] with its edges sorted by height.
#[derive(Clone, Debug)]
pub struct PolygonIndex {
    min: DVec2,
    max: DVec2,
    rows: Vec<Vec<(DVec2, DVec2)>>,
}

impl PolygonIndex {
    /// Prepares a polygon.
    pub fn new(polygon: &Polygon) -> Self {
        let (min, max) = polygon.bounds();
        let mut index = Self {
            min,
            max,
            rows: vec![Vec::new(); ROWS],
        };
        for (a, b) in polygon.edges() {
            let (low, high) = (a.y.min(b.y), a.y.max(b.y));
            for row in index.row(low)..=index.row(high) {
                index.rows[row].push((a, b));
            }
        }
        index
    }

    /// The corners of the axis-aligned bounding box, (min, max).
    pub fn bounds(&self) -> (DVec2, DVec2) {
        (self.min, self.max)
    }

    /// Same as [`Polygon::contains`] of the polygon of this index.
    pub fn contains(&self, point: DVec2) -> bool {
        if point.cmplt(self.min).any() || point.cmpgt(self.max).any() {
            return false;
        }
        let crosses = |&&(a, b): &&(DVec2, DVec2)| {
            (a.y > point.y) != (b.y > point.y)
                && point.x < a.x + (point.y - a.y) / (b.y - a.y) * (b.x - a.x)
        };
        let row = &self.rows[self.row(point.y)];
        row.iter().filter(crosses).count() % 2 == 1
    }

    fn row(&self, y: f64) -> usize {
        let share = (y - self.min.y) / (self.max.y - self.min.y).max(1e-9);
        ((share * ROWS as f64) as usize).min(ROWS - 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::dvec2;

    fn spiral(n: usize) -> Vec<DVec2> {
        let turn = |i: usize| {
            let a = i as f64 * 0.13;
            DVec2::from_angle(a) * (3.0 + 0.7 * a)
        };
        (0..n).map(turn).collect()
    }

    #[test]
    fn an_indexed_line_projects_as_the_line_does() {
        for n in [1, 2, 12, 13, 14, 200] {
            let line = Polyline::new(spiral(n)).unwrap();
            let index = LineIndex::new(&line);
            for i in 0..500 {
                let f = f64::from(i);
                let point = dvec2((f * 0.37).sin(), (f * 0.71).cos()) * (f * 0.06);
                assert_eq!(index.project(&line, point), line.project(point));
            }
        }
        // Four feet are equally near; the first one is meant.
        let corners = [(0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0), (0.0, 0.0)];
        let square = Polyline::new(corners.map(|(x, y)| dvec2(x, y)).to_vec()).unwrap();
        let foot = LineIndex::new(&square).project(&square, dvec2(2.0, 2.0));
        assert_eq!(foot.segment, 0);
    }

    #[test]
    fn an_indexed_polygon_contains_what_the_polygon_does() {
        let mut ring = spiral(40);
        ring.push(dvec2(0.0, 0.0));
        let hole = vec![dvec2(1.0, 1.0), dvec2(2.0, 1.0), dvec2(2.0, 2.0)];
        let polygon = Polygon::with_holes(ring, vec![hole]).unwrap();
        let index = PolygonIndex::new(&polygon);
        let mut n_inside = 0;
        for i in 0..80 {
            for j in 0..80 {
                let point = dvec2(f64::from(i), f64::from(j)) * 0.25 - 10.0;
                assert_eq!(index.contains(point), polygon.contains(point), "{point}");
                n_inside += usize::from(index.contains(point));
            }
        }
        assert!(n_inside > 100);
    }
}
