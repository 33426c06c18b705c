//! One vehicle: its lanes and its motion.

use gump_geometry::{DVec2, Pose, angle_difference, wrap_angle};
use gump_scene::{Agent, AgentState, LaneId, Light, LightState, SceneState, Seed};
use rand::Rng as _;

use super::IdmConfig;
use super::law::{gentle_speed, idm_acceleration};
use super::obstacles::{Lead, Observer, Obstacle};
use super::path::{Path, Stop};
use super::road::{Road, STANDING};

// Distances and speeds are chosen by hand; none was tuned.

/// A standing vehicle farther from the centre of its lane is parked, metres: its side is then over
/// the edge of a usual lane.
const PARKED_OFFSET: f64 = 1.0;
/// A moving vehicle has passed a stop line this far behind its front bumper, metres: the law stops a
/// little late at times. A standing one has only when its centre is past it.
const PASSED: f64 = 1.0;
/// A vehicle that is slower than this at the start, metres per second, ...
const WAITING: f64 = 1.0;
/// ... waits for a light of unknown colour within this distance of its front bumper, metres: the
/// first two or three of a queue, whom the others follow.
const WAITING_REACH: f64 = 15.0;
/// A route farther away than this is not the one being driven, metres: more than a lane's width, as
/// routes may run in the next lane.
const ROUTE_REACH: f64 = 5.0;
/// Path prepared beyond what the driver looks at, so that it is seldom extended, metres.
const RESERVE: f64 = 100.0;

/// Motion of an agent.
#[derive(Clone, Debug)]
pub(super) enum MotionModel {
    /// Along the lane graph.
    Follow(Box<Follower>),
    /// Along its heading, braking comfortably.
    Brake,
    /// Not at all.
    Park,
    /// At constant velocity.
    Coast,
    /// By an external driver.
    Driven,
}

/// Possible paths of a driver, before a lane is drawn at random.
#[derive(Clone, Debug)]
pub(super) enum Situation {
    /// The scene's route.
    Route(Path),
    /// One of these lanes.
    Lanes(Vec<LaneId>),
    /// No choice.
    Fixed(MotionModel),
}

/// The settings, road and lights from which a follower gets its path.
#[derive(Clone, Copy)]
pub(super) struct Ground<'a> {
    pub(super) config: &'a IdmConfig,
    pub(super) road: &'a Road,
    pub(super) lights: &'a [Light],
}

impl Situation {
    /// The intention of an agent other than the ego.
    pub(super) fn of(agent: &Agent, scene: SceneState<'_>, road: &Road) -> Self {
        let lanes = road.lanes_of(&agent.state);
        let standing = scene
            .history
            .iter()
            .filter_map(|frame| frame.agent(agent.id))
            .all(|past| past.state.speed() < STANDING);
        match lanes.first() {
            None if standing => Self::Fixed(MotionModel::Park),
            None => Self::Fixed(MotionModel::Brake),
            Some((_, lateral)) if standing && lateral.abs() > PARKED_OFFSET => {
                Self::Fixed(MotionModel::Park)
            }
            Some(_) => Self::Lanes(lanes.into_iter().map(|(lane, _)| lane).collect()),
        }
    }

    /// The intention of the ego: its route, if it is on it.
    pub(super) fn of_ego(agent: &Agent, scene: SceneState<'_>, ground: Ground<'_>) -> Self {
        let Some(route) = scene.route else {
            return Self::of(agent, scene, ground.road);
        };
        let mut path = Path::new();
        let points = super::road::simplify(route.path.points());
        path.push_route(ground.road, &points, &route.lanes, ground.lights);
        path.finish(ground.config, 0.0);
        match path.project(agent.state.pose.position, 0.0, f64::INFINITY) {
            Some(foot)
                if foot.lateral.abs() < ROUTE_REACH
                    && angle_difference(agent.state.pose.heading, foot.heading).abs() < 1.0 =>
            {
                Self::Route(path)
            }
            _ => Self::of(agent, scene, ground.road),
        }
    }

    /// Makes the random choices of one future.
    pub(super) fn decide(&self, agent: &Agent, ground: Ground<'_>, seed: Seed) -> MotionModel {
        let follower = match self {
            Self::Fixed(driver) => return driver.clone(),
            Self::Route(path) => Follower::new(agent, path.clone(), ground, seed),
            Self::Lanes(lanes) => {
                let mut path = Path::new();
                // Choices number 1 and up are forks ahead, see `Follower::extend`.
                let lane = lanes[seed.fork(0).rng().random_range(0..lanes.len())];
                path.push_lane(ground.road, lane, ground.lights);
                path.finish(ground.config, 0.0);
                Follower::new(agent, path, ground, seed)
            }
        };
        follower.map_or(MotionModel::Brake, |follower| {
            MotionModel::Follow(Box::new(follower))
        })
    }
}

/// A vehicle on its path.
#[derive(Clone, Debug)]
pub(super) struct Follower {
    path: Path,
    /// Arc length of the box centre.
    s: f64,
    speed: f64,
    /// Speed at the start: a limit that is not stated never makes a vehicle slower than that.
    start_speed: f64,
    /// Up to this arc length the vehicle waits for lights of unknown colour.
    waits_until: f64,
    place: Placement,
    seed: Seed,
    n_choices: u64,
}

/// The approach of a vehicle that starts off the centre of its path to the centre.
///
/// The offset follows a critically damped oscillator over distance driven, so position and
/// direction are continuous and a standing vehicle stays in place.
#[derive(Clone, Copy, Debug)]
struct Placement {
    start: Pose,
    start_s: f64,
    offset: f64,
    slope: f64,
    /// Residual of the projection, metres.
    residual: DVec2,
    length: f64,
}

impl Placement {
    fn new(state: &AgentState, path: &Path, speed: f64) -> Option<(f64, Self)> {
        let foot = path.project(state.pose.position, 0.0, f64::INFINITY)?;
        let center = path.pose_at(foot.s);
        let local = center.inverse() * state.pose.position;
        let turn = angle_difference(state.pose.heading, center.heading).clamp(-1.0, 1.0);
        let mut place = Self {
            start: state.pose,
            start_s: foot.s,
            offset: local.y,
            slope: turn.tan(),
            residual: DVec2::ZERO,
            // About a second of driving, and never sharper than a car can steer.
            length: speed.max(5.0),
        };
        place.residual = state.pose.position - place.on(path, foot.s).position;
        Some((foot.s, place))
    }

    /// Offset from the path and its change per metre at arc length `s`.
    fn lateral(&self, s: f64) -> (f64, f64) {
        let driven = (s - self.start_s).max(0.0);
        let rate = self.slope + self.offset / self.length;
        let decay = (-driven / self.length).exp();
        let offset = (self.offset + rate * driven) * decay;
        (offset, rate * decay - offset / self.length)
    }

    fn on(&self, path: &Path, s: f64) -> Pose {
        let driven = s - self.start_s;
        let (offset, slope) = self.lateral(s);
        let center = path.pose_at(s);
        let decay = (-driven / self.length).exp();
        Pose {
            position: center.position + center.direction().perp() * offset + self.residual * decay,
            heading: wrap_angle(center.heading + slope.atan()),
        }
    }

    /// The pose at `s`; exactly the first one until the vehicle has moved.
    fn pose(&self, path: &Path, s: f64) -> Pose {
        if s == self.start_s {
            self.start
        } else {
            self.on(path, s)
        }
    }
}

impl Follower {
    fn new(agent: &Agent, path: Path, ground: Ground<'_>, seed: Seed) -> Option<Self> {
        let speed = agent
            .state
            .velocity
            .dot(agent.state.pose.direction())
            .max(0.0);
        let (s, place) = Placement::new(&agent.state, &path, speed)?;
        let mut follower = Self {
            path,
            s,
            speed,
            start_speed: speed,
            waits_until: if speed < WAITING {
                s + agent.length / 2.0 + WAITING_REACH
            } else {
                f64::NEG_INFINITY
            },
            place,
            seed,
            n_choices: 0,
        };
        follower.extend(ground);
        Some(follower)
    }

    /// Adds lanes, drawn at random where the road forks, until the path reaches far enough. Where
    /// the map ends the path does too; it then goes on straight.
    fn extend(&mut self, ground: Ground<'_>) {
        let needed = self.s + ground.config.look_ahead;
        if self.path.end() >= needed {
            return;
        }
        let mut grown = false;
        // Bounded, because a ring of lanes without length would never reach ahead.
        for _ in 0..1000 {
            if self.path.end() >= needed + RESERVE {
                break;
            }
            let next = self
                .path
                .last_lane()
                .map(|id| ground.road.next(id))
                .unwrap_or_default();
            if next.is_empty() {
                break;
            }
            self.n_choices += 1;
            let choice = self
                .seed
                .fork(self.n_choices)
                .rng()
                .random_range(0..next.len());
            self.path
                .push_lane(ground.road, next[choice], ground.lights);
            grown = true;
        }
        if grown {
            self.path.finish(ground.config, self.s);
        }
    }

    fn acceleration(
        &self,
        config: &IdmConfig,
        obstacles: &[Obstacle],
        own: usize,
        half: f64,
    ) -> f64 {
        let observer = Observer {
            config,
            path: &self.path,
            own,
            s: self.s,
            speed: self.speed,
            lateral: |s| self.place.lateral(s).0,
        };
        let lead = observer.lead(obstacles);
        let stop = self.stop_line(config, half);
        let most = [lead, stop].into_iter().flatten().max_by(|a, b| {
            let pressure = |lead: &Lead| lead.pressure(config, self.speed);
            pressure(a).total_cmp(&pressure(b))
        });
        let (gap, lead_speed) = most.map_or((f64::INFINITY, 0.0), |lead| (lead.gap, lead.speed));
        let desired = self.desired_speed(config);
        idm_acceleration(config, self.speed, desired, gap, lead_speed)
            .clamp(-config.emergency_deceleration, config.max_acceleration)
    }

    fn desired_speed(&self, config: &IdmConfig) -> f64 {
        let (limit, curve) = self.path.speeds_at(self.s);
        let guess = limit.usual.unwrap_or(config.target_velocity);
        let limit = limit.stated.unwrap_or(guess.max(self.start_speed));
        // The law divides by it.
        let wanted = limit.min(curve).max(1.0);
        wanted.max(gentle_speed(config, self.speed))
    }

    /// The next light to stop for, as a vehicle standing with its rear at the stop line.
    fn stop_line(&self, config: &IdmConfig, half_length: f64) -> Option<Lead> {
        let front = self.s + half_length;
        let stopping = self.speed * self.speed / (2.0 * config.max_deceleration);
        let passed = if self.speed < STANDING {
            half_length
        } else {
            PASSED
        };
        let binds = |stop: &Stop, gap: f64| match stop.state {
            LightState::Red => true,
            LightState::Yellow => gap >= stopping,
            LightState::Unknown => stop.s <= self.waits_until,
            LightState::Green => false,
        };
        self.path
            .stops()
            .iter()
            .map(|stop| (stop, stop.s - front))
            .filter(|&(stop, gap)| gap > -passed && gap < config.look_ahead && binds(stop, gap))
            .map(|(_, gap)| gap)
            .min_by(f64::total_cmp)
            .map(|gap| Lead { gap, speed: 0.0 })
    }

    /// Moves for `dt` seconds.
    ///
    /// Source: the ballistic update of Treiber and Kanagaraj 2015, which ends braking at rest.
    fn advance(&mut self, acceleration: f64, dt: f64) {
        let end = self.speed + acceleration * dt;
        if end > 0.0 {
            self.s += (self.speed + end) / 2.0 * dt;
            self.speed = end;
        } else {
            if self.speed > 0.0 {
                self.s += self.speed * self.speed / (-2.0 * acceleration);
            }
            self.speed = 0.0;
        }
    }

    fn state(&self) -> AgentState {
        let pose = self.place.pose(&self.path, self.s);
        AgentState {
            pose,
            velocity: pose.direction() * self.speed,
        }
    }
}

impl MotionModel {
    /// Updates the lights that it sees.
    pub(super) fn show(&mut self, lights: &[Light]) {
        if let Self::Follow(follower) = self {
            follower.path.show(lights);
        }
    }

    /// The agent's state `dt` seconds on; `own` is its index among the obstacles.
    pub(super) fn step(
        &mut self,
        agent: &Agent,
        obstacles: &[Obstacle],
        own: usize,
        ground: Ground<'_>,
        dt: f64,
    ) -> AgentState {
        let AgentState { pose, velocity } = agent.state;
        let ahead = |velocity: DVec2, distance: DVec2| AgentState {
            pose: Pose {
                position: pose.position + distance,
                ..pose
            },
            velocity,
        };
        match self {
            Self::Follow(follower) => {
                let half = agent.length / 2.0;
                let a = follower.acceleration(ground.config, obstacles, own, half);
                follower.advance(a, dt);
                follower.extend(ground);
                follower.state()
            }
            Self::Brake => {
                let speed = velocity.length();
                let end = (speed - ground.config.max_deceleration * dt).max(0.0);
                let direction = velocity.normalize_or_zero();
                ahead(direction * end, direction * ((speed + end) / 2.0 * dt))
            }
            Self::Park => ahead(DVec2::ZERO, DVec2::ZERO),
            Self::Coast | Self::Driven => ahead(velocity, velocity * dt),
        }
    }
}
