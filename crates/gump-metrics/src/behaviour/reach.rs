//! Lanes under a pose and ahead of it.

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

/// A lane that a vehicle may reach.
pub(crate) struct Ahead<'a> {
    pub(crate) lane: &'a Lane,
    /// Metres from the vehicle to the start of the lane, below 0 for the lane it is on.
    pub(crate) base_m: f64,
}

/// The lane of a vehicle, `arc_m` metres from its start, all its successors within `metres`, and
/// whether any of them reaches that far.
pub(crate) fn ahead<'a>(
    map: &'a MapGraph,
    lane: &'a Lane,
    arc_m: f64,
    metres: f64,
) -> (Vec<Ahead<'a>>, bool) {
    let mut reached = vec![Ahead {
        lane,
        base_m: -arc_m,
    }];
    let (mut i, mut goes_on) = (0, false);
    while let Some(Ahead { lane, base_m }) = reached.get(i) {
        let (id, end_m) = (lane.id, base_m + lane.centerline.length());
        i += 1;
        if end_m >= metres {
            goes_on = true;
            continue;
        }
        for next in map.successors(id) {
            if reached.iter().all(|known| known.lane.id != next.id) {
                reached.push(Ahead {
                    lane: next,
                    base_m: end_m,
                });
            }
        }
    }
    (reached, goes_on)
}
