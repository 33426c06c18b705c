//! Messages of nuPlan's planner protocol, written by hand from their published field numbers
//! (package `challenge_protocol`, proto3): service `DetectionTracksChallenge` with the calls
//! `InitializePlanner`, which takes [`PlannerInitializationLight`] and gives [`Empty`], and
//! `ComputeTrajectory`, which takes [`PlannerInput`] and gives [`Trajectory`].
//!
//! Metres, seconds, radians; poses of the ego are those of its rear axle, in the world frame. The
//! protocol has 32-bit numbers, 6 cm apart 1,000 km from the origin and 25 cm at 4,000 km.

/// Path of the service; calls are at `/PACKAGE.SERVICE/CALL`.
pub const SERVICE: &str = "/challenge_protocol.DetectionTracksChallenge";

/// A message without fields.
#[derive(Clone, Copy, PartialEq, prost::Message)]
pub struct Empty {}

/// The mission: route, goal and map.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are nuPlan's")]
pub struct PlannerInitializationLight {
    #[prost(string, repeated, tag = "1")]
    pub route_roadblock_ids: Vec<String>,
    #[prost(message, optional, tag = "2")]
    pub mission_goal: Option<StateSe2>,
    #[prost(string, tag = "3")]
    pub map_name: String,
}

/// One step of the simulation.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are nuPlan's")]
pub struct PlannerInput {
    #[prost(message, optional, tag = "1")]
    pub simulation_iteration: Option<SimulationIteration>,
    #[prost(message, optional, tag = "2")]
    pub simulation_history_buffer: Option<SimulationHistoryBuffer>,
    #[prost(message, repeated, tag = "3")]
    pub traffic_light_data: Vec<TrafficLightStatusData>,
}

/// Time and index of a step.
#[derive(Clone, Copy, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are nuPlan's")]
pub struct SimulationIteration {
    #[prost(int64, tag = "1")]
    pub time_us: i64,
    #[prost(int32, tag = "2")]
    pub index: i32,
}

/// History since the last call, oldest first: pickled Python objects, an `EgoState` and a
/// `DetectionsTracks` of nuplan-devkit for each moment.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are nuPlan's")]
pub struct SimulationHistoryBuffer {
    #[prost(bytes = "vec", repeated, tag = "1")]
    pub ego_states: Vec<Vec<u8>>,
    #[prost(bytes = "vec", repeated, tag = "2")]
    pub observations: Vec<Vec<u8>>,
    #[prost(float, optional, tag = "3")]
    pub sample_interval: Option<f32>,
}

/// The light of one lane.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are nuPlan's")]
pub struct TrafficLightStatusData {
    #[prost(message, optional, tag = "1")]
    pub status: Option<TrafficLightStatusType>,
    #[prost(int32, tag = "2")]
    pub lane_connector_id: i32,
    #[prost(int64, tag = "3")]
    pub timestamp: i64,
}

/// GREEN, YELLOW, RED or UNKNOWN.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are nuPlan's")]
pub struct TrafficLightStatusType {
    #[prost(string, tag = "1")]
    pub status_name: String,
}

/// A pose.
#[derive(Clone, Copy, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are nuPlan's")]
pub struct StateSe2 {
    #[prost(float, tag = "1")]
    pub x: f32,
    #[prost(float, tag = "2")]
    pub y: f32,
    #[prost(float, tag = "3")]
    pub heading: f32,
}

/// A velocity or an acceleration in the vehicle's own frame, x ahead.
#[derive(Clone, Copy, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are nuPlan's")]
pub struct StateVector2D {
    #[prost(float, tag = "1")]
    pub x: f32,
    #[prost(float, tag = "2")]
    pub y: f32,
}

/// The ego at its rear axle.
#[derive(Clone, Copy, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are nuPlan's")]
pub struct EgoState {
    #[prost(message, optional, tag = "1")]
    pub rear_axle_pose: Option<StateSe2>,
    #[prost(message, optional, tag = "2")]
    pub rear_axle_velocity_2d: Option<StateVector2D>,
    #[prost(message, optional, tag = "3")]
    pub rear_axle_acceleration_2d: Option<StateVector2D>,
    #[prost(float, tag = "4")]
    pub tire_steering_angle: f32,
    #[prost(int64, tag = "5")]
    pub time_us: i64,
    #[prost(float, tag = "6")]
    pub angular_vel: f32,
    #[prost(float, tag = "7")]
    pub angular_accel: f32,
}

/// The plan: states that the ego is to follow.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are nuPlan's")]
pub struct Trajectory {
    #[prost(message, repeated, tag = "1")]
    pub ego_states: Vec<EgoState>,
}
