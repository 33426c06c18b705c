//! Passing a red light.

use gump_geometry::{DVec2, Pose};
use gump_scene::{Agent, AgentKind, LightState, SceneState, stop_line};

use crate::{Metric, Reduce};

/// 1 if the vehicle's centre passed the stop line of a lane it drives on, in the last step and at
/// red, else 0; `None` for anything but vehicles and in the first frame.
///
/// The line crosses the lane at the light's stop point; without one, at the entry of a lane inside
/// an intersection and at the end of any other. It is as long as the lane is wide.
#[derive(Clone, Copy, Debug)]
pub struct RedLight;

impl Metric for RedLight {
    fn name(&self) -> &'static str {
        "red_light"
    }

    fn at(&self, scene: &SceneState<'_>, agent: &Agent) -> Option<f64> {
        if agent.kind != AgentKind::Vehicle {
            return None;
        }
        let before = scene.history.len().checked_sub(2)?;
        let before = scene.history[before].agent(agent.id)?.state.pose.position;
        let now = agent.state.pose;
        let lights = scene.now().lights().iter();
        let passed = lights
            .filter(|light| light.state == LightState::Red)
            .any(|light| {
                let Some(lane) = scene.map.lane(light.lane) else {
                    return false;
                };
                passes(stop_line(lane, light), lane.width, before, now)
            });
        Some(f64::from(passed))
    }

    fn reduce(&self) -> Reduce {
        Reduce::Any
    }
}

/// True if an agent passes over a line in its direction, from its previous position.
pub(crate) fn passes(line: Pose, width: f64, before: DVec2, now: Pose) -> bool {
    let (from, to) = (line.inverse() * before, line.inverse() * now.position);
    let along = now.direction().dot(line.direction()) > 0.0;
    along && from.x <= 0.0 && to.x > 0.0 && to.y.abs() <= width / 2.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{logged, over_rollout};
    use gump_scene::{AgentId, fixture};

    fn check(light: &str, ego: &str, expected: f64) {
        let text = format!("lane 1: 0,0 100,0 width 4\nlight 1 {light}\nego vehicle 0: {ego}");
        let rollout = logged(&fixture::scenario(&text).unwrap());
        assert_eq!(
            over_rollout(&RedLight, &rollout, AgentId(0)),
            Some(expected)
        );
    }

    #[test]
    fn passing_at_red_is_a_violation() {
        check("red: 40,1", "10,0 velocity 10,0", 1.0);
        check("green: 40,1", "10,0 velocity 10,0", 0.0);
        check("yellow: 40,1", "10,0 velocity 10,0", 0.0);
        check("red:", "50,0 velocity 10,0", 1.0);
    }

    #[test]
    fn stopping_driving_beside_and_against_are_none() {
        check("red: 40,1", "10,0 velocity 3,0", 0.0);
        check("red: 40,1", "41,0 velocity 10,0", 0.0);
        check("red: 40,1", "10,2.1 velocity 10,0", 0.0);
        check("red: 40,1", "70,0 velocity -10,0", 0.0);
    }
}
