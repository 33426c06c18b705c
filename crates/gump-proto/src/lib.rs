//! Messages of the Waymo Open Dataset, written by hand from their published field numbers
//! (package `waymo.open_dataset`, proto2). Lidar and camera fields are not listed and so skipped.
//! Those of nuPlan's planner protocol are in [`nuplan`].
//!
//! Fields are named as in the schema. Optional fields keep proto2's meaning: absent is `None`.
//! Repeated numbers are read packed and unpacked; each is written as in the schema.
//!
//! ```
//! use gump_proto::{ObjectType, Scenario, Track};
//! use prost::Message as _;
//!
//! let car = Track { id: Some(7), object_type: Some(ObjectType::Vehicle as i32), ..Track::default() };
//! let sent = Scenario { tracks: vec![car], ..Scenario::default() };
//! let read = Scenario::decode(sent.encode_to_vec().as_slice())?;
//! assert_eq!(read, sent);
//! assert_eq!(read.tracks[0].object_type(), ObjectType::Vehicle);
//! # Ok::<(), prost::DecodeError>(())
//! ```

pub mod motion;
pub mod nuplan;

/// A recorded scenario of the motion dataset.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are Waymo's")]
pub struct Scenario {
    #[prost(double, repeated, packed = "false", tag = "1")]
    pub timestamps_seconds: Vec<f64>,
    #[prost(message, repeated, tag = "2")]
    pub tracks: Vec<Track>,
    #[prost(int32, repeated, packed = "false", tag = "4")]
    pub objects_of_interest: Vec<i32>,
    #[prost(string, optional, tag = "5")]
    pub scenario_id: Option<String>,
    #[prost(int32, optional, tag = "6")]
    pub sdc_track_index: Option<i32>,
    #[prost(message, repeated, tag = "7")]
    pub dynamic_map_states: Vec<DynamicMapState>,
    #[prost(message, repeated, tag = "8")]
    pub map_features: Vec<MapFeature>,
    #[prost(int32, optional, tag = "10")]
    pub current_time_index: Option<i32>,
    #[prost(message, repeated, tag = "11")]
    pub tracks_to_predict: Vec<RequiredPrediction>,
}

/// One object over time.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are Waymo's")]
pub struct Track {
    #[prost(int32, optional, tag = "1")]
    pub id: Option<i32>,
    #[prost(enumeration = "ObjectType", optional, tag = "2")]
    pub object_type: Option<i32>,
    #[prost(message, repeated, tag = "3")]
    pub states: Vec<ObjectState>,
}

/// Kind of an object.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, prost::Enumeration)]
#[allow(missing_docs, reason = "the names are Waymo's")]
pub enum ObjectType {
    Unset = 0,
    Vehicle = 1,
    Pedestrian = 2,
    Cyclist = 3,
    Other = 4,
}

/// An object at one step: box centre in metres, size in metres, heading in radians, velocity in
/// metres per second.
#[derive(Clone, Copy, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are Waymo's")]
pub struct ObjectState {
    #[prost(double, optional, tag = "2")]
    pub center_x: Option<f64>,
    #[prost(double, optional, tag = "3")]
    pub center_y: Option<f64>,
    #[prost(double, optional, tag = "4")]
    pub center_z: Option<f64>,
    #[prost(float, optional, tag = "5")]
    pub length: Option<f32>,
    #[prost(float, optional, tag = "6")]
    pub width: Option<f32>,
    #[prost(float, optional, tag = "7")]
    pub height: Option<f32>,
    #[prost(float, optional, tag = "8")]
    pub heading: Option<f32>,
    #[prost(float, optional, tag = "9")]
    pub velocity_x: Option<f32>,
    #[prost(float, optional, tag = "10")]
    pub velocity_y: Option<f32>,
    #[prost(bool, optional, tag = "11")]
    pub valid: Option<bool>,
}

/// A track that a benchmark requires to be predicted.
#[derive(Clone, Copy, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are Waymo's")]
pub struct RequiredPrediction {
    #[prost(int32, optional, tag = "1")]
    pub track_index: Option<i32>,
    #[prost(enumeration = "DifficultyLevel", optional, tag = "2")]
    pub difficulty: Option<i32>,
}

/// Difficulty of predicting a track.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, prost::Enumeration)]
#[allow(missing_docs, reason = "the names are Waymo's")]
pub enum DifficultyLevel {
    None = 0,
    Level1 = 1,
    Level2 = 2,
}

/// All signals at one step.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are Waymo's")]
pub struct DynamicMapState {
    #[prost(message, repeated, tag = "1")]
    pub lane_states: Vec<TrafficSignalLaneState>,
}

/// The signal of one lane.
#[derive(Clone, Copy, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are Waymo's")]
pub struct TrafficSignalLaneState {
    #[prost(int64, optional, tag = "1")]
    pub lane: Option<i64>,
    #[prost(enumeration = "SignalState", optional, tag = "2")]
    pub state: Option<i32>,
    #[prost(message, optional, tag = "3")]
    pub stop_point: Option<MapPoint>,
}

/// State of a signal.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, prost::Enumeration)]
#[allow(missing_docs, reason = "the names are Waymo's")]
pub enum SignalState {
    Unknown = 0,
    ArrowStop = 1,
    ArrowCaution = 2,
    ArrowGo = 3,
    Stop = 4,
    Caution = 5,
    Go = 6,
    FlashingStop = 7,
    FlashingCaution = 8,
}

/// One element of the map.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are Waymo's")]
pub struct MapFeature {
    #[prost(int64, optional, tag = "1")]
    pub id: Option<i64>,
    #[prost(oneof = "FeatureData", tags = "3, 4, 5, 7, 8, 9, 10")]
    pub feature_data: Option<FeatureData>,
}

/// Data of a map element, by kind.
#[derive(Clone, PartialEq, prost::Oneof)]
#[allow(missing_docs, reason = "the names are Waymo's")]
pub enum FeatureData {
    #[prost(message, tag = "3")]
    Lane(LaneCenter),
    #[prost(message, tag = "4")]
    RoadLine(RoadLine),
    #[prost(message, tag = "5")]
    RoadEdge(RoadEdge),
    #[prost(message, tag = "7")]
    StopSign(StopSign),
    #[prost(message, tag = "8")]
    Crosswalk(Outline),
    #[prost(message, tag = "9")]
    SpeedBump(Outline),
    #[prost(message, tag = "10")]
    Driveway(Outline),
}

/// A point in the world, metres.
#[derive(Clone, Copy, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are Waymo's")]
pub struct MapPoint {
    #[prost(double, optional, tag = "1")]
    pub x: Option<f64>,
    #[prost(double, optional, tag = "2")]
    pub y: Option<f64>,
    #[prost(double, optional, tag = "3")]
    pub z: Option<f64>,
}

/// A lane's centre line and links.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are Waymo's")]
pub struct LaneCenter {
    #[prost(double, optional, tag = "1")]
    pub speed_limit_mph: Option<f64>,
    #[prost(enumeration = "LaneType", optional, tag = "2")]
    pub r#type: Option<i32>,
    #[prost(bool, optional, tag = "3")]
    pub interpolating: Option<bool>,
    #[prost(message, repeated, tag = "8")]
    pub polyline: Vec<MapPoint>,
    #[prost(int64, repeated, packed = "true", tag = "9")]
    pub entry_lanes: Vec<i64>,
    #[prost(int64, repeated, packed = "true", tag = "10")]
    pub exit_lanes: Vec<i64>,
    #[prost(message, repeated, tag = "11")]
    pub left_neighbors: Vec<LaneNeighbor>,
    #[prost(message, repeated, tag = "12")]
    pub right_neighbors: Vec<LaneNeighbor>,
    #[prost(message, repeated, tag = "13")]
    pub left_boundaries: Vec<BoundarySegment>,
    #[prost(message, repeated, tag = "14")]
    pub right_boundaries: Vec<BoundarySegment>,
}

/// Kind of a lane.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, prost::Enumeration)]
#[allow(missing_docs, reason = "the names are Waymo's")]
pub enum LaneType {
    Undefined = 0,
    Freeway = 1,
    SurfaceStreet = 2,
    BikeLane = 3,
}

/// A stretch of a lane that runs along a line or edge; indices into the lane's points.
#[derive(Clone, Copy, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are Waymo's")]
pub struct BoundarySegment {
    #[prost(int32, optional, tag = "1")]
    pub lane_start_index: Option<i32>,
    #[prost(int32, optional, tag = "2")]
    pub lane_end_index: Option<i32>,
    #[prost(int64, optional, tag = "3")]
    pub boundary_feature_id: Option<i64>,
    #[prost(enumeration = "RoadLineType", optional, tag = "4")]
    pub boundary_type: Option<i32>,
}

/// A lane of the same direction beside this one; indices into the two lanes' points.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are Waymo's")]
pub struct LaneNeighbor {
    #[prost(int64, optional, tag = "1")]
    pub feature_id: Option<i64>,
    #[prost(int32, optional, tag = "2")]
    pub self_start_index: Option<i32>,
    #[prost(int32, optional, tag = "3")]
    pub self_end_index: Option<i32>,
    #[prost(int32, optional, tag = "4")]
    pub neighbor_start_index: Option<i32>,
    #[prost(int32, optional, tag = "5")]
    pub neighbor_end_index: Option<i32>,
    #[prost(message, repeated, tag = "6")]
    pub boundaries: Vec<BoundarySegment>,
}

/// A border of the road.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are Waymo's")]
pub struct RoadEdge {
    #[prost(enumeration = "RoadEdgeType", optional, tag = "1")]
    pub r#type: Option<i32>,
    #[prost(message, repeated, tag = "2")]
    pub polyline: Vec<MapPoint>,
}

/// Kind of a road edge.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, prost::Enumeration)]
#[allow(missing_docs, reason = "the names are Waymo's")]
pub enum RoadEdgeType {
    Unknown = 0,
    Boundary = 1,
    Median = 2,
}

/// Paint on the road.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are Waymo's")]
pub struct RoadLine {
    #[prost(enumeration = "RoadLineType", optional, tag = "1")]
    pub r#type: Option<i32>,
    #[prost(message, repeated, tag = "2")]
    pub polyline: Vec<MapPoint>,
}

/// Paint of a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, prost::Enumeration)]
#[allow(missing_docs, reason = "the names are Waymo's")]
pub enum RoadLineType {
    Unknown = 0,
    BrokenSingleWhite = 1,
    SolidSingleWhite = 2,
    SolidDoubleWhite = 3,
    BrokenSingleYellow = 4,
    BrokenDoubleYellow = 5,
    SolidSingleYellow = 6,
    SolidDoubleYellow = 7,
    PassingDoubleYellow = 8,
}

/// A stop sign and the lanes it rules.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are Waymo's")]
pub struct StopSign {
    #[prost(int64, repeated, packed = "false", tag = "1")]
    pub lane: Vec<i64>,
    #[prost(message, optional, tag = "2")]
    pub position: Option<MapPoint>,
}

/// The outline of a crosswalk, speed bump or driveway.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are Waymo's")]
pub struct Outline {
    #[prost(message, repeated, tag = "1")]
    pub polygon: Vec<MapPoint>,
}

/// One agent of an imagined future: one value per step, metres and radians.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are Waymo's")]
pub struct SimulatedTrajectory {
    #[prost(float, repeated, packed = "true", tag = "2")]
    pub center_x: Vec<f32>,
    #[prost(float, repeated, packed = "true", tag = "3")]
    pub center_y: Vec<f32>,
    #[prost(float, repeated, packed = "true", tag = "4")]
    pub center_z: Vec<f32>,
    #[prost(float, repeated, packed = "true", tag = "5")]
    pub heading: Vec<f32>,
    #[prost(int32, optional, tag = "6")]
    pub object_id: Option<i32>,
    #[prost(float, repeated, packed = "true", tag = "7")]
    pub width: Vec<f32>,
    #[prost(float, repeated, packed = "true", tag = "8")]
    pub length: Vec<f32>,
    #[prost(float, repeated, packed = "true", tag = "9")]
    pub height: Vec<f32>,
    #[prost(enumeration = "ObjectType", optional, tag = "10")]
    pub object_type: Option<i32>,
    #[prost(bool, repeated, packed = "true", tag = "11")]
    pub valid: Vec<bool>,
}

/// One imagined future of all agents.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are Waymo's")]
pub struct JointScene {
    #[prost(message, repeated, tag = "1")]
    pub simulated_trajectories: Vec<SimulatedTrajectory>,
}

/// All imagined futures of one scenario.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are Waymo's")]
pub struct ScenarioRollouts {
    #[prost(string, optional, tag = "1")]
    pub scenario_id: Option<String>,
    #[prost(message, repeated, tag = "2")]
    pub joint_scenes: Vec<JointScene>,
}

/// A shard of a challenge submission: futures of many scenarios and their authors.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are Waymo's")]
pub struct SimAgentsChallengeSubmission {
    #[prost(message, repeated, tag = "1")]
    pub scenario_rollouts: Vec<ScenarioRollouts>,
    #[prost(enumeration = "SubmissionType", optional, tag = "2")]
    pub submission_type: Option<i32>,
    #[prost(string, optional, tag = "3")]
    pub account_name: Option<String>,
    #[prost(string, optional, tag = "4")]
    pub unique_method_name: Option<String>,
    #[prost(string, repeated, tag = "5")]
    pub authors: Vec<String>,
    #[prost(string, optional, tag = "6")]
    pub affiliation: Option<String>,
    #[prost(string, optional, tag = "7")]
    pub description: Option<String>,
    #[prost(string, optional, tag = "8")]
    pub method_link: Option<String>,
    #[prost(bool, optional, tag = "9")]
    pub uses_lidar_data: Option<bool>,
    #[prost(bool, optional, tag = "10")]
    pub uses_camera_data: Option<bool>,
    #[prost(bool, optional, tag = "11")]
    pub uses_public_model_pretraining: Option<bool>,
    #[prost(string, optional, tag = "12")]
    pub num_model_parameters: Option<String>,
    #[prost(string, repeated, tag = "13")]
    pub public_model_names: Vec<String>,
    #[prost(bool, optional, tag = "14")]
    pub acknowledge_complies_with_closed_loop_requirement: Option<bool>,
}

/// Challenge that a submission is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, prost::Enumeration)]
#[allow(missing_docs, reason = "the names are Waymo's")]
pub enum SubmissionType {
    Unknown = 0,
    SimAgentsSubmission = 1,
}
