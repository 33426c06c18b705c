//! Forecast of the positions of all objects over the next seconds: as simulated where known,
//! otherwise with constant speed and direction.

use std::collections::BTreeSet;

use gump_geometry::{DVec2, OrientedBox, Polygon, Pose, Quad};
use gump_scene::{Agent, AgentId, AgentKind, AgentState, LaneId};

/// Objects whose centre is farther from the ego's are ignored, metres. Source: tuPlan Garage.
const RADIUS: f64 = 50.0;
/// Moments of the forecast: from now to 8 s. Source, of their distance too: tuPlan Garage.
pub(crate) const MOMENTS: usize = 41;
/// Seconds between moments.
pub(crate) const MOMENT_DT: f64 = 0.2;

/// An obstacle: an object or a red light.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Token {
    /// An object.
    Agent(AgentId),
    /// The surface of a lane whose light is red.
    RedLight(LaneId),
}

/// Up to this speed an object stands, metres per second.
const STANDING: f64 = 0.05;

/// One object over all instants: at its known positions, then straight on.
#[derive(Clone, Debug)]
pub(crate) struct Object {
    pub(crate) agent: Agent,
    /// Known positions from now on, one per instant; never empty.
    known: Vec<Spot>,
    /// The velocity after the last of them: world frame, metres per second.
    drift: DVec2,
    /// Bounds over all moments.
    swept: (DVec2, DVec2),
}

/// Pose, outline and motion of an object at a moment.
#[derive(Clone, Copy, Debug)]
struct Spot {
    quad: Quad,
    pose: Pose,
    /// World frame, metres per second.
    velocity: DVec2,
    /// 0 for kinds that never move.
    speed: f64,
}

/// The forecast of one planning step.
#[derive(Clone, Debug, Default)]
pub(crate) struct Forecast {
    pub(crate) objects: Vec<Object>,
    pub(crate) red_lights: Vec<(LaneId, Polygon)>,
    /// Objects that the ego touches, or has ever touched, and therefore ignores.
    pub(crate) collided: BTreeSet<Token>,
}

impl Object {
    /// An object that keeps its speed; it moves along its heading, or against it if it rolls back.
    fn new(agent: &Agent) -> Self {
        let moving = agent.kind.is_moving();
        let velocity = agent.state.velocity;
        let ahead = agent.state.pose.direction();
        let speed = if moving { velocity.length() } else { 0.0 };
        let drift = if velocity.dot(ahead) < 0.0 {
            -ahead
        } else {
            ahead
        } * speed;
        let quad = Quad::from(&agent.oriented_box());
        let mut object = Self {
            agent: *agent,
            known: vec![Spot {
                quad,
                pose: agent.state.pose,
                velocity,
                speed,
            }],
            drift,
            swept: quad.bounds(),
        };
        object.sweep();
        object
    }

    /// Adds simulated positions at the next instants, and the velocity there and after them.
    pub(crate) fn imagine(&mut self, poses: impl Iterator<Item = Pose>, drift: DVec2) {
        for pose in poses {
            let state = AgentState {
                pose,
                velocity: drift,
            };
            self.known.push(Spot {
                quad: Quad::from(&self.agent.with_state(state).oriented_box()),
                pose,
                velocity: drift,
                speed: drift.length(),
            });
        }
        self.drift = drift;
        self.sweep();
    }

    /// True if its footprint never changes.
    pub(crate) fn is_still(&self) -> bool {
        self.known.len() == 1 && self.drift == DVec2::ZERO
    }

    /// Bounds of all its footprints.
    pub(crate) fn swept(&self) -> (DVec2, DVec2) {
        self.swept
    }

    /// Its centre at a moment.
    pub(crate) fn center(&self, moment: usize) -> DVec2 {
        let (spot, offset) = self.at(moment);
        spot.pose.position + offset
    }

    /// Its footprint at a moment.
    pub(crate) fn quad(&self, moment: usize) -> Quad {
        let (spot, offset) = self.at(moment);
        Quad::new(spot.quad.corners().map(|corner| corner + offset))
    }

    /// Bounds of its footprint at a moment.
    pub(crate) fn bounds(&self, moment: usize) -> (DVec2, DVec2) {
        let (spot, offset) = self.at(moment);
        let (min, max) = spot.quad.bounds();
        (min + offset, max + offset)
    }

    /// Its speed at a moment along a heading, metres per second.
    pub(crate) fn speed_along(&self, heading: f64, moment: usize) -> f64 {
        let (spot, _) = self.at(moment);
        let turned = spot.pose.heading - heading;
        spot.speed * turned.cos()
    }

    /// True if it stands at a moment, or is of a kind that never moves.
    pub(crate) fn stands(&self, moment: usize) -> bool {
        self.at(moment).0.speed <= STANDING
    }

    /// The agent at a moment.
    pub(crate) fn agent(&self, moment: usize) -> Agent {
        let (spot, offset) = self.at(moment);
        let mut pose = spot.pose;
        pose.position += offset;
        let velocity = spot.velocity;
        self.agent.with_state(AgentState { pose, velocity })
    }

    pub(crate) fn token(&self) -> Token {
        Token::Agent(self.agent.id)
    }

    /// The last position known by an instant, and the distance driven from there.
    fn at(&self, moment: usize) -> (&Spot, DVec2) {
        let last = moment.min(self.known.len() - 1);
        let beyond = MOMENT_DT * (moment - last) as f64;
        (&self.known[last], self.drift * beyond)
    }

    fn sweep(&mut self) {
        let none = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        let join = |all: (DVec2, DVec2), spot: &Spot| {
            let (min, max) = spot.quad.bounds();
            (all.0.min(min), all.1.max(max))
        };
        let (low, high) = self.known.iter().fold(none, join);
        let (min, max) = self.bounds(MOMENTS - 1);
        self.swept = (low.min(min), high.max(max));
    }
}

impl Forecast {
    /// Updates all objects; those that were ever touched stay ignored.
    pub(crate) fn look<'a>(
        &mut self,
        ego: &OrientedBox,
        agents: impl Iterator<Item = &'a Agent>,
        red_lights: Vec<(LaneId, Polygon)>,
    ) {
        let place = ego.pose.position;
        let mut seen: Vec<(f64, &Agent)> = agents
            .filter(|agent| !self.collided.contains(&Token::Agent(agent.id)))
            .map(|agent| (agent.state.pose.position.distance(place), agent))
            .filter(|(distance, _)| *distance < RADIUS)
            .collect();
        seen.sort_by(|a, b| a.0.total_cmp(&b.0));
        // At most this many of each kind, as in PDM.
        let mut room = [50, 25, 10, 50];
        self.objects.clear();
        for (_, agent) in seen {
            let kind = match agent.kind {
                AgentKind::Vehicle => 0,
                AgentKind::Pedestrian => 1,
                AgentKind::Bicycle => 2,
                _ => 3,
            };
            if room[kind] > 0 {
                room[kind] -= 1;
                self.objects.push(Object::new(agent));
            }
        }
        let own = Quad::from(ego);
        for object in &self.objects {
            if object.quad(0).intersects(&own) {
                self.collided.insert(object.token());
            }
        }
        for (lane, polygon) in &red_lights {
            let within = own.corners().iter().all(|&corner| polygon.contains(corner));
            if within {
                self.collided.insert(Token::RedLight(*lane));
            }
        }
        self.red_lights = red_lights;
    }

    /// Objects that were not touched.
    pub(crate) fn relevant(&self) -> impl Iterator<Item = &Object> {
        self.objects
            .iter()
            .filter(|object| !self.collided.contains(&object.token()))
    }

    /// Red lights the ego is not inside of.
    pub(crate) fn relevant_lights(&self) -> impl Iterator<Item = &Polygon> {
        self.red_lights
            .iter()
            .filter(|(lane, _)| !self.collided.contains(&Token::RedLight(*lane)))
            .map(|(_, polygon)| polygon)
    }
}
