//! What a policy sees: a scene as a short vector of numbers in the ego's frame.

use std::sync::Arc;

use gump_geometry::{DVec2, angle_difference};
use gump_scene::SceneState;

/// A scene as numbers; cheap to clone, since the end of one transition starts the next.
///
/// Shape: [`ObservationSpec::len`], laid out as [`observe`] says.
#[derive(Clone, Debug, PartialEq)]
pub struct Observation(Arc<[f32]>);

/// What an observation contains.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ObservationSpec {
    /// Points of the route ahead.
    pub n_route_points: usize,
    /// Metres between them, > 0.
    pub route_spacing: f64,
    /// Nearest other agents.
    pub n_agents: usize,
}

impl ObservationSpec {
    /// Numbers for the ego: speed, length, width.
    pub const EGO: usize = 3;
    /// Numbers before the route's points: 1 if there is a route, else 0.
    pub const ROUTE: usize = 1;
    /// Numbers per point of the route: x, y.
    pub const POINT: usize = 2;
    /// Numbers per agent: 1 if there is one, x, y, cosine and sine of its heading, its velocity
    /// along x and y, length, width.
    pub const AGENT: usize = 9;

    /// The length of an observation.
    #[allow(
        clippy::len_without_is_empty,
        reason = "an observation always holds the ego"
    )]
    pub fn len(&self) -> usize {
        Self::EGO + Self::ROUTE + self.n_route_points * Self::POINT + self.n_agents * Self::AGENT
    }
}

impl Default for ObservationSpec {
    /// 50 m of route, four seconds at 45 km/h, and ten agents, of which few streets have more
    /// within reach. Our choice: the paper's policy sees a raster.
    fn default() -> Self {
        Self {
            n_route_points: 10,
            route_spacing: 5.0,
            n_agents: 10,
        }
    }
}

impl Observation {
    /// The numbers.
    pub fn values(&self) -> &[f32] {
        &self.0
    }
}

/// Describes a scene from the ego's point of view.
///
/// Shape: ego `[speed, length, width]`; route `[present, (x, y) per point]`, points
/// `route_spacing`, `2 * route_spacing`, ... ahead of the ego's foot on the route, the last one
/// repeated past its end; then per agent, nearest box centre first, `[present, x, y, cos, sin, vx,
/// vy, length, width]`. Absent things are zeros.
/// Units: ego frame (x ahead, y left of the box centre), metres, metres per second over ground.
pub fn observe(spec: &ObservationSpec, scene: &SceneState<'_>) -> Observation {
    let ego = scene.ego_now();
    let ego_from_world = ego.state.pose.inverse();
    let mut values: Vec<f32> = Vec::with_capacity(spec.len());
    let speed = ego.state.velocity.dot(ego.state.pose.direction());
    values.extend([speed, ego.length, ego.width].map(|v| v as f32));

    let route_end = values.len() + ObservationSpec::ROUTE + spec.n_route_points * 2;
    if let Some(route) = scene.route {
        values.push(1.0);
        let foot = route.path.project(ego.state.pose.position).arc_length;
        for i in 1..=spec.n_route_points {
            let s = (foot + i as f64 * spec.route_spacing).min(route.path.length());
            push(&mut values, ego_from_world * route.path.pose_at(s).position);
        }
    }
    values.resize(route_end, 0.0);

    let distance = |p: DVec2| p.distance_squared(ego.state.pose.position);
    let others = scene.now().agents().iter().filter(|a| a.id != scene.ego);
    let mut others: Vec<_> = others.collect();
    // Frames are sorted by id and the sort is stable, so ids break ties.
    others.sort_by(|a, b| {
        distance(a.state.pose.position).total_cmp(&distance(b.state.pose.position))
    });
    for agent in others.into_iter().take(spec.n_agents) {
        let turn = angle_difference(agent.state.pose.heading, ego.state.pose.heading);
        values.push(1.0);
        push(&mut values, ego_from_world * agent.state.pose.position);
        push(&mut values, DVec2::from_angle(turn));
        push(&mut values, ego_from_world.rotate(agent.state.velocity));
        values.extend([agent.length as f32, agent.width as f32]);
    }
    values.resize(spec.len(), 0.0);
    Observation(values.into())
}

fn push(values: &mut Vec<f32>, vector: DVec2) {
    values.extend([vector.x as f32, vector.y as f32]);
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_scene::fixture;

    const SPEC: ObservationSpec = ObservationSpec {
        n_route_points: 3,
        route_spacing: 10.0,
        n_agents: 2,
    };

    fn check(text: &str, expected: &[f32]) {
        let scenario = fixture::scenario(text).unwrap();
        let found = observe(&SPEC, &scenario.present());
        assert_eq!(found.values().len(), SPEC.len());
        for (i, (a, b)) in found.values().iter().zip(expected).enumerate() {
            assert!((a - b).abs() < 1e-4, "number {i} is {a}, expected {b}");
        }
        assert_eq!(expected.len(), SPEC.len());
    }

    #[test]
    fn a_scene_by_hand() {
        // The ego drives north at 8 m/s, far from the origin.
        check(
            "lane 1: 500000,4000000 500000,4000035\nroute 1
             ego vehicle 0: 500000,4000010 velocity 0,8
             agent vehicle 1: 499980,4000010 velocity 0,5
             agent pedestrian 2: 500001,4000013 velocity -1,0
             agent vehicle 3: 500000,4000100",
            &[
                8.0, 4.8, 2.0, // ego
                1.0, 10.0, 0.0, 20.0, 0.0, 25.0, 0.0, // route, which ends 25 m ahead
                1.0, 3.0, -1.0, 0.0, 1.0, 0.0, 1.0, 0.8, 0.8, // the pedestrian is nearer
                1.0, 0.0, 20.0, 1.0, 0.0, 5.0, 0.0, 4.8, 2.0,
            ],
        );
    }

    #[test]
    fn what_is_absent_is_zero() {
        let mut expected = [0.0; 28];
        expected[..3].copy_from_slice(&[0.0, 4.8, 2.0]);
        check("ego vehicle 0: 3,4 heading 1", &expected);
    }
}
