//! Directed polylines with arc length: lane centres, road edges, paths to follow.

use std::ops::Range;

use glam::DVec2;

use crate::{Polygon, Pose, project_on_segment};

/// A directed line through at least one point, measured by arc length.
///
/// Repeated points are kept as given (formats refer to points by index); they have no length.
#[derive(Clone, Debug, PartialEq)]
pub struct Polyline {
    points: Vec<DVec2>,
    arc_lengths: Vec<f64>,
}

/// The projection of a point onto a [`Polyline`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Projection {
    /// Index of the nearest segment (from point `segment` to point `segment + 1`).
    pub segment: usize,
    /// Arc length of the foot of the perpendicular, metres, in [0, length].
    pub arc_length: f64,
    /// Signed distance, metres: positive to the left of the line's direction.
    pub lateral: f64,
    /// Unsigned distance, metres.
    pub distance: f64,
}

impl Polyline {
    /// Builds a polyline; `None` if `points` is empty.
    pub fn new(points: Vec<DVec2>) -> Option<Self> {
        if points.is_empty() {
            return None;
        }
        let mut arc_lengths = Vec::with_capacity(points.len());
        let mut total = 0.0;
        arc_lengths.push(0.0);
        for pair in points.windows(2) {
            total += pair[0].distance(pair[1]);
            arc_lengths.push(total);
        }
        Some(Self {
            points,
            arc_lengths,
        })
    }

    /// The points in order, never empty.
    pub fn points(&self) -> &[DVec2] {
        &self.points
    }

    /// The arc length of each point, metres, not decreasing.
    pub fn arc_lengths(&self) -> &[f64] {
        &self.arc_lengths
    }

    /// Total length, metres.
    pub fn length(&self) -> f64 {
        self.arc_lengths[self.arc_lengths.len() - 1]
    }

    /// The segments in order, as pairs of end points.
    pub fn segments(&self) -> impl Iterator<Item = (DVec2, DVec2)> + '_ {
        self.points.windows(2).map(|pair| (pair[0], pair[1]))
    }

    /// The point and direction at arc length `s`; before the start and past the end the line is
    /// continued straight.
    pub fn pose_at(&self, s: f64) -> Pose {
        let Some(segment) = self.segment_at(s) else {
            return Pose {
                position: self.points[0],
                heading: 0.0,
            };
        };
        let (a, b) = (self.points[segment], self.points[segment + 1]);
        let direction = (b - a).normalize();
        Pose {
            position: a + direction * (s - self.arc_lengths[segment]),
            heading: direction.to_angle(),
        }
    }

    /// The position of [`Polyline::pose_at`], for less time than both.
    pub fn point_at(&self, s: f64) -> DVec2 {
        let Some(segment) = self.segment_at(s) else {
            return self.points[0];
        };
        let (a, b) = (self.points[segment], self.points[segment + 1]);
        a + (b - a).normalize() * (s - self.arc_lengths[segment])
    }

    /// The nearest point of the line to `point`; on ties the first.
    pub fn project(&self, point: DVec2) -> Projection {
        self.project_within(0..self.points.len(), point)
    }

    /// [`Polyline::project`] on some of the segments only.
    pub(crate) fn project_within(&self, segments: Range<usize>, point: DVec2) -> Projection {
        let mut best = Projection {
            segment: 0,
            arc_length: 0.0,
            lateral: point.distance(self.points[0]),
            distance: f64::INFINITY,
        };
        let last = segments.end.min(self.points.len() - 1);
        for segment in segments.start..last {
            let (a, b) = (self.points[segment], self.points[segment + 1]);
            let t = project_on_segment(point, a, b);
            let distance = point.distance(a.lerp(b, t));
            if distance < best.distance {
                let left = (b - a).perp_dot(point - a) >= 0.0;
                best = Projection {
                    segment,
                    arc_length: self.arc_lengths[segment] + t * a.distance(b),
                    lateral: if left { distance } else { -distance },
                    distance,
                };
            }
        }
        if best.distance.is_infinite() {
            best.distance = best.lateral;
        }
        best
    }

    /// The part between two arc lengths, ends interpolated; clamped to the line.
    pub fn slice(&self, from: f64, to: f64) -> Self {
        let (from, to) = (from.clamp(0.0, self.length()), to.clamp(0.0, self.length()));
        let inner = self
            .points
            .iter()
            .zip(&self.arc_lengths)
            .filter(|(_, s)| from < **s && **s < to)
            .map(|(p, _)| *p);
        let mut points = vec![self.pose_at(from).position];
        points.extend(inner);
        points.push(self.pose_at(to).position);
        Self::new(points).expect("a slice has its two ends")
    }

    /// The same line with a point every `spacing` metres (the last interval may be shorter).
    pub fn resample(&self, spacing: f64) -> Self {
        let n_intervals = (self.length() / spacing).ceil().max(1.0) as usize;
        let points = (0..=n_intervals)
            .map(|i| {
                self.pose_at((i as f64 * spacing).min(self.length()))
                    .position
            })
            .collect();
        Self::new(points).expect("at least two points")
    }

    /// The line moved sideways by `offset` metres (positive to the left), point by point.
    pub fn offset(&self, offset: f64) -> Self {
        let n = self.points.len();
        let points = (0..n)
            .map(|i| {
                let before = self.points[i.saturating_sub(1)];
                let after = self.points[(i + 1).min(n - 1)];
                let normal = (after - before).normalize_or_zero().perp();
                self.points[i] + normal * offset
            })
            .collect();
        Self::new(points).expect("as many points as before")
    }

    /// The strip from `width / 2` metres left of the line to `width / 2` right of it, with flat
    /// ends; `None` for a line without length.
    pub fn ribbon(&self, width: f64) -> Option<Polygon> {
        if self.length() == 0.0 {
            return None;
        }
        let mut ring = self.offset(-width / 2.0).points;
        ring.extend(self.offset(width / 2.0).points.into_iter().rev());
        Polygon::new(ring)
    }

    /// Index of a segment of non-zero length that contains arc length `s`, or the nearest such.
    fn segment_at(&self, s: f64) -> Option<usize> {
        let has_length = |i: &usize| self.arc_lengths[i + 1] > self.arc_lengths[*i];
        let last = self.points.len().checked_sub(2)?;
        let guess = self
            .arc_lengths
            .partition_point(|&l| l <= s)
            .saturating_sub(1)
            .min(last);
        (0..=guess)
            .rev()
            .find(has_length)
            .or_else(|| (guess..=last).find(has_length))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;
    use glam::dvec2;

    fn corner() -> Polyline {
        Polyline::new(vec![
            dvec2(0.0, 0.0),
            dvec2(10.0, 0.0),
            dvec2(10.0, 0.0),
            dvec2(10.0, 5.0),
        ])
        .unwrap()
    }

    #[test]
    fn arc_length_ignores_repeated_points() {
        assert_eq!(corner().length(), 15.0);
        let pose = corner().pose_at(12.0);
        assert_abs_diff_eq!(pose.position.y, 2.0, epsilon = 1e-12);
        assert_abs_diff_eq!(pose.heading, std::f64::consts::FRAC_PI_2, epsilon = 1e-12);
    }

    #[test]
    fn lines_continue_straight_past_their_ends() {
        assert_eq!(corner().pose_at(-2.0).position, dvec2(-2.0, 0.0));
        assert_eq!(corner().pose_at(17.0).position, dvec2(10.0, 7.0));
    }

    #[test]
    fn a_point_is_the_position_of_its_pose() {
        let line = corner();
        for s in [-2.0, 0.0, 3.7, 10.0, 12.3, 17.0] {
            assert_eq!(line.point_at(s), line.pose_at(s).position);
        }
    }

    #[test]
    fn left_of_the_line_is_positive() {
        let left = corner().project(dvec2(4.0, 3.0));
        assert_eq!((left.arc_length, left.lateral, left.segment), (4.0, 3.0, 0));
        let right = corner().project(dvec2(12.0, 3.0));
        assert_eq!((right.arc_length, right.lateral), (13.0, -2.0));
    }

    #[test]
    fn a_single_point_is_a_line_without_length() {
        let point = Polyline::new(vec![dvec2(1.0, 1.0)]).unwrap();
        assert_eq!(point.project(dvec2(1.0, 4.0)).distance, 3.0);
        assert_eq!(point.pose_at(3.0).position, dvec2(1.0, 1.0));
        assert!(Polyline::new(vec![]).is_none());
    }

    #[test]
    fn slices_and_samples_keep_the_shape() {
        assert_eq!(corner().slice(5.0, 12.0).length(), 7.0);
        let samples = corner().resample(4.0);
        assert_eq!(samples.points().len(), 5);
        assert_eq!(*samples.points().last().unwrap(), dvec2(10.0, 5.0));
        assert_eq!(corner().offset(1.0).points()[0], dvec2(0.0, 1.0));
    }

    #[test]
    fn a_ribbon_has_flat_ends() {
        let line = Polyline::new(vec![dvec2(0.0, 0.0), dvec2(5.0, 0.0)]).unwrap();
        let ribbon = line.ribbon(2.0).unwrap();
        assert_eq!(ribbon.signed_area(), 10.0);
        assert!(ribbon.contains(dvec2(4.9, 0.9)) && !ribbon.contains(dvec2(5.1, 0.0)));
    }
}
