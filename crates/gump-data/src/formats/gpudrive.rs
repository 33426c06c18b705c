//! GPUDrive's and Nocturne's JSON: Waymo scenarios, one per file, plain or gzip.
//!
//! There are three generations: Nocturne's (no ids, headings in degrees), one with traffic lights,
//! and GPUDrive's with `metadata`. The lane graph is inferred, and in the older ones the ego.
//! Headings are in degrees if that agrees better with the motion. Only `valid` determines whether a
//! state counts; the values of invalid ones (-10000, 0) are never used, because real places have
//! them too.
//!
//! Source: the files themselves; 201 of them were examined.

use std::collections::BTreeMap;
use std::path::Path;

use gump_geometry::{DVec3, angle_difference, dvec2, dvec3};
use gump_scene::{
    AgentKind, AreaKind, LaneId, LaneKind, Light, LightState, MapParts, RoadEdgeKind, RoadLineKind,
    StopSign,
};
use serde::Deserialize;

use super::document::{self, Document};
use crate::complete::recording::{Recording, assemble};
use crate::complete::track::{State, Track};
use crate::complete::{features, infer};
use crate::io::json::{self, Flag, Real};
use crate::source::Format;
use crate::{DataError, Problem, ReadOptions, ReadReport};

pub(crate) const FORMAT: Format = Format {
    name: "GPUDrive/Nocturne JSON (plain or gzip)",
    recognises,
    open: document::open::<File>,
};

/// Seconds between steps: that of the Waymo scenarios all these files come from.
const DT: f64 = 0.1;
/// The present of Waymo's scenarios, which the files do not state.
const PRESENT: usize = 10;

fn recognises(head: &[u8]) -> bool {
    const KEYS: [&str; 6] = [
        "name",
        "scenario_id",
        "objects",
        "roads",
        "tl_states",
        "metadata",
    ];
    let keys = json::keys(head);
    let known = keys.iter().all(|key| KEYS.contains(&key.as_str()));
    known && keys.iter().any(|key| key == "objects" || key == "roads")
}

#[derive(Deserialize)]
pub(crate) struct File {
    #[serde(default)]
    name: Option<String>,
    #[serde(default)]
    scenario_id: Option<String>,
    objects: Vec<Object>,
    roads: Vec<Road>,
    #[serde(default)]
    tl_states: Option<BTreeMap<String, Signal>>,
    #[serde(default)]
    metadata: Option<Metadata>,
}

#[derive(Deserialize)]
struct Object {
    position: Vec<Point>,
    heading: Vec<Real>,
    velocity: Vec<Point>,
    valid: Vec<Flag>,
    #[serde(default)]
    length: Real,
    #[serde(default)]
    width: Real,
    #[serde(default)]
    height: Real,
    #[serde(rename = "type")]
    kind: String,
    #[serde(default)]
    id: Option<i64>,
}

#[derive(Clone, Copy, Deserialize)]
struct Point {
    x: Real,
    y: Real,
    #[serde(default)]
    z: Real,
}

impl Point {
    fn place(self) -> DVec3 {
        dvec3(self.x.0, self.y.0, self.z.0)
    }
}

#[derive(Deserialize)]
struct Road {
    geometry: Vec<Point>,
    #[serde(rename = "type")]
    kind: String,
    #[serde(default)]
    map_element_id: Option<i64>,
    #[serde(default)]
    id: Option<i64>,
}

#[derive(Deserialize)]
struct Signal {
    state: Vec<String>,
    #[serde(default)]
    x: Vec<Real>,
    #[serde(default)]
    y: Vec<Real>,
    time_index: Vec<usize>,
}

#[derive(Deserialize)]
struct Metadata {
    #[serde(default)]
    sdc_track_index: Option<i64>,
    #[serde(default)]
    objects_of_interest: Vec<i64>,
    #[serde(default)]
    tracks_to_predict: Vec<Target>,
}

#[derive(Deserialize)]
struct Target {
    track_index: i64,
}

impl Document for File {
    const WHAT: &'static str = "a GPUDrive/Nocturne scenario as JSON";

    fn read(path: &Path) -> Result<Self, DataError> {
        json::read(path, Self::WHAT)
    }

    fn id(&self, path: &Path) -> String {
        let id = self.scenario_id.clone().or_else(|| self.name.clone());
        id.unwrap_or_else(|| document::stem(path))
    }

    fn scenario(
        self,
        id: String,
        options: ReadOptions,
        report: &mut ReadReport,
    ) -> Result<gump_scene::Scenario, Problem> {
        let mut parts = parts(&self.roads, report);
        parts.unstated.lights = self.tl_states.is_none();
        if parts.lanes.is_empty() && parts.road_edges.is_empty() {
            return Err(Problem::NoMap);
        }
        infer::lane_graph(&mut parts, options, report);
        let recording = self.recording(id, options, report)?;
        let mut scenario = assemble(recording, parts, options, report)?;
        infer::light_gaps(&mut scenario.log, scenario.now, DT, options, report);
        Ok(scenario)
    }
}

impl File {
    fn recording(
        self,
        id: String,
        options: ReadOptions,
        report: &mut ReadReport,
    ) -> Result<Recording, Problem> {
        let steps = self
            .objects
            .iter()
            .map(|o| o.valid.len())
            .max()
            .unwrap_or(0);
        let in_degrees = in_degrees(&self.objects);
        report.infer("time step of 0.1 s", 1);
        report.infer("present at step 10", 1);
        report.infer(
            "headings from degrees",
            if in_degrees { self.objects.len() } else { 0 },
        );
        let mut tracks = Vec::with_capacity(self.objects.len());
        for (index, object) in self.objects.iter().enumerate() {
            tracks.push(object.track(index, steps, in_degrees)?);
        }
        let track_id = |index: i64, what| {
            let track = usize::try_from(index).ok().and_then(|i| tracks.get(i));
            let len = tracks.len();
            track
                .map(|track| track.id)
                .ok_or(Problem::Index { what, len, index })
        };
        let stated = self.metadata.as_ref().and_then(|m| m.sdc_track_index);
        let ego = match stated {
            Some(index) => Some(track_id(index, "the index of the ego's track")?),
            None if options.infer_ego => last_full_vehicle(&tracks, steps, report),
            None => None,
        };
        let mut targets = Vec::new();
        for target in self.metadata.iter().flat_map(|m| &m.tracks_to_predict) {
            targets.push(track_id(
                target.track_index,
                "the index of a track to predict",
            )?);
        }
        Ok(Recording {
            id,
            dt: DT,
            steps,
            now: PRESENT.min(steps.saturating_sub(1)),
            ego,
            lights: lights(self.tl_states.as_ref(), report),
            targets: Some(targets),
            objects_of_interest: self
                .metadata
                .map(|m| m.objects_of_interest)
                .unwrap_or_default(),
            tags: Vec::new(),
            route: None,
            tracks,
        })
    }
}

/// The ego where it is not stated: the last vehicle that is there at every step.
///
/// Source: true of all of the 190 files that state it.
fn last_full_vehicle(tracks: &[Track], steps: usize, report: &mut ReadReport) -> Option<i64> {
    let full = |t: &&Track| t.kind == AgentKind::Vehicle && t.states.len() == steps;
    let id = tracks.iter().rev().find(full).map(|track| track.id);
    report.infer(
        "ego: the last vehicle that is always there",
        usize::from(id.is_some()),
    );
    id
}

impl Object {
    fn track(&self, index: usize, steps: usize, in_degrees: bool) -> Result<Track, Problem> {
        let id = self.id.unwrap_or(index as i64);
        let lengths = [
            self.position.len(),
            self.heading.len(),
            self.velocity.len(),
            self.valid.len(),
        ];
        if let Some(&found) = lengths.iter().find(|&&n| n != steps) {
            return Err(Problem::StateCount {
                track: id,
                expected: steps,
                found,
            });
        }
        let kind = agent_kind(&self.kind);
        let size = [self.length.0, self.width.0, self.height.0];
        let state = |step: usize| State {
            step,
            position: self.position[step].place(),
            heading: if in_degrees {
                self.heading[step].0.to_radians()
            } else {
                self.heading[step].0
            },
            velocity: dvec2(self.velocity[step].x.0, self.velocity[step].y.0),
            size,
        };
        Ok(Track {
            id,
            kind,
            usual_size: kind.usual_size(),
            states: (0..steps)
                .filter(|&step| self.valid[step].0)
                .map(state)
                .collect(),
        })
    }

    /// Headings of valid states with the direction of motion where there is enough.
    fn headings(&self) -> impl Iterator<Item = (f64, Option<f64>)> + '_ {
        let valid = self.valid.iter().zip(&self.heading).zip(&self.velocity);
        valid
            .filter(|((valid, _), _)| valid.0)
            .map(|((_, heading), velocity)| {
                let velocity = dvec2(velocity.x.0, velocity.y.0);
                (
                    heading.0,
                    (velocity.length() > 3.0).then(|| velocity.to_angle()),
                )
            })
    }
}

/// Whether headings are in degrees: the unit in which moving agents face where they move.
///
/// Large numbers alone prove nothing: a file in radians holds unwrapped headings up to 10. They
/// decide where nothing moves.
fn in_degrees(objects: &[Object]) -> bool {
    let advantage = objects
        .iter()
        .flat_map(Object::headings)
        .filter_map(|(heading, direction)| {
            let direction = direction?;
            let as_radians = angle_difference(heading, direction).cos();
            let as_degrees = angle_difference(heading.to_radians(), direction).cos();
            Some(as_degrees - as_radians).filter(|a| a.is_finite())
        });
    let advantage: f64 = advantage.sum();
    if advantage.abs() > ENOUGH {
        return advantage > 0.0;
    }
    let mut all = objects.iter().flat_map(Object::headings);
    all.any(|(heading, _)| heading.abs() > TWO_TURNS)
}

/// So much agreement of moving agents, as a sum of cosines, decides about the unit: a few steps of
/// one agent suffice. Chosen by hand.
const ENOUGH: f64 = 1.0;
/// Radians that no unwrapped heading of nine seconds in a parked scene reaches.
const TWO_TURNS: f64 = 2.0 * std::f64::consts::TAU;

fn agent_kind(name: &str) -> AgentKind {
    match name {
        "vehicle" => AgentKind::Vehicle,
        "pedestrian" => AgentKind::Pedestrian,
        "cyclist" => AgentKind::Bicycle,
        _ => AgentKind::Other,
    }
}

fn parts(roads: &[Road], report: &mut ReadReport) -> MapParts {
    let mut parts = MapParts::default();
    let mut lanes = std::collections::BTreeSet::new();
    for (index, road) in roads.iter().enumerate() {
        let id = road.id.unwrap_or(index as i64);
        let points: Vec<DVec3> = road.geometry.iter().map(|p| p.place()).collect();
        match road.kind.as_str() {
            "lane" if !lanes.insert(id) => {
                report.drop_damaged("lane whose id occurs before", || format!("lane {id}"));
            }
            "lane" => {
                let kind = lane_kind(road.map_element_id);
                parts
                    .lanes
                    .extend(features::lane(id, kind, &points, report));
            }
            "road_line" => {
                let kind = line_kind(road.map_element_id);
                features::add_road_line(&mut parts, id, kind, &points, report);
            }
            "road_edge" => {
                let kind = edge_kind(road.map_element_id);
                features::add_road_edge(&mut parts, id, kind, &points, report);
            }
            "crosswalk" => {
                features::add_area(&mut parts, id, AreaKind::Crosswalk, &points, report);
            }
            "speed_bump" => {
                features::add_area(&mut parts, id, AreaKind::SpeedBump, &points, report);
            }
            "driveway" => {
                features::add_area(&mut parts, id, AreaKind::Driveway, &points, report);
            }
            "stop_sign" => {
                let sound = points.first().filter(|p| p.is_finite());
                parts.stop_signs.extend(sound.map(|&position| StopSign {
                    id,
                    position,
                    lanes: Vec::new(),
                }));
            }
            _ => report.drop("map feature of an unknown type", 1),
        }
    }
    parts
}

/// Source: `road_types` of GPUDrive, which are Waymo's.
fn lane_kind(element: Option<i64>) -> LaneKind {
    match element {
        Some(1) => LaneKind::Freeway,
        Some(2) => LaneKind::SurfaceStreet,
        Some(3) => LaneKind::BikeLane,
        _ => LaneKind::Undefined,
    }
}

fn line_kind(element: Option<i64>) -> RoadLineKind {
    match element {
        Some(6) => RoadLineKind::BrokenSingleWhite,
        Some(7) => RoadLineKind::SolidSingleWhite,
        Some(8) => RoadLineKind::SolidDoubleWhite,
        Some(9) => RoadLineKind::BrokenSingleYellow,
        Some(10) => RoadLineKind::BrokenDoubleYellow,
        Some(11) => RoadLineKind::SolidSingleYellow,
        Some(12) => RoadLineKind::SolidDoubleYellow,
        Some(13) => RoadLineKind::PassingDoubleYellow,
        _ => RoadLineKind::Unknown,
    }
}

fn edge_kind(element: Option<i64>) -> RoadEdgeKind {
    match element {
        Some(15) => RoadEdgeKind::Boundary,
        Some(16) => RoadEdgeKind::Median,
        _ => RoadEdgeKind::Unknown,
    }
}

fn lights(
    signals: Option<&BTreeMap<String, Signal>>,
    report: &mut ReadReport,
) -> Vec<(usize, Light)> {
    let mut lights = Vec::new();
    for (lane, signal) in signals.into_iter().flatten() {
        let Ok(id) = lane.parse() else {
            report.drop_damaged("light of a lane that is no number", || lane.clone());
            continue;
        };
        for (i, (&step, state)) in signal.time_index.iter().zip(&signal.state).enumerate() {
            let stop = signal.x.get(i).zip(signal.y.get(i));
            let stop = stop.map(|(x, y)| dvec2(x.0, y.0)).filter(|p| p.is_finite());
            let light = Light {
                lane: LaneId(id),
                state: light_state(state),
                stop_point: stop,
            };
            lights.push((step, light));
        }
    }
    lights
}

fn light_state(name: &str) -> LightState {
    match name {
        "stop" | "arrow_stop" | "flashing_stop" => LightState::Red,
        "caution" | "arrow_caution" | "flashing_caution" => LightState::Yellow,
        "go" | "arrow_go" => LightState::Green,
        _ => LightState::Unknown,
    }
}
