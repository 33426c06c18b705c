//! Conversion of a [`Scenario`] to a Waymo scenario message: the inverse of `read` and `map`.
//!
//! Start with [`write_scenarios`] for a file, [`scenario_to_proto`] for one message.

use std::borrow::Borrow;
use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

use flate2::Compression;
use flate2::write::GzEncoder;
use gump_scene::{Agent, AgentId, AgentKind, Frame, Light, LightState, Scenario};
use prost::Message;

use super::write_map;
use crate::io::stream::io_error;
use crate::io::tfrecord::write_record;
use crate::{DataError, ReadReport, write_atomically};
use gump_proto::{self as proto, ObjectType, SignalState};

/// Writes scenarios as TFRecord, gzip if the name ends in `.gz`, and reports what Waymo's messages
/// cannot represent.
///
/// The file appears under its name only when it is complete.
///
/// # Errors
/// [`DataError::Unwritable`] for ids beyond 32 bits and roles without a track;
/// [`DataError::Io`].
pub fn write_scenarios<S: Borrow<Scenario>>(
    path: &Path,
    scenarios: impl IntoIterator<Item = S>,
) -> Result<ReadReport, DataError> {
    let gzip = path.extension().is_some_and(|extension| extension == "gz");
    write_atomically(path, |file| {
        if gzip {
            let mut packed = GzEncoder::new(file, Compression::default());
            let report = write_all(&mut packed, scenarios, path)?;
            packed.finish().map_err(|e| io_error("write", e, path))?;
            Ok(report)
        } else {
            write_all::<_, BufWriter<File>>(file, scenarios, path)
        }
    })
}

fn write_all<S: Borrow<Scenario>, W: Write>(
    out: &mut W,
    scenarios: impl IntoIterator<Item = S>,
    path: &Path,
) -> Result<ReadReport, DataError> {
    let mut report = ReadReport::default();
    for scenario in scenarios {
        let (message, dropped) = scenario_to_proto(scenario.borrow())?;
        report.merge(&dropped);
        write_record(out, &message.encode_to_vec()).map_err(|e| io_error("write", e, path))?;
    }
    Ok(report)
}

/// Converts a scenario to a message that reads back as the same scenario, and reports what it
/// cannot represent.
///
/// Sizes, headings and velocities are rounded to f32. Values that readers infer (lane widths,
/// drivable surfaces, the route) are dropped: they are inferred again from the same map and log.
///
/// # Errors
/// [`DataError::Unwritable`] for ids beyond 32 bits and roles without a track.
pub fn scenario_to_proto(scenario: &Scenario) -> Result<(proto::Scenario, ReadReport), DataError> {
    let mut report = ReadReport::default();
    report.drop("tag", scenario.tags.len());
    report.drop("route", usize::from(scenario.route.is_some()));
    let unwritable = |problem: String| DataError::Unwritable {
        id: scenario.id.clone(),
        problem,
    };
    let ids: BTreeSet<AgentId> = scenario
        .log
        .iter()
        .flat_map(|frame| frame.agents().iter().map(|agent| agent.id))
        .collect();
    let index: BTreeMap<AgentId, i32> = ids.iter().copied().zip(0..).collect();
    let track_index = |id: AgentId| {
        let found = index.get(&id).copied();
        found.ok_or_else(|| unwritable(format!("agent {id} has a role but no track")))
    };
    let narrow = |id: AgentId| {
        i32::try_from(id.0).map_err(|_| unwritable(format!("agent id {id} exceeds 32 bits")))
    };
    let mut tracks = Vec::with_capacity(ids.len());
    for &id in &ids {
        tracks.push(track(id, narrow(id)?, &scenario.log));
    }
    let targets = scenario.targets.iter().map(|&id| track_index(id));
    let message = proto::Scenario {
        timestamps_seconds: (0..scenario.log.len())
            .map(|step| step as f64 * scenario.dt)
            .collect(),
        tracks,
        objects_of_interest: scenario
            .objects_of_interest
            .iter()
            .map(|&id| narrow(id))
            .collect::<Result<_, _>>()?,
        scenario_id: Some(scenario.id.clone()),
        sdc_track_index: Some(track_index(scenario.ego)?),
        dynamic_map_states: scenario.log.iter().map(signals).collect(),
        map_features: write_map::features_from_map(&scenario.map, &mut report),
        current_time_index: Some(
            i32::try_from(scenario.now)
                .map_err(|_| unwritable(format!("step {} exceeds 32 bits", scenario.now)))?,
        ),
        tracks_to_predict: targets
            .map(|index| {
                Ok(proto::RequiredPrediction {
                    track_index: Some(index?),
                    difficulty: None,
                })
            })
            .collect::<Result<_, DataError>>()?,
    };
    Ok((message, report))
}

fn track(id: AgentId, narrow: i32, log: &[Frame]) -> proto::Track {
    let kind = log.iter().find_map(|frame| frame.agent(id)).map(|a| a.kind);
    proto::Track {
        id: Some(narrow),
        object_type: kind.map(|kind| object_type(kind).into()),
        states: log
            .iter()
            .map(|frame| frame.agent(id).map_or_else(absent, state))
            .collect(),
    }
}

fn state(agent: &Agent) -> proto::ObjectState {
    let pose = agent.state.pose;
    proto::ObjectState {
        center_x: Some(pose.position.x),
        center_y: Some(pose.position.y),
        center_z: Some(agent.elevation),
        length: Some(agent.length as f32),
        width: Some(agent.width as f32),
        height: Some(agent.height as f32),
        heading: Some(pose.heading as f32),
        velocity_x: Some(agent.state.velocity.x as f32),
        velocity_y: Some(agent.state.velocity.y as f32),
        valid: Some(true),
    }
}

fn absent() -> proto::ObjectState {
    proto::ObjectState {
        valid: Some(false),
        ..proto::ObjectState::default()
    }
}

fn object_type(kind: AgentKind) -> ObjectType {
    match kind {
        AgentKind::Vehicle => ObjectType::Vehicle,
        AgentKind::Pedestrian => ObjectType::Pedestrian,
        AgentKind::Bicycle => ObjectType::Cyclist,
        AgentKind::TrafficCone | AgentKind::Barrier | AgentKind::Sign | AgentKind::Other => {
            ObjectType::Other
        }
    }
}

fn signals(frame: &Frame) -> proto::DynamicMapState {
    proto::DynamicMapState {
        lane_states: frame.lights().iter().map(signal).collect(),
    }
}

fn signal(light: &Light) -> proto::TrafficSignalLaneState {
    let state = match light.state {
        LightState::Green => SignalState::Go,
        LightState::Yellow => SignalState::Caution,
        LightState::Red => SignalState::Stop,
        LightState::Unknown => SignalState::Unknown,
    };
    proto::TrafficSignalLaneState {
        lane: Some(light.lane.0),
        state: Some(state.into()),
        stop_point: light.stop_point.map(|p| write_map::point(p, 0.0)),
    }
}
