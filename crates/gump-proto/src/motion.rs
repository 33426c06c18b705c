//! Messages of the motion and interaction prediction challenges (package `waymo.open_dataset`,
//! proto2), written by hand from their published field numbers.

/// Positions of one object at 2 Hz, metres; the first is half a second after the present.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are Waymo's")]
pub struct Trajectory {
    #[prost(float, repeated, packed = "true", tag = "2")]
    pub center_x: Vec<f32>,
    #[prost(float, repeated, packed = "true", tag = "3")]
    pub center_y: Vec<f32>,
}

/// One way an object may go.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are Waymo's")]
pub struct ScoredTrajectory {
    #[prost(message, optional, tag = "1")]
    pub trajectory: Option<Trajectory>,
    #[prost(float, optional, tag = "2")]
    pub confidence: Option<f32>,
}

/// All ways one object may go.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are Waymo's")]
pub struct SingleObjectPrediction {
    #[prost(int32, optional, tag = "1")]
    pub object_id: Option<i32>,
    #[prost(message, repeated, tag = "2")]
    pub trajectories: Vec<ScoredTrajectory>,
}

/// Predictions of objects one by one.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are Waymo's")]
pub struct PredictionSet {
    #[prost(message, repeated, tag = "1")]
    pub predictions: Vec<SingleObjectPrediction>,
}

/// The way of one object in a joint prediction.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are Waymo's")]
pub struct ObjectTrajectory {
    #[prost(int32, optional, tag = "1")]
    pub object_id: Option<i32>,
    #[prost(message, optional, tag = "2")]
    pub trajectory: Option<Trajectory>,
}

/// One way several objects may go together.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are Waymo's")]
pub struct ScoredJointTrajectory {
    #[prost(message, repeated, tag = "2")]
    pub trajectories: Vec<ObjectTrajectory>,
    #[prost(float, optional, tag = "3")]
    pub confidence: Option<f32>,
}

/// All ways several objects may go together.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are Waymo's")]
pub struct JointPrediction {
    #[prost(message, repeated, tag = "1")]
    pub joint_trajectories: Vec<ScoredJointTrajectory>,
}

/// The predictions of one scenario.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are Waymo's")]
pub struct ChallengeScenarioPredictions {
    #[prost(string, optional, tag = "1")]
    pub scenario_id: Option<String>,
    #[prost(oneof = "PredictionKind", tags = "2, 3")]
    pub prediction_set: Option<PredictionKind>,
}

/// One by one or together.
#[derive(Clone, PartialEq, prost::Oneof)]
#[allow(missing_docs, reason = "the names are Waymo's")]
pub enum PredictionKind {
    #[prost(message, tag = "2")]
    SinglePredictions(PredictionSet),
    #[prost(message, tag = "3")]
    JointPrediction(JointPrediction),
}

/// Predictions of many scenarios and their authors.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(missing_docs, reason = "the field names are Waymo's")]
pub struct MotionChallengeSubmission {
    #[prost(message, repeated, tag = "1")]
    pub scenario_predictions: Vec<ChallengeScenarioPredictions>,
    #[prost(enumeration = "MotionSubmissionType", optional, tag = "2")]
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
}

/// Challenge that a submission is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, prost::Enumeration)]
#[allow(missing_docs, reason = "the names are Waymo's")]
pub enum MotionSubmissionType {
    Unknown = 0,
    MotionPrediction = 1,
    InteractionPrediction = 2,
}
