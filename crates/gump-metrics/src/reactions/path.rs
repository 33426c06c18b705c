//! The path of the ego: along its log, then along the lanes.

use std::f64::consts::FRAC_PI_6;

use gump_geometry::{DVec2, Polyline, Pose, interpolate_angle};
use gump_scene::{AgentState, Lane, MapGraph};

use crate::behaviour::reach;

// Chosen by hand.
/// Positions of the log nearer than this to the last one used are jitter, metres.
const SPACING_M: f64 = 0.5;
/// A lane farther than this beside the path does not continue it, metres.
const ON_LANE_M: f64 = 2.5;
/// Distance over which the path moves from the end of the log to the centre line, metres.
const JOIN_M: f64 = 15.0;
/// Spacing of points along lanes, metres.
const STEP_M: f64 = 1.0;
/// More lanes than this in a row are a loop of lanes without length.
const MOST_LANES: usize = 100;

/// A path with a heading everywhere; straight on past its end.
pub(super) struct Path {
    line: Polyline,
    /// Of each point of the line, radians.
    headings: Vec<f64>,
}

impl Path {
    /// The path of the log, which starts in the present and may stand, extended to at least
    /// `metres` in all.
    pub(super) fn of_log(logged: &[AgentState], map: &MapGraph, metres: f64) -> Option<Self> {
        let mut poses: Vec<Pose> = Vec::with_capacity(logged.len());
        for state in logged {
            let pose = state.pose;
            let is_new = poses.last().is_none_or(|last| {
                // What backs up is no way ahead.
                (pose.position - last.position).dot(last.direction()) >= SPACING_M
            });
            if is_new {
                poses.push(pose);
            }
        }
        let last = *poses.last()?;
        let pairs = poses.windows(2);
        let length: f64 = pairs
            .map(|pair| pair[0].position.distance(pair[1].position))
            .sum();
        if length < metres {
            poses.extend(onward(map, last, metres - length));
        }
        let headings = poses.iter().map(|pose| pose.heading).collect();
        let line = Polyline::new(poses.into_iter().map(|pose| pose.position).collect())?;
        Some(Self { line, headings })
    }

    /// The pose on the path after this many metres.
    pub(super) fn pose_at(&self, metres: f64) -> Pose {
        let lengths = self.line.arc_lengths();
        let Pose { position, heading } = self.line.pose_at(metres);
        let after = lengths.partition_point(|&length| length <= metres);
        if after == lengths.len() {
            // A way of one point has no direction but that of its pose.
            let heading = self.headings[after - 1];
            let past = metres - self.line.length();
            let direction = DVec2::from_angle(heading);
            let end = self.line.points()[after - 1];
            return Pose {
                position: end + direction * past,
                heading,
            };
        }
        let Some(before) = after.checked_sub(1) else {
            return Pose { position, heading };
        };
        let share = (metres - lengths[before]) / (lengths[after] - lengths[before]);
        let heading = interpolate_angle(self.headings[before], self.headings[after], share);
        Pose { position, heading }
    }
}

/// The continuation from a pose along the lane under it and its successors, for this many metres,
/// without the pose itself; straight on where there are no lanes.
fn onward(map: &MapGraph, from: Pose, metres: f64) -> Vec<Pose> {
    let straight = || {
        let position = from.position + from.direction() * metres;
        vec![Pose { position, ..from }]
    };
    let Some((lane, place)) = reach::nearest(map, from, ON_LANE_M, FRAC_PI_6) else {
        return straight();
    };
    let Some(line) = chain(map, lane, place.arc_length + metres + STEP_M) else {
        return straight();
    };
    let n = (metres / STEP_M).ceil() as usize;
    let poses = (1..=n).map(|i| {
        let ahead = i as f64 * STEP_M;
        let pose = line.pose_at(place.arc_length + ahead);
        let left = place.lateral * (1.0 - smooth(ahead / JOIN_M));
        Pose {
            position: pose.position + pose.direction().perp() * left,
            heading: pose.heading,
        }
    });
    poses.collect()
}

/// A lane and its successors, at forks the straightest, from its start for at least `metres` if the
/// road is that long; `None` for lanes without length.
pub(super) fn chain(map: &MapGraph, lane: &Lane, metres: f64) -> Option<Polyline> {
    let mut points: Vec<DVec2> = lane.centerline.points().to_vec();
    let (mut length, mut last) = (lane.centerline.length(), lane);
    for _ in 0..MOST_LANES {
        if length >= metres {
            break;
        }
        let Some(next) = map.straightest_successor(last) else {
            break;
        };
        points.extend(next.centerline.points());
        length += next.centerline.length();
        last = next;
    }
    points.dedup();
    Polyline::new(points).filter(|line| line.length() > 0.0)
}

/// From 0 to 1 with neither speed nor acceleration at either end; 0 before, 1 after.
///
/// Source: the quintic polynomial of minimum jerk.
pub(super) fn smooth(share: f64) -> f64 {
    let t = share.clamp(0.0, 1.0);
    t * t * t * (10.0 - 15.0 * t + 6.0 * t * t)
}
