//! Reading the recorded values.

use gump_geometry::{DVec2, Pose, dvec2};
use gump_nuplan::metrics::{Sample, SimulationHistory};
use gump_scene::{
    Agent, AgentId, AgentKind, AgentState, EgoState, Frame, MapGraph, VehicleParameters,
};
use serde_json::Value;

/// A file of `tests/data/metrics`.
pub(crate) fn golden(name: &str) -> Value {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/metrics");
    let text = std::fs::read_to_string(format!("{folder}/{name}.json")).unwrap();
    serde_json::from_str(&text).unwrap()
}

/// A number, also one that JSON cannot write; true is 1.
pub(crate) fn number(value: &Value) -> f64 {
    match value {
        Value::Bool(yes) => f64::from(*yes),
        Value::String(text) => text.parse().unwrap(),
        other => other.as_f64().unwrap_or_else(|| panic!("{other}")),
    }
}

pub(crate) fn numbers(value: &Value) -> Vec<f64> {
    list(value).iter().map(number).collect()
}

pub(crate) fn list(value: &Value) -> &[Value] {
    value.as_array().map(Vec::as_slice).unwrap_or_default()
}

pub(crate) fn entries(value: &Value) -> impl Iterator<Item = (&String, &Value)> {
    value.as_object().unwrap().iter()
}

/// Equal numbers, infinities included, to a tolerance.
#[track_caller]
pub(crate) fn assert_close(found: f64, expected: f64, tolerance: f64, what: &str) {
    let close = found == expected || (found - expected).abs() <= tolerance;
    assert!(close, "{what}: found {found}, expected {expected}");
}

#[track_caller]
pub(crate) fn assert_all_close(found: &[f64], expected: &[f64], tolerance: f64, what: &str) {
    assert_eq!(found.len(), expected.len(), "{what}");
    for (i, (found, expected)) in found.iter().zip(expected).enumerate() {
        assert_close(*found, *expected, tolerance, &format!("{what}[{i}]"));
    }
}

/// The ego from time, rear axle, and, as far as the row goes, velocity, acceleration, yaw rate and
/// yaw acceleration.
pub(crate) fn ego(row: &Value) -> EgoState {
    let row = numbers(row);
    let at = |i: usize| row.get(i).copied().unwrap_or_default();
    EgoState {
        time_us: row[0] as i64,
        rear_axle: Pose::new(row[1], row[2], row[3]),
        velocity: dvec2(at(4), at(5)),
        acceleration: dvec2(at(6), at(7)),
        yaw_rate: at(8),
        yaw_acceleration: at(9),
        ..EgoState::default()
    }
}

pub(crate) fn egos(rows: &Value) -> Vec<EgoState> {
    list(rows).iter().map(ego).collect()
}

/// The devkit's numbers for kinds.
pub(crate) fn kind(type_id: u64) -> AgentKind {
    match type_id {
        0 => AgentKind::Vehicle,
        1 => AgentKind::Pedestrian,
        2 => AgentKind::Bicycle,
        3 => AgentKind::TrafficCone,
        4 => AgentKind::Barrier,
        5 => AgentKind::Sign,
        _ => AgentKind::Other,
    }
}

pub(crate) fn agent(
    id: usize,
    type_id: &Value,
    pose: Pose,
    size: [f64; 2],
    velocity: DVec2,
) -> Agent {
    Agent {
        id: AgentId(id as i64),
        kind: kind(type_id.as_u64().unwrap()),
        length: size[0],
        width: size[1],
        height: 1.5,
        elevation: 0.0,
        state: AgentState { pose, velocity },
    }
}

/// Samples without plans.
pub(crate) fn samples(
    egos: Vec<EgoState>,
    frames: impl Iterator<Item = Vec<Agent>>,
) -> Vec<Sample> {
    let pairs = egos.into_iter().zip(frames);
    let sample = |(ego, agents)| Sample {
        ego,
        frame: Frame::new(agents, Vec::new()),
        plan: Vec::new(),
    };
    pairs.map(sample).collect()
}

/// A drive where there is no map.
pub(crate) fn drive<'a>(
    samples: &'a [Sample],
    expert: &'a [EgoState],
    map: &'a MapGraph,
) -> SimulationHistory<'a> {
    SimulationHistory {
        samples,
        expert,
        map,
        ego: None,
        vehicle: VehicleParameters::PACIFICA,
    }
}
