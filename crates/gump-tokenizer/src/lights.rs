//! The traffic lights of a window: which have tokens, with which number, and at which position.

use std::collections::BTreeSet;

use gump_geometry::Pose;
use gump_scene::{Frame, LaneId, LightState, MapGraph, light_indices_of};

use crate::{Field, TokenLight};

/// The numbered lights of a window; light `i + 1` controls lane `lanes[i]`.
#[derive(Clone, Debug, Default)]
pub(crate) struct Lights {
    pub(crate) lanes: Vec<LaneId>,
    /// Lights within the radius without a number.
    pub(crate) n_over: usize,
    places: Vec<TokenLight>,
}

impl Lights {
    /// Numbers the lights of frame `now` as the raster does, then those that occur only in other
    /// frames.
    pub(crate) fn number(
        map: &MapGraph,
        frames: &[&Frame],
        now: usize,
        world_from_scene: Pose,
        radius: f64,
        capacity: usize,
    ) -> Self {
        let centre = world_from_scene.position;
        let ordered = |frame: &Frame| -> Vec<LaneId> {
            let lights = light_indices_of(map, frame, centre, radius);
            lights.into_iter().map(|(_, light)| light.lane).collect()
        };
        let mut lanes = frames
            .get(now)
            .map_or_else(Vec::new, |frame| ordered(frame));
        let seen = frames.iter().flat_map(|frame| frame.lights());
        let others = seen.filter(|light| !lanes.contains(&light.lane)).copied();
        lanes.append(&mut ordered(&Frame::new(Vec::new(), others.collect())));
        lanes.truncate(capacity);
        let scene_from_world = world_from_scene.inverse();
        let places = lanes.iter().zip(1..).filter_map(|(lane, index)| {
            let start = scene_from_world * map.lane(*lane)?.centerline.pose_at(0.0);
            Some(TokenLight {
                index,
                x: Field::X.quantize(start.position.x).bin,
                y: Field::Y.quantize(start.position.y).bin,
                heading: Field::Heading.quantize(start.heading).bin,
                state: LightState::Unknown,
            })
        });
        Self {
            n_over: n_within(map, frames, world_from_scene, radius) - lanes.len(),
            places: places.collect(),
            lanes,
        }
    }

    /// The tokens of one frame; a light that it does not contain is unknown.
    pub(crate) fn tokens(&self, frame: &Frame) -> Vec<TokenLight> {
        let tokens = self.lanes.iter().zip(&self.places).map(|(lane, place)| {
            let light = frame.light(*lane);
            TokenLight {
                state: light.map_or(LightState::Unknown, |light| light.state),
                ..*place
            }
        });
        tokens.collect()
    }
}

fn n_within(map: &MapGraph, frames: &[&Frame], world_from_scene: Pose, radius: f64) -> usize {
    let lanes: BTreeSet<LaneId> = frames
        .iter()
        .flat_map(|frame| frame.lights().iter().map(|light| light.lane))
        .collect();
    let starts = lanes.into_iter().filter_map(|lane| map.lane(lane));
    let distances =
        starts.map(|lane| lane.centerline.points()[0].distance(world_from_scene.position));
    distances.filter(|distance| *distance <= radius).count()
}
