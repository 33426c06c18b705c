//! Paths with a heading at every point, by arc length.
//!
//! A [`gump_geometry::Polyline`] takes directions from its points; here every point has its own
//! heading and both are interpolated, as in nuPlan's paths.

use gump_geometry::{DVec2, Polyline, Pose, angle_difference, wrap_angle};
use gump_scene::Lane;

/// Points closer than this to the next are the same point, metres. The devkit drops steps of about
/// zero; a millimetre is chosen by hand.
const SAME: f64 = 1e-3;
/// Distance between the points that a curvature is computed from, metres.
///
/// Source: nuplan-devkit.
const CURVATURE_SPAN: f64 = 2.0;
/// Distance over which a baseline's direction is determined, metres.
///
/// Source: nuplan-devkit.
const HEADING_SPAN: f64 = 0.5;

/// Poses along a line; at least one.
#[derive(Clone, Debug, PartialEq)]
pub struct Path {
    line: Polyline,
    /// Headings without jumps by whole turns.
    headings: Vec<f64>,
}

impl Path {
    /// A path through all poses; `None` if there is none.
    pub fn through(poses: &[Pose]) -> Option<Self> {
        let line = Polyline::new(poses.iter().map(|pose| pose.position).collect())?;
        let mut headings = Vec::with_capacity(poses.len());
        for pose in poses {
            let before = headings.last().copied().unwrap_or(pose.heading);
            headings.push(before + angle_difference(pose.heading, before));
        }
        Some(Self { line, headings })
    }

    /// A path through poses that another path continues; `None` if there are fewer than two.
    ///
    /// The last pose is dropped even where it is not repeated, unless too few would be left.
    /// Source: nuPlan's path of a vehicle; routes are shorter by one point because of it, as the
    /// golden values show.
    pub fn without_last(poses: &[Pose]) -> Option<Self> {
        let mut kept: Vec<Pose> = poses
            .windows(2)
            .filter(|pair| pair[0].position.distance(pair[1].position) > SAME)
            .map(|pair| pair[0])
            .collect();
        if kept.len() == 1 {
            kept.extend(poses.last());
        }
        if kept.is_empty() {
            return None;
        }
        Self::through(&kept)
    }

    /// The line itself.
    pub fn line(&self) -> &Polyline {
        &self.line
    }

    /// The points, each with its heading.
    pub fn poses(&self) -> impl Iterator<Item = Pose> + '_ {
        let points = self.line.points().iter().zip(&self.headings);
        points.map(|(&position, &heading)| Pose {
            position,
            heading: wrap_angle(heading),
        })
    }

    /// Length of the path, metres.
    pub fn length(&self) -> f64 {
        self.line.length()
    }

    /// Position and heading at arc length `s`, clamped to the path; the heading is wrapped.
    pub fn pose_at(&self, s: f64) -> Pose {
        let arc = self.line.arc_lengths();
        let last = arc.len() - 1;
        if last == 0 {
            return self.vertex(0);
        }
        let s = s.clamp(0.0, self.length());
        let after = arc.partition_point(|&a| a < s).clamp(1, last);
        let (a, b) = (arc[after - 1], arc[after]);
        let t = if b > a { (s - a) / (b - a) } else { 0.0 };
        let points = self.line.points();
        let (from, to) = (self.headings[after - 1], self.headings[after]);
        Pose {
            position: points[after - 1].lerp(points[after], t),
            heading: wrap_angle(from + t * (to - from)),
        }
    }

    /// Arc length of the nearest point of the path, metres.
    pub fn project(&self, point: DVec2) -> f64 {
        self.line.project(point).arc_length
    }

    /// The poses from arc length `s` on, the first one interpolated; the last two where `s` is at
    /// the end or beyond.
    pub fn poses_from(&self, s: f64) -> Vec<Pose> {
        let n = self.headings.len();
        if s >= self.length() {
            return (n.saturating_sub(2)..n).map(|i| self.vertex(i)).collect();
        }
        let first = self.line.arc_lengths().partition_point(|&a| a <= s);
        let mut poses = vec![self.pose_at(s)];
        poses.extend((first..n).map(|i| self.vertex(i)));
        poses
    }

    /// The same path moved sideways, point by point across its heading; positive to the left.
    pub fn shifted(&self, left: f64) -> Self {
        let shift = |pose: Pose| pose.position + pose.direction().perp() * left;
        let points = self.poses().map(shift).collect();
        Self {
            line: Polyline::new(points).expect("as many points as before"),
            headings: self.headings.clone(),
        }
    }

    fn vertex(&self, i: usize) -> Pose {
        Pose {
            position: self.line.points()[i],
            heading: wrap_angle(self.headings[i]),
        }
    }
}

/// The centre line as nuPlan's discrete baseline: every point with the direction to the next, the
/// last with that of the one before.
pub fn baseline(lane: &Lane) -> Vec<Pose> {
    let points = lane.centerline.points();
    let mut heading = 0.0;
    let mut poses: Vec<Pose> = points
        .windows(2)
        .map(|pair| {
            heading = (pair[1] - pair[0]).to_angle();
            Pose {
                position: pair[0],
                heading,
            }
        })
        .collect();
    poses.push(Pose {
        position: points[points.len() - 1],
        heading,
    });
    poses
}

/// The pose of a lane's centre line nearest to `point`, and its arc length.
///
/// Source: nuPlan's nearest pose, whose heading is that of the chord over the next half metre.
pub fn nearest_on_baseline(lane: &Lane, point: DVec2) -> (f64, Pose) {
    let line = &lane.centerline;
    let s = line.project(point).arc_length;
    let at = |s: f64| line.pose_at(s.clamp(0.0, line.length())).position;
    let position = at(s);
    let chord = if s + HEADING_SPAN <= line.length() {
        at(s + HEADING_SPAN) - position
    } else {
        position - at(s - HEADING_SPAN)
    };
    let heading = chord.to_angle();
    (s, Pose { position, heading })
}

/// Curvature where a lane starts, radians per metre, positive to the left; 0 if it is too short.
///
/// Source: nuPlan's three-point estimate, with its bound for points on one line.
pub fn curvature_at_start(lane: &Lane) -> f64 {
    let line = &lane.centerline;
    let at = |s: f64| line.pose_at(s.min(line.length())).position;
    let [p, q, r] = [0.0, CURVATURE_SPAN, 2.0 * CURVATURE_SPAN].map(at);
    let (a, b, c) = (p.distance(q), q.distance(r), r.distance(p));
    let heron = (a + b + c) * (c - a + b) * (c + a - b) * (a + b - c);
    if heron < 1e-6 {
        return 0.0;
    }
    (heron.sqrt() / (a * b * c)).copysign((q - p).perp_dot(r - q))
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;
    use gump_geometry::dvec2;
    use gump_scene::fixture;
    use serde_json::Value;

    fn rows(value: &Value) -> Vec<Vec<f64>> {
        let row = |v: &Value| {
            v.as_array()
                .unwrap()
                .iter()
                .map(|x| x.as_f64().unwrap())
                .collect()
        };
        value.as_array().unwrap().iter().map(row).collect()
    }

    fn check(found: Pose, expected: &[f64]) {
        assert_abs_diff_eq!(found.position.x, expected[1], epsilon = 1e-8);
        assert_abs_diff_eq!(found.position.y, expected[2], epsilon = 1e-8);
        assert_abs_diff_eq!(found.heading, expected[3], epsilon = 1e-8);
    }

    #[test]
    fn paths_agree_with_the_reference() {
        let text = include_str!("../tests/data/path_geometry.json");
        let golden: Value = serde_json::from_str(text).unwrap();
        let golden = &golden["interpolated_path"];
        let poses: Vec<Pose> = rows(&golden["input"])
            .iter()
            .map(|row| Pose::new(row[0], row[1], row[2]))
            .collect();
        let path = Path::without_last(&poses).unwrap();
        let expected = rows(&golden["path"]);
        assert_eq!(path.poses().count(), expected.len());
        for (i, (pose, row)) in path.poses().zip(&expected).enumerate() {
            check(pose, row);
            assert_abs_diff_eq!(path.line().arc_lengths()[i], row[0], epsilon = 1e-8);
        }
        for row in rows(&golden["samples"]) {
            check(path.pose_at(row[0]), &row);
        }
        for (key, from) in [
            ("trim_10_20", 10.0),
            ("trim_upto_7_5", 7.5),
            ("trim_at_end", 1e3),
        ] {
            let expected = rows(&golden[key]);
            let found = path.poses_from(from);
            // The path is never cut at its far end here.
            let n = expected.len() - usize::from(key == "trim_10_20");
            for (pose, row) in found.iter().zip(&expected[..n]) {
                check(*pose, row);
            }
            assert!(key == "trim_10_20" || found.len() == expected.len());
        }
    }

    #[test]
    fn curvature_is_signed_and_nearest_poses_look_ahead() {
        let lane = |text: &str| fixture::scenario(text).unwrap().map.lanes()[0].clone();
        let bend = |y: f64| {
            let points: Vec<_> = (0..20)
                .map(|i| {
                    let a = f64::from(i) * 0.05;
                    format!("{},{}", 10.0 * a.sin(), y * 10.0 * (1.0 - a.cos()))
                })
                .collect();
            lane(&format!("lane 1: {}\nego vehicle 0: 0,0", points.join(" ")))
        };
        assert_abs_diff_eq!(curvature_at_start(&bend(1.0)), 0.1, epsilon = 1e-3);
        assert_abs_diff_eq!(curvature_at_start(&bend(-1.0)), -0.1, epsilon = 1e-3);
        let corner = lane("lane 1: 0,0 10,0 10,10\nego vehicle 0: 0,0");
        let (s, pose) = nearest_on_baseline(&corner, dvec2(9.75, 1.0));
        assert_eq!((s, pose.position.x), (11.0, 10.0));
        assert_eq!(
            nearest_on_baseline(&corner, dvec2(9.75, 0.0)).1.heading,
            0.25f64.atan2(0.25)
        );
        let end = nearest_on_baseline(&corner, dvec2(10.0, 12.0)).1;
        assert_abs_diff_eq!(end.heading, std::f64::consts::FRAC_PI_2, epsilon = 1e-12);
    }

    #[test]
    fn shifted_paths_keep_their_headings() {
        let poses = [Pose::new(0.0, 0.0, 0.0), Pose::new(10.0, 0.0, 0.5)];
        let left = Path::through(&poses).unwrap().shifted(1.0);
        assert_abs_diff_eq!(left.pose_at(0.0).position.y, 1.0);
        assert_abs_diff_eq!(left.poses().last().unwrap().position.x, 10.0 - 0.5f64.sin());
        assert_eq!(left.poses().last().unwrap().heading, 0.5);
    }
}
