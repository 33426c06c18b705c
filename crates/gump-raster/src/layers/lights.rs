//! Signalled lanes.

use gump_scene::{Light, LightState, SceneState, light_indices};

use super::Plane;

/// Radius of the disc at the start of a signalled lane, metres: 4 px of the paper's raster.
const DISC_RADIUS: f64 = 2.0;

/// Lights are numbered below this, the capacity in the paper's code; the index plane is divided by
/// it.
const INDEX_SCALE: f32 = 64.0;

/// Paints the lanes whose light is in a state that `shows` accepts.
pub(crate) fn draw_lights(
    plane: &mut Plane<'_>,
    scene: &SceneState<'_>,
    shows: impl Fn(LightState) -> bool,
) {
    for light in scene.now().lights() {
        if shows(light.state) {
            draw_light(plane, scene, light, 1.0);
        }
    }
}

pub(crate) fn draw_light_indices(plane: &mut Plane<'_>, scene: &SceneState<'_>) {
    // A radius only cuts the numbering off, and what it would cut is off the canvas or wanted.
    let lights = light_indices(scene, plane.frame.centre, f64::INFINITY);
    // Backwards, so that the nearest of several lanes that start together is seen.
    for (index, light) in lights.into_iter().rev() {
        draw_light(plane, scene, light, index as f32 / INDEX_SCALE);
    }
}

fn draw_light(plane: &mut Plane<'_>, scene: &SceneState<'_>, light: &Light, value: f32) {
    if let Some(lane) = scene.map.lane(light.lane) {
        plane.line(&lane.centerline, value);
        plane.disc(lane.centerline.points()[0], DISC_RADIUS, value);
    }
}
