//! The drivable surface as overlapping polygons, and its border.
//!
//! A network states every lane and junction as a separate shape. The border of their union is
//! found without clipping polygons: a candidate line is cut into short pieces, and a piece belongs
//! to the border if the ground just beyond it belongs to no surface.

use gump_geometry::{BoxIndex, DVec2, Polygon, Polyline};

/// Length of the pieces a line is cut into, metres: the resolution of a border.
const PIECE: f64 = 0.5;
/// Distance beyond a line at which surfaces are looked up, metres: narrower gaps between surfaces
/// that were drawn side by side are no border.
const BEYOND: f64 = 0.4;
/// Stretches shorter than this are left over from joints, metres: two pieces.
const SHORTEST: f64 = 1.0;

/// Surfaces with a look-up by place.
#[derive(Debug)]
pub(super) struct Surfaces {
    polygons: Vec<Polygon>,
    boxes: BoxIndex<usize>,
}

/// The ground beyond a stretch of a line, to the right of its direction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Beyond {
    /// No surface.
    Nothing,
    /// The surface with this index, the lowest of several.
    Surface(usize),
}

impl Surfaces {
    pub(super) fn new(polygons: Vec<Polygon>) -> Self {
        let boxes = polygons.iter().enumerate().map(|(i, polygon)| {
            let (min, max) = polygon.bounds();
            (min, max, i)
        });
        let boxes = BoxIndex::new(boxes);
        Self { polygons, boxes }
    }

    /// The stretches of `line` by what lies beyond its right side, where `own` does not count.
    pub(super) fn stretches(&self, line: &Polyline, own: usize) -> Vec<(Beyond, Polyline)> {
        let points = line.resample(PIECE);
        let points = points.points();
        let mut stretches: Vec<(Beyond, Vec<DVec2>)> = Vec::new();
        for pair in points.windows(2) {
            let right = -(pair[1] - pair[0]).normalize_or_zero().perp();
            let beyond = self.at((pair[0] + pair[1]) / 2.0 + right * BEYOND, own);
            match stretches.last_mut() {
                Some((last, stretch)) if *last == beyond => stretch.push(pair[1]),
                _ => stretches.push((beyond, pair.to_vec())),
            }
        }
        let lines = stretches.into_iter().filter_map(|(beyond, points)| {
            let line = Polyline::new(points)?;
            (line.length() >= SHORTEST).then_some((beyond, line))
        });
        lines.collect()
    }

    /// All polygons in the order given.
    pub(super) fn into_polygons(self) -> Vec<Polygon> {
        self.polygons
    }

    fn at(&self, point: DVec2, own: usize) -> Beyond {
        let near = self.boxes.intersecting(point, point);
        let hits = near.filter(|&i| i != own && self.polygons[i].contains(point));
        hits.min().map_or(Beyond::Nothing, Beyond::Surface)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_geometry::dvec2;

    #[test]
    fn the_border_is_where_nothing_lies_beyond() {
        let line = |y: f64| Polyline::new(vec![dvec2(0.0, y), dvec2(100.0, y)]).unwrap();
        let half = Polyline::new(vec![dvec2(40.0, -3.5), dvec2(100.0, -3.5)]).unwrap();
        let strips = vec![line(0.0).ribbon(3.5).unwrap(), half.ribbon(3.5).unwrap()];
        let surfaces = Surfaces::new(strips);
        let found = surfaces.stretches(&line(-1.75), 0);
        let kinds: Vec<_> = found.iter().map(|(beyond, _)| *beyond).collect();
        assert_eq!(kinds, [Beyond::Nothing, Beyond::Surface(1)]);
        assert!((found[0].1.length() - 40.0).abs() <= 0.5);
    }
}
