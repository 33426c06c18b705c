//! Lanes under a pose.

use gump_geometry::{Pose, Projection, angle_difference};
use gump_scene::{Lane, LaneKind, MapGraph};

/// Position of `pose` on a lane, if it points along it within `turn` radians.
pub(crate) fn along(lane: &Lane, pose: Pose, turn: f64) -> Option<Projection> {
    let found = lane.centerline.project(pose.position);
    let heading = lane.centerline.pose_at(found.arc_length).heading;
    (angle_difference(pose.heading, heading).abs() <= turn).then_some(found)
}

/// The nearest lane for cars that points along `pose` within `turn` radians and whose centre line
/// passes within `metres`.
pub(crate) fn nearest(
    map: &MapGraph,
    pose: Pose,
    metres: f64,
    turn: f64,
) -> Option<(&Lane, Projection)> {
    let near = map.lanes_near(pose.position, metres);
    near.filter(|(lane, _)| lane.kind != LaneKind::BikeLane)
        .find_map(|(lane, _)| Some((lane, along(lane, pose, turn)?)))
}
