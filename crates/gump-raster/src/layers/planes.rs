//! Planes that are a formula of the pixel, or constant.

use gump_scene::SceneState;

use super::Plane;
use super::lanes::SPEED_SCALE;

pub(crate) fn draw_coordinate_x(plane: &mut Plane<'_>) {
    let side = plane.frame.side_px;
    for (row, pixels) in plane.pixels.chunks_exact_mut(side).enumerate() {
        pixels.fill(coordinate(row, side));
    }
}

pub(crate) fn draw_coordinate_y(plane: &mut Plane<'_>) {
    let side = plane.frame.side_px;
    for pixels in plane.pixels.chunks_exact_mut(side) {
        for (column, pixel) in pixels.iter_mut().enumerate() {
            *pixel = coordinate(column, side);
        }
    }
}

pub(crate) fn draw_ego_speed(plane: &mut Plane<'_>, scene: &SceneState<'_>) {
    let speed = scene.ego_now().state.speed() / SPEED_SCALE;
    plane.pixels.fill(speed.min(1.0) as f32);
}

/// The coordinate of a pixel's centre in half extents: near 1 at index 0, near -1 at the last.
fn coordinate(index: usize, side: usize) -> f32 {
    (1.0 - (2.0 * index as f64 + 1.0) / side as f64) as f32
}
