//! The path of one vehicle: a line with speeds and stop lines, extended as it is driven.

use gump_geometry::{DVec2, Pose, angle_difference, interpolate_angle, project_on_segment};
use gump_scene::{Lane, LaneId, Light, LightState};

use super::IdmConfig;
use super::road::Road;

/// Metres of path kept behind the vehicle when the path is extended: more than half of any vehicle,
/// so that a stop line under one is kept.
const TAIL: f64 = 20.0;
/// A stop point farther than this from the path belongs to another place, metres: more than a lane's
/// width, as they are drawn beside it, too. Chosen by hand.
const STOP_REACH: f64 = 5.0;
/// Curvature is the turn over this far before and after a point, metres: evens out the corners of
/// simplified lines. Chosen by hand.
const CURVATURE_SPAN: f64 = 3.0;
/// No curve is driven more slowly than this, metres per second, so that a kink in a map stops
/// nobody.
const CRAWL: f64 = 2.0;

/// A directed line with arc lengths that stay valid while it is extended ahead and cut behind.
#[derive(Clone, Debug)]
pub(super) struct Path {
    vertices: Vec<Vertex>,
    /// The lane the path ends on.
    last_lane: Option<LaneId>,
    stops: Vec<Stop>,
}

/// The speed that a lane allows.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Limit {
    /// The limit that the map states, metres per second.
    pub(super) stated: Option<f64>,
    /// The usual limit of lanes of its type, if the type is stated.
    pub(super) usual: Option<f64>,
}

impl Limit {
    fn of(lane: &Lane) -> Self {
        Self {
            stated: lane.speed_limit,
            usual: lane.kind.usual_speed_limit(),
        }
    }
}

#[derive(Clone, Copy, Debug)]
struct Vertex {
    point: DVec2,
    s: f64,
    heading: f64,
    /// Speed limit from here on.
    limit: Limit,
    /// Speed that lets the vehicle take every curve ahead.
    curve_speed: f64,
}

/// A stop required by a light.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Stop {
    pub(super) s: f64,
    pub(super) lane: LaneId,
    pub(super) state: LightState,
}

/// A position relative to a path.
#[derive(Clone, Copy, Debug)]
pub(super) struct Foot {
    pub(super) s: f64,
    /// Metres to the left.
    pub(super) lateral: f64,
    pub(super) heading: f64,
}

impl Path {
    /// An empty path at arc length 0.
    pub(super) fn new() -> Self {
        Self {
            vertices: Vec::new(),
            last_lane: None,
            stops: Vec::new(),
        }
    }

    /// True if there is a direction to drive in.
    pub(super) fn is_drivable(&self) -> bool {
        self.vertices.len() >= 2
    }

    pub(super) fn end(&self) -> f64 {
        self.vertices.last().map_or(0.0, |vertex| vertex.s)
    }

    /// The lane the path ends on.
    pub(super) fn last_lane(&self) -> Option<LaneId> {
        self.last_lane
    }

    pub(super) fn stops(&self) -> &[Stop] {
        &self.stops
    }

    /// Appends a lane, with the stop line of its light.
    pub(super) fn push_lane(&mut self, road: &Road, id: LaneId, lights: &[Light]) {
        let (Some(lane), Some(center)) = (road.lane(id), road.center(id)) else {
            return;
        };
        let start = self.end();
        self.push_points(center, Limit::of(lane));
        self.last_lane = Some(id);
        self.push_stop(lane, start, lights);
    }

    /// Appends points that belong to `lanes` in order, as a route gives them.
    pub(super) fn push_route(
        &mut self,
        road: &Road,
        points: &[DVec2],
        lanes: &[LaneId],
        lights: &[Light],
    ) {
        self.push_points(points, Limit::default());
        let mut start = 0.0;
        for lane in lanes.iter().filter_map(|&id| road.lane(id)) {
            let center = lane.centerline.points();
            // A lane that the route leaves sideways ends at the projection of its last point.
            let end = match center
                .last()
                .and_then(|&p| self.project(p, start, f64::INFINITY))
            {
                Some(foot) => foot.s.max(start),
                None => start,
            };
            for vertex in &mut self.vertices {
                if start <= vertex.s && vertex.s < end {
                    vertex.limit = Limit::of(lane);
                }
            }
            self.last_lane = Some(lane.id);
            self.push_stop(lane, start, lights);
            start = end;
        }
    }

    fn push_points(&mut self, points: &[DVec2], limit: Limit) {
        for &point in points {
            let s = match self.vertices.last_mut() {
                Some(last) => {
                    let step = last.point.distance(point);
                    if step < 0.01 {
                        last.limit = limit;
                        continue;
                    }
                    last.s + step
                }
                None => 0.0,
            };
            self.vertices.push(Vertex {
                point,
                s,
                heading: 0.0,
                limit,
                curve_speed: f64::INFINITY,
            });
        }
    }

    /// Records the stop position for the light of `lane`, entered at arc length `start`.
    ///
    /// Without a stop point that is the entry of a lane inside an intersection, else the end.
    fn push_stop(&mut self, lane: &Lane, start: f64, lights: &[Light]) {
        let Ok(i) = lights.binary_search_by_key(&lane.id, |light| light.lane) else {
            return;
        };
        let state = lights[i].state;
        let marked = lights[i].stop_point.and_then(|point| {
            let foot = self.project(point, start - STOP_REACH, self.end())?;
            (foot.lateral.abs() <= STOP_REACH).then_some(foot.s)
        });
        let s = match marked {
            Some(s) => s,
            None if lane.in_intersection => start,
            None => self.end(),
        };
        let lane = lane.id;
        self.stops.push(Stop { s, lane, state });
    }

    /// Updates the lights ahead to their present state.
    pub(super) fn show(&mut self, lights: &[Light]) {
        for stop in &mut self.stops {
            if let Ok(i) = lights.binary_search_by_key(&stop.lane, |light| light.lane) {
                stop.state = lights[i].state;
            }
        }
    }

    /// Recomputes headings and curve speeds after points were appended, and forgets what lies far
    /// behind `s`.
    pub(super) fn finish(&mut self, config: &IdmConfig, s: f64) {
        let behind = self.vertices.partition_point(|vertex| vertex.s < s - TAIL);
        self.vertices.drain(..behind.saturating_sub(1));
        self.stops.retain(|stop| stop.s >= s - TAIL);
        self.set_headings();
        self.set_curve_speeds(config);
    }

    fn set_headings(&mut self) {
        let points: Vec<DVec2> = self.vertices.iter().map(|vertex| vertex.point).collect();
        let n = points.len();
        for (i, vertex) in self.vertices.iter_mut().enumerate() {
            let direction = |j: usize| (points[j + 1] - points[j]).normalize_or_zero();
            let before = if i > 0 { direction(i - 1) } else { DVec2::ZERO };
            let after = if i + 1 < n { direction(i) } else { DVec2::ZERO };
            let mean = before + after;
            // A full reversal has no mean direction; keep the one that is driven next.
            vertex.heading = if mean.length() > 1e-6 { mean } else { after }.to_angle();
        }
    }

    fn set_curve_speeds(&mut self, config: &IdmConfig) {
        let speeds: Vec<f64> = self
            .vertices
            .iter()
            .map(|vertex| {
                let (before, after) = (vertex.s - CURVATURE_SPAN, vertex.s + CURVATURE_SPAN);
                let turn =
                    angle_difference(self.pose_at(after).heading, self.pose_at(before).heading);
                let curvature = turn.abs() / (2.0 * CURVATURE_SPAN);
                (config.lateral_acceleration / curvature.max(1e-9))
                    .sqrt()
                    .max(CRAWL)
            })
            .collect();
        // Half the comfortable deceleration: the law lags behind a falling desired speed.
        let braking = config.max_deceleration / 2.0;
        let mut ahead: Option<(f64, f64)> = None;
        for (vertex, speed) in self.vertices.iter_mut().zip(speeds).rev() {
            let reachable = ahead.map_or(f64::INFINITY, |(s, speed)| {
                (speed * speed + 2.0 * braking * (s - vertex.s)).sqrt()
            });
            vertex.curve_speed = speed.min(reachable);
            ahead = Some((vertex.s, vertex.curve_speed));
        }
    }

    /// Index of the segment at arc length `s`; the first or last one beyond the ends.
    fn segment(&self, s: f64) -> usize {
        let after = self.vertices.partition_point(|vertex| vertex.s <= s);
        after
            .saturating_sub(1)
            .min(self.vertices.len().saturating_sub(2))
    }

    /// Point and direction at arc length `s`; straight on beyond the ends. The direction changes
    /// gradually along segments.
    pub(super) fn pose_at(&self, s: f64) -> Pose {
        let i = self.segment(s);
        let (Some(a), Some(b)) = (self.vertices.get(i), self.vertices.get(i + 1)) else {
            return Pose::IDENTITY;
        };
        let t = (s - a.s) / (b.s - a.s);
        Pose {
            position: a.point.lerp(b.point, t),
            heading: interpolate_angle(a.heading, b.heading, t.clamp(0.0, 1.0)),
        }
    }

    /// The speed limit at `s` and the speed that curves allow.
    pub(super) fn speeds_at(&self, s: f64) -> (Limit, f64) {
        let i = self.segment(s);
        let (Some(a), Some(b)) = (self.vertices.get(i), self.vertices.get(i + 1)) else {
            return (Limit::default(), f64::INFINITY);
        };
        if s >= b.s {
            // Past the end nothing is known of curves.
            return (a.limit, f64::INFINITY);
        }
        let t = ((s - a.s) / (b.s - a.s)).max(0.0);
        (a.limit, a.curve_speed + t * (b.curve_speed - a.curve_speed))
    }

    /// The nearest place between two arc lengths; none if the path has no segment.
    ///
    /// Beyond the path's end the last segment is extended straight on.
    pub(super) fn project(&self, point: DVec2, from: f64, to: f64) -> Option<Foot> {
        if !self.is_drivable() {
            return None;
        }
        let (first, last) = (self.segment(from), self.segment(to));
        let mut best: Option<(f64, usize, f64)> = None;
        for i in first..=last {
            let (a, b) = (&self.vertices[i], &self.vertices[i + 1]);
            let mut t = project_on_segment(point, a.point, b.point);
            if t == 1.0 && i + 2 == self.vertices.len() {
                let along = b.point - a.point;
                t = ((point - a.point).dot(along) / along.length_squared()).max(1.0);
            }
            let squared = point.distance_squared(a.point.lerp(b.point, t));
            if best.is_none_or(|(least, ..)| squared < least) {
                best = Some((squared, i, t));
            }
        }
        let (squared, i, t) = best?;
        let (a, b) = (&self.vertices[i], &self.vertices[i + 1]);
        let left = (b.point - a.point).perp_dot(point - a.point) >= 0.0;
        let distance = squared.sqrt();
        Some(Foot {
            s: a.s + t * (b.s - a.s),
            lateral: if left { distance } else { -distance },
            heading: interpolate_angle(a.heading, b.heading, t.min(1.0)),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;
    use gump_geometry::dvec2;
    use gump_scene::fixture;
    use std::f64::consts::FRAC_PI_2;

    fn stated(limit: f64) -> Limit {
        Limit {
            stated: Some(limit),
            usual: None,
        }
    }

    /// 40 m east, a quarter circle of radius 10 m to the left, 40 m north.
    fn bend() -> Path {
        let mut points = vec![dvec2(0.0, 0.0)];
        points.extend((0..=45).map(|i| {
            let angle = f64::from(i) * 2f64.to_radians();
            dvec2(40.0, 10.0) + DVec2::from_angle(angle - FRAC_PI_2) * 10.0
        }));
        points.push(dvec2(50.0, 50.0));
        let mut path = Path::new();
        path.push_points(&super::super::road::simplify(&points), stated(13.0));
        path.finish(&IdmConfig::default(), 0.0);
        path
    }

    #[test]
    fn headings_turn_gradually() {
        let path = bend();
        let mut last = path.pose_at(0.0);
        for i in 1..=(path.end() * 10.0) as usize {
            let pose = path.pose_at(i as f64 * 0.1);
            assert!(angle_difference(pose.heading, last.heading).abs() < 0.03);
            assert!(pose.position.distance(last.position) < 0.11);
            last = pose;
        }
        let last = path.pose_at(path.end());
        assert_abs_diff_eq!(last.heading, FRAC_PI_2, epsilon = 0.01);
        assert_abs_diff_eq!(
            path.pose_at(path.end() + 5.0).position.y,
            55.0,
            epsilon = 1e-2
        );
    }

    #[test]
    fn curves_ask_for_slow_driving_in_time() {
        let path = bend();
        let (limit, slow) = path.speeds_at(48.0);
        assert_eq!(limit.stated, Some(13.0));
        // sqrt(3 m/s² * 10 m) = 5.5 m/s, up to the corners of the simplified line.
        assert!((4.5..6.5).contains(&slow), "{slow}");
        let (_, before) = path.speeds_at(20.0);
        let distance = 40.0 - 20.0;
        assert!(before <= (slow * slow + 2.0 * 1.5 * (distance + 4.0)).sqrt() + 0.5);
        assert!(path.speeds_at(75.0).1 > 20.0);
    }

    #[test]
    fn projection_is_signed_and_goes_on_past_the_end() {
        let path = bend();
        let foot = path.project(dvec2(20.0, 2.0), 0.0, 90.0).unwrap();
        assert_abs_diff_eq!(foot.s, 20.0, epsilon = 0.05);
        assert_abs_diff_eq!(foot.lateral, 2.0, epsilon = 0.05);
        let beyond = path.project(dvec2(51.0, 57.0), 0.0, 120.0).unwrap();
        assert_abs_diff_eq!(beyond.s, path.end() + 7.0, epsilon = 0.05);
        assert_abs_diff_eq!(beyond.lateral, -1.0, epsilon = 0.05);
    }

    #[test]
    fn cutting_the_tail_keeps_arc_lengths() {
        let mut path = bend();
        let pose = path.pose_at(70.0);
        path.finish(&IdmConfig::default(), 60.0);
        assert!(path.vertices[0].s > 30.0);
        assert_abs_diff_eq!(
            path.pose_at(70.0).position.y,
            pose.position.y,
            epsilon = 1e-9
        );
    }

    #[test]
    fn stops_are_at_the_stop_point_or_at_the_end_of_the_lane() {
        let check = |light: &str, expected: Option<f64>| {
            let text =
                format!("lane 1: 0,0 50,0 next 2\nlane 2: 50,0 80,0\n{light}\nego vehicle 0: 0,0");
            let scenario = fixture::scenario(&text).unwrap();
            let lights = scenario.present().now().lights();
            let road = Road::new(&scenario.map);
            let mut path = Path::new();
            path.push_lane(&road, LaneId(1), lights);
            path.push_lane(&road, LaneId(2), lights);
            assert_eq!(path.stops().first().map(|stop| stop.s), expected);
            assert_eq!(path.last_lane(), Some(LaneId(2)));
            let red = Light {
                state: LightState::Red,
                ..lights[0]
            };
            path.show(&[red]);
            assert_eq!(path.stops()[0].state, LightState::Red);
        };
        check("light 1 red: 38,1", Some(38.0));
        check("light 2 red: 49,1", Some(49.0));
        check("light 1 red: 38,30", Some(50.0));
        check("light 1 red:", Some(50.0));
        check("light 1 green: 38,1", Some(38.0));
    }
}
