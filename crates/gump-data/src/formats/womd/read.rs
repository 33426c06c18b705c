//! Conversion of a Waymo scenario message to a [`Scenario`]: tracks, lights, roles.
//!
//! The map is in `map`. Start with [`scenario_from_proto`].

use std::collections::BTreeSet;
use std::sync::Arc;

use gump_geometry::{Pose, dvec2, wrap_angle};
use gump_scene::{
    Agent, AgentId, AgentKind, AgentState, Frame, LaneId, Light, LightState, Scenario,
};

use super::map;
use crate::complete::infer;
use crate::complete::recording::{Recording, assemble};
use crate::error::MAX_COORDINATE;
use crate::{Problem, ReadOptions, ReadReport};
use gump_proto::{self as proto, ObjectType, SignalState};

/// Time stamps may stray from the nominal step by this fraction: Waymo's clocks drift by up to
/// 0.5 %, and a lost step would be 100 %.
const TIME_STEP_TOLERANCE: f64 = 0.1;

/// Converts a decoded message to a validated scenario and reports what was dropped and inferred.
///
/// An invalid state means that the agent is absent at that step. Headings are wrapped to [-π, π);
/// the time step is the mean of the stamps, rounded to a millisecond (the nominal rate, which is
/// what benchmarks differentiate with). Flashing and arrow signals become their colour.
///
/// # Errors
/// The first [`Problem`] found.
pub fn scenario_from_proto(
    proto: &proto::Scenario,
    options: ReadOptions,
) -> Result<(Scenario, ReadReport), Problem> {
    let mut report = ReadReport::default();
    if options.park_an_ego && proto.tracks.is_empty() && !proto.map_features.is_empty() {
        return map_alone(proto, options, report);
    }
    check_tracks(proto)?;
    let dt = time_step(&proto.timestamps_seconds)?;
    let ego = ego(proto)?;
    let mut parts = map::parts_from_proto(&proto.map_features, &mut report)?;
    let mut log = frames(proto, &mut report)?;
    let stamps = proto.timestamps_seconds.len();
    let now = usize::try_from(proto.current_time_index()).map_err(|_| Problem::Index {
        what: "the index of the present",
        len: stamps,
        index: proto.current_time_index().into(),
    })?;
    infer::light_gaps(&mut log, now, dt, options, &mut report);
    infer::map(&mut parts, options, &mut report);
    let map = Arc::new(gump_scene::MapGraph::new(parts)?);
    let mut targets = Vec::with_capacity(proto.tracks_to_predict.len());
    for target in &proto.tracks_to_predict {
        targets.push(track_id(
            "the index of a track to predict",
            target.track_index(),
            proto,
        )?);
    }
    targets.sort_unstable();
    targets.dedup();
    let mut scenario = Scenario {
        id: proto.scenario_id().into(),
        map,
        route: None,
        log,
        dt,
        now,
        ego,
        targets,
        objects_of_interest: proto
            .objects_of_interest
            .iter()
            .map(|&id| AgentId(id.into()))
            .collect(),
        tags: Vec::new(),
    };
    scenario.validate()?;
    infer::route(&mut scenario, options, &mut report);
    Ok((scenario, report))
}

/// A message with a map and no agents.
fn map_alone(
    proto: &proto::Scenario,
    options: ReadOptions,
    mut report: ReadReport,
) -> Result<(Scenario, ReadReport), Problem> {
    let parts = map::parts_from_proto(&proto.map_features, &mut report)?;
    let nobody = Recording::of_nobody(proto.scenario_id().into());
    let scenario = assemble(nobody, parts, options, &mut report)?;
    Ok((scenario, report))
}

fn check_tracks(proto: &proto::Scenario) -> Result<(), Problem> {
    if proto.map_features.is_empty() {
        return Err(Problem::NoMap);
    }
    if proto.tracks.is_empty() {
        return Err(Problem::NoAgents);
    }
    let expected = proto.timestamps_seconds.len();
    let mut ids = BTreeSet::new();
    for track in &proto.tracks {
        let id = i64::from(track.id());
        if !ids.insert(id) {
            return Err(Problem::DuplicateTrack(id));
        }
        if track.states.len() != expected {
            return Err(Problem::StateCount {
                track: id,
                expected,
                found: track.states.len(),
            });
        }
    }
    let found = proto.dynamic_map_states.len();
    if found != 0 && found != expected {
        return Err(Problem::LightCount { expected, found });
    }
    Ok(())
}

/// The nominal step, seconds, checked against every stamp.
fn time_step(stamps: &[f64]) -> Result<f64, Problem> {
    let [first, .., last] = stamps else {
        // One step or none has no rate; the dataset's is 10 Hz.
        return Ok(0.1);
    };
    let mean = (last - first) / (stamps.len() - 1) as f64;
    let dt = (mean * 1000.0).round() / 1000.0;
    for (i, pair) in stamps.windows(2).enumerate() {
        let found = pair[1] - pair[0];
        let near = (found - dt).abs() <= TIME_STEP_TOLERANCE * dt;
        if !near || dt <= 0.0 {
            return Err(Problem::TimeStep {
                expected: dt,
                found,
                step: i + 1,
            });
        }
    }
    Ok(dt)
}

fn ego(proto: &proto::Scenario) -> Result<AgentId, Problem> {
    let index = proto.sdc_track_index.ok_or(Problem::NoEgo)?;
    track_id("the index of the ego's track", index, proto)
}

fn track_id(what: &'static str, index: i32, proto: &proto::Scenario) -> Result<AgentId, Problem> {
    let track = usize::try_from(index)
        .ok()
        .and_then(|i| proto.tracks.get(i));
    let track = track.ok_or(Problem::Index {
        what,
        len: proto.tracks.len(),
        index: index.into(),
    })?;
    Ok(AgentId(track.id().into()))
}

fn frames(proto: &proto::Scenario, report: &mut ReadReport) -> Result<Vec<Frame>, Problem> {
    let never_valid = |track: &&proto::Track| !track.states.iter().any(|state| state.valid());
    let empty = proto.tracks.iter().filter(never_valid).count();
    report.drop("track without a valid state", empty);
    (0..proto.timestamps_seconds.len())
        .map(|step| {
            let mut agents = Vec::with_capacity(proto.tracks.len());
            for track in &proto.tracks {
                let state = &track.states[step];
                if state.valid() {
                    agents.push(agent(track, state, step)?);
                }
            }
            let lights = proto.dynamic_map_states.get(step);
            let lights = lights.map_or(&[][..], |state| &state.lane_states);
            Ok(Frame::new(agents, lights_from_proto(lights, report)))
        })
        .collect()
}

fn agent(track: &proto::Track, state: &proto::ObjectState, step: usize) -> Result<Agent, Problem> {
    let fields = [
        ("center_x", state.center_x()),
        ("center_y", state.center_y()),
        ("center_z", state.center_z()),
        ("length", state.length().into()),
        ("width", state.width().into()),
        ("height", state.height().into()),
        ("heading", state.heading().into()),
        ("velocity_x", state.velocity_x().into()),
        ("velocity_y", state.velocity_y().into()),
    ];
    let sound = |value: f64| value.abs() <= MAX_COORDINATE;
    if let Some(&(field, value)) = fields.iter().find(|(_, value)| !sound(*value)) {
        return Err(Problem::State {
            track: track.id().into(),
            step,
            field,
            value,
        });
    }
    let [x, y, z, length, width, height, heading, vx, vy] = fields.map(|(_, value)| value);
    Ok(Agent {
        id: AgentId(track.id().into()),
        kind: kind(track.object_type()),
        length,
        width,
        height,
        elevation: z,
        state: AgentState {
            pose: Pose::new(x, y, wrap_angle(heading)),
            velocity: dvec2(vx, vy),
        },
    })
}

fn kind(object_type: ObjectType) -> AgentKind {
    match object_type {
        ObjectType::Vehicle => AgentKind::Vehicle,
        ObjectType::Pedestrian => AgentKind::Pedestrian,
        ObjectType::Cyclist => AgentKind::Bicycle,
        ObjectType::Other | ObjectType::Unset => AgentKind::Other,
    }
}

fn lights_from_proto(
    signals: &[proto::TrafficSignalLaneState],
    report: &mut ReadReport,
) -> Vec<Light> {
    let lanes: BTreeSet<i64> = signals.iter().map(|signal| signal.lane()).collect();
    report.drop(
        "second signal of a lane in one step",
        signals.len() - lanes.len(),
    );
    signals
        .iter()
        .map(|signal| Light {
            lane: LaneId(signal.lane()),
            state: light_state(signal.state()),
            stop_point: signal.stop_point.map(|p| dvec2(p.x(), p.y())),
        })
        .collect()
}

fn light_state(state: SignalState) -> LightState {
    match state {
        SignalState::Unknown => LightState::Unknown,
        SignalState::ArrowStop | SignalState::Stop | SignalState::FlashingStop => LightState::Red,
        SignalState::ArrowCaution | SignalState::Caution | SignalState::FlashingCaution => {
            LightState::Yellow
        }
        SignalState::ArrowGo | SignalState::Go => LightState::Green,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn signals_become_colours() {
        let colours: Vec<_> = (0..=8)
            .map(|state| light_state(SignalState::try_from(state).unwrap()))
            .collect();
        use LightState::{Green, Red, Unknown, Yellow};
        let expected = [Unknown, Red, Yellow, Green, Red, Yellow, Green, Red, Yellow];
        assert_eq!(colours, expected);
    }

    #[test]
    fn the_last_signal_of_a_lane_counts_and_the_first_is_reported() {
        let signal = |lane, state: SignalState| proto::TrafficSignalLaneState {
            lane: Some(lane),
            state: Some(state.into()),
            stop_point: None,
        };
        let signals = [signal(5, SignalState::Stop), signal(5, SignalState::Go)];
        let mut report = ReadReport::default();
        let frame = Frame::new(Vec::new(), lights_from_proto(&signals, &mut report));
        assert_eq!(frame.light(LaneId(5)).unwrap().state, LightState::Green);
        assert_eq!(report.dropped["second signal of a lane in one step"], 1);
    }

    #[test]
    fn unknown_enum_values_are_the_unknown_kind() {
        let track = proto::Track {
            object_type: Some(77),
            ..proto::Track::default()
        };
        assert_eq!(kind(track.object_type()), AgentKind::Other);
    }

    #[test]
    fn the_time_step_is_the_nominal_one() {
        let drifting: Vec<f64> = (0..91).map(|i| f64::from(i) * 0.10024).collect();
        assert_eq!(time_step(&drifting), Ok(0.1));
        assert_eq!(time_step(&[0.0, 0.5, 1.0]), Ok(0.5));
        assert!(time_step(&[0.0, 0.0, 0.0]).is_err());
        assert!(time_step(&[1.0, 0.5, 0.0]).is_err());
    }
}
