//! Reads the document's own fields, tracks and lights.

use std::collections::BTreeMap;
use std::path::Path;

use gump_geometry::{DVec2, dvec2};
use gump_scene::{AgentKind, LaneId, Light, LightState, Scenario};
use serde::Deserialize;

use super::map::{self, Feature};
use super::names::{Names, place};
use super::{NAME, VERSION};
use crate::complete::infer;
use crate::complete::recording::{Recording, assemble};
use crate::complete::track::{self, State, Track, UNSTATED};
use crate::formats::document::{self, Document};
use crate::io::json::{self, Flag, Real};
use crate::{DataError, Problem, ReadOptions, ReadReport};

#[derive(Deserialize)]
pub(crate) struct File {
    #[serde(default)]
    format: Option<String>,
    #[serde(default)]
    version: Option<serde_json::Value>,
    #[serde(default)]
    id: Option<String>,
    #[serde(default)]
    length: Option<usize>,
    tracks: BTreeMap<String, TrackEntry>,
    map_features: BTreeMap<String, Feature>,
    #[serde(default)]
    dynamic_map_states: BTreeMap<String, Signal>,
    #[serde(default)]
    metadata: Metadata,
}

#[derive(Deserialize)]
struct TrackEntry {
    #[serde(rename = "type")]
    kind: String,
    state: States,
}

#[derive(Deserialize)]
struct States {
    position: Vec<Vec<Real>>,
    #[serde(default)]
    heading: Vec<Real>,
    #[serde(default)]
    velocity: Vec<Vec<Real>>,
    #[serde(default)]
    valid: Option<Vec<Flag>>,
    #[serde(default)]
    length: OneOrMany,
    #[serde(default)]
    width: OneOrMany,
    #[serde(default)]
    height: OneOrMany,
}

/// A number for all steps, or one for each.
#[derive(Deserialize)]
#[serde(untagged)]
enum OneOrMany {
    One(f64),
    Many(Vec<Option<f64>>),
    Nested(Vec<Vec<f64>>),
}

impl Default for OneOrMany {
    fn default() -> Self {
        Self::One(UNSTATED)
    }
}

impl OneOrMany {
    fn at(&self, step: usize) -> f64 {
        match self {
            Self::One(value) => *value,
            Self::Many(values) => values.get(step).copied().flatten().unwrap_or(UNSTATED),
            Self::Nested(values) => values
                .get(step)
                .and_then(|v| v.first())
                .copied()
                .unwrap_or(UNSTATED),
        }
    }
}

#[derive(Deserialize)]
struct Signal {
    state: SignalStates,
    #[serde(default)]
    lane: Option<serde_json::Value>,
    #[serde(default)]
    stop_point: Option<Vec<Real>>,
}

#[derive(Deserialize)]
struct SignalStates {
    object_state: Vec<Option<String>>,
}

#[derive(Default, Deserialize)]
struct Metadata {
    #[serde(default)]
    scenario_id: Option<String>,
    #[serde(default, alias = "timestep")]
    ts: Vec<Real>,
    #[serde(default)]
    sdc_id: Option<serde_json::Value>,
    #[serde(default)]
    current_time_index: Option<i64>,
    #[serde(default)]
    tracks_to_predict: BTreeMap<String, serde_json::Value>,
    #[serde(default)]
    objects_of_interest: Vec<serde_json::Value>,
}

impl Document for File {
    const WHAT: &'static str = "a scenario as JSON";

    fn read(path: &Path) -> Result<Self, DataError> {
        json::read(path, Self::WHAT)
    }

    fn id(&self, path: &Path) -> String {
        let stated = self
            .id
            .clone()
            .or_else(|| self.metadata.scenario_id.clone());
        stated.unwrap_or_else(|| document::stem(path))
    }

    fn scenario(
        self,
        id: String,
        options: ReadOptions,
        report: &mut ReadReport,
    ) -> Result<Scenario, Problem> {
        self.check_version()?;
        let mut names = Names::default();
        let mut parts = map::parts(&self.map_features, &mut names, report);
        if parts.lanes.is_empty() && parts.road_edges.is_empty() {
            return Err(Problem::NoMap);
        }
        infer::lane_graph(&mut parts, options, report);
        let recording = self.recording(id, &mut names, report)?;
        assemble(recording, parts, options, report)
    }
}

impl File {
    /// Files of ours state their version; those of ScenarioNet state its own, which is not looked at.
    fn check_version(&self) -> Result<(), Problem> {
        let ours = self.format.as_deref() == Some(NAME);
        let version = self.version.as_ref().and_then(serde_json::Value::as_i64);
        if ours && version != Some(VERSION) {
            let found = self
                .version
                .as_ref()
                .map_or("none".into(), ToString::to_string);
            return Err(Problem::Unexpected {
                expected: "version 1",
                found: found.into(),
                place: "the key version".into(),
            });
        }
        Ok(())
    }

    fn recording(
        self,
        id: String,
        names: &mut Names,
        report: &mut ReadReport,
    ) -> Result<Recording, Problem> {
        if self.tracks.is_empty() {
            return Ok(Recording::of_nobody(id));
        }
        let longest = self
            .tracks
            .values()
            .map(|t| t.state.position.len())
            .max()
            .unwrap_or(0);
        let n = self.length.unwrap_or(longest).min(longest);
        let clock = Clock::of(&self.metadata.ts, n, report)?;
        let tracks: Vec<Track> = self
            .tracks
            .iter()
            .map(|(name, entry)| entry.track(names.id(name), n, &clock))
            .collect();
        let steps = clock.steps(n);
        let now = match self.metadata.current_time_index {
            Some(index) => {
                let stated = usize::try_from(index).ok().filter(|&i| i < n);
                clock.step(stated.ok_or(Problem::Index {
                    what: "the index of the present",
                    len: n,
                    index,
                })?)
            }
            None => {
                report.infer("present one second in, or at the start", 1);
                track::usual_present(steps, clock.dt)
            }
        };
        let mut lights = Vec::new();
        for (name, signal) in &self.dynamic_map_states {
            let lane = signal.lane.as_ref().and_then(|lane| names.of(lane));
            let lane = LaneId(lane.unwrap_or_else(|| names.id(name)));
            lights.extend(
                signal
                    .lights(lane)
                    .map(|(index, light)| (clock.step(index), light)),
            );
        }
        let ids = self
            .metadata
            .tracks_to_predict
            .keys()
            .map(|name| names.id(name));
        let targets = ids.collect();
        let interesting = self.metadata.objects_of_interest.iter();
        Ok(Recording {
            id,
            dt: clock.dt,
            steps,
            now,
            ego: self
                .metadata
                .sdc_id
                .as_ref()
                .and_then(|name| names.of(name)),
            lights,
            targets: Some(targets),
            objects_of_interest: interesting.filter_map(|name| names.of(name)).collect(),
            tags: Vec::new(),
            route: None,
            tracks,
        })
    }
}

/// From indices of states to steps of equal length.
struct Clock {
    dt: f64,
    /// The step of each index; empty if they are the same.
    steps: Vec<usize>,
}

impl Clock {
    /// Steps are as long as the median distance of time stamps; a gap leaves steps empty.
    fn of(stamps: &[Real], n: usize, report: &mut ReadReport) -> Result<Self, Problem> {
        let sound = stamps.len() >= 2 && stamps.iter().all(|t| t.0.is_finite());
        if !sound {
            report.infer("time step of 0.1 s", 1);
            return Ok(Self {
                dt: 0.1,
                steps: Vec::new(),
            });
        }
        let mut sorted: Vec<f64> = stamps.iter().map(|t| t.0).collect();
        if !sorted.is_sorted() {
            report.drop("order of time stamps that are not sorted", 1);
            sorted.sort_by(f64::total_cmp);
        }
        let first = sorted[0];
        let mut gaps: Vec<f64> = sorted.windows(2).map(|pair| pair[1] - pair[0]).collect();
        gaps.sort_by(f64::total_cmp);
        let dt = (gaps[gaps.len() / 2] * 1000.0).round() / 1000.0;
        if !(dt > 0.0 && dt < 10.0) {
            return Err(Problem::TimeStep {
                expected: 0.1,
                found: dt,
                step: 1,
            });
        }
        let step = |t: &Real| ((t.0 - first) / dt).round().clamp(0.0, 1e9) as usize;
        let mut steps: Vec<usize> = stamps.iter().take(n).map(step).collect();
        while steps.len() < n {
            steps.push(steps.last().map_or(0, |last| last + 1));
        }
        let missing = steps
            .iter()
            .max()
            .map_or(0, |last| last + 1)
            .saturating_sub(n);
        report.drop("step missing between time stamps", missing);
        Ok(Self { dt, steps })
    }

    fn step(&self, index: usize) -> usize {
        self.steps.get(index).copied().unwrap_or(index)
    }

    fn steps(&self, n: usize) -> usize {
        self.steps.iter().max().map_or(n, |last| last + 1)
    }
}

impl TrackEntry {
    fn track(&self, id: i64, n: usize, clock: &Clock) -> Track {
        let kind = agent_kind(&self.kind);
        let states = &self.state;
        let valid = |i: &usize| {
            states
                .valid
                .as_ref()
                .is_none_or(|v| v.get(*i).is_some_and(|v| v.0))
        };
        let state = |i: usize| State {
            step: clock.step(i),
            position: place(&states.position[i]),
            heading: states.heading.get(i).map_or(UNSTATED, |h| h.0),
            velocity: states
                .velocity
                .get(i)
                .map_or(DVec2::NAN, |v| place(v).truncate()),
            size: [states.length.at(i), states.width.at(i), states.height.at(i)],
        };
        Track {
            id,
            kind,
            usual_size: kind.usual_size(),
            states: (0..n.min(states.position.len()))
                .filter(valid)
                .map(state)
                .collect(),
        }
    }
}

fn agent_kind(name: &str) -> AgentKind {
    match name {
        "VEHICLE" => AgentKind::Vehicle,
        "PEDESTRIAN" => AgentKind::Pedestrian,
        "CYCLIST" => AgentKind::Bicycle,
        "TRAFFIC_CONE" => AgentKind::TrafficCone,
        "TRAFFIC_BARRIER" => AgentKind::Barrier,
        "TRAFFIC_SIGN" => AgentKind::Sign,
        _ => AgentKind::Other,
    }
}

impl Signal {
    fn lights(&self, lane: LaneId) -> impl Iterator<Item = (usize, Light)> + '_ {
        let stop = self.stop_point.as_deref().map(|p| place(p).truncate());
        let stop_point = stop.filter(|p| p.is_finite()).map(|p| dvec2(p.x, p.y));
        let states = self.state.object_state.iter().enumerate();
        states.filter_map(move |(i, state)| {
            let state = light_state(state.as_deref()?);
            Some((
                i,
                Light {
                    lane,
                    state,
                    stop_point,
                },
            ))
        })
    }
}

/// Source: the lane states of Waymo's format and the light names of MetaDrive.
fn light_state(name: &str) -> LightState {
    match name {
        "TRAFFIC_LIGHT_RED"
        | "LANE_STATE_STOP"
        | "LANE_STATE_ARROW_STOP"
        | "LANE_STATE_FLASHING_STOP" => LightState::Red,
        "TRAFFIC_LIGHT_YELLOW"
        | "LANE_STATE_CAUTION"
        | "LANE_STATE_ARROW_CAUTION"
        | "LANE_STATE_FLASHING_CAUTION" => LightState::Yellow,
        "TRAFFIC_LIGHT_GREEN" | "LANE_STATE_GO" | "LANE_STATE_ARROW_GO" => LightState::Green,
        _ => LightState::Unknown,
    }
}
