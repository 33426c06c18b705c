//! The camera: the part of the world that is seen.

use std::ops::RangeInclusive;

use gump_geometry::{DVec2, Pose, dvec2};
use gump_scene::{Agent, MapGraph, Rollout, SceneState};

/// A view from straight above.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// The point in the middle of the picture, and the world direction that is up.
    pub world_from_camera: Pose,
    /// Metres visible across the width, > 0.
    pub metres: f64,
    /// Width of the picture, pixels, > 0.
    pub width_px: u32,
    /// Height of the picture, pixels, > 0.
    pub height_px: u32,
}

impl Camera {
    /// Centred on the ego as it is now, its heading up.
    pub fn on_ego(scene: &SceneState<'_>, metres: f64, width_px: u32, height_px: u32) -> Self {
        Self {
            world_from_camera: scene.ego_now().state.pose,
            metres,
            width_px,
            height_px,
        }
    }

    /// Shows all of `points` with a margin of a tenth, but at least `min_metres` across the width.
    ///
    /// Units: `heading` is the world direction that is up, radians.
    /// Error: none; without points it looks at the origin.
    pub fn framing(
        points: impl IntoIterator<Item = DVec2>,
        heading: f64,
        min_metres: f64,
        (width_px, height_px): (u32, u32),
    ) -> Self {
        let world_from_up = Pose::new(0.0, 0.0, heading);
        let up_from_world = world_from_up.inverse();
        let (mut min, mut max) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        for point in points {
            let local = up_from_world * point;
            (min, max) = (min.min(local), max.max(local));
        }
        if min.x > max.x {
            (min, max) = (DVec2::ZERO, DVec2::ZERO);
        }
        let aspect = f64::from(width_px) / f64::from(height_px);
        let needed = (max.y - min.y).max((max.x - min.x) * aspect) * 1.2;
        Self {
            world_from_camera: world_from_up
                * Pose {
                    position: (min + max) / 2.0,
                    heading: 0.0,
                },
            metres: needed.max(min_metres),
            width_px,
            height_px,
        }
    }

    /// Shows where the ego goes on the map in any of these futures, its present heading up; fixed,
    /// so that the road need be drawn only once per film.
    ///
    /// Error: none; without rollouts it looks at the origin.
    pub fn on_futures(rollouts: &[&Rollout], min_metres: f64, size_px: (u32, u32)) -> Self {
        let heading = rollouts
            .first()
            .and_then(|r| r.start().agent(r.ego()))
            .map_or(0.0, |ego| ego.state.pose.heading);
        let positions = rollouts.iter().flat_map(|r| {
            let frames = std::iter::once(r.start()).chain(r.imagined());
            let egos = frames.filter_map(|frame| frame.agent(r.ego()));
            let places = egos.map(|ego| ego.state.pose.position);
            places.filter(|place| is_on_map(r.map(), *place))
        });
        Self::framing(positions, heading, min_metres, size_px)
    }

    /// Shows the ego's path and all agents that move near it in any of these futures, the ego's
    /// present heading up; fixed, so that the road need be drawn only once per film.
    ///
    /// Units: `metres` are the least and the most that may be visible across the width.
    /// Error: none; `None` if the ego's path alone takes more than that, so that the camera should
    /// follow the ego.
    pub fn on_movement(
        rollouts: &[&Rollout],
        metres: RangeInclusive<f64>,
        size_px: (u32, u32),
    ) -> Option<Self> {
        let (least, most) = (*metres.start(), *metres.end());
        let way = Self::on_futures(rollouts, least, size_px);
        if way.metres > most {
            return None;
        }
        let heading = way.world_from_camera.heading;
        let points = rollouts.iter().flat_map(|rollout| moving(rollout));
        let all = Self::framing(points, heading, least, size_px);
        if all.metres <= most {
            return Some(all);
        }
        Some(Self {
            metres: most,
            ..way
        })
    }

    /// This view from where the ego is after `step` steps, its heading up. Once it has left the map
    /// nothing else is there to be seen, so the view is that of the start.
    pub(crate) fn with_ego(&self, rollout: &Rollout, step: usize) -> Self {
        let ego = |step| rollout.at(step).ego_now().state.pose;
        let now = ego(step);
        let is_seen = is_on_map(rollout.map(), now.position);
        Self {
            world_from_camera: if is_seen { now } else { ego(0) },
            ..*self
        }
    }

    /// Pixels per metre.
    pub fn scale(&self) -> f64 {
        f64::from(self.width_px) / self.metres
    }

    /// The pixel coordinates (x right, y down) of a world point.
    pub fn pixel(&self, point: DVec2) -> DVec2 {
        let offset = point - self.world_from_camera.position;
        let ahead = self.world_from_camera.direction();
        let local = dvec2(ahead.dot(offset), ahead.perp_dot(offset));
        let middle = dvec2(f64::from(self.width_px), f64::from(self.height_px)) / 2.0;
        middle - dvec2(local.y, local.x) * self.scale()
    }

    /// Whether a world point is in the picture.
    pub(crate) fn sees(&self, point: DVec2) -> bool {
        let pixel = self.pixel(point);
        let is_in = |at: f64, size: u32| (0.0..=f64::from(size)).contains(&at);
        is_in(pixel.x, self.width_px) && is_in(pixel.y, self.height_px)
    }

    /// False if nothing within `radius` metres of `point` is in view.
    pub(crate) fn may_see(&self, point: DVec2, radius: f64) -> bool {
        let half = f64::from(self.width_px).hypot(f64::from(self.height_px)) / 2.0 / self.scale();
        let reach = half + radius;
        self.world_from_camera.position.distance_squared(point) <= reach * reach
    }
}

/// Distance from the ego within which moving agents are framed, metres. Chosen by eye: those who
/// matter to the ego, without making everything small.
const NEAR: f64 = 30.0;
/// An agent that goes farther than this counts as moving, metres. Chosen by hand.
const MOVES: f64 = 2.0;

/// Whoever is farther than this from any lane has left the map, metres: more than the width of a car
/// park beside a lane, less than a camera sees. Chosen by hand.
const OFF_MAP: f64 = 25.0;

/// Whether a place is on the map or beside it. On a map without lanes every place is.
fn is_on_map(map: &MapGraph, place: DVec2) -> bool {
    map.lanes().is_empty() || map.lanes_near(place, OFF_MAP).next().is_some()
}

/// Positions of the ego, and of all other agents while they are near it and have moved.
fn moving(rollout: &Rollout) -> Vec<DVec2> {
    let start = rollout.start();
    let mut points = Vec::new();
    for frame in std::iter::once(start).chain(rollout.imagined()) {
        let Some(ego) = frame.agent(rollout.ego()) else {
            continue;
        };
        let ego = ego.state.pose.position;
        if !is_on_map(rollout.map(), ego) {
            continue;
        }
        points.push(ego);
        for agent in frame.agents() {
            let at = agent.state.pose.position;
            let moves = |before: &Agent| before.state.pose.position.distance(at) > MOVES;
            if at.distance(ego) < NEAR && start.agent(agent.id).is_some_and(moves) {
                points.push(at);
            }
        }
    }
    points
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn up_is_ahead_and_left_is_left() {
        let camera = Camera {
            world_from_camera: Pose::new(10.0, 0.0, std::f64::consts::FRAC_PI_2),
            metres: 50.0,
            width_px: 100,
            height_px: 80,
        };
        let check = |x, y, expected: DVec2| {
            assert!((camera.pixel(dvec2(x, y)) - expected).length() < 1e-9);
        };
        check(10.0, 0.0, dvec2(50.0, 40.0));
        check(10.0, 5.0, dvec2(50.0, 30.0));
        check(5.0, 0.0, dvec2(40.0, 40.0));
        assert!(camera.may_see(dvec2(10.0, 40.0), 10.0));
        assert!(!camera.may_see(dvec2(10.0, 50.0), 10.0));
    }

    #[test]
    fn framing_sees_every_point() {
        let points = [dvec2(1e6, 4e6), dvec2(1e6 + 90.0, 4e6 - 20.0)];
        for heading in [0.0, 0.7, -2.0] {
            let camera = Camera::framing(points, heading, 40.0, (200, 100));
            for pixel in points.map(|p| camera.pixel(p)) {
                assert!(0.0 < pixel.x && pixel.x < 200.0 && 0.0 < pixel.y && pixel.y < 100.0);
            }
        }
        assert_eq!(Camera::framing([], 0.0, 40.0, (9, 9)).metres, 40.0);
    }
}
