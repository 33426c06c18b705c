//! Smooth drivable curves: bends, turns, and tracks by arc length.
//!
//! Independent of lanes. Start with [`Track`], then [`connect`].

use gump_geometry::{DVec2, Pose, angle_difference, dvec2, wrap_angle};

/// Metres between the samples of a [`Track`], at most: the cubics in between stay within a
/// millimetre of a circle of 20 m (see the tests).
const SPACING: f64 = 1.0;

/// A directed smooth curve, sampled evenly, with tangent and curvature at every sample.
///
/// Between samples position and direction come from one cubic, so a body that follows the curve
/// turns without jumps.
#[derive(Clone, Debug)]
pub(crate) struct Track {
    step: f64,
    points: Vec<DVec2>,
    tangents: Vec<DVec2>,
    curvatures: Vec<f64>,
}

impl Track {
    /// Fits a track through densely sampled points of a smooth curve (at least two, distinct).
    pub(crate) fn through(points: &[DVec2]) -> Self {
        let mut distinct: Vec<DVec2> = Vec::with_capacity(points.len());
        for &point in points {
            if distinct
                .last()
                .is_none_or(|&last| last.distance(point) > 1e-3)
            {
                distinct.push(point);
            }
        }
        let mut arc = vec![0.0];
        for pair in distinct.windows(2) {
            arc.push(arc[arc.len() - 1] + pair[0].distance(pair[1]));
        }
        let tangents = tangents(&distinct);
        let length = arc[arc.len() - 1];
        let n = (length / SPACING).ceil().max(1.0) as usize;
        let step = length / n as f64;
        let mut segment = 0;
        let resampled: Vec<DVec2> = (0..=n)
            .map(|i| {
                let s = i as f64 * step;
                while segment + 2 < distinct.len() && arc[segment + 1] < s {
                    segment += 1;
                }
                let h = arc[segment + 1] - arc[segment];
                let t = ((s - arc[segment]) / h).clamp(0.0, 1.0);
                let ends = [distinct[segment], distinct[segment + 1]];
                hermite(ends, [tangents[segment] * h, tangents[segment + 1] * h], t).0
            })
            .collect();
        Self::even(resampled, step)
    }

    fn even(points: Vec<DVec2>, step: f64) -> Self {
        let tangents = tangents(&points);
        let n = points.len();
        let curvatures = (0..n)
            .map(|i| {
                let (a, b) = (i.saturating_sub(1), (i + 1).min(n - 1));
                tangents[a].angle_to(tangents[b]) / ((b - a) as f64 * step)
            })
            .collect();
        Self {
            step,
            points,
            tangents,
            curvatures,
        }
    }

    /// Total length, metres.
    pub(crate) fn length(&self) -> f64 {
        self.step * (self.points.len() - 1) as f64
    }

    /// The samples in order.
    pub(crate) fn points(&self) -> &[DVec2] {
        &self.points
    }

    /// Metres between samples.
    pub(crate) fn step(&self) -> f64 {
        self.step
    }

    /// Radians per metre at each sample, positive to the left.
    pub(crate) fn curvatures(&self) -> &[f64] {
        &self.curvatures
    }

    /// Position and direction at arc length `s`; continued straight past both ends.
    pub(crate) fn pose_at(&self, s: f64) -> Pose {
        let last = self.points.len() - 1;
        if s <= 0.0 {
            return straight_on(self.points[0], self.tangents[0], s);
        }
        if s >= self.length() {
            return straight_on(self.points[last], self.tangents[last], s - self.length());
        }
        let i = ((s / self.step) as usize).min(last - 1);
        let ends = [self.points[i], self.points[i + 1]];
        let slopes = [
            self.tangents[i] * self.step,
            self.tangents[i + 1] * self.step,
        ];
        let (position, direction) = hermite(ends, slopes, s / self.step - i as f64);
        Pose {
            position,
            heading: direction.to_angle(),
        }
    }

    /// Curvature at arc length `s`, radians per metre.
    pub(crate) fn curvature_at(&self, s: f64) -> f64 {
        let x = (s / self.step).clamp(0.0, (self.points.len() - 1) as f64);
        let i = (x as usize).min(self.points.len() - 2);
        let t = x - i as f64;
        self.curvatures[i] * (1.0 - t) + self.curvatures[i + 1] * t
    }

    /// The track `lateral` metres to the left (negative: right).
    pub(crate) fn offset(&self, lateral: f64) -> Self {
        let points: Vec<DVec2> = self
            .points
            .iter()
            .zip(&self.tangents)
            .map(|(p, t)| *p + t.perp() * lateral)
            .collect();
        Self::through(&points)
    }

    /// The part between two arc lengths.
    pub(crate) fn slice(&self, from: f64, to: f64) -> Self {
        let n = ((to - from) / SPACING).ceil().max(1.0) as usize;
        let step = (to - from) / n as f64;
        let points = (0..=n).map(|i| self.pose_at(from + i as f64 * step).position);
        Self::through(&points.collect::<Vec<_>>())
    }

    /// The same curve driven the other way.
    pub(crate) fn reversed(&self) -> Self {
        let mut points = self.points.clone();
        points.reverse();
        Self::even(points, self.step)
    }

    /// Arc length of the sample nearest to `point`, refined by the tangent there.
    pub(crate) fn project(&self, point: DVec2) -> f64 {
        let nearest = (0..self.points.len())
            .min_by(|&a, &b| {
                let squared = |i: usize| self.points[i].distance_squared(point);
                squared(a).total_cmp(&squared(b))
            })
            .unwrap_or(0);
        let along = (point - self.points[nearest]).dot(self.tangents[nearest]);
        (nearest as f64 * self.step + along).clamp(0.0, self.length())
    }
}

/// Points along a road that starts at `start` and turns by each `(centre, reach, angle)` of
/// `bends`: `angle` radians spread smoothly over `centre ± reach` metres.
pub(crate) fn bend(start: Pose, length: f64, bends: &[(f64, f64, f64)]) -> Vec<DVec2> {
    let step = 0.5;
    let n = (length / step).ceil() as usize;
    let heading = |s: f64| {
        let turned = bends.iter().map(|(centre, reach, angle)| {
            angle * smooth_step((s - centre + reach) / (2.0 * reach))
        });
        start.heading + turned.sum::<f64>()
    };
    let mut position = start.position;
    let mut points = vec![position];
    for i in 0..n {
        // The midpoint rule keeps the closing error of a bend below a millimetre.
        position += DVec2::from_angle(heading((i as f64 + 0.5) * step)) * step;
        points.push(position);
    }
    points
}

/// Points of a smooth curve from one pose to another, with given curvatures at the ends.
///
/// Between straight ends that face a corner: straight on, a turn about as wide as the corner
/// allows (but not wider than `reach` metres from it), straight on. Otherwise a quintic.
pub(crate) fn connect(start: Pose, end: Pose, curvatures: [f64; 2], reach: f64) -> Vec<DVec2> {
    let turn = angle_difference(end.heading, start.heading);
    let (u, w) = (start.direction(), end.direction());
    let gap = end.position - start.position;
    // Ends with a radius over 250 m count as straight; nearly parallel ends (7 degrees) and U-turns
    // (150 degrees) have no corner to round. Bounds by eye.
    let is_straight = curvatures.iter().all(|k| k.abs() < 0.004);
    if is_straight && turn.abs() > 0.12 && turn.abs() < 2.6 {
        let d0 = gap.perp_dot(w) / u.perp_dot(w);
        let d1 = gap.perp_dot(u) / w.perp_dot(u);
        if d0 > 0.3 && d1 > 0.3 {
            return corner(start, end, d0, d1, reach);
        }
    }
    quintic(start, end, curvatures)
}

/// Straight, turn around the corner `d0` ahead of `start` and `d1` behind `end`, straight.
fn corner(start: Pose, end: Pose, d0: f64, d1: f64, reach: f64) -> Vec<DVec2> {
    let d = d0.min(d1).min(reach);
    let (u, w) = (start.direction(), end.direction());
    let apex = start.position + u * d0;
    // Three collinear control points at each end give a turn without a jump in curvature; how far
    // apart they are was chosen by eye.
    let control = [-1.0, -0.66, -0.26].map(|k| apex + u * (k * d));
    let control_out = [0.26, 0.66, 1.0].map(|k| apex + w * (k * d));
    let all = [
        control[0],
        control[1],
        control[2],
        control_out[0],
        control_out[1],
        control_out[2],
    ];
    let mut points = line(start.position, control[0]);
    let n = ((2.0 * d) / 0.4).ceil().max(6.0) as usize;
    points.extend((0..=n).map(|i| bezier5(&all, i as f64 / n as f64)));
    points.extend(line(control_out[2], end.position));
    points
}

fn quintic(start: Pose, end: Pose, curvatures: [f64; 2]) -> Vec<DVec2> {
    let scale = start.position.distance(end.position);
    let turn = angle_difference(end.heading, start.heading).abs();
    // An arc is longer than its chord; with this the quintic follows it to millimetres.
    let scale = if turn > 1e-3 {
        scale * (turn / 2.0) / (turn / 2.0).sin()
    } else {
        scale
    };
    let (v0, v1) = (start.direction() * scale, end.direction() * scale);
    let a0 = start.direction().perp() * (curvatures[0] * scale * scale);
    let a1 = end.direction().perp() * (curvatures[1] * scale * scale);
    let control = [
        start.position,
        start.position + v0 / 5.0,
        start.position + v0 * 0.4 + a0 / 20.0,
        end.position - v1 * 0.4 + a1 / 20.0,
        end.position - v1 / 5.0,
        end.position,
    ];
    let n = (scale / 0.4).ceil().max(6.0) as usize;
    (0..=n)
        .map(|i| bezier5(&control, i as f64 / n as f64))
        .collect()
}

/// Points of a straight line, both ends included, about half a metre apart.
pub(crate) fn line(from: DVec2, to: DVec2) -> Vec<DVec2> {
    let n = (from.distance(to) / 0.5).ceil().max(1.0) as usize;
    (0..=n)
        .map(|i| from.lerp(to, i as f64 / n as f64))
        .collect()
}

/// 0 to 1 with vanishing first and second derivatives at both ends.
pub(crate) fn smooth_step(t: f64) -> f64 {
    let t = t.clamp(0.0, 1.0);
    t * t * t * (10.0 + t * (6.0 * t - 15.0))
}

/// The derivative of [`smooth_step`].
pub(crate) fn smooth_step_slope(t: f64) -> f64 {
    let t = t.clamp(0.0, 1.0);
    30.0 * t * t * (1.0 - t) * (1.0 - t)
}

fn bezier5(control: &[DVec2; 6], t: f64) -> DVec2 {
    let weights = [1.0, 5.0, 10.0, 10.0, 5.0, 1.0];
    (0..6)
        .map(|i| control[i] * (weights[i] * t.powi(i as i32) * (1.0 - t).powi(5 - i as i32)))
        .sum()
}

fn straight_on(point: DVec2, tangent: DVec2, distance: f64) -> Pose {
    Pose {
        position: point + tangent * distance,
        heading: wrap_angle(tangent.to_angle()),
    }
}

/// Position and derivative of the cubic through two ends with given slopes.
fn hermite(ends: [DVec2; 2], slopes: [DVec2; 2], t: f64) -> (DVec2, DVec2) {
    let (t2, t3) = (t * t, t * t * t);
    let position = ends[0] * (2.0 * t3 - 3.0 * t2 + 1.0)
        + slopes[0] * (t3 - 2.0 * t2 + t)
        + ends[1] * (3.0 * t2 - 2.0 * t3)
        + slopes[1] * (t3 - t2);
    let derivative = (ends[1] - ends[0]) * (6.0 * t - 6.0 * t2)
        + slopes[0] * (3.0 * t2 - 4.0 * t + 1.0)
        + slopes[1] * (3.0 * t2 - 2.0 * t);
    (position, derivative)
}

/// Unit tangents: the direction of the parabola through each point and its neighbours.
fn tangents(points: &[DVec2]) -> Vec<DVec2> {
    let n = points.len();
    let chord = |i: usize| points[i + 1] - points[i];
    (0..n)
        .map(|i| {
            if n == 2 {
                return chord(0).normalize_or(dvec2(1.0, 0.0));
            }
            let at = i.clamp(1, n - 2);
            let (a, b) = (chord(at - 1), chord(at));
            let (ha, hb) = (a.length(), b.length());
            let middle = (a / ha * hb + b / hb * ha) / (ha + hb);
            let tangent = if i == 0 {
                a / ha * 2.0 - middle
            } else if i == n - 1 {
                b / hb * 2.0 - middle
            } else {
                middle
            };
            tangent.normalize_or(dvec2(1.0, 0.0))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::FRAC_PI_2;

    #[test]
    fn a_track_on_a_circle_has_its_curvature_everywhere() {
        let points: Vec<_> = (0..=90)
            .map(|i| DVec2::from_angle(f64::from(i).to_radians()) * 20.0)
            .collect();
        let track = Track::through(&points);
        assert!((track.length() - 10.0 * std::f64::consts::PI).abs() < 0.01);
        assert!(track.curvatures().iter().all(|k| (k - 0.05).abs() < 1e-3));
        for i in 0..300 {
            let pose = track.pose_at(f64::from(i) * 0.1);
            assert!((pose.position.length() - 20.0).abs() < 1e-3);
            let radial = angle_difference(pose.heading, pose.position.to_angle());
            assert!((radial - FRAC_PI_2).abs() < 2e-3, "{radial}");
        }
        let outer = track.offset(-2.0);
        assert!((outer.pose_at(7.0).position.length() - 22.0).abs() < 1e-2);
        assert!((track.project(track.pose_at(11.3).position * 1.1) - 11.3).abs() < 0.06);
    }

    #[test]
    fn turns_meet_both_poses_and_can_be_driven() {
        let start = Pose::new(0.0, 0.0, 0.0);
        for (end, tightest) in [
            (Pose::new(14.0, 10.0, FRAC_PI_2), 0.25),
            (Pose::new(12.0, -12.0, -FRAC_PI_2), 0.2),
            (Pose::new(30.0, 2.0, 0.0), 0.02),
            (Pose::new(40.0, 3.4, 0.02), 0.02),
            (Pose::new(25.0, 5.0, 0.4), 0.1),
        ] {
            let track = Track::through(&connect(start, end, [0.0; 2], 40.0));
            let last = track.pose_at(track.length());
            assert!(last.position.distance(end.position) < 1e-6);
            assert!(angle_difference(last.heading, end.heading).abs() < 0.02);
            assert!(track.pose_at(0.0).heading.abs() < 0.02 && track.points()[1].y.abs() < 0.02);
            let worst = track
                .curvatures()
                .iter()
                .fold(0.0, |w: f64, k| w.max(k.abs()));
            assert!(worst < tightest, "{worst} at {end:?}");
        }
    }

    #[test]
    fn a_bend_ends_with_the_sum_of_its_angles() {
        let points = bend(
            Pose::IDENTITY,
            100.0,
            &[(30.0, 20.0, 0.5), (70.0, 20.0, -0.2)],
        );
        let track = Track::through(&points);
        assert!((track.pose_at(100.0).heading - 0.3).abs() < 1e-3);
    }
}
