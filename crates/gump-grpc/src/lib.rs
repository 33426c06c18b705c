//! Planners in other processes, by nuPlan's planner protocol.
//!
//! [`RemoteDriver`] follows the plans of a server at `HOST:PORT`. The protocol is the one that
//! nuPlan's challenges called planners by (gRPC service `DetectionTracksChallenge`): the initialization is
//! sent once per drive, and at every step a trajectory is requested. A server plans for one drive
//! at a time, so one drive has to end before the next begins. nuplan-devkit's own servicer and
//! `python/nuplan_planner.py` are such servers.
//!
//! The history is sent as pickled objects of nuplan-devkit, which open wherever the devkit is
//! installed.
//!
//! ```
//! use gump_grpc::RemoteDriver;
//! use gump_nuplan::closed_loop::Driver;
//!
//! // On a map that is not nuPlan's; a step may take 30 s.
//! let driver = RemoteDriver::new("127.0.0.1:50051", "", None);
//! assert_eq!(driver.name(), "grpc:127.0.0.1:50051");
//! ```

mod client;
mod pickle;
#[cfg(test)]
mod tests;

use std::time::Duration;

use gump_geometry::{Pose, dvec2};
use gump_nuplan::closed_loop::{Driver, PlannerInitialization, PlannerInput};
use gump_nuplan::tracking::Trajectory;
use gump_planner::{Candidate, Explain};
use gump_proto::nuplan as proto;
use gump_rollout::BoxError;
use gump_scene::{EgoState, LightState, VehicleParameters};

use self::client::Client;

/// Time limit for loading maps and weights before the drive. Chosen by hand.
const TO_INITIALIZE: Duration = Duration::from_secs(60);
/// Time limit per step if no budget is set; the challenges allowed one second, and slower machines
/// should not fail. Chosen by hand.
const TO_PLAN: Duration = Duration::from_secs(30);
/// Moments that nuPlan's planners see: the present and 2.1 s before it, at 10 Hz, as
/// nuplan-devkit's history buffer holds.
const BUFFER: usize = 22;

/// Why a remote planner returned no plan.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RemoteError {
    /// No planner could be reached.
    #[error("expected a planner at {address}, found none: {what}")]
    Unreachable {
        /// The address, `HOST:PORT`.
        address: String,
        /// The error of the network.
        what: String,
    },
    /// The answer exceeded the time limit.
    #[error("expected an answer to {call} within {seconds} s, found none")]
    Late {
        /// Name of the call.
        call: &'static str,
        /// The time limit, seconds.
        seconds: f64,
    },
    /// The call failed with a gRPC status.
    #[error("expected an answer to {call}, found the error {code}: {message}")]
    Refused {
        /// Name of the call.
        call: &'static str,
        /// The gRPC status code.
        code: String,
        /// The message of the status, on one line.
        message: String,
    },
    /// A state without a pose.
    #[error("state {state} of the trajectory: expected a rear_axle_pose, found none")]
    NoPose {
        /// Index of the state.
        state: usize,
    },
    /// A trajectory that does not cover the next step.
    #[error(
        "expected a trajectory over {now_us} to {next_us} µs, found one over {from_us} to {to_us}"
    )]
    OtherTime {
        /// The present.
        now_us: i64,
        /// The next step.
        next_us: i64,
        /// Time of its first state.
        from_us: i64,
        /// Time of its last state.
        to_us: i64,
    },
    /// A light whose lane the protocol has no number for.
    #[error(
        "the light of lane {0}: expected a lane below 2147483648, as the protocol has 32 bits for it"
    )]
    Lane(i64),
    /// A plan was requested before the initialization was set.
    #[error("the planner was asked to drive before it was initialized")]
    NotInitialized,
}

/// A driver that follows the plans of another process.
pub struct RemoteDriver {
    name: String,
    address: String,
    map_name: String,
    to_plan: Duration,
    begun: Option<(Client, VehicleParameters)>,
}

impl RemoteDriver {
    /// The planner at `HOST:PORT`, for a drive on nuPlan's map of that name (empty for maps that are
    /// not nuPlan's); a step may take `limit`, 30 s without one.
    pub fn new(address: &str, map_name: &str, limit: Option<Duration>) -> Self {
        Self {
            name: format!("grpc:{address}"),
            address: address.into(),
            map_name: map_name.into(),
            to_plan: limit.unwrap_or(TO_PLAN),
            begun: None,
        }
    }
}

impl Driver for RemoteDriver {
    fn name(&self) -> &str {
        &self.name
    }

    fn start(&mut self, initialization: &PlannerInitialization<'_>) -> Result<(), BoxError> {
        let mut client = Client::connect(&self.address)?;
        let message = initialization_message(initialization, &self.map_name);
        let proto::Empty {} = client.call("InitializePlanner", message, TO_INITIALIZE)?;
        self.begun = Some((client, initialization.vehicle));
        Ok(())
    }

    fn drive(&mut self, moment: &PlannerInput<'_>) -> Result<Trajectory, BoxError> {
        let (client, vehicle) = self.begun.as_mut().ok_or(RemoteError::NotInitialized)?;
        let message = input(moment, vehicle)?;
        let plan: proto::Trajectory = client.call("ComputeTrajectory", message, self.to_plan)?;
        trajectory(&plan, moment)
    }
}

impl Explain for RemoteDriver {
    fn candidates(&self) -> Vec<Candidate> {
        vec![Candidate::alone("what the planner said", Vec::new())]
    }
}

fn initialization_message(
    initialization: &PlannerInitialization<'_>,
    map_name: &str,
) -> proto::PlannerInitializationLight {
    let blocks = initialization
        .route
        .map(|route| route.roadblocks.as_slice());
    let blocks = blocks.unwrap_or_default().iter();
    proto::PlannerInitializationLight {
        route_roadblock_ids: blocks.map(|block| block.0.to_string()).collect(),
        mission_goal: initialization.goal.map(|goal| proto::StateSe2 {
            x: goal.position.x as f32,
            y: goal.position.y as f32,
            heading: goal.heading as f32,
        }),
        map_name: map_name.into(),
    }
}

/// The input of a step: the past and present in the first step, then the present alone.
fn input(
    moment: &PlannerInput<'_>,
    vehicle: &VehicleParameters,
) -> Result<proto::PlannerInput, RemoteError> {
    let first = moment.iteration == 0;
    let n = match first {
        true => BUFFER
            .min(moment.past.len() + 1)
            .min(moment.scene.history.len()),
        false => 1,
    };
    let past = &moment.past[moment.past.len() + 1 - n..];
    let frames = &moment.scene.history[moment.scene.history.len() - n..];
    let egos = past.iter().chain([moment.ego]);
    let observed = frames.iter().zip(egos.clone());
    let history = proto::SimulationHistoryBuffer {
        ego_states: egos.map(|ego| pickle::ego_state(ego, vehicle)).collect(),
        observations: observed
            .map(|(frame, ego)| pickle::detections(frame, moment.scene.ego, ego.time_us))
            .collect(),
        sample_interval: first.then_some(moment.scene.dt as f32),
    };
    Ok(proto::PlannerInput {
        simulation_iteration: Some(proto::SimulationIteration {
            time_us: moment.ego.time_us,
            index: moment.iteration as i32,
        }),
        simulation_history_buffer: Some(history),
        traffic_light_data: lights(moment)?,
    })
}

fn lights(moment: &PlannerInput<'_>) -> Result<Vec<proto::TrafficLightStatusData>, RemoteError> {
    let lights = moment.scene.now().lights().iter();
    let lights = lights.map(|light| {
        let name = match light.state {
            LightState::Green => "GREEN",
            LightState::Yellow => "YELLOW",
            LightState::Red => "RED",
            LightState::Unknown => "UNKNOWN",
        };
        let lane = light.lane.0;
        Ok(proto::TrafficLightStatusData {
            status: Some(proto::TrafficLightStatusType {
                status_name: name.into(),
            }),
            lane_connector_id: i32::try_from(lane).map_err(|_| RemoteError::Lane(lane))?,
            timestamp: moment.ego.time_us,
        })
    });
    lights.collect()
}

/// Converts a plan to a trajectory that covers the next step.
fn trajectory(plan: &proto::Trajectory, moment: &PlannerInput<'_>) -> Result<Trajectory, BoxError> {
    let states = plan.ego_states.iter().enumerate();
    let states = states.map(|(i, state)| ego_state(i, state));
    let trajectory = Trajectory::new(states.collect::<Result<_, _>>()?)?;
    let now_us = moment.ego.time_us;
    let next_us = now_us + (moment.scene.dt * 1e6).round() as i64;
    if trajectory.start_us() > now_us || trajectory.end_us() < next_us {
        let other = RemoteError::OtherTime {
            now_us,
            next_us,
            from_us: trajectory.start_us(),
            to_us: trajectory.end_us(),
        };
        return Err(other.into());
    }
    Ok(trajectory)
}

fn ego_state(i: usize, state: &proto::EgoState) -> Result<EgoState, RemoteError> {
    let pose = state
        .rear_axle_pose
        .ok_or(RemoteError::NoPose { state: i })?;
    let vector = |vector: Option<proto::StateVector2D>| {
        let vector = vector.unwrap_or_default();
        dvec2(vector.x.into(), vector.y.into())
    };
    Ok(EgoState {
        time_us: state.time_us,
        rear_axle: Pose::new(pose.x.into(), pose.y.into(), pose.heading.into()),
        velocity: vector(state.rear_axle_velocity_2d),
        acceleration: vector(state.rear_axle_acceleration_2d),
        steering_angle: state.tire_steering_angle.into(),
        steering_rate: 0.0,
        yaw_rate: state.angular_vel.into(),
        yaw_acceleration: state.angular_accel.into(),
    })
}
