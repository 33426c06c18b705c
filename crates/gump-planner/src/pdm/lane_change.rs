//! Lines into the lanes beside the ego's, for planners that change lanes. PDM does not.

use gump_geometry::{DVec2, Pose, angle_difference};
use gump_nuplan::path::{Path, baseline};
use gump_scene::{Lane, LaneId, MapGraph, RoadblockId};

use super::propose::Line;
use crate::route_search::shortest_lanes;

/// Duration of a change, seconds. At a lane's width to the side the lateral acceleration then
/// stays below 2 m/s².
const CHANGE_S: f64 = 3.5;
/// The least length of a change, metres: over the width of a lane it bends with a radius of 11 m at
/// least, which a car can steer. Neither was tuned.
const CHANGE_M: f64 = 15.0;
/// Spacing of the points of a change, metres: half of that of nuPlan's lines, as it bends more.
const SPACING: f64 = 0.5;
// Chosen by hand (decision 23); none was tuned.

/// Lanes are beside each other up to this distance of their centre lines, metres: wide lanes with a
/// line or a bicycle lane in between.
const BESIDE_M: f64 = 6.0;
/// A lane that ends or begins within this is no place to change to, metres: a car's length.
const ROOM_M: f64 = 5.0;
/// A change is followed to its end unless the ego is farther than this from its line, metres, ...
const LEFT_M: f64 = 0.5;
/// ... or nearer than this to the centre of the other lane.
const DONE_M: f64 = 0.3;
/// Beyond this distance from the centre of its line the ego is in another lane, metres: half of a
/// usual lane.
pub(crate) const OTHER_LANE_M: f64 = 1.8;

/// The side of a lane change.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    /// To the left.
    Left,
    /// To the right.
    Right,
}

/// A change into a lane beside the ego's.
#[derive(Clone, Debug)]
pub(crate) struct Change {
    pub(crate) side: Side,
    /// The centre of that lane and of those that follow it on the route.
    pub(crate) target: Path,
    /// Whether that way gets to the end of the route.
    pub(crate) arrives: bool,
    /// Whether there is a reason to change: it was begun before, or the ego's lane ends.
    pub(crate) is_due: bool,
}

impl Change {
    /// Whether a vehicle here is still under way on the change's line: another line from its pose
    /// would bend differently, and the change would never end smoothly.
    pub(crate) fn goes_on(&self, line: &Line, place: DVec2) -> bool {
        let off = |path: &Path| path.line().project(place).distance;
        off(&line.path) < LEFT_M && off(&self.target) > DONE_M
    }
}

/// The changes that are possible from a lane of the route, with their lines from the ego's pose on.
pub(crate) fn changes(
    map: &MapGraph,
    own: LaneId,
    route: &[RoadblockId],
    rear_axle: Pose,
    speed: f64,
) -> Vec<(Change, Line)> {
    let Some(own) = map.lane(own) else {
        return Vec::new();
    };
    let beside = |side: Side| {
        let listed = match side {
            Side::Left => &own.left_neighbors,
            Side::Right => &own.right_neighbors,
        };
        let lanes = listed.iter().filter_map(|&id| map.lane(id));
        let mut lanes = lanes.filter(|lane| lane.roadblock.is_some_and(|b| route.contains(&b)));
        let lane = lanes.find(|lane| is_beside(lane, rear_axle))?;
        let (target, arrives) = way_from(map, lane.id, route)?;
        let line = Line::new(into(&target, rear_axle, speed)?);
        let change = Change {
            side,
            target,
            arrives,
            is_due: false,
        };
        Some((change, line))
    };
    [Side::Left, Side::Right]
        .into_iter()
        .filter_map(beside)
        .collect()
}

/// The centre of the way from a lane along the route, and whether it gets to the route's end.
pub(crate) fn way_from(
    map: &MapGraph,
    lane: LaneId,
    route: &[RoadblockId],
) -> Option<(Path, bool)> {
    let lanes = shortest_lanes(map, lane, route);
    let of = |id: &LaneId| map.lane(*id);
    let poses: Vec<Pose> = lanes.iter().filter_map(of).flat_map(baseline).collect();
    let last = lanes.last().and_then(of)?.roadblock;
    Some((Path::through(&poses)?, last == route.last().copied()))
}

fn is_beside(lane: &Lane, rear_axle: Pose) -> bool {
    let line = &lane.centerline;
    let foot = line.project(rear_axle.position);
    let heading = line.pose_at(foot.arc_length).heading;
    foot.distance < BESIDE_M
        && (ROOM_M..line.length() - ROOM_M).contains(&foot.arc_length)
        && angle_difference(heading, rear_axle.heading).abs() < 0.5
}

/// From a pose into a path and on along it: a cubic that leaves in the direction of the pose and
/// arrives in that of the path.
fn into(target: &Path, from: Pose, speed: f64) -> Option<Path> {
    let start = target.project(from.position);
    let length = (speed * CHANGE_S).max(CHANGE_M);
    let to = target.pose_at(start + length);
    let chord = to.position.distance(from.position);
    let (out, back) = (from.direction() * chord, to.direction() * chord);
    let n = (chord / SPACING).ceil().max(2.0) as usize;
    let at = |i: usize| {
        let t = i as f64 / n as f64;
        let (t2, t3) = (t * t, t * t * t);
        let position = from.position * (2.0 * t3 - 3.0 * t2 + 1.0)
            + out * (t3 - 2.0 * t2 + t)
            + to.position * (3.0 * t2 - 2.0 * t3)
            + back * (t3 - t2);
        let along: DVec2 = (from.position - to.position) * (6.0 * t2 - 6.0 * t)
            + out * (3.0 * t2 - 4.0 * t + 1.0)
            + back * (3.0 * t2 - 2.0 * t);
        Pose {
            position,
            heading: along.to_angle(),
        }
    };
    let mut poses: Vec<Pose> = (0..n).map(at).collect();
    poses.extend(target.poses_from(start + length));
    Path::through(&poses)
}

#[cfg(test)]
mod tests {
    use approx::assert_abs_diff_eq;
    use gump_geometry::dvec2;

    use super::*;

    fn straight(y: f64) -> Path {
        let poses: Vec<Pose> = (0..=20)
            .map(|i| Pose::new(10.0 * i as f64, y, 0.0))
            .collect();
        Path::through(&poses).unwrap()
    }

    #[test]
    fn a_change_leaves_and_arrives_without_a_kink() {
        let from = Pose::new(20.0, 0.0, 0.1);
        let path = into(&straight(3.5), from, 10.0).unwrap();
        let first = path.pose_at(0.0);
        assert_eq!(first.position, from.position);
        assert_abs_diff_eq!(first.heading, 0.1, epsilon = 1e-9);
        // 35 m on it is in the other lane, and stays there.
        let place = path.project(dvec2(55.0, 3.5));
        let there = path.pose_at(place);
        assert_abs_diff_eq!(there.position.y, 3.5, epsilon = 1e-6);
        assert_abs_diff_eq!(there.heading, 0.0, epsilon = 1e-3);
        assert_abs_diff_eq!(path.pose_at(place + 50.0).position.x, 105.0, epsilon = 1e-3);
        let turn = |pair: &[Pose]| angle_difference(pair[1].heading, pair[0].heading).abs();
        let poses: Vec<Pose> = path.poses().collect();
        assert!(poses.windows(2).map(turn).fold(0.0, f64::max) < 0.01);
    }
}
