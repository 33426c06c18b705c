//! Inputs of scoring: a drive, the expert's drive and the map.

use gump_geometry::{DVec2, OrientedBox};
use gump_scene::{Agent, AgentId, EgoState, Frame, MapGraph, Rollout, Scenario, VehicleParameters};

use super::comfort::Motion;

/// One executed step of a simulation.
#[derive(Clone, Debug, Default)]
pub struct Sample {
    /// The ego at the start of the step, and the time.
    pub ego: EgoState,
    /// The other agents and the lights at that time. The ego may be among the agents, see
    /// [`SimulationHistory::ego`].
    pub frame: Frame,
    /// The plan of this step, with increasing times; only open-loop scores use it, so it may be
    /// empty otherwise.
    pub plan: Vec<EgoState>,
}

/// A drive to score, with that of the expert.
///
/// A simulation of N iterations has N - 1 samples (no action follows the last state) and N states
/// of the expert; the metrics do not depend on that.
#[derive(Clone, Copy, Debug)]
pub struct SimulationHistory<'a> {
    /// Executed steps in order of time.
    pub samples: &'a [Sample],
    /// The recorded driver's states over the same time, from the same start.
    pub expert: &'a [EgoState],
    /// The map. Roadblocks, outlines and limits are used where there are any; see [`super::score`].
    pub map: &'a MapGraph,
    /// The ego's id, if the frames contain it; it does not collide with itself.
    pub ego: Option<AgentId>,
    /// The ego's extents.
    pub vehicle: VehicleParameters,
}

impl<'a> SimulationHistory<'a> {
    /// Times, microseconds.
    pub(crate) fn times_us(&self) -> Vec<i64> {
        self.samples.iter().map(|s| s.ego.time_us).collect()
    }

    /// The ego's box in one sample.
    pub(crate) fn footprint(&self, sample: &Sample) -> OrientedBox {
        self.vehicle.footprint(sample.ego.rear_axle)
    }

    /// Box centres of the ego.
    pub(crate) fn centres(&self) -> Vec<DVec2> {
        let states = self.samples.iter().map(|s| &s.ego);
        centres(&self.vehicle, states)
    }

    /// Box centres of the expert.
    pub(crate) fn expert_centres(&self) -> Vec<DVec2> {
        centres(&self.vehicle, self.expert)
    }

    /// All agents except the ego in one sample.
    pub(crate) fn others(&self, sample: &'a Sample) -> impl Iterator<Item = &'a Agent> {
        let ego = self.ego;
        let agents = sample.frame.agents().iter();
        agents.filter(move |agent| Some(agent.id) != ego)
    }

    /// The motion that comfort is evaluated on.
    pub(crate) fn motion(&self) -> Motion {
        let states: Vec<EgoState> = self.samples.iter().map(|s| s.ego).collect();
        Motion::of(&self.vehicle, &states)
    }
}

/// The motion of an agent in frames `dt` apart, as far as it is present, for comfort.
pub(crate) fn motion_of<'a>(
    frames: impl Iterator<Item = &'a Frame>,
    agent: AgentId,
    dt: f64,
) -> Motion {
    let vehicle = VehicleParameters::PACIFICA;
    Motion::of(&vehicle, &ego_states(&vehicle, agent, dt, None, frames))
}

/// A simulated drive and the logged one as inputs of scoring; see [`RolloutHistory::new`].
#[derive(Clone, Debug)]
pub struct RolloutHistory {
    samples: Vec<Sample>,
    expert: Vec<EgoState>,
    ego: AgentId,
    vehicle: VehicleParameters,
}

impl RolloutHistory {
    /// Prepares a rollout and the log it started from for scoring, including the start, as far as
    /// the ego is present.
    ///
    /// Box centres are converted to rear axles by the proportions of nuPlan's car. Accelerations
    /// are backward differences of velocities, and yaw rates are 0, as where nuPlan reads a log;
    /// comfort smooths the former and derives the latter from headings.
    pub fn new(rollout: &Rollout, scenario: &Scenario) -> Self {
        let ego = rollout.ego();
        let vehicle = rollout
            .start()
            .agent(ego)
            .map_or(VehicleParameters::PACIFICA, vehicle_of);
        let last_before = rollout.history().len().checked_sub(2);
        let before = last_before.and_then(|i| rollout.history()[i].agent(ego));
        let imagined = std::iter::once(rollout.start()).chain(rollout.imagined());
        let states = ego_states(&vehicle, ego, rollout.dt(), before, imagined.clone());
        let samples = states.into_iter().zip(imagined).map(|(ego, frame)| Sample {
            ego,
            frame: frame.clone(),
            plan: Vec::new(),
        });
        let before = scenario.now.checked_sub(1);
        let before = before.and_then(|i| scenario.log[i].agent(ego));
        let logged = scenario.log[scenario.now..].iter();
        Self {
            samples: samples.collect(),
            expert: ego_states(&vehicle, ego, scenario.dt, before, logged),
            ego,
            vehicle,
        }
    }

    /// The drive, on a map.
    pub fn on<'a>(&'a self, map: &'a MapGraph) -> SimulationHistory<'a> {
        SimulationHistory {
            samples: &self.samples,
            expert: &self.expert,
            map,
            ego: Some(self.ego),
            vehicle: self.vehicle,
        }
    }
}

/// The extents of an agent with the axles of nuPlan's car, in proportion.
pub fn vehicle_of(agent: &Agent) -> VehicleParameters {
    let pacifica = VehicleParameters::PACIFICA;
    let scale = agent.length / pacifica.length();
    VehicleParameters {
        width: agent.width,
        front_length: pacifica.front_length * scale,
        rear_length: pacifica.rear_length * scale,
        wheel_base: pacifica.wheel_base * scale,
        center_of_gravity: pacifica.center_of_gravity * scale,
        height: agent.height,
    }
}

/// The ego of consecutive frames at its rear axle, until it is first absent.
fn ego_states<'a>(
    vehicle: &VehicleParameters,
    ego: AgentId,
    dt: f64,
    before: Option<&'a Agent>,
    frames: impl Iterator<Item = &'a Frame>,
) -> Vec<EgoState> {
    let mut last = before;
    let mut states = Vec::new();
    for (i, agent) in frames.map_while(|frame| frame.agent(ego)).enumerate() {
        let Agent { state, .. } = agent;
        let gained = last.map_or(DVec2::ZERO, |last| state.velocity - last.state.velocity);
        let into_vehicle = |vector: DVec2| DVec2::from_angle(-state.pose.heading).rotate(vector);
        states.push(EgoState {
            time_us: (i as f64 * dt * 1e6).round() as i64,
            rear_axle: vehicle.rear_axle_of(state.pose),
            velocity: into_vehicle(state.velocity),
            acceleration: into_vehicle(gained / dt),
            ..EgoState::default()
        });
        last = Some(agent);
    }
    // Without a frame before, the first difference is the best guess of the first acceleration.
    if before.is_none() && states.len() > 1 {
        states[0].acceleration = states[1].acceleration;
    }
    states
}

fn centres<'a>(
    vehicle: &VehicleParameters,
    states: impl IntoIterator<Item = &'a EgoState>,
) -> Vec<DVec2> {
    let centre = |state: &EgoState| vehicle.center_of(state.rear_axle).position;
    states.into_iter().map(centre).collect()
}
