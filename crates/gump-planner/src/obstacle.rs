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
    fn new(agent: &Agent, path: &PathAhead, seconds: f64) -> Self {
        let mut footprint = agent.oriented_box();
        footprint.pose.position += agent.state.velocity * seconds;
        let (center, lateral) = path.project(footprint.pose.position);
        let mut obstacle = Self {
            rear: center,
            speed: agent.state.velocity.dot(path.pose_at(center).direction()),
            center,
            right: lateral,
            left: lateral,
        };
        for corner in footprint.corners() {
            let (s, lateral) = path.project(corner);
            obstacle.rear = obstacle.rear.min(s);
            obstacle.right = obstacle.right.min(lateral);
            obstacle.left = obstacle.left.max(lateral);
        }
        obstacle
    }
}
