//! Agents as boxes.

use gump_scene::SceneState;

use super::Plane;

/// Length of the fading history, seconds: about what nuPlan's planners see. Chosen by hand.
const HISTORY: f64 = 2.0;

pub(crate) fn draw_ego(plane: &mut Plane<'_>, scene: &SceneState<'_>) {
    plane.oriented_box(&scene.ego_now().oriented_box(), 1.0);
}

pub(crate) fn draw_agents(plane: &mut Plane<'_>, scene: &SceneState<'_>) {
    draw_frame(plane, scene, 0, 1.0);
}

pub(crate) fn draw_static_agents(plane: &mut Plane<'_>, scene: &SceneState<'_>) {
    for agent in scene.now().agents() {
        if !agent.kind.is_moving() && agent.id != scene.ego {
            plane.oriented_box(&agent.oriented_box(), 1.0);
        }
    }
}

pub(crate) fn draw_history(plane: &mut Plane<'_>, scene: &SceneState<'_>) {
    // Oldest first: where boxes overlap the younger, brighter one is seen.
    for age in (0..scene.history.len()).rev() {
        let value = 1.0 - age as f64 * scene.dt / HISTORY;
        if value > 0.0 {
            draw_frame(plane, scene, age, value as f32);
        }
    }
}

/// Paints the moving agents, `age` frames ago, without the ego.
fn draw_frame(plane: &mut Plane<'_>, scene: &SceneState<'_>, age: usize, value: f32) {
    for agent in scene.history[scene.history.len() - 1 - age].agents() {
        if agent.kind.is_moving() && agent.id != scene.ego {
            plane.oriented_box(&agent.oriented_box(), value);
        }
    }
}
