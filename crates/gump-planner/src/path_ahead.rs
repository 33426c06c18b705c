//! The way ahead of the ego: its route, or the lane graph where there is none.
//!
//! How fast to drive along it is `proposal`'s business.

use gump_geometry::{DVec2, Polyline, Pose, angle_difference, project_on_segment};
use gump_scene::{Lane, LaneId, LaneKind, LightState, Route, SceneState};

use crate::PlanError;

/// A route or lane farther from the ego is not the one being driven, metres.
const REACH: f64 = 5.0;
/// A line that runs more obliquely to the ego's heading is not the one being driven, radians.
const OBLIQUE: f64 = 1.0;
/// Directions are taken over this much to both sides, so that an offset path does not jump where
/// the line has a corner, metres.
const HALF_CHORD: f64 = 1.0;
/// A stop line this far behind the front bumper has been passed, metres.
const PASSED: f64 = 1.0;

/// The line to drive along, from behind the ego to at least the asked distance ahead unless the
/// map ends before; past its end it goes on straight.
#[derive(Clone, Debug)]
pub(crate) struct PathAhead {
    line: Polyline,
    lanes: Vec<LaneId>,
    /// Arc length of the ego's foot on the line, metres.
    pub(crate) ego_s: f64,
    /// Limit of the lane the ego is on, metres per second, if stated.
    pub(crate) speed_limit: Option<f64>,
}

impl PathAhead {
    /// Finds the way ahead of the ego, `distance` metres of it.
    ///
    /// The route is taken if it passes near the ego in its direction; it is continued through the
    /// lane graph where it ends. Without one the nearest lane starts the way. At forks the least
    /// winding lane is taken, the first given on ties.
    ///
    /// # Errors
    /// [`PlanError::NoLaneAhead`] if neither is near.
    pub(crate) fn find(scene: SceneState<'_>, distance: f64) -> Result<Self, PlanError> {
        let ego = scene.ego_now().state.pose;
        let on_route = scene
            .route
            .and_then(|route| foot(&route.path, ego).map(|foot| (route, foot)))
            .filter(|(_, foot)| foot.distance < REACH);
        let (mut points, mut lanes, foot) = match on_route {
            Some((route, foot)) => (route.path.points().to_vec(), route.lanes.clone(), foot),
            None => {
                let (lane, foot) = nearest_lane(scene, ego).ok_or(PlanError::NoLaneAhead {
                    position: ego.position,
                })?;
                (lane.centerline.points().to_vec(), vec![lane.id], foot)
            }
        };
        let speed_limit = lanes
            .iter()
            .filter_map(|&id| scene.map.lane(id))
            .filter_map(|lane| Some((lane, foot_on_lane(lane, ego)?)))
            .min_by(|a, b| a.1.distance.total_cmp(&b.1.distance))
            .and_then(|(lane, _)| lane.speed_limit.or(lane.kind.usual_speed_limit()));
        extend(scene, &mut points, &mut lanes, foot.arc_length + distance);
        let line = Polyline::new(points).expect("a line the ego was projected on has points");
        Ok(Self {
            line,
            lanes,
            ego_s: foot.arc_length,
            speed_limit,
        })
    }

    /// The point and direction at arc length `s`, the direction free of jumps.
    pub(crate) fn pose_at(&self, s: f64) -> Pose {
        let middle = self.line.pose_at(s);
        let before = self.line.pose_at(s - HALF_CHORD).position;
        let chord = self.line.pose_at(s + HALF_CHORD).position - before;
        match chord.try_normalize() {
            Some(direction) => Pose {
                heading: direction.to_angle(),
                ..middle
            },
            None => middle,
        }
    }

    /// Change of direction per metre at arc length `s`, positive to the left.
    pub(crate) fn curvature_at(&self, s: f64) -> f64 {
        let turn = angle_difference(
            self.pose_at(s + HALF_CHORD).heading,
            self.pose_at(s - HALF_CHORD).heading,
        );
        turn / (2.0 * HALF_CHORD)
    }

    /// The way as a route.
    pub(crate) fn into_route(self) -> Route {
        Route {
            lanes: self.lanes,
            roadblocks: Vec::new(),
            path: self.line,
        }
    }

    /// Arc length and lateral offset of `point`, metres; past the end the line goes on straight.
    pub(crate) fn project(&self, point: DVec2) -> (f64, f64) {
        let foot = self.line.project(point);
        let length = self.line.length();
        if foot.arc_length < length {
            return (foot.arc_length, foot.lateral);
        }
        let local = self.line.pose_at(length).inverse() * point;
        (length + local.x.max(0.0), local.y)
    }

    /// Arc length of the next stop line of a red light that the front bumper at `front_s` has not
    /// passed: the stop point, else the entry of a lane inside an intersection, else the end.
    pub(crate) fn red_stop_line(&self, scene: SceneState<'_>, front_s: f64) -> Option<f64> {
        scene
            .now()
            .lights()
            .iter()
            .filter(|light| light.state == LightState::Red && self.lanes.contains(&light.lane))
            .filter_map(|light| {
                let stop = light.stop_point.or_else(|| {
                    let lane = scene.map.lane(light.lane)?;
                    let points = lane.centerline.points();
                    if lane.in_intersection {
                        points.first().copied()
                    } else {
                        points.last().copied()
                    }
                })?;
                Some(self.line.project(stop).arc_length)
            })
            .filter(|&s| s > front_s - PASSED)
            .min_by(f64::total_cmp)
    }
}

/// Where a pose falls on a line.
#[derive(Clone, Copy, Debug)]
struct Foot {
    arc_length: f64,
    distance: f64,
}

/// The nearest point of `line` where it runs in the direction of `pose`, so that a route which
/// crosses itself or turns back is met on the right pass.
fn foot(line: &Polyline, pose: Pose) -> Option<Foot> {
    let mut best: Option<Foot> = None;
    for ((a, b), start) in line.segments().zip(line.arc_lengths()) {
        let along = b - a;
        if along == DVec2::ZERO || angle_difference(along.to_angle(), pose.heading).abs() > OBLIQUE
        {
            continue;
        }
        let t = project_on_segment(pose.position, a, b);
        let distance = pose.position.distance(a.lerp(b, t));
        if best.is_none_or(|best| distance < best.distance) {
            best = Some(Foot {
                arc_length: start + t * along.length(),
                distance,
            });
        }
    }
    best
}

fn foot_on_lane(lane: &Lane, pose: Pose) -> Option<Foot> {
    foot(&lane.centerline, pose)
}

fn nearest_lane<'a>(scene: SceneState<'a>, ego: Pose) -> Option<(&'a Lane, Foot)> {
    scene
        .map
        .lanes_near(ego.position, REACH)
        .filter(|(lane, _)| lane.kind != LaneKind::BikeLane)
        .filter_map(|(lane, _)| Some((lane, foot_on_lane(lane, ego)?)))
        .min_by(|a, b| a.1.distance.total_cmp(&b.1.distance))
        .filter(|(_, foot)| foot.distance < REACH)
}

/// Appends the rest of the last lane and then its successors until the line is `length` metres long
/// or the map ends.
fn extend(scene: SceneState<'_>, points: &mut Vec<DVec2>, lanes: &mut Vec<LaneId>, length: f64) {
    let mut reached: f64 = points.windows(2).map(|p| p[0].distance(p[1])).sum();
    let mut append = |points: &mut Vec<DVec2>, more: &[DVec2]| {
        for &point in more {
            let end = points.last().copied().unwrap_or(point);
            reached += end.distance(point);
            points.push(point);
        }
        reached >= length
    };
    // A route may end in the middle of its last lane.
    let rest = lanes.last().and_then(|&id| {
        let center = &scene.map.lane(id)?.centerline;
        let foot = center.project(*points.last()?);
        (foot.distance < REACH).then(|| &center.points()[foot.segment + 1..])
    });
    let mut done = append(points, rest.unwrap_or_default());
    // Bounded, because a ring of lanes without length would never reach ahead.
    for _ in 0..1000 {
        let next = lanes.last().and_then(|&last| {
            let next = scene.map.successors(last);
            next.filter(|lane| lane.kind != LaneKind::BikeLane)
                .min_by(|a, b| winding(a).total_cmp(&winding(b)))
        });
        let (false, Some(next)) = (done, next) else {
            return;
        };
        done = append(points, next.centerline.points());
        lanes.push(next.id);
    }
}

/// The turn from the start of a lane to its end, radians.
fn winding(lane: &Lane) -> f64 {
    let line = &lane.centerline;
    angle_difference(
        line.pose_at(line.length()).heading,
        line.pose_at(0.0).heading,
    )
    .abs()
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;
    use gump_geometry::dvec2;
    use gump_scene::fixture;

    const FORK: &str = "
        lane 1: 0,0 20,0 speed 12 next 2,3
        lane 2: 20,0 30,0 30,40
        lane 3: 20,0 40,0 60,0 speed 20\n";

    fn check(text: &str, distance: f64) -> PathAhead {
        let scenario = fixture::scenario(text).unwrap();
        PathAhead::find(scenario.present(), distance).unwrap()
    }

    #[test]
    fn without_a_route_the_least_winding_lane_is_taken() {
        let path = check(&format!("{FORK} ego vehicle 0: 5,1 velocity 8,0"), 40.0);
        assert_eq!(path.lanes, [LaneId(1), LaneId(3)]);
        assert_eq!((path.ego_s, path.speed_limit), (5.0, Some(12.0)));
        // Past the end of the map the way goes on straight.
        assert_eq!(path.pose_at(70.0).position, dvec2(70.0, 0.0));
        assert_eq!(path.project(dvec2(65.0, 2.0)), (65.0, 2.0));
    }

    #[test]
    fn a_route_is_followed_through_the_fork() {
        let path = check(
            &format!("{FORK} route 1,2\n ego vehicle 0: 5,0 velocity 8,0"),
            40.0,
        );
        assert_eq!(path.lanes, [LaneId(1), LaneId(2)]);
        assert_abs_diff_eq!(path.pose_at(50.0).position.y, 20.0, epsilon = 1e-9);
    }

    #[test]
    fn a_route_that_ends_is_continued_by_the_lanes() {
        let path = check(
            &format!("{FORK} route 1\n ego vehicle 0: 5,0 velocity 8,0"),
            40.0,
        );
        assert_eq!(path.lanes, [LaneId(1), LaneId(3)]);
    }

    #[test]
    fn a_route_that_ends_within_a_lane_keeps_to_it() {
        let text = "lane 1: 0,0 50,0 50,50 next 2\n lane 2: 50,50 50,90\n route 1
            ego vehicle 0: 5,0 velocity 8,0";
        let mut scenario = fixture::scenario(text).unwrap();
        let path = Polyline::new(vec![dvec2(0.0, 0.0), dvec2(20.0, 0.0)]).unwrap();
        let lanes = vec![LaneId(1)];
        scenario.route = Some(std::sync::Arc::new(Route {
            lanes,
            roadblocks: Vec::new(),
            path,
        }));
        let found = PathAhead::find(scenario.present(), 100.0).unwrap();
        assert_eq!(found.lanes, [LaneId(1), LaneId(2)]);
        assert_abs_diff_eq!(found.pose_at(30.0).position.x, 30.0, epsilon = 1e-9);
        assert_eq!(found.line.length(), 140.0);
    }

    #[test]
    fn a_lane_of_the_other_direction_is_no_way_ahead() {
        let text = "lane 1: 100,0 0,0\n ego vehicle 0: 50,0 velocity 8,0";
        let scenario = fixture::scenario(text).unwrap();
        let found = PathAhead::find(scenario.present(), 40.0);
        assert!(matches!(found, Err(PlanError::NoLaneAhead { .. })));
    }

    #[test]
    fn directions_do_not_jump_at_corners() {
        let path = check(
            "lane 1: 0,0 20,0 40,5\n ego vehicle 0: 5,0 velocity 8,0",
            40.0,
        );
        for i in 0..400 {
            let s = 5.0 + f64::from(i) * 0.05;
            let turn = angle_difference(path.pose_at(s + 0.05).heading, path.pose_at(s).heading);
            assert!(turn.abs() < 0.02, "turns by {turn} at {s}");
        }
    }

    #[test]
    fn the_next_red_light_on_the_way_is_found() {
        let text = format!(
            "{FORK} light 3 red: 19,0\n light 2 red: 10,0\n ego vehicle 0: 5,0 velocity 8,0"
        );
        let scenario = fixture::scenario(&text).unwrap();
        let scene = scenario.present();
        let path = PathAhead::find(scene, 40.0).unwrap();
        assert_eq!(path.red_stop_line(scene, 7.4), Some(19.0));
        assert_eq!(path.red_stop_line(scene, 20.5), None);
    }
}
