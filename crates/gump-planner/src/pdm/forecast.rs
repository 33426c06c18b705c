//! Who is where over the next seconds, if everyone keeps its speed and direction.

use std::collections::BTreeSet;

use gump_geometry::{DVec2, OrientedBox, Polygon, Quad};
use gump_scene::{Agent, AgentId, AgentKind, AgentState, LaneId};

/// Objects whose centre is farther from the ego's are not seen, metres.
const RADIUS: f64 = 50.0;
/// Moments of the forecast, a fifth of a second apart.
pub(crate) const MOMENTS: usize = 41;
/// Seconds between moments.
pub(crate) const MOMENT_DT: f64 = 0.2;

/// What stands in the way: an object or a red light.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Token {
    /// An object.
    Agent(AgentId),
    /// The surface of a lane whose light is red.
    RedLight(LaneId),
}

/// One object over all moments.
#[derive(Clone, Debug)]
pub(crate) struct Object {
    pub(crate) agent: Agent,
    /// 0 for what does not move by itself.
    pub(crate) speed: f64,
    /// World frame, metres per second; along the heading, or against it if it rolls back.
    drift: DVec2,
    quad: Quad,
    /// Bounds over all moments.
    swept: (DVec2, DVec2),
}

/// The forecast of one planning step.
#[derive(Clone, Debug, Default)]
pub(crate) struct Forecast {
    pub(crate) objects: Vec<Object>,
    pub(crate) red_lights: Vec<(LaneId, Polygon)>,
    /// What the ego touches, or has ever touched, and therefore does not care for any more.
    pub(crate) collided: BTreeSet<Token>,
}

impl Object {
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
        let (min, max) = quad.bounds();
        let moved = drift * (MOMENT_DT * (MOMENTS - 1) as f64);
        Self {
            agent: *agent,
            speed,
            drift,
            quad,
            swept: (min.min(min + moved), max.max(max + moved)),
        }
    }

    /// True if its footprint never changes.
    pub(crate) fn is_still(&self) -> bool {
        self.drift == DVec2::ZERO
    }

    /// Bounds of all its footprints.
    pub(crate) fn swept(&self) -> (DVec2, DVec2) {
        self.swept
    }

    /// Its centre at a moment.
    pub(crate) fn center(&self, moment: usize) -> DVec2 {
        self.agent.state.pose.position + self.offset(moment)
    }

    /// Its footprint at a moment.
    pub(crate) fn quad(&self, moment: usize) -> Quad {
        let offset = self.offset(moment);
        Quad::new(self.quad.corners().map(|corner| corner + offset))
    }

    /// Bounds of its footprint at a moment.
    pub(crate) fn bounds(&self, moment: usize) -> (DVec2, DVec2) {
        let (offset, (min, max)) = (self.offset(moment), self.quad.bounds());
        (min + offset, max + offset)
    }

    /// The agent at a moment.
    pub(crate) fn agent(&self, moment: usize) -> Agent {
        let mut pose = self.agent.state.pose;
        pose.position += self.offset(moment);
        self.agent.with_state(AgentState {
            pose,
            ..self.agent.state
        })
    }

    pub(crate) fn token(&self) -> Token {
        Token::Agent(self.agent.id)
    }

    fn offset(&self, moment: usize) -> DVec2 {
        self.drift * (MOMENT_DT * moment as f64)
    }
}

impl Forecast {
    /// Sees everyone afresh; what was ever touched stays ignored.
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
        // Room for so many of each kind, as PDM has it.
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
            if object.quad.intersects(&own) {
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
