//! Conversion of Waymo's messages to the inputs of the metrics.
//!
//! The metrics read more of a message than a scene keeps: the values of invalid states, flashing
//! and unobserved signals, the order of the map.

use gump_proto::{
    FeatureData, LaneType, MapPoint, ObjectState, ObjectType, ScenarioRollouts, SignalState,
    SimulatedTrajectory, TrafficSignalLaneState,
};
use gump_scene::{AgentId, AgentKind};

use crate::realism::{Log, Mode, Rollouts, Signal, SignalLane, State, Track, Trajectory};

impl Log {
    /// The log of a message, with its ego and prediction targets where it states them.
    ///
    /// Scores computed from it equal the official ones to the last digit.
    pub fn of_message(message: &gump_proto::Scenario) -> Self {
        let tracks = message.tracks.iter().map(|track| {
            let states = track.states.iter().map(state).collect();
            Track::new(id(track), kind(track.object_type()), states)
        });
        let mut log = Self::new(message.scenario_id(), tracks.collect());
        let known = |index: i32| message.tracks.get(usize::try_from(index).ok()?).map(id);
        log.ego = message.sdc_track_index.and_then(known);
        let wanted = message.tracks_to_predict.iter();
        log.targets = wanted.filter_map(|t| known(t.track_index?)).collect();
        for feature in &message.map_features {
            match &feature.feature_data {
                Some(FeatureData::RoadEdge(edge)) => {
                    let points = edge.polyline.iter().map(point);
                    log.road_edges.push(points.collect());
                }
                Some(FeatureData::Lane(lane)) if lane.r#type() == LaneType::SurfaceStreet => {
                    let points = lane.polyline.iter().map(point);
                    log.lanes.push(SignalLane {
                        id: feature.id(),
                        points: points.map(|[x, y, _]| [x, y]).collect(),
                    });
                }
                _ => {}
            }
        }
        let steps = message.dynamic_map_states.iter();
        let signals = steps.map(|step| step.lane_states.iter().map(signal).collect());
        log.signals = signals.collect();
        log
    }
}

impl Rollouts {
    /// The futures of a message; sizes and classes of agents are used in scene generation only.
    pub fn of_message(message: &ScenarioRollouts, mode: Mode) -> Self {
        let futures = message.joint_scenes.iter().map(|scene| {
            let agents = scene.simulated_trajectories.iter();
            agents.map(|agent| trajectory(agent, mode)).collect()
        });
        Self::new(message.scenario_id(), futures.collect())
    }
}

fn trajectory(agent: &SimulatedTrajectory, mode: Mode) -> Trajectory {
    let path = Trajectory::new(
        AgentId(agent.object_id().into()),
        agent.center_x.clone(),
        agent.center_y.clone(),
        agent.center_z.clone(),
        agent.heading.clone(),
    );
    match mode {
        Mode::SimAgents => path,
        Mode::Generation => {
            let sizes = agent.length.iter().zip(&agent.width).zip(&agent.height);
            let sizes = sizes.map(|((&l, &w), &h)| [l, w, h]);
            path.with_box(kind(agent.object_type()), sizes.collect())
        }
    }
}

fn id(track: &gump_proto::Track) -> AgentId {
    AgentId(track.id().into())
}

fn kind(object_type: ObjectType) -> AgentKind {
    match object_type {
        ObjectType::Vehicle => AgentKind::Vehicle,
        ObjectType::Pedestrian => AgentKind::Pedestrian,
        ObjectType::Cyclist => AgentKind::Bicycle,
        ObjectType::Other | ObjectType::Unset => AgentKind::Other,
    }
}

fn state(state: &ObjectState) -> State {
    State {
        position: [state.center_x(), state.center_y(), state.center_z()].map(|v| v as f32),
        heading: state.heading(),
        size: [state.length(), state.width(), state.height()],
        valid: state.valid(),
    }
}

fn point(point: &MapPoint) -> [f32; 3] {
    [point.x(), point.y(), point.z()].map(|v| v as f32)
}

fn signal(signal: &TrafficSignalLaneState) -> Signal {
    let [x, y, _] = signal.stop_point.as_ref().map_or([0.0; 3], point);
    Signal {
        lane: signal.lane(),
        stop: matches!(signal.state(), SignalState::Stop | SignalState::ArrowStop),
        stop_point: [x, y],
    }
}
