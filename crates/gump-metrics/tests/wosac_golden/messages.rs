//! The fields of Waymo's messages that the metric reads, and the messages as what is scored.
//!
//! `gump-data` knows the whole messages; it lies in the same layer as this crate, so tests have
//! their own few.

use gump_metrics::wosac::{Log, Rollouts, Signal, SignalLane, State, Track, Trajectory};
use gump_scene::{AgentId, AgentKind};
use prost::Message;

#[derive(Clone, PartialEq, Message)]
pub(crate) struct Scenario {
    #[prost(message, repeated, tag = "2")]
    tracks: Vec<LoggedTrack>,
    #[prost(string, optional, tag = "5")]
    scenario_id: Option<String>,
    #[prost(int32, optional, tag = "6")]
    sdc_track_index: Option<i32>,
    #[prost(message, repeated, tag = "7")]
    dynamic_map_states: Vec<DynamicMapState>,
    #[prost(message, repeated, tag = "8")]
    map_features: Vec<MapFeature>,
    #[prost(message, repeated, tag = "11")]
    tracks_to_predict: Vec<Prediction>,
}

#[derive(Clone, PartialEq, Message)]
struct LoggedTrack {
    #[prost(int32, optional, tag = "1")]
    id: Option<i32>,
    #[prost(int32, optional, tag = "2")]
    object_type: Option<i32>,
    #[prost(message, repeated, tag = "3")]
    states: Vec<ObjectState>,
}

#[derive(Clone, PartialEq, Message)]
struct ObjectState {
    #[prost(double, optional, tag = "2")]
    x: Option<f64>,
    #[prost(double, optional, tag = "3")]
    y: Option<f64>,
    #[prost(double, optional, tag = "4")]
    z: Option<f64>,
    #[prost(float, optional, tag = "5")]
    length: Option<f32>,
    #[prost(float, optional, tag = "6")]
    width: Option<f32>,
    #[prost(float, optional, tag = "7")]
    height: Option<f32>,
    #[prost(float, optional, tag = "8")]
    heading: Option<f32>,
    #[prost(bool, optional, tag = "11")]
    valid: Option<bool>,
}

#[derive(Clone, PartialEq, Message)]
struct Prediction {
    #[prost(int32, optional, tag = "1")]
    track_index: Option<i32>,
}

#[derive(Clone, PartialEq, Message)]
struct DynamicMapState {
    #[prost(message, repeated, tag = "1")]
    lane_states: Vec<LaneState>,
}

#[derive(Clone, PartialEq, Message)]
struct LaneState {
    #[prost(int64, optional, tag = "1")]
    lane: Option<i64>,
    #[prost(int32, optional, tag = "2")]
    state: Option<i32>,
    #[prost(message, optional, tag = "3")]
    stop_point: Option<Point>,
}

#[derive(Clone, PartialEq, Message)]
struct Point {
    #[prost(double, optional, tag = "1")]
    x: Option<f64>,
    #[prost(double, optional, tag = "2")]
    y: Option<f64>,
    #[prost(double, optional, tag = "3")]
    z: Option<f64>,
}

#[derive(Clone, PartialEq, Message)]
struct MapFeature {
    #[prost(int64, optional, tag = "1")]
    id: Option<i64>,
    #[prost(message, optional, tag = "3")]
    lane: Option<Lane>,
    #[prost(message, optional, tag = "5")]
    road_edge: Option<RoadEdge>,
}

#[derive(Clone, PartialEq, Message)]
struct Lane {
    #[prost(int32, optional, tag = "2")]
    kind: Option<i32>,
    #[prost(message, repeated, tag = "8")]
    polyline: Vec<Point>,
}

#[derive(Clone, PartialEq, Message)]
struct RoadEdge {
    #[prost(message, repeated, tag = "2")]
    polyline: Vec<Point>,
}

/// Futures of one scenario.
#[derive(Clone, PartialEq, Message)]
pub(crate) struct ScenarioRollouts {
    #[prost(string, optional, tag = "1")]
    pub(crate) scenario_id: Option<String>,
    #[prost(message, repeated, tag = "2")]
    pub(crate) joint_scenes: Vec<JointScene>,
}

/// A challenge submission of one scenario.
#[derive(Clone, PartialEq, Message)]
pub(crate) struct Submission {
    #[prost(message, repeated, tag = "1")]
    pub(crate) scenario_rollouts: Vec<ScenarioRollouts>,
}

/// One future.
#[derive(Clone, PartialEq, Message)]
pub(crate) struct JointScene {
    #[prost(message, repeated, tag = "1")]
    trajectories: Vec<SimulatedTrajectory>,
}

#[derive(Clone, PartialEq, Message)]
struct SimulatedTrajectory {
    #[prost(float, repeated, tag = "2")]
    x: Vec<f32>,
    #[prost(float, repeated, tag = "3")]
    y: Vec<f32>,
    #[prost(float, repeated, tag = "4")]
    z: Vec<f32>,
    #[prost(float, repeated, tag = "5")]
    heading: Vec<f32>,
    #[prost(int32, optional, tag = "6")]
    object_id: Option<i32>,
    #[prost(float, repeated, tag = "7")]
    width: Vec<f32>,
    #[prost(float, repeated, tag = "8")]
    length: Vec<f32>,
    #[prost(float, repeated, tag = "9")]
    height: Vec<f32>,
    #[prost(int32, optional, tag = "10")]
    object_type: Option<i32>,
}

fn kind(object_type: Option<i32>) -> AgentKind {
    match object_type {
        Some(1) => AgentKind::Vehicle,
        Some(2) => AgentKind::Pedestrian,
        Some(3) => AgentKind::Bicycle,
        _ => AgentKind::Other,
    }
}

impl Point {
    fn to_f32(&self) -> [f32; 3] {
        [self.x, self.y, self.z].map(|v| v.unwrap_or_default() as f32)
    }
}

impl Scenario {
    /// What the metric reads of the message.
    pub(crate) fn log(&self) -> Log {
        let id = |index: i32| AgentId(self.tracks[index as usize].id.unwrap().into());
        let tracks = self.tracks.iter().map(|track| {
            let state = |s: &ObjectState| State {
                position: [s.x, s.y, s.z].map(|v| v.unwrap_or_default() as f32),
                heading: s.heading.unwrap_or_default(),
                size: [s.length, s.width, s.height].map(Option::unwrap_or_default),
                valid: s.valid.unwrap_or_default(),
            };
            let states = track.states.iter().map(state).collect();
            let id = AgentId(track.id.unwrap().into());
            Track::new(id, kind(track.object_type), states)
        });
        let features = self.map_features.iter();
        let edges = features.clone().filter_map(|f| f.road_edge.as_ref());
        let lanes = features.filter_map(|feature| {
            let lane = feature.lane.as_ref().filter(|lane| lane.kind == Some(2))?;
            let points = lane.polyline.iter().map(Point::to_f32);
            Some(SignalLane {
                id: feature.id.unwrap(),
                points: points.map(|[x, y, _]| [x, y]).collect(),
            })
        });
        let signals = self.dynamic_map_states.iter().map(|step| {
            let signal = |s: &LaneState| {
                let stop = s.stop_point.as_ref().map_or([0.0; 3], Point::to_f32);
                Signal {
                    lane: s.lane.unwrap(),
                    stop: matches!(s.state, Some(1 | 4)),
                    stop_point: [stop[0], stop[1]],
                }
            };
            step.lane_states.iter().map(signal).collect()
        });
        let targets = self.tracks_to_predict.iter();
        Log::new(self.scenario_id.clone().unwrap(), tracks.collect())
            .ego(id(self.sdc_track_index.unwrap()))
            .unwrap()
            .targets(targets.map(|t| id(t.track_index.unwrap())).collect())
            .unwrap()
            .road_edges(
                edges
                    .map(|edge| edge.polyline.iter().map(Point::to_f32).collect())
                    .collect(),
            )
            .signals(lanes.collect(), signals.collect())
    }
}

impl ScenarioRollouts {
    /// The futures as what is scored.
    pub(crate) fn rollouts(&self) -> Rollouts {
        let trajectory = |t: &SimulatedTrajectory| {
            let id = AgentId(t.object_id.unwrap().into());
            let (x, y, z) = (t.x.clone(), t.y.clone(), t.z.clone());
            let drive = Trajectory::new(id, x, y, z, t.heading.clone());
            if t.length.is_empty() {
                return drive;
            }
            let sizes = (0..t.length.len()).map(|i| [t.length[i], t.width[i], t.height[i]]);
            drive.with_box(kind(t.object_type), sizes.collect())
        };
        let futures = self.joint_scenes.iter();
        let futures = futures.map(|scene| scene.trajectories.iter().map(trajectory).collect());
        Rollouts::new(self.scenario_id.clone().unwrap(), futures.collect())
    }
}
