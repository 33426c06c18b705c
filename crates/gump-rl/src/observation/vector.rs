//! Observations as a short vector of numbers in the ego's frame.

use gump_geometry::{DVec2, Polyline, angle_difference, dvec2};
use gump_scene::{Agent, AgentKind, LightState};
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
/// * per agent, in [`AgentOrder`]: 1, x, y, cosine and sine of its relative heading, its velocity
///   over ground along x and y, length over 5 m, width over 2 m, acceleration along its heading over
///   the last step over 4 m/s² (0 where it was not there), 1 for a pedestrian, 1 for a bicycle;
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
    /// Number of agents.
    pub n_agents: usize,
    /// Which of them, and in which order.
    pub order: AgentOrder,
    /// Maximum distance of agents, metres, > 0.
    pub agent_range: f64,
    /// Number of directions in which the distance to the road border is measured.
    pub n_rays: usize,
    /// Maximum distance to the border, metres, > 0.
    pub ray_range: f64,
}

/// The order of agents in a vector observation; of equal ones the lower id is first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum AgentOrder {
    /// By time: the seconds in which the ego, at its speed but at least 5 m/s, reaches the place
    /// beside the agent on its way ahead, and those in which the agent, at its speed but at least
    /// 0.25 m/s (1 m/s on foot or by bicycle), covers the distance between its side and the ego's
    /// there. The way is 50 m of the route, or straight ahead without one. Parked vehicles beside
    /// it thus come late.
    #[default]
    Relevance,
    /// By the distance of box centres.
    Distance,
}

impl Default for VectorView {
    /// 50 m of route, four seconds at 45 km/h; ten agents, since few streets have more within
    /// reach; a ray every 22.5 degrees. Our choice: the paper's policy uses a raster.
    fn default() -> Self {
        Self {
            n_route_points: 10,
            route_spacing: 5.0,
            n_agents: 10,
            order: AgentOrder::default(),
            agent_range: 80.0,
            n_rays: 9,
            ray_range: 30.0,
        }
    }
}

/// Maximum distance of lights and of the end of the route, metres: as far as the default's points
/// of the route reach.
const AHEAD: f64 = 50.0;
/// Metres between the points of the way by which agents are ordered; not tuned.
const WAY_SPACING: f64 = 5.0;
/// Speeds that the ego and an agent are taken to have at least when they are ordered, metres per
/// second: an ego that starts, and a parked vehicle or a pedestrian that sets off. Chosen by hand.
const EGO_SETS_OFF: f64 = 5.0;
const STEPS_IN: f64 = 1.0;
const PULLS_OUT: f64 = 0.25;
/// Scale of accelerations, as [`VectorView`] has it.
const ACCELERATION: f64 = 1.0 / 4.0;
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
    pub const AGENT: usize = 12;
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
            .chosen(view)
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
            let before = view.before.and_then(|frame| frame.agent(agent.id));
            let acceleration = before.map_or(0.0, |before| {
                let change = state.velocity - before.state.velocity;
                change.dot(state.pose.direction()) / view.prepared.dt()
            });
            let is = |kind| f64::from(u8::from(agent.kind == kind));
            out[9] = (acceleration * ACCELERATION) as f32;
            put(
                &mut out[10..],
                dvec2(is(AgentKind::Pedestrian), is(AgentKind::Bicycle)),
            );
        }
    }

    /// The first of the others within range, in order.
    fn chosen<'a>(&self, view: &View<'a>) -> Vec<&'a Agent> {
        let ego = &view.state.ego;
        let place = ego.state.pose.position;
        let way = Way::new(view);
        let mut found: Vec<(f64, &Agent)> = Vec::with_capacity(self.n_agents + 1);
        let range = self.agent_range * self.agent_range;
        for agent in view.now.agents() {
            let distance = place.distance_squared(agent.state.pose.position);
            if distance >= range || agent.id == ego.id {
                continue;
            }
            let key = match self.order {
                AgentOrder::Relevance => way.seconds_to(agent),
                AgentOrder::Distance => distance,
            };
            let rank = found.partition_point(|(sooner, _)| *sooner <= key);
            if rank < self.n_agents {
                found.insert(rank, (key, agent));
                found.truncate(self.n_agents);
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

/// The ego's way ahead, by which agents are ordered.
struct Way {
    /// Every [`WAY_SPACING`] metres, the first beside the ego.
    points: [DVec2; (AHEAD / WAY_SPACING) as usize + 1],
    /// The ego's, metres per second, and its width, metres.
    speed: f64,
    width: f64,
}

impl Way {
    fn new(view: &View<'_>) -> Self {
        let ego = &view.state.ego;
        let pose = ego.state.pose;
        let metres = |i: usize| i as f64 * WAY_SPACING;
        let points = match view.prepared.route() {
            Some(path) => {
                let along = view.state.along;
                let mut walk = Walk::new(path, along);
                std::array::from_fn(|i| walk.to(along + metres(i)))
            }
            None => std::array::from_fn(|i| pose.position + pose.direction() * metres(i)),
        };
        Self {
            points,
            speed: ego.state.speed().max(EGO_SETS_OFF),
            width: ego.width,
        }
    }

    /// The time of [`AgentOrder::Relevance`], seconds.
    fn seconds_to(&self, agent: &Agent) -> f64 {
        let place = agent.state.pose.position;
        let mut nearest = (f64::INFINITY, 0.0);
        for (i, piece) in self.points.windows(2).enumerate() {
            let (from, piece) = (piece[0], piece[1] - piece[0]);
            let length_squared = piece.length_squared();
            let share = if length_squared > 0.0 {
                ((place - from).dot(piece) / length_squared).clamp(0.0, 1.0)
            } else {
                0.0
            };
            let distance_squared = place.distance_squared(from + piece * share);
            if distance_squared < nearest.0 {
                nearest = (distance_squared, (i as f64 + share) * WAY_SPACING);
            }
        }
        let (distance_squared, ahead) = nearest;
        let beside = distance_squared.sqrt() - (self.width + agent.width) / 2.0;
        let sets_off = match agent.kind {
            AgentKind::Pedestrian | AgentKind::Bicycle => STEPS_IN,
            _ => PULLS_OUT,
        };
        ahead / self.speed + beside.max(0.0) / agent.state.speed().max(sets_off)
    }
}

fn ego(view: &View<'_>, out: &mut [f32]) {
    let ego = &view.state.ego;
    let speed = ego.state.velocity.dot(ego.state.pose.direction());
    let (acceleration, yaw_rate) = view.state.motion(view.prepared.dt());
    let numbers = [
        speed * SPEED,
        acceleration * ACCELERATION,
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
        order: AgentOrder::Relevance,
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
            before: prepared.logged_before(0),
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
                0.4,
                0.0,
                1.0,
                0.0, // the pedestrian is in the way
                1.0,
                0.0,
                1.05,
                1.0,
                0.0,
                0.5,
                0.0,
                0.96,
                1.0,
                0.0,
                0.0,
                0.0, //
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
        expected[40..43].fill(1.0);
        check("ego vehicle 0: 3,4 heading 1", &expected);
    }

    #[test]
    fn agents_out_of_range_are_not_seen() {
        for (x, expected) in [(79.0, 1), (81.0, 0)] {
            let text = format!("ego vehicle 0: 0,0\nagent vehicle 1: {x},0");
            assert_eq!(chosen(&VIEW, &text).len(), expected);
        }
    }

    /// The ids of the agents that are seen, in order.
    fn chosen(vector: &VectorView, text: &str) -> Vec<i64> {
        let prepared = PreparedScenario::new(fixture::scenario(text).unwrap(), 0.5).unwrap();
        let state = Rules::default().reset(&prepared);
        let view = View {
            prepared: &prepared,
            state: &state,
            now: prepared.logged(0),
            before: None,
        };
        let chosen = vector.chosen(&view);
        chosen.iter().map(|agent| agent.id.0).collect()
    }

    #[test]
    fn who_may_be_met_first_comes_first() {
        // The route turns left after 30 m. One drives ahead, one comes up the street that the ego
        // turns into, one comes from the left; two are parked, one beside the ego, one behind it.
        let text = "lane 1: 0,0 40,0 40,60\nroute 1\nego vehicle 0: 10,0 velocity 10,0
            agent vehicle 1: 30,0 velocity 8,0\nagent vehicle 2: 37,30 velocity 0,-10
            agent bicycle 3: 25,12 velocity 0,-5\nagent vehicle 4: 11,3.5\nagent vehicle 5: 3,-3";
        let ordered = |order| {
            let all = VectorView {
                n_agents: 9,
                order,
                ..VIEW
            };
            chosen(&all, text)
        };
        // Seconds: 2.0 + 0, 5.0 + 0.8, 1.5 + 2.1, 0.1 + 6, 0 + 22.5.
        assert_eq!(ordered(AgentOrder::Relevance), [1, 3, 2, 4, 5]);
        assert_eq!(ordered(AgentOrder::Distance), [4, 5, 3, 1, 2]);
    }

    #[test]
    fn agents_that_brake_are_seen_to_brake() {
        let mut scenario = fixture::scenario(
            "ego vehicle 0: 0,0 velocity 8,0\nagent bicycle 1: 20,0 heading 0 velocity 4,0",
        )
        .unwrap();
        // Half a second before the present it was 1 m/s faster.
        let frame = &mut scenario.log[scenario.now - 5];
        let faster = frame.agents().iter().map(|agent| match agent.id.0 {
            1 => agent.with_state(gump_scene::AgentState {
                velocity: dvec2(5.0, 0.0),
                ..agent.state
            }),
            _ => *agent,
        });
        *frame = gump_scene::Frame::new(faster.collect(), Vec::new());
        let prepared = PreparedScenario::new(scenario, 0.5).unwrap();
        let state = Rules::default().reset(&prepared);
        let seen = |before| {
            let mut found = vec![f32::NAN; VIEW.len()];
            let view = View {
                prepared: &prepared,
                state: &state,
                now: prepared.logged(0),
                before,
            };
            VIEW.observe(&view, &mut found);
            [25, 26, 27].map(|i| found[i])
        };
        assert_eq!(seen(prepared.logged_before(0)), [-0.5, 0.0, 1.0]);
        assert_eq!(seen(None), [0.0, 0.0, 1.0]);
    }
}
