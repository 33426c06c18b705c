//! Speed, acceleration, jerk and turning as functions of frames.
//!
//! Frames store velocities; everything else here is a backward difference over the latest frames,
//! without smoothing. Every function returns `None` where the agent is absent in a frame it needs.

use gump_geometry::{DVec2, angle_difference};
use gump_scene::{Agent, AgentId, SceneState};

use crate::{Metric, Reduce};

/// Acceleration now, world frame, metres per second squared.
pub fn acceleration(scene: &SceneState<'_>, agent: AgentId) -> Option<DVec2> {
    let [before, now] = latest(scene, agent)?;
    Some((now.state.velocity - before.state.velocity) / scene.dt)
}

/// Jerk now, world frame, metres per second cubed.
pub fn jerk(scene: &SceneState<'_>, agent: AgentId) -> Option<DVec2> {
    let [a, b, c] = latest(scene, agent)?.map(|agent| agent.state.velocity);
    Some((c - 2.0 * b + a) / (scene.dt * scene.dt))
}

/// Change of the magnitude of the acceleration now, metres per second cubed.
pub fn acceleration_change(scene: &SceneState<'_>, agent: AgentId) -> Option<f64> {
    let [a, b, c] = latest(scene, agent)?.map(|agent| agent.state.velocity);
    Some(((c - b).length() - (b - a).length()) / (scene.dt * scene.dt))
}

/// Yaw rate now, radians per second, positive to the left.
pub fn yaw_rate(scene: &SceneState<'_>, agent: AgentId) -> Option<f64> {
    let [before, now] = latest(scene, agent)?.map(|agent| agent.state.pose.heading);
    Some(angle_difference(now, before) / scene.dt)
}

/// Yaw acceleration now, radians per second squared.
pub fn yaw_acceleration(scene: &SceneState<'_>, agent: AgentId) -> Option<f64> {
    let [a, b, c] = latest(scene, agent)?.map(|agent| agent.state.pose.heading);
    Some((angle_difference(c, b) - angle_difference(b, a)) / (scene.dt * scene.dt))
}

/// The agent in the latest `N` frames, oldest first.
fn latest<'a, const N: usize>(scene: &SceneState<'a>, agent: AgentId) -> Option<[&'a Agent; N]> {
    let first = scene.history.len().checked_sub(N)?;
    let mut found = [scene.now().agent(agent)?; N];
    for (slot, frame) in found.iter_mut().zip(&scene.history[first..]) {
        *slot = frame.agent(agent)?;
    }
    Some(found)
}

/// Speed, metres per second.
#[derive(Clone, Copy, Debug)]
pub struct Speed;

impl Metric for Speed {
    fn name(&self) -> &'static str {
        "speed_mps"
    }

    fn at(&self, _: &SceneState<'_>, agent: &Agent) -> Option<f64> {
        Some(agent.state.speed())
    }

    fn reduce(&self) -> Reduce {
        Reduce::Mean
    }
}

/// Acceleration along the heading, metres per second squared.
#[derive(Clone, Copy, Debug)]
pub struct Acceleration;

impl Metric for Acceleration {
    fn name(&self) -> &'static str {
        "acceleration_mps2"
    }

    fn at(&self, scene: &SceneState<'_>, agent: &Agent) -> Option<f64> {
        Some(acceleration(scene, agent.id)?.dot(agent.state.pose.direction()))
    }

    fn reduce(&self) -> Reduce {
        Reduce::Mean
    }
}

/// Yaw rate, radians per second, positive to the left.
#[derive(Clone, Copy, Debug)]
pub struct YawRate;

impl Metric for YawRate {
    fn name(&self) -> &'static str {
        "yaw_rate_radps"
    }

    fn at(&self, scene: &SceneState<'_>, agent: &Agent) -> Option<f64> {
        yaw_rate(scene, agent.id)
    }

    fn reduce(&self) -> Reduce {
        Reduce::Mean
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;
    use gump_geometry::{Pose, dvec2};
    use gump_scene::{AgentState, Frame, Scenario, fixture};

    /// The ego in three frames 0.5 s apart, given as (heading, vx, vy).
    fn scenario(states: [(f64, f64, f64); 3]) -> Scenario {
        let text = "ego vehicle 0: 0,0\nhistory 1.0 future 0 dt 0.5";
        let mut scenario = fixture::scenario(text).unwrap();
        for (frame, (heading, vx, vy)) in scenario.log.iter_mut().zip(states) {
            let state = AgentState {
                pose: Pose::new(0.0, 0.0, heading),
                velocity: dvec2(vx, vy),
            };
            *frame = Frame::new(vec![frame.agents()[0].with_state(state)], vec![]);
        }
        scenario
    }

    #[test]
    fn differences_by_hand() {
        let scenario = scenario([(3.0, 2.0, 0.0), (-3.1, 3.0, 0.0), (-3.0, 3.0, 1.0)]);
        let scene = scenario.present();
        let id = scene.ego;
        let turn = std::f64::consts::TAU - 6.1;
        assert_eq!(acceleration(&scene, id), Some(dvec2(0.0, 2.0)));
        assert_eq!(jerk(&scene, id), Some(dvec2(-4.0, 4.0)));
        assert_eq!(acceleration_change(&scene, id), Some(0.0));
        assert_abs_diff_eq!(yaw_rate(&scene, id).unwrap(), 0.2, epsilon = 1e-12);
        let expected = (0.1 - turn) / 0.25;
        assert_abs_diff_eq!(
            yaw_acceleration(&scene, id).unwrap(),
            expected,
            epsilon = 1e-12
        );
        let along = Acceleration.at(&scene, scene.ego_now()).unwrap();
        assert_abs_diff_eq!(along, 2.0 * (-3.0f64).sin(), epsilon = 1e-12);
        assert_abs_diff_eq!(Speed.at(&scene, scene.ego_now()).unwrap(), 10f64.sqrt());
        assert_eq!(YawRate.at(&scene, scene.ego_now()), yaw_rate(&scene, id));
    }

    #[test]
    fn too_little_history_is_no_value() {
        let scenario = scenario([(0.0, 1.0, 0.0); 3]);
        let early = scenario.at(1);
        assert!(acceleration(&early, early.ego).is_some());
        assert!(jerk(&early, early.ego).is_none());
        assert!(yaw_rate(&scenario.at(0), early.ego).is_none());
    }
}
