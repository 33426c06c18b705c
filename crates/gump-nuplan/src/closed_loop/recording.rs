//! Recordings: scenarios with the ego as a vehicle, from which closed loops start.

use gump_geometry::{Pose, angle_difference};
use gump_scene::{Agent, EgoState, Scenario, VehicleParameters};

use super::PlannerInitialization;
use gump_rollout::{RecordingDefect, RolloutError};

/// A recorded drive: traffic, and the ego at its rear axle in every frame.
#[derive(Clone, Debug)]
pub struct Recording {
    scenario: Scenario,
    ego: Vec<EgoState>,
    vehicle: VehicleParameters,
    goal: Option<Pose>,
}

impl Recording {
    /// Takes a scenario with the ego's states as recorded, one per frame of the log.
    ///
    /// # Errors
    /// [`RolloutError::Recording`] if there are more or fewer states than frames, or if time stamps
    /// do not increase; [`RolloutError::NotFinite`] for a state that is not finite.
    pub fn new(
        scenario: Scenario,
        ego: Vec<EgoState>,
        vehicle: VehicleParameters,
        goal: Option<Pose>,
    ) -> Result<Self, RolloutError> {
        if ego.len() != scenario.log.len() {
            let (frames, states) = (scenario.log.len(), ego.len());
            return Err(RecordingDefect::StateCount { frames, states }.into());
        }
        if let Some(i) = ego.windows(2).position(|p| p[1].time_us <= p[0].time_us) {
            return Err(RecordingDefect::TimeOrder { frame: i + 1 }.into());
        }
        if !ego.iter().all(EgoState::is_finite) {
            return Err(RolloutError::NotFinite {
                who: "the recording",
            });
        }
        Ok(Self {
            scenario,
            ego,
            vehicle,
            goal,
        })
    }

    /// Derives the vehicle of a scenario that only has box centres: proportions of nuPlan's car,
    /// accelerations from differences.
    ///
    /// The log is cut after the last frame that has the ego, and before the present at the last one
    /// that lacks it.
    ///
    /// # Errors
    /// [`RolloutError::Recording`] if the ego is absent in the present.
    pub fn of_boxes(mut scenario: Scenario) -> Result<Self, RolloutError> {
        let id = scenario.ego;
        let Some(car) = scenario.log[scenario.now].agent(id).copied() else {
            return Err(RecordingDefect::NoEgo { ego: id }.into());
        };
        let has_ego = |frame: &gump_scene::Frame| frame.agent(id).is_some();
        let before = scenario.log[..scenario.now]
            .iter()
            .rev()
            .take_while(|f| has_ego(f))
            .count();
        let after = scenario.log[scenario.now..]
            .iter()
            .take_while(|f| has_ego(f))
            .count();
        scenario.log.truncate(scenario.now + after);
        scenario.log.drain(..scenario.now - before);
        scenario.now = before;
        let vehicle = vehicle_like(&car);
        let ego = ego_states(&scenario, &vehicle);
        let goal = ego.last().map(|state| state.rear_axle);
        Self::new(scenario, ego, vehicle, goal)
    }

    /// The recorded traffic.
    pub fn scenario(&self) -> &Scenario {
        &self.scenario
    }

    /// The ego's extents.
    pub fn vehicle(&self) -> &VehicleParameters {
        &self.vehicle
    }

    /// The recorded ego from the present on.
    pub fn expert(&self) -> &[EgoState] {
        &self.ego[self.scenario.now..]
    }

    /// The recorded ego before the present, oldest first.
    pub fn past(&self) -> &[EgoState] {
        &self.ego[..self.scenario.now]
    }

    /// The recorded ego `iteration` frames after the present.
    ///
    /// # Panics
    /// If the recording is shorter.
    pub fn ego_at(&self, iteration: usize) -> &EgoState {
        &self.expert()[iteration]
    }

    /// The driver's initialization.
    pub fn initialization(&self) -> PlannerInitialization<'_> {
        PlannerInitialization {
            map: &self.scenario.map,
            route: self.scenario.route.as_ref(),
            goal: self.goal,
            vehicle: self.vehicle,
        }
    }

    /// Iterations of a loop of at most `seconds`.
    ///
    /// # Errors
    /// [`RolloutError::Recording`] if fewer than two are left,
    /// [`RolloutError::Duration`] for a duration that is not a positive number.
    pub fn n_iterations(&self, seconds: f64) -> Result<usize, RolloutError> {
        if !(seconds > 0.0 && seconds.is_finite()) {
            return Err(RolloutError::Duration(seconds));
        }
        let requested = (seconds / self.scenario.dt).round() as usize;
        let n = requested.min(self.scenario.future().len());
        if n < 2 {
            let frames = self.scenario.future().len();
            return Err(RecordingDefect::TooShort { frames }.into());
        }
        Ok(n)
    }

    /// The ego as an agent of the scene.
    pub fn ego_agent(&self, state: &EgoState) -> Agent {
        let present = &self.scenario.log[self.scenario.now];
        let agent = present
            .agent(self.scenario.ego)
            .expect("the ego is present now");
        agent.with_state(state.agent_state(&self.vehicle))
    }
}

/// A vehicle of the agent's size with the proportions of nuPlan's.
fn vehicle_like(agent: &Agent) -> VehicleParameters {
    let car = VehicleParameters::PACIFICA;
    let scale = agent.length / car.length();
    VehicleParameters {
        width: agent.width,
        front_length: car.front_length * scale,
        rear_length: car.rear_length * scale,
        wheel_base: car.wheel_base * scale,
        center_of_gravity: car.center_of_gravity * scale,
        height: agent.height,
    }
}

fn ego_states(scenario: &Scenario, vehicle: &VehicleParameters) -> Vec<EgoState> {
    let centers: Vec<_> = scenario
        .log
        .iter()
        .filter_map(|frame| frame.agent(scenario.ego))
        .map(|agent| agent.state)
        .collect();
    let n = centers.len();
    let speed_at = |i: usize| centers[i].velocity.dot(centers[i].pose.direction());
    (0..n)
        .map(|i| {
            // One-sided at the ends; nothing at all for a single frame.
            let (a, b) = (i.saturating_sub(1), (i + 1).min(n - 1));
            let elapsed = ((b - a) as f64 * scenario.dt).max(scenario.dt);
            let turned = angle_difference(centers[b].pose.heading, centers[a].pose.heading);
            let yaw_rate = turned / elapsed;
            let speed = speed_at(i);
            EgoState {
                time_us: (i as f64 * scenario.dt * 1e6).round() as i64,
                rear_axle: vehicle.rear_axle_of(centers[i].pose),
                velocity: gump_geometry::dvec2(speed, 0.0),
                acceleration: gump_geometry::dvec2((speed_at(b) - speed_at(a)) / elapsed, 0.0),
                // Nearly standing, the quotient of turning and speed is noise. Bounds by hand.
                steering_angle: if speed.abs() > 0.5 {
                    (yaw_rate * vehicle.wheel_base / speed)
                        .atan()
                        .clamp(-1.0, 1.0)
                } else {
                    0.0
                },
                yaw_rate,
                ..EgoState::default()
            }
        })
        .collect()
}
