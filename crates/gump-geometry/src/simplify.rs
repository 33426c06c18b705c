//! Simplification of lines.

use glam::DVec2;

use crate::distance_to_segment;

/// The indices of the points that keep a line within `tolerance` metres of its shape, ends
/// included, in order. Of equally distant points the last is kept first.
///
/// Source: Douglas and Peucker 1973.
pub fn simplify(points: &[DVec2], tolerance: f64) -> Vec<usize> {
    let Some(last) = points.len().checked_sub(1) else {
        return Vec::new();
    };
    let mut kept = vec![0];
    let mut spans = vec![(0, last)];
    while let Some((from, to)) = spans.pop() {
        let distance = |i: usize| distance_to_segment(points[i], points[from], points[to]);
        let farthest = (from + 1..to)
            .map(|i| (i, distance(i)))
            .max_by(|a, b| a.1.total_cmp(&b.1));
        match farthest {
            Some((middle, d)) if d > tolerance => {
                spans.push((middle, to));
                spans.push((from, middle));
            }
            _ if to > from => kept.push(to),
            _ => {}
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Polyline;
    use glam::dvec2;

    #[test]
    fn simplifying_keeps_ends_and_corners() {
        let corner = [
            dvec2(0.0, 0.0),
            dvec2(5.0, 0.01),
            dvec2(10.0, 0.0),
            dvec2(10.0, 4.0),
            dvec2(10.0, 9.0),
        ];
        assert_eq!(simplify(&corner, 0.1), [0, 2, 4]);
        assert_eq!(simplify(&corner[..1], 0.1), [0]);
        assert_eq!(simplify(&corner, 0.001), [0, 1, 2, 4]);
        assert!(simplify(&[], 0.1).is_empty());
    }

    #[test]
    fn every_point_stays_within_the_tolerance() {
        let arc: Vec<DVec2> = (0..=200)
            .map(|i| DVec2::from_angle(f64::from(i) * 0.0075) * 20.0)
            .collect();
        let kept = simplify(&arc, 0.05);
        assert!(kept.len() < 20, "{} points", kept.len());
        let line = Polyline::new(kept.iter().map(|&i| arc[i]).collect()).unwrap();
        assert!(arc.iter().all(|&p| line.project(p).distance <= 0.05));
    }
}
