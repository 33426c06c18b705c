//! Features of scored agents, of the log and of every rollout.

use gump_scene::{AgentId, AgentKind};

use super::assemble::SimulatedAgents;
use super::config::{Algorithm, Component};
use super::kinematics::{Differences, kinematics};
use super::lights::Lights;
use super::road_edge::{self, RoadEdges};
use super::{box_distance, following};

/// Features of the scored agents of one scenario, logged or simulated.
#[derive(Clone, Debug, PartialEq)]
pub struct Features {
    /// The scored agents.
    pub agents: Vec<AgentId>,
    /// Their kinds.
    pub kinds: Vec<AgentKind>,
    /// Scored steps: the 80 of the future, or all 91 for scenario generation.
    pub n_steps: usize,
    /// Values of a component that is not an indicator, `[agent, step]`; empty for the others.
    values: [Vec<f32>; Component::ALL.len()],
    red_light: Vec<bool>,
}

impl Features {
    /// Values of a component `[agent, step]`, in its unit; NaN where a difference lacks a
    /// neighbour. Empty for indicators.
    ///
    /// Where an agent is invalid or alone, its distance to others is 1e10, and to the road edge
    /// -1e10 where it is invalid.
    pub fn values(&self, component: Component) -> &[f32] {
        &self.values[component as usize]
    }

    /// Whether an indicator holds, `[agent, step]`. Empty for other components.
    pub fn holds(&self, component: Component) -> Vec<bool> {
        let of =
            |component, is: fn(f32) -> bool| self.values(component).iter().map(move |&v| is(v));
        match component {
            Component::Collision => of(Component::DistanceToNearestObject, |d| d < 0.0).collect(),
            Component::Offroad => of(Component::DistanceToRoadEdge, |d| d > 0.0).collect(),
            Component::TrafficLightViolation => self.red_light.clone(),
            _ => Vec::new(),
        }
    }
}

/// The parts of the map that features need.
pub(crate) struct Surroundings {
    pub(crate) edges: RoadEdges,
    pub(crate) lights: Option<Lights>,
}

/// Measures the `scored` agents of a log or a rollout from step `first` on.
pub(crate) fn measure(
    simulated: &SimulatedAgents,
    ids: &[AgentId],
    scored: &[usize],
    first: usize,
    surroundings: &Surroundings,
    algorithm: Algorithm,
) -> Features {
    let differences = Differences::from(algorithm);
    let mut features = Features {
        agents: ids.to_vec(),
        kinds: scored.iter().map(|&agent| simulated.kinds[agent]).collect(),
        n_steps: 0,
        values: Default::default(),
        red_light: Vec::new(),
    };
    for &agent in scored {
        let motion = kinematics(simulated.states(agent), differences);
        let mut add = |component: Component, values: &[f32]| {
            features.values[component as usize].extend_from_slice(values);
            features.n_steps = values.len();
        };
        add(Component::LinearSpeed, &motion.linear_speed[first..]);
        add(
            Component::LinearAcceleration,
            &motion.linear_acceleration[first..],
        );
        add(Component::AngularSpeed, &motion.angular_speed[first..]);
        add(
            Component::AngularAcceleration,
            &motion.angular_acceleration[first..],
        );
        let distance = box_distance::nearest_object(simulated, agent, first, algorithm);
        add(Component::DistanceToNearestObject, &distance);
        let time = following::times(simulated, agent, first, differences);
        add(Component::TimeToCollision, &time);
        let edge = road_edge::outermost(simulated, agent, first, &surroundings.edges);
        add(Component::DistanceToRoadEdge, &edge);
        let n_steps = features.n_steps;
        features.red_light.extend(match &surroundings.lights {
            Some(lights) => lights.violations(simulated, agent, first),
            None => vec![false; n_steps],
        });
    }
    features
}
