//! Tracks, lights and maps as arrays, in the named tuples of `gump.types`.

use std::collections::BTreeMap;

use gump_geometry::DVec2;
use gump_scene::{Agent, AgentId, AreaKind, LaneId, LaneKind, LightState, MapGraph, Scenario};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};

use crate::arrays::array;

/// x, y, z and heading.
pub(crate) fn state(agent: &Agent) -> [f64; 4] {
    let pose = agent.state.pose;
    [
        pose.position.x,
        pose.position.y,
        agent.elevation,
        pose.heading,
    ]
}

/// A named tuple of `gump.types`.
fn named<'py>(name: &str, fields: &Bound<'py, PyDict>) -> PyResult<Bound<'py, PyAny>> {
    let types = fields.py().import("gump.types")?;
    types.getattr(name)?.call((), Some(fields))
}

/// All agents over time.
pub(crate) fn tracks<'py>(py: Python<'py>, scenario: &Scenario) -> PyResult<Bound<'py, PyAny>> {
    let mut agents: BTreeMap<AgentId, &Agent> = BTreeMap::new();
    for agent in scenario.log.iter().flat_map(|frame| frame.agents()) {
        agents.entry(agent.id).or_insert(agent);
    }
    let (n, steps) = (agents.len(), scenario.log.len());
    let mut valid = Vec::with_capacity(n * steps);
    let (mut position, mut heading) = (Vec::new(), Vec::new());
    let (mut velocity, mut size) = (Vec::new(), Vec::new());
    for &id in agents.keys() {
        for frame in &scenario.log {
            let agent = frame.agent(id);
            let [x, y, z, h] = agent.map_or([f64::NAN; 4], state);
            valid.push(agent.is_some());
            position.extend([x, y, z]);
            heading.push(h);
            velocity.extend(agent.map_or([f64::NAN; 2], |a| a.state.velocity.to_array()));
            size.extend(agent.map_or([f64::NAN; 3], |a| [a.length, a.width, a.height]));
        }
    }
    let ids: Vec<i64> = agents.keys().map(|id| id.0).collect();
    let kinds: Vec<&str> = agents.values().map(|agent| agent.kind.name()).collect();
    let fields = PyDict::new(py);
    fields.set_item("agent_id", array(py, n, ids)?)?;
    fields.set_item("kind", kinds)?;
    fields.set_item("valid", array(py, [n, steps], valid)?)?;
    fields.set_item("position", array(py, [n, steps, 3], position)?)?;
    fields.set_item("heading", array(py, [n, steps], heading)?)?;
    fields.set_item("velocity", array(py, [n, steps, 2], velocity)?)?;
    fields.set_item("size", array(py, [n, steps, 3], size)?)?;
    named("Tracks", &fields)
}

/// Traffic lights over time.
pub(crate) fn lights<'py>(py: Python<'py>, scenario: &Scenario) -> PyResult<Bound<'py, PyAny>> {
    let mut lanes: BTreeMap<LaneId, ()> = BTreeMap::new();
    for light in scenario.log.iter().flat_map(|frame| frame.lights()) {
        lanes.insert(light.lane, ());
    }
    let (n, steps) = (lanes.len(), scenario.log.len());
    let (mut states, mut points) = (Vec::new(), Vec::new());
    for &lane in lanes.keys() {
        for frame in &scenario.log {
            let light = frame.light(lane);
            states.push(light.map_or(-1, |light| code(light.state)));
            let point = light.and_then(|light| light.stop_point);
            points.extend(point.map_or([f64::NAN; 2], |p| p.to_array()));
        }
    }
    let fields = PyDict::new(py);
    let ids: Vec<i64> = lanes.keys().map(|lane| lane.0).collect();
    fields.set_item("lane_id", array(py, n, ids)?)?;
    fields.set_item("state", array(py, [n, steps], states)?)?;
    fields.set_item("stop_point", array(py, [n, steps, 2], points)?)?;
    named("Lights", &fields)
}

/// The code of a colour; -1 is a light that was not seen.
fn code(state: LightState) -> i8 {
    match state {
        LightState::Unknown => 0,
        LightState::Green => 1,
        LightState::Yellow => 2,
        LightState::Red => 3,
    }
}

/// The road.
pub(crate) fn map<'py>(py: Python<'py>, map: &MapGraph) -> PyResult<Bound<'py, PyAny>> {
    let lanes = PyList::empty(py);
    for lane in map.lanes() {
        let fields = PyDict::new(py);
        let ids = |ids: &[LaneId]| ids.iter().map(|id| id.0).collect::<Vec<_>>();
        fields.set_item("id", lane.id.0)?;
        fields.set_item("kind", lane_kind(lane.kind))?;
        fields.set_item(
            "centerline",
            line(py, lane.centerline.points(), &lane.elevation)?,
        )?;
        fields.set_item("width", lane.width)?;
        fields.set_item("speed_limit", lane.speed_limit)?;
        fields.set_item("in_intersection", lane.in_intersection)?;
        fields.set_item("predecessors", ids(&lane.predecessors))?;
        fields.set_item("successors", ids(&lane.successors))?;
        fields.set_item("left_neighbors", ids(&lane.left_neighbors))?;
        fields.set_item("right_neighbors", ids(&lane.right_neighbors))?;
        lanes.append(named("Lane", &fields)?)?;
    }
    let edges = map.road_edges().iter();
    let edges = edges.map(|edge| line(py, edge.line.points(), &edge.elevation));
    let lines = map.road_lines().iter();
    let lines = lines.map(|road| line(py, road.line.points(), &road.elevation));
    let areas = PyList::empty(py);
    for area in map.areas() {
        let fields = PyDict::new(py);
        fields.set_item("id", area.id)?;
        fields.set_item("kind", area_kind(area.kind))?;
        fields.set_item("polygon", line(py, area.polygon.ring(), &area.elevation)?)?;
        areas.append(named("Area", &fields)?)?;
    }
    let signs = PyList::empty(py);
    for sign in map.stop_signs() {
        let fields = PyDict::new(py);
        fields.set_item("id", sign.id)?;
        fields.set_item("position", array(py, 3, sign.position.to_array().to_vec())?)?;
        fields.set_item(
            "lanes",
            sign.lanes.iter().map(|id| id.0).collect::<Vec<_>>(),
        )?;
        signs.append(named("StopSign", &fields)?)?;
    }
    let drivable = map.drivable().iter().map(|polygon| {
        let ring = polygon.ring();
        let numbers = ring.iter().flat_map(|point| point.to_array()).collect();
        array(py, [ring.len(), 2], numbers)
    });
    let fields = PyDict::new(py);
    fields.set_item("lanes", lanes)?;
    fields.set_item("road_edges", edges.collect::<PyResult<Vec<_>>>()?)?;
    fields.set_item("road_lines", lines.collect::<PyResult<Vec<_>>>()?)?;
    fields.set_item("areas", areas)?;
    fields.set_item("stop_signs", signs)?;
    fields.set_item("drivable", drivable.collect::<PyResult<Vec<_>>>()?)?;
    named("Map", &fields)
}

/// Points with their heights, `[P, 3]`.
fn line<'py>(py: Python<'py>, points: &[DVec2], elevation: &[f64]) -> PyResult<Bound<'py, PyAny>> {
    let heights = elevation.iter().copied().chain(std::iter::repeat(0.0));
    let numbers = points.iter().zip(heights).flat_map(|(p, z)| [p.x, p.y, z]);
    let numbers: Vec<f64> = numbers.collect();
    Ok(array(py, [points.len(), 3], numbers)?.into_any())
}

fn lane_kind(kind: LaneKind) -> &'static str {
    match kind {
        LaneKind::Freeway => "freeway",
        LaneKind::SurfaceStreet => "surface_street",
        LaneKind::BikeLane => "bike_lane",
        LaneKind::Undefined => "undefined",
    }
}

fn area_kind(kind: AreaKind) -> &'static str {
    match kind {
        AreaKind::Crosswalk => "crosswalk",
        AreaKind::SpeedBump => "speed_bump",
        AreaKind::Driveway => "driveway",
        AreaKind::StopLine => "stop_line",
        AreaKind::TurnStop => "turn_stop",
        AreaKind::Intersection => "intersection",
        AreaKind::Walkway => "walkway",
        AreaKind::Carpark => "carpark",
    }
}
