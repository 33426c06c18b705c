//! Observations as a short vector of numbers in the ego's frame.

use gump_geometry::{DVec2, Polyline, angle_difference, dvec2};
use gump_scene::{Agent, LightState};
use serde::{Deserialize, Serialize};

use super::View;

/// Extent of a vector observation.
///
/// Numbers are scaled to the order of one: positions in the ego frame (x ahead, y left of the box
/// centre) over 20 m, speeds over 10 m/s. In this order:
/// * the ego: speed, acceleration over 4 m/s², yaw rate in rad/s, length over 5 m, width over 2 m;
/// * the route: 1 if there is one, metres to the left of it over 2 m, its direction at the ego as
///   the sine and cosine relative to the ego's heading, metres left of it over 50 m up to 1, then
///   (x, y) per point ahead, the last one repeated past its end;
/// * per agent, nearest box centre first: 1, x, y, cosine and sine of its relative heading, its
///   velocity over ground along x and y, length over 5 m, width over 2 m;
/// * per ray, from straight right over ahead to straight left: metres to the border of the road
///   over the range, up to 1;
/// * the next light of the route within 50 m: 1 if there is one, metres to its stop point over
///   50 m, then 1 for red, for yellow, for green.
///
/// Absent values are zeros; rays are 1 on maps without road edges. Rays are traced through
/// [`gump_metrics::Border::clearance`] and are accurate to a few decimetres.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct VectorView {
    /// Points of the route ahead.
    pub n_route_points: usize,
    /// Metres between them, > 0.
    pub route_spacing: f64,
    /// Number of agents, nearest first.
    pub n_agents: usize,
    /// Maximum distance of agents, metres, > 0.
    pub agent_range: f64,
    /// Number of directions in which the distance to the road border is measured.
    pub n_rays: usize,
    /// Maximum distance to the border, metres, > 0.
    pub ray_range: f64,
}

impl Default for VectorView {
    /// 50 m of route, four seconds at 45 km/h; ten agents, since few streets have more within
    /// reach; a ray every 22.5 degrees. Our choice: the paper's policy uses a raster.
    fn default() -> Self {
        Self {
            n_route_points: 10,
            route_spacing: 5.0,
            n_agents: 10,
            agent_range: 80.0,
            n_rays: 9,
            ray_range: 30.0,
        }
    }
}

/// Maximum distance of lights and of the end of the route, metres: as far as the default's points
/// of the route reach.
const AHEAD: f64 = 50.0;
/// Scales of positions and speeds, as [`VectorView`] has them.
const PLACE: f64 = 1.0 / 20.0;
const SPEED: f64 = 1.0 / 10.0;

impl VectorView {
    /// Numbers for the ego.
    pub const EGO: usize = 5;
    /// Numbers for the route before its points.
    pub const ROUTE: usize = 5;
    /// Numbers per point of the route.
    pub const POINT: usize = 2;
    /// Numbers per agent.
    pub const AGENT: usize = 9;
    /// Numbers for the light.
    pub const LIGHT: usize = 5;

    /// The length of an observation.
    #[allow(
        clippy::len_without_is_empty,
        reason = "an observation always holds the ego"
    )]
    pub fn len(&self) -> usize {
        Self::EGO
            + Self::ROUTE
            + self.n_route_points * Self::POINT
            + self.n_agents * Self::AGENT
            + self.n_rays
            + Self::LIGHT
    }

    /// Shape: `out` is `[len]`.
    pub(super) fn observe(&self, view: &View<'_>, out: &mut [f32]) {
        out.fill(0.0);
        let mut rest = out;
        let mut take = |n: usize| {
            let (part, others) = std::mem::take(&mut rest).split_at_mut(n);
            rest = others;
            part
        };
        ego(view, take(Self::EGO));
        let len = Self::ROUTE + self.n_route_points * Self::POINT;
        self.route(view, take(len));
        self.agents(view, take(self.n_agents * Self::AGENT));
        self.rays(view, take(self.n_rays));
        light(view, take(Self::LIGHT));
    }

    fn route(&self, view: &View<'_>, out: &mut [f32]) {
        let Some(path) = view.prepared.route() else {
            return;
        };
        let (pose, along) = (view.state.ego.state.pose, view.state.along);
        let foot = path.pose_at(along);
        let turn = angle_difference(foot.heading, pose.heading);
        let offset = foot.direction().perp_dot(pose.position - foot.position);
        let left = (path.length() - along) / AHEAD;
        let numbers = [1.0, offset / 2.0, turn.sin(), turn.cos(), left.min(1.0)];
        out[..Self::ROUTE].copy_from_slice(&numbers.map(|v| v as f32));
        let forward = pose.direction();
        let mut walk = Walk::new(path, along);
        for (i, point) in out[Self::ROUTE..].chunks_exact_mut(Self::POINT).enumerate() {
            let ahead = walk.to(along + (i + 1) as f64 * self.route_spacing);
            put(point, in_frame(forward, ahead - pose.position) * PLACE);
        }
    }

    fn agents(&self, view: &View<'_>, out: &mut [f32]) {
        let ego = &view.state.ego;
        let pose = ego.state.pose;
        let forward = pose.direction();
        for (agent, out) in self
            .nearest(view)
            .iter()
            .zip(out.chunks_exact_mut(Self::AGENT))
        {
            let state = &agent.state;
            let turn = DVec2::from_angle(state.pose.heading - pose.heading);
            out[0] = 1.0;
            put(
                &mut out[1..],
                in_frame(forward, state.pose.position - pose.position) * PLACE,
            );
            put(&mut out[3..], turn);
            put(&mut out[5..], in_frame(forward, state.velocity) * SPEED);
            put(&mut out[7..], dvec2(agent.length / 5.0, agent.width / 2.0));
        }
    }

    /// The nearest others, nearest first; of equally near ones the lower id.
    fn nearest<'a>(&self, view: &View<'a>) -> Vec<&'a Agent> {
        let ego = &view.state.ego;
        let place = ego.state.pose.position;
        let mut found: Vec<(f64, &Agent)> = Vec::with_capacity(self.n_agents + 1);
        let mut reach = self.agent_range * self.agent_range;
        for agent in view.now.agents() {
            let distance = place.distance_squared(agent.state.pose.position);
            if distance >= reach || agent.id == ego.id {
                continue;
            }
            let rank = found.partition_point(|(nearer, _)| *nearer <= distance);
            found.insert(rank, (distance, agent));
            found.truncate(self.n_agents);
            if found.len() == self.n_agents {
                reach = found.last().map_or(0.0, |(farthest, _)| *farthest);
            }
        }
        found.into_iter().map(|(_, agent)| agent).collect()
    }

    fn rays(&self, view: &View<'_>, out: &mut [f32]) {
        let pose = view.state.ego.state.pose;
        let (forward, n) = (pose.direction(), out.len());
        for (i, out) in out.iter_mut().enumerate() {
            let share = if n > 1 {
                i as f64 / (n - 1) as f64
            } else {
                0.5
            };
            let bearing = DVec2::from_angle((share - 0.5) * std::f64::consts::PI);
            let metres = self.trace(view, pose.position, forward.rotate(bearing));
            *out = (metres / self.ray_range) as f32;
        }
    }

    /// Metres from `from` to the border in one direction, at most the range: walks as far as the
    /// clearance allows until that turns negative (sphere tracing).
    fn trace(&self, view: &View<'_>, from: DVec2, direction: DVec2) -> f64 {
        /// Shortest stride, metres: along a kerb the clearance allows hardly any. Bounds the error
        /// of a ray and its time; not tuned.
        const STRIDE: f64 = 0.5;
        let mut walked = 0.0;
        let mut before: Option<(f64, f64)> = None;
        while walked < self.ray_range {
            let Some(clearance) = view.prepared.border.clearance(from + direction * walked) else {
                return self.ray_range;
            };
            if clearance <= 0.0 {
                // Between the last point on the road and this one.
                return before.map_or(0.0, |(at, clear)| {
                    at + (walked - at) * clear / (clear - clearance)
                });
            }
            before = Some((walked, clearance));
            walked += clearance.max(STRIDE);
        }
        self.ray_range
    }
}

fn ego(view: &View<'_>, out: &mut [f32]) {
    let ego = &view.state.ego;
    let speed = ego.state.velocity.dot(ego.state.pose.direction());
    let (acceleration, yaw_rate) = view.state.motion(view.prepared.dt());
    let numbers = [
        speed * SPEED,
        acceleration / 4.0,
        yaw_rate,
        ego.length / 5.0,
        ego.width / 2.0,
    ];
    out.copy_from_slice(&numbers.map(|v| v as f32));
}

fn light(view: &View<'_>, out: &mut [f32]) {
    let Some((distance, colour)) = view.prepared.light_ahead(view.state.along, view.now) else {
        return;
    };
    if distance > AHEAD {
        return;
    }
    let is = |state: LightState| f32::from(u8::from(colour == state));
    out.copy_from_slice(&[
        1.0,
        (distance / AHEAD) as f32,
        is(LightState::Red),
        is(LightState::Yellow),
        is(LightState::Green),
    ]);
}

/// A vector in the frame whose x axis is `forward`.
fn in_frame(forward: DVec2, vector: DVec2) -> DVec2 {
    dvec2(forward.dot(vector), forward.perp_dot(vector))
}

fn put(out: &mut [f32], vector: DVec2) {
    out[0] = vector.x as f32;
    out[1] = vector.y as f32;
}

/// Points of a line at growing arc lengths, found by walking on from the last one.
struct Walk<'a> {
    line: &'a Polyline,
    segment: usize,
}

impl<'a> Walk<'a> {
    fn new(line: &'a Polyline, from: f64) -> Self {
        let behind = line.arc_lengths().partition_point(|&s| s <= from);
        Self {
            line,
            segment: behind.saturating_sub(1),
        }
    }

    /// The point at arc length `s`, the last one past the end.
    fn to(&mut self, s: f64) -> DVec2 {
        let (points, lengths) = (self.line.points(), self.line.arc_lengths());
        while self.segment + 1 < points.len() && lengths[self.segment + 1] < s {
            self.segment += 1;
        }
        let Some(&next) = points.get(self.segment + 1) else {
            return points[points.len() - 1];
        };
        let (from, to) = (lengths[self.segment], lengths[self.segment + 1]);
        let t = if to > from {
            (s - from) / (to - from)
        } else {
            0.0
        };
        points[self.segment].lerp(next, t)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{PreparedScenario, Rules};
    use gump_scene::fixture;

    const VIEW: VectorView = VectorView {
        n_route_points: 3,
        route_spacing: 10.0,
        n_agents: 2,
        agent_range: 80.0,
        n_rays: 3,
        ray_range: 30.0,
    };

    fn check(text: &str, expected: &[f32]) {
        let prepared = PreparedScenario::new(fixture::scenario(text).unwrap(), 0.5).unwrap();
        let state = Rules::default().reset(&prepared);
        let mut found = vec![f32::NAN; VIEW.len()];
        let view = View {
            prepared: &prepared,
            state: &state,
            now: prepared.logged(0),
            before: None,
        };
        VIEW.observe(&view, &mut found);
        for (i, (a, b)) in found.iter().zip(expected).enumerate() {
            assert!((a - b).abs() < 1e-4, "number {i} is {a}, expected {b}");
        }
        assert_eq!(expected.len(), VIEW.len());
    }

    #[test]
    fn a_scene_by_hand() {
        // The ego drives north at 8 m/s, far from the origin, a metre to the right of its route.
        check(
            "lane 1: 500000,4000000 500000,4000035\nroute 1\nlight 1 red: 500000,4000030
             edge: 500004,3999900 500004,4000100\nedge: 499990,4000100 499990,3999900
             ego vehicle 0: 500001,4000010 velocity 0,8
             agent vehicle 1: 499980,4000010 velocity 0,5
             agent pedestrian 2: 500001,4000013 velocity -1,0
             agent vehicle 3: 500000,4000100",
            &[
                0.8,
                0.0,
                0.0,
                0.96,
                1.0, // ego
                1.0,
                -0.5,
                0.0,
                1.0,
                0.5, // route, which ends 25 m ahead
                0.5,
                0.05,
                1.0,
                0.05,
                1.25,
                0.05, // its points, a metre to the left
                1.0,
                0.15,
                0.0,
                0.0,
                1.0,
                0.0,
                0.1,
                0.16,
                0.4, // the pedestrian is nearer
                1.0,
                0.0,
                1.05,
                1.0,
                0.0,
                0.5,
                0.0,
                0.96,
                1.0, //
                0.1,
                1.0,
                11.0 / 30.0, // 3 m to the right, free ahead, 11 m to the left
                1.0,
                0.4,
                1.0,
                0.0,
                0.0, // red in 20 m
            ],
        );
    }

    #[test]
    fn what_is_absent_is_zero() {
        let mut expected = vec![0.0; VIEW.len()];
        expected[3..5].copy_from_slice(&[0.96, 1.0]);
        expected[34..37].fill(1.0);
        check("ego vehicle 0: 3,4 heading 1", &expected);
    }

    #[test]
    fn agents_out_of_range_are_not_seen() {
        let prepared = |x: f64| {
            let text = format!("ego vehicle 0: 0,0\nagent vehicle 1: {x},0");
            PreparedScenario::new(fixture::scenario(&text).unwrap(), 0.5).unwrap()
        };
        for (x, expected) in [(79.0, 1), (81.0, 0)] {
            let prepared = prepared(x);
            let state = Rules::default().reset(&prepared);
            let view = View {
                prepared: &prepared,
                state: &state,
                now: prepared.logged(0),
                before: None,
            };
            assert_eq!(VIEW.nearest(&view).len(), expected);
        }
    }
}
