//! Progress along the route.

use gump_geometry::{DVec2, Polyline};
use gump_scene::{Agent, SceneState};

use crate::{Metric, Reduce};

/// Metres along the route since the previous frame; negative when driving back.
///
/// Only the ego has a route: `None` for others, without a route and in the first frame. A step
/// counts at most the distance the ego moved.
#[derive(Clone, Copy, Debug)]
pub struct Progress;

impl Metric for Progress {
    fn name(&self) -> &'static str {
        "progress_m"
    }

    fn at(&self, scene: &SceneState<'_>, agent: &Agent) -> Option<f64> {
        if agent.id != scene.ego {
            return None;
        }
        let path = &scene.route?.path;
        let before = scene.history.len().checked_sub(2)?;
        let before = scene.history[before].agent(agent.id)?.state.pose.position;
        let now = agent.state.pose.position;
        Some(gained(path, before, now))
    }

    fn reduce(&self) -> Reduce {
        Reduce::Sum
    }
}

/// Metres gained along a path by moving from one point to another, at most the distance moved, so
/// that a path which crosses itself adds nothing.
pub fn gained(path: &Polyline, before: DVec2, now: DVec2) -> f64 {
    let gained = path.project(now).arc_length - path.project(before).arc_length;
    let moved = before.distance(now);
    gained.clamp(-moved, moved)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{logged, over_rollout};
    use approx::assert_abs_diff_eq;
    use gump_scene::{AgentId, fixture};

    fn check(lanes: &str, ego: &str, expected: Option<f64>) {
        let text = format!("{lanes}\nego vehicle 0: {ego}\nagent vehicle 1: 0,50 velocity 5,0");
        let rollout = logged(&fixture::scenario(&text).unwrap());
        let found = over_rollout(&Progress, &rollout, AgentId(0));
        match (found, expected) {
            (Some(found), Some(expected)) => assert_abs_diff_eq!(found, expected, epsilon = 1e-9),
            _ => assert_eq!(found, expected),
        }
        assert_eq!(over_rollout(&Progress, &rollout, AgentId(1)), None);
    }

    #[test]
    fn the_sum_is_the_distance_along_the_route() {
        let street = "lane 1: 0,0 200,0\nroute 1";
        check(street, "10,1 velocity 5,0", Some(40.0));
        check(street, "80,1 velocity -5,0", Some(-40.0));
        check(street, "10,1 velocity 3,4", Some(24.0));
        // Past its end there is nothing to gain.
        check(street, "180,0 velocity 5,0", Some(20.0));
        check("lane 1: 0,0 200,0", "10,1 velocity 5,0", None);
    }

    #[test]
    fn a_route_that_comes_back_adds_no_jump() {
        // Out along y = 0 and back along y = 3: crossing the middle is not 100 m of progress.
        check(
            "lane 1: 0,0 100,0 100,3 0,3\nroute 1",
            "50,1.4 velocity 0,0.1",
            Some(0.1 * 0.1),
        );
    }
}
