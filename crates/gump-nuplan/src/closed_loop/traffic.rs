//! Traffic around the ego in a closed loop.

use gump_scene::{Agent, AgentState, EgoState, Frame, Light, SceneState, Seed};

use super::Recording;
use crate::tracking::Trajectory;
use gump_rollout::{BoxError, Session, Start, WorldModel};

/// Moves all agents except the ego, one iteration after another.
pub trait Traffic {
    /// A short name for tables and reports.
    fn name(&self) -> &str;

    /// Resets the traffic to the present of the recording.
    ///
    /// # Errors
    /// Any reason for which the traffic cannot start there.
    fn begin(&mut self, recording: &Recording) -> Result<Others, BoxError>;

    /// The states of the agents at the next iteration.
    ///
    /// # Errors
    /// Any reason for which the traffic cannot continue.
    fn advance(&mut self, step: &Step<'_>) -> Result<Others, BoxError>;
}

/// An instant of traffic without the ego.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Others {
    /// All agents except the ego.
    pub agents: Vec<Agent>,
    /// The traffic lights.
    pub lights: Vec<Light>,
}

/// The input of traffic at one step of the loop.
#[derive(Clone, Copy, Debug)]
pub struct Step<'a> {
    /// The recording.
    pub recording: &'a Recording,
    /// The iteration that ends.
    pub iteration: usize,
    /// The ego at that iteration.
    pub ego: &'a EgoState,
    /// The ego at the next.
    pub next: &'a EgoState,
    /// The ego's plan.
    pub plan: &'a Trajectory,
    /// The scene up to the iteration that ends.
    pub scene: SceneState<'a>,
}

impl Step<'_> {
    /// Seconds from this iteration to the next.
    pub fn dt(&self) -> f64 {
        (self.next.time_us - self.ego.time_us) as f64 * 1e-6
    }

    /// The logged agents and lights of the next iteration.
    pub fn logged(&self) -> &Frame {
        &self.recording.scenario().future()[self.iteration]
    }
}

/// Log replay; agents do not react to the ego.
#[derive(Clone, Copy, Debug, Default)]
pub struct Replayed;

impl Traffic for Replayed {
    fn name(&self) -> &str {
        "log"
    }

    fn begin(&mut self, recording: &Recording) -> Result<Others, BoxError> {
        let scenario = recording.scenario();
        Ok(all_but(scenario.ego, &scenario.log[scenario.now]))
    }

    fn advance(&mut self, step: &Step<'_>) -> Result<Others, BoxError> {
        Ok(all_but(step.scene.ego, step.logged()))
    }
}

fn all_but(ego: gump_scene::AgentId, frame: &Frame) -> Others {
    let agents = frame.agents().iter().filter(|agent| agent.id != ego);
    Others {
        agents: agents.copied().collect(),
        lights: frame.lights().to_vec(),
    }
}

/// A world model as traffic.
///
/// At every knot of the world, whatever its time step, the world is opened again on the executed
/// history and simulated for one step, given where the ego plans to be; in between, agents move
/// straight to their next positions. Agents that it drops stand still. Lights are those of the log.
///
/// Source: the released observation class of the GUMP paper, which does so at every iteration.
pub struct ImaginedTraffic<'a> {
    world: &'a dyn WorldModel,
    seed: Seed,
    knot: Option<Knot>,
}

struct Knot {
    start: usize,
    stride: usize,
    from: Vec<Agent>,
    to: Frame,
}

impl<'a> ImaginedTraffic<'a> {
    /// Takes the world and the seed of its futures.
    pub fn new(world: &'a dyn WorldModel, seed: Seed) -> Self {
        Self {
            world,
            seed,
            knot: None,
        }
    }

    fn imagine(&self, step: &Step<'_>) -> Result<Knot, BoxError> {
        let seed = self.seed.fork(step.iteration as u64);
        let probe = open(self.world, step.scene, seed)?;
        let stride = (probe.dt() / step.scene.dt).round().max(1.0) as usize;
        // The ego is where it will be if the world is as fast as the loop, else where it intends.
        let time_us = step.ego.time_us + (probe.dt() * 1e6).round() as i64;
        let ego = if stride == 1 {
            *step.next
        } else {
            step.plan.at(time_us.min(step.plan.end_us()))?
        };
        let ego = ego.agent_state(step.recording.vehicle());
        let to = advance(probe, &ego)?;
        let agents = step.scene.now().agents().iter();
        Ok(Knot {
            start: step.iteration,
            stride,
            from: agents.filter(|a| a.id != step.scene.ego).copied().collect(),
            to,
        })
    }
}

fn open<'w>(
    world: &'w dyn WorldModel,
    scene: SceneState<'_>,
    seed: Seed,
) -> Result<Box<dyn Session + 'w>, BoxError> {
    world.open(&[Start {
        scene,
        n_futures: 1,
        seed,
    }])
}

fn advance(mut session: Box<dyn Session + '_>, ego: &AgentState) -> Result<Frame, BoxError> {
    let frames = session.step(Some(&[*ego]))?;
    let found = frames.len();
    frames.into_iter().next().ok_or_else(|| {
        let (who, expected) = ("the world", 1);
        gump_rollout::RolloutError::Count {
            who,
            expected,
            found,
        }
        .into()
    })
}

impl Traffic for ImaginedTraffic<'_> {
    fn name(&self) -> &str {
        self.world.name()
    }

    fn begin(&mut self, recording: &Recording) -> Result<Others, BoxError> {
        self.knot = None;
        Replayed.begin(recording)
    }

    fn advance(&mut self, step: &Step<'_>) -> Result<Others, BoxError> {
        let spent = |knot: &Knot| step.iteration >= knot.start + knot.stride;
        if self.knot.as_ref().is_none_or(spent) {
            self.knot = Some(self.imagine(step)?);
        }
        let knot = self.knot.as_ref().expect("the knot was just imagined");
        let t = (step.iteration + 1 - knot.start) as f64 / knot.stride as f64;
        let agents = knot.from.iter().map(|from| match knot.to.agent(from.id) {
            Some(to) => from.with_state(between(&from.state, &to.state, t)),
            None => from.with_state(AgentState {
                velocity: gump_geometry::DVec2::ZERO,
                ..from.state
            }),
        });
        Ok(Others {
            agents: agents.collect(),
            lights: step.logged().lights().to_vec(),
        })
    }
}

fn between(from: &AgentState, to: &AgentState, t: f64) -> AgentState {
    AgentState {
        pose: from.pose.interpolate(to.pose, t),
        velocity: from.velocity.lerp(to.velocity, t),
    }
}
