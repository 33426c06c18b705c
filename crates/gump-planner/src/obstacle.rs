//! Who is in the way of a proposal, now and as constant velocity has it.

use gump_geometry::DVec2;
use gump_scene::{Agent, SceneState};

use crate::path_ahead::PathAhead;

/// Room to both sides that a driver wants between two vehicles, metres.
const SIDE_ROOM: f64 = 0.2;

/// Everyone else in terms of the way ahead, for every decision of a proposal.
pub(crate) struct Forecast {
    /// `[decision][obstacle]`
    moments: Vec<Vec<Obstacle>>,
}

/// A box on the way, by what it covers of it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Obstacle {
    /// Arc length of the nearest corner, metres.
    pub(crate) rear: f64,
    /// Speed along the way, metres per second; negative if it comes towards the ego.
    pub(crate) speed: f64,
    center: f64,
    right: f64,
    left: f64,
}

/// What the ego will sweep.
pub(crate) struct Strip<'a> {
    /// Arc length of the ego's centre, metres.
    pub(crate) s: f64,
    /// Half of the ego's width, metres.
    pub(crate) half_width: f64,
    /// Where the centre of the strip is at an arc length, metres to the left of the way.
    pub(crate) lateral: &'a dyn Fn(f64) -> f64,
}

impl Forecast {
    /// Moves everyone within reach for `n` decisions `dt` seconds apart.
    pub(crate) fn new(
        scene: SceneState<'_>,
        path: &PathAhead,
        n: usize,
        dt: f64,
        look_ahead: f64,
    ) -> Self {
        let ego = scene.ego_now();
        let seconds = n as f64 * dt;
        let others = scene.now().agents().iter().filter(|agent| {
            let distance = agent.state.pose.position - ego.state.pose.position;
            let reach = look_ahead + (agent.state.speed() + ego.state.speed()) * seconds;
            agent.id != ego.id && distance.length() <= reach
        });
        let mut moments = vec![Vec::new(); n];
        for agent in others {
            // Standing agents are many and their place on the way never changes.
            let still =
                (agent.state.velocity == DVec2::ZERO).then(|| Obstacle::new(agent, path, 0.0));
            for (i, moment) in moments.iter_mut().enumerate() {
                let moved = || Obstacle::new(agent, path, i as f64 * dt);
                moment.push(still.unwrap_or_else(moved));
            }
        }
        Self { moments }
    }

    /// Those in front of the ego's centre whose box reaches into the strip.
    pub(crate) fn ahead<'a>(
        &'a self,
        decision: usize,
        strip: &'a Strip<'a>,
    ) -> impl Iterator<Item = &'a Obstacle> + 'a {
        let reach = strip.half_width + SIDE_ROOM;
        self.moments[decision].iter().filter(move |obstacle| {
            let middle = (strip.lateral)(obstacle.center);
            obstacle.center > strip.s
                && obstacle.right < middle + reach
                && obstacle.left > middle - reach
        })
    }
}

impl Obstacle {
    /// Places the agent's box on the way as it will be in `seconds` at constant velocity.
    ///
    /// The whole box is taken in the frame of its centre's foot: on a way that winds, corners of
    /// one box would be projected to different bends.
    fn new(agent: &Agent, path: &PathAhead, seconds: f64) -> Self {
        let mut footprint = agent.oriented_box();
        footprint.pose.position += agent.state.velocity * seconds;
        let (center, lateral) = path.project(footprint.pose.position);
        let foot = path.pose_at(center);
        let across = foot.direction().perp();
        let mut obstacle = Self {
            rear: center,
            speed: agent.state.velocity.dot(foot.direction()),
            center,
            right: lateral,
            left: lateral,
        };
        for corner in footprint.corners() {
            let arm = corner - footprint.pose.position;
            obstacle.rear = obstacle.rear.min(center + arm.dot(foot.direction()));
            obstacle.right = obstacle.right.min(lateral + arm.dot(across));
            obstacle.left = obstacle.left.max(lateral + arm.dot(across));
        }
        obstacle
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_scene::fixture;

    /// How far ahead the rears are of those in the way of an ego that keeps to the middle.
    fn check(text: &str, decision: usize, expected: &[f64]) {
        let scenario = fixture::scenario(text).unwrap();
        let scene = scenario.present();
        let path = PathAhead::find(scene, 150.0).unwrap();
        let forecast = Forecast::new(scene, &path, 41, 0.1, 80.0);
        let strip = Strip {
            s: path.ego_s,
            half_width: 1.0,
            lateral: &|_| 0.0,
        };
        let ahead = forecast.ahead(decision, &strip);
        let rears: Vec<f64> = ahead.map(|o| o.rear - path.ego_s).collect();
        assert_eq!(rears.len(), expected.len(), "{text}");
        for (found, expected) in rears.iter().zip(expected) {
            assert!((found - expected).abs() < 1e-6, "{found}, not {expected}");
        }
    }

    #[test]
    fn boxes_in_the_strip_are_in_the_way() {
        let street = "lane 1: 0,0 200,0\nego vehicle 0: 10,0 velocity 5,0\n";
        for (other, expected) in [
            ("vehicle 1: 30,0 size 4,2", Some(18.0)),
            ("vehicle 1: 30,2.1 size 4,2", Some(18.0)),
            ("vehicle 1: 30,2.3 size 4,2", None),
            (
                "vehicle 1: 30,2.3 size 4,2 heading 1.5707963267948966",
                Some(19.0),
            ),
            ("vehicle 1: 5,0 size 4,2", None),
        ] {
            let expected: Vec<f64> = expected.into_iter().collect();
            check(&format!("{street} agent {other}"), 0, &expected);
        }
        let walker = format!("{street} agent pedestrian 1: 30,-5 velocity 0,1 size 1,1");
        check(&walker, 0, &[]);
        check(&walker, 40, &[19.5]);
    }

    #[test]
    fn a_box_between_two_bends_of_the_way_is_on_one_of_them() {
        // The way comes back 6 m beside itself; the parked truck stands between both.
        let bends = "lane 1: 0,0 40,0 40,6 0,6\nego vehicle 0: 5,0 velocity 5,0\n";
        check(
            &format!("{bends} agent vehicle 1: 20,2.9 size 8,2.4"),
            0,
            &[],
        );
        check(
            &format!("{bends} agent vehicle 1: 20,2 size 8,2.4"),
            0,
            &[11.0],
        );
    }
}
