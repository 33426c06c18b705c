//! Renders a scene: allocates the planes and calls the function that draws each.

use gump_geometry::Pose;
use gump_scene::{AreaKind, LightState, SceneState};

use crate::layers::Plane;
use crate::layers::agents::{draw_agents, draw_ego, draw_history, draw_static_agents};
use crate::layers::lanes::{LaneSurfaces, draw_baseline_paths, draw_route};
use crate::layers::lights::{draw_light_indices, draw_lights};
use crate::layers::planes::{draw_coordinate_x, draw_coordinate_y, draw_ego_speed};
use crate::layers::roads::{
    draw_areas, draw_drivable, draw_road_edges, draw_road_lines, draw_roadmap, draw_stop_lines,
};
use crate::pixel_frame::PixelFrame;
use crate::{Layer, Raster, RasterSpec};

/// Draws the present of a scene and its map as seen from above.
///
/// `world_from_raster` is the pose at the centre of the image, facing up; pass the ego's for the
/// usual view and a moved or turned one to augment. Map and agents go through the same transform.
///
/// Shape: `[layer, row, column]`, row 0 at +x of the raster frame, column 0 at +y. Error: none;
/// layers without map data stay 0.
pub fn rasterize(spec: &RasterSpec, scene: &SceneState<'_>, world_from_raster: Pose) -> Raster {
    let frame = PixelFrame::new(spec, world_from_raster);
    let area = spec.side_px * spec.side_px;
    let surfaces = spec
        .layers
        .iter()
        .any(|layer| needs_lane_surfaces(*layer))
        .then(|| LaneSurfaces::paint(scene.map, &frame));
    let mut data = vec![0.0; spec.layers.len() * area];
    for (pixels, &layer) in data.chunks_exact_mut(area.max(1)).zip(&spec.layers) {
        draw(
            layer,
            &mut Plane::new(pixels, frame),
            scene,
            surfaces.as_ref(),
        );
    }
    Raster {
        layers: spec.layers.clone(),
        side_px: spec.side_px,
        metres_per_px: spec.metres_per_px,
        data,
        raster_from_world: world_from_raster.inverse(),
        frame,
    }
}

/// Layers that read the surfaces of all lanes, which are painted once for all of them.
fn needs_lane_surfaces(layer: Layer) -> bool {
    matches!(
        layer,
        Layer::Roadmap | Layer::SpeedLimit | Layer::LaneDirectionCos | Layer::LaneDirectionSin
    )
}

fn draw(
    layer: Layer,
    plane: &mut Plane<'_>,
    scene: &SceneState<'_>,
    surfaces: Option<&LaneSurfaces>,
) {
    let surfaces = || surfaces.expect("lane surfaces are painted when a layer needs them");
    match layer {
        Layer::RoadLines => draw_road_lines(plane, scene.map),
        Layer::RoadEdge => draw_road_edges(plane, scene.map),
        Layer::Crosswalk => draw_areas(plane, scene.map, AreaKind::Crosswalk, 1.0),
        Layer::StopLine => draw_stop_lines(plane, scene.map),
        Layer::SpeedBump => draw_areas(plane, scene.map, AreaKind::SpeedBump, 1.0),
        Layer::BaselinePaths => draw_baseline_paths(plane, scene.map),
        Layer::LaneDirectionCos => surfaces().draw(plane, |segment| segment.direction[0]),
        Layer::LaneDirectionSin => surfaces().draw(plane, |segment| segment.direction[1]),
        Layer::Route => draw_route(plane, scene),
        Layer::DrivableArea => draw_drivable(plane, scene.map),
        Layer::SpeedLimit => surfaces().draw(plane, |segment| segment.speed_limit),
        Layer::StaticAgents => draw_static_agents(plane, scene),
        Layer::TrafficLightOccupancy => draw_lights(plane, scene, |_| true),
        Layer::TrafficLightIndex => draw_light_indices(plane, scene),
        Layer::TrafficLightRed => draw_lights(plane, scene, |s| s == LightState::Red),
        Layer::TrafficLightYellow => draw_lights(plane, scene, |s| s == LightState::Yellow),
        Layer::TrafficLightGreen => draw_lights(plane, scene, |s| s == LightState::Green),
        Layer::CoordinateX => draw_coordinate_x(plane),
        Layer::CoordinateY => draw_coordinate_y(plane),
        Layer::Roadmap => draw_roadmap(plane, scene.map, surfaces()),
        Layer::Ego => draw_ego(plane, scene),
        Layer::EgoSpeed => draw_ego_speed(plane, scene),
        Layer::Agents => draw_agents(plane, scene),
        Layer::AgentHistory => draw_history(plane, scene),
    }
}
