//! What Waymo's messages say, as the realism metric reads it.
//!
//! The metric reads more than a scenario keeps: what invalid states hold, which signals flash and
//! when they were not seen, the order of the map.

use gump_data::womd::proto::{
    self, FeatureData, LaneType, MapPoint, ObjectState, ObjectType, ScenarioRollouts, SignalState,
    SimulatedTrajectory, TrafficSignalLaneState,
};
use gump_metrics::wosac::{
    Log, Mode, N_HISTORY, N_STEPS, Rollouts, Signal, SignalLane, State, Track, Trajectory,
};
use gump_scene::{AgentId, AgentKind, Scenario};

/// The log of a message that is a scenario; `None` for one of another clock than the challenge's.
pub(crate) fn log(message: &proto::Scenario, scenario: &Scenario) -> Option<Log> {
    if (scenario.now + 1, scenario.log.len()) != (N_HISTORY, N_STEPS) {
        return None;
    }
    let tracks = message.tracks.iter().map(|track| {
        let states = track.states.iter().map(state).collect();
        let kind = kind(track.object_type());
        Track::new(AgentId(track.id().into()), kind, states)
    });
    let mut log = Log::new(message.scenario_id(), tracks.collect());
    log.ego = Some(scenario.ego);
    log.targets.clone_from(&scenario.targets);
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
    Some(log)
}

/// A message of rollouts as what is scored.
pub(crate) fn rollouts(message: &ScenarioRollouts, mode: Mode) -> Rollouts {
    let futures = message.joint_scenes.iter().map(|scene| {
        let agents = scene.simulated_trajectories.iter();
        agents.map(|agent| trajectory(agent, mode)).collect()
    });
    Rollouts::new(message.scenario_id(), futures.collect())
}

fn trajectory(agent: &SimulatedTrajectory, mode: Mode) -> Trajectory {
    let drive = Trajectory::new(
        AgentId(agent.object_id().into()),
        agent.center_x.clone(),
        agent.center_y.clone(),
        agent.center_z.clone(),
        agent.heading.clone(),
    );
    match mode {
        Mode::SimAgents => drive,
        Mode::Generation => {
            let sizes = agent.length.iter().zip(&agent.width).zip(&agent.height);
            let sizes = sizes.map(|((&l, &w), &h)| [l, w, h]);
            drive.with_box(kind(agent.object_type()), sizes.collect())
        }
    }
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
