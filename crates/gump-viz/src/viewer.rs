//! The viewer: one HTML file in which to play scenes, their logs and any number of futures.
//!
//! [`Viewer`] collects the content of a scene, `viewer/annotations.rs` the metrics, predictions and
//! candidate paths shown beside it; `viewer/pack.rs` packs it; `viewer/gallery.rs` puts scenes and
//! page together. The page itself is `viewer/*.js` and `traffic.js`, plain script without
//! libraries. Its colours are in `theme.rs` and `palette.css`, shared with pictures and pages.

mod annotations;
mod gallery;
mod pack;
#[cfg(feature = "rerun")]
mod recording;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::path::Path;

use gump_geometry::DVec2;
use gump_scene::{Agent, AgentId, AreaKind, Frame, Light, MapGraph, Rollout, Scenario};
use serde_json::{Value, json};

use crate::VizError;
use crate::draw_map::{is_for_cars, style};
use annotations::{CELL, SPEED, TURN_DEG};
pub use annotations::{CandidatePath, HeatMap, MetricTrack};
pub use gallery::Gallery;
use pack::{CENTI, Class, HEADINGS, Packer, units};

/// The map is kept within this distance of any agent, metres: what a look at it shows. Chosen by
/// hand; more makes pages larger.
const MARGIN: f64 = 120.0;

/// A scene under preparation for the browser.
///
/// The page shows positions to 1 cm, speeds to 1 cm/s, headings to 1/8192 of a turn. An agent
/// keeps the extent it has in the present, or where it is first seen.
#[derive(Clone, Debug)]
pub struct Viewer<'a> {
    scenario: &'a Scenario,
    futures: Vec<(String, &'a Rollout)>,
    metrics: Vec<MetricTrack>,
    heat: Vec<HeatMap>,
    plausibility: BTreeMap<AgentId, f64>,
    deeds: BTreeMap<AgentId, String>,
    candidates: Vec<CandidatePath>,
    note: String,
}

/// The log or a future, as the page knows it.
struct ShownRollout<'a> {
    name: &'a str,
    /// Seconds from the present to the first frame.
    first: f64,
    dt: f64,
    frames: Vec<&'a Frame>,
}

impl<'a> Viewer<'a> {
    /// A viewer of the log alone.
    pub fn new(scenario: &'a Scenario) -> Self {
        Self {
            scenario,
            futures: Vec::new(),
            metrics: Vec::new(),
            heat: Vec::new(),
            plausibility: BTreeMap::new(),
            deeds: BTreeMap::new(),
            candidates: Vec::new(),
            note: String::new(),
        }
    }

    /// Sets the line under the title.
    pub fn note(&mut self, text: impl Into<String>) -> &mut Self {
        self.note = text.into();
        self
    }

    /// Adds a future, which begins in the present of the scenario.
    pub fn future(&mut self, name: impl Into<String>, rollout: &'a Rollout) -> &mut Self {
        self.futures.push((name.into(), rollout));
        self
    }

    /// Adds futures under the numbers 1, 2, ...
    pub fn futures(&mut self, rollouts: &'a [Rollout]) -> &mut Self {
        for rollout in rollouts {
            let number = self.futures.len() + 1;
            self.future(number.to_string(), rollout);
        }
        self
    }

    /// Adds a metric, shown when its agent is chosen.
    pub fn metric(&mut self, track: MetricTrack) -> &mut Self {
        self.metrics.push(track);
        self
    }

    /// Adds a distribution of the next states of an agent, shown when it is chosen in that future.
    pub fn heat(&mut self, heat: HeatMap) -> &mut Self {
        self.heat.push(heat);
        self
    }

    /// Sets how plausible an agent's futures are, 0 to 1, shown as a colour: its realism times the
    /// share of futures without an implausible action.
    pub fn plausibility(&mut self, agent: AgentId, plausibility: f64) -> &mut Self {
        self.plausibility.insert(agent, plausibility);
        self
    }

    /// Sets a description of the violations of an agent in its futures, shown when it is chosen;
    /// empty for none.
    pub fn deeds(&mut self, agent: AgentId, words: impl Into<String>) -> &mut Self {
        self.deeds.insert(agent, words.into());
        self
    }

    /// Adds a path that a planner considered.
    pub fn candidate(&mut self, candidate: CandidatePath) -> &mut Self {
        self.candidates.push(candidate);
        self
    }

    /// The whole page; it refers to nothing outside itself.
    pub fn to_html(&self) -> String {
        self.gallery().to_html()
    }

    /// Writes the page; a reader finds the old file or the new one, never half of one.
    ///
    /// # Errors
    /// [`VizError::Write`] with the path.
    pub fn save(&self, path: &Path) -> Result<(), VizError> {
        self.gallery().save(path)
    }

    /// This scene alone.
    fn gallery(&self) -> Gallery {
        let mut gallery = Gallery::default();
        gallery.add(self);
        gallery
    }

    /// Returns the JSON description for the page, and the bytes of road and traffic.
    fn pack(&self) -> (Value, Vec<u8>) {
        let scenario = self.scenario;
        let takes = self.takes();
        let agents = agents(scenario, &takes);
        let lights = lights(&scenario.map, &takes);
        let origin = scenario.present().ego_now().state.pose.position.round();
        let mut packer = Packer::new(origin);
        let n_features = self.pack_map(&mut packer, window(&takes));
        for take in &takes {
            for agent in &agents {
                packer.track(agent.id, &take.frames);
            }
            for (light, _) in &lights {
                packer.light(light.lane, &take.frames);
            }
        }
        let place = |id: AgentId| agents.iter().position(|agent| agent.id == id);
        let names = self.pack_metrics_and_heat(&mut packer, origin, &place);
        let local = |p: DVec2| {
            let p = p - origin;
            [units(p.x, CENTI), units(p.y, CENTI)]
        };
        let facts = json!({
            "id": scenario.id,
            "note": self.note,
            "origin": [origin.x, origin.y],
            "ego": place(scenario.ego),
            "centi": CENTI,
            "headings": HEADINGS,
            "features": n_features,
            "agents": agents.iter().map(|a| json!({
                "id": a.id.to_string(),
                "kind": a.kind.name(),
                "length": rounded(a.length),
                "width": rounded(a.width),
                "plausibility": self.plausibility.get(&a.id).map(|&share| rounded(share)),
                "deeds": self.deeds.get(&a.id).filter(|words| !words.is_empty()),
            })).collect::<Vec<_>>(),
            "lights": lights.iter().map(|&(_, at)| local(at)).collect::<Vec<_>>(),
            "takes": takes.iter().map(|take| json!({
                "name": take.name,
                "first": take.first,
                "dt": take.dt,
                "frames": take.frames.len(),
            })).collect::<Vec<_>>(),
            "metrics": names,
            "cell": CELL,
            "speedBar": SPEED,
            "turnBar": TURN_DEG,
            "candidates": self.candidates.iter().map(|c| json!({
                "name": c.name,
                "score": c.score,
                "parts": c.parts,
                "chosen": c.is_chosen,
                "path": c.path.iter().map(|&p| local(p)).collect::<Vec<_>>(),
            })).collect::<Vec<_>>(),
        });
        (facts, packer.into_bytes())
    }

    /// Packs metrics and heat maps, each list after its length; returns the names of the metrics.
    /// Those of agents that no take has are left out.
    fn pack_metrics_and_heat(
        &self,
        packer: &mut Packer,
        origin: DVec2,
        place: &impl Fn(AgentId) -> Option<usize>,
    ) -> Vec<&str> {
        let mut names: Vec<&str> = Vec::new();
        let of_known = |track: &&MetricTrack| place(track.agent).is_some();
        let metrics: Vec<_> = self.metrics.iter().filter(of_known).collect();
        packer.unsigned(metrics.len() as u64);
        for track in metrics {
            let known = names.iter().position(|name| *name == track.name);
            let name = known.unwrap_or_else(|| {
                names.push(&track.name);
                names.len() - 1
            });
            track.pack(packer, name, place(track.agent).unwrap_or_default());
        }
        let heat = self.heat.iter().filter(|heat| place(heat.agent).is_some());
        let heat: Vec<_> = heat.collect();
        packer.unsigned(heat.len() as u64);
        for heat in heat {
            heat.pack(packer, place(heat.agent).unwrap_or_default(), origin);
        }
        names
    }

    /// The log, then the futures with the present as their first frame.
    fn takes(&self) -> Vec<ShownRollout<'_>> {
        let scenario = self.scenario;
        let log = ShownRollout {
            name: "log",
            first: -(scenario.now as f64) * scenario.dt,
            dt: scenario.dt,
            frames: scenario.log.iter().collect(),
        };
        let futures = self.futures.iter().map(|(name, rollout)| ShownRollout {
            name,
            first: 0.0,
            dt: rollout.dt(),
            frames: std::iter::once(rollout.start())
                .chain(rollout.imagined())
                .collect(),
        });
        std::iter::once(log).chain(futures).collect()
    }

    /// Packs the road near the agents in the order in which it is drawn; returns how many features.
    fn pack_map(&self, packer: &mut Packer, window: (DVec2, DVec2)) -> usize {
        let map = &self.scenario.map;
        let mut n = 0;
        let mut add = |class, width, points: &[DVec2]| {
            if meets(points, window) {
                packer.feature(class, width, points);
                n += 1;
            }
        };
        for polygon in map.drivable() {
            add(Class::Surface, 0.0, polygon.ring());
        }
        for lane in map.lanes().iter().filter(|lane| is_for_cars(lane)) {
            let class = if lane.in_intersection {
                Class::Turn
            } else {
                Class::Lane
            };
            add(class, lane.width, lane.centerline.points());
        }
        if let Some(route) = &self.scenario.route {
            let lanes: Vec<_> = route.lanes.iter().filter_map(|&id| map.lane(id)).collect();
            for lane in &lanes {
                add(Class::Route, lane.width, lane.centerline.points());
            }
            if lanes.is_empty() {
                add(Class::Route, 3.0, route.path.points());
            }
        }
        for area in map.areas() {
            if let Some(class) = class_of(area.kind) {
                add(class, 0.0, area.polygon.ring());
            }
        }
        for line in map.road_lines() {
            let class = match style(line.kind) {
                (false, true) => Class::BrokenWhite,
                (false, false) => Class::SolidWhite,
                (true, true) => Class::BrokenYellow,
                (true, false) => Class::SolidYellow,
            };
            add(class, 0.0, line.line.points());
        }
        for edge in map.road_edges() {
            add(Class::Edge, 0.0, edge.line.points());
        }
        for sign in map.stop_signs() {
            add(Class::StopSign, 0.0, &[sign.position.truncate()]);
        }
        n
    }
}

fn class_of(kind: AreaKind) -> Option<Class> {
    match kind {
        AreaKind::Intersection | AreaKind::Driveway | AreaKind::Carpark => Some(Class::Surface),
        AreaKind::Crosswalk => Some(Class::Crosswalk),
        AreaKind::SpeedBump => Some(Class::SpeedBump),
        AreaKind::StopLine | AreaKind::TurnStop => Some(Class::StopLine),
        AreaKind::Walkway => None,
    }
}

/// Every agent of any take by id, as it is in the present or else first seen.
fn agents(scenario: &Scenario, takes: &[ShownRollout<'_>]) -> Vec<Agent> {
    let present = scenario.log[scenario.now].agents();
    let later = takes.iter().flat_map(|take| &take.frames);
    let mut agents = BTreeMap::<AgentId, Agent>::new();
    for agent in present.iter().chain(later.flat_map(|f| f.agents())) {
        agents.entry(agent.id).or_insert(*agent);
    }
    agents.into_values().collect()
}

/// Every light of any take, by lane, and where to draw it.
fn lights(map: &MapGraph, takes: &[ShownRollout<'_>]) -> Vec<(Light, DVec2)> {
    let mut lights = BTreeMap::new();
    for light in takes
        .iter()
        .flat_map(|take| &take.frames)
        .flat_map(|frame| frame.lights())
    {
        let start = || map.lane(light.lane).map(|lane| lane.centerline.points()[0]);
        if let Some(at) = light.stop_point.or_else(start) {
            lights.entry(light.lane).or_insert((*light, at));
        }
    }
    lights.into_values().collect()
}

/// The corners of the world that is worth keeping.
fn window(takes: &[ShownRollout<'_>]) -> (DVec2, DVec2) {
    let frames = takes.iter().flat_map(|take| &take.frames);
    let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    for agent in frames.flat_map(|frame| frame.agents()) {
        let at = agent.state.pose.position;
        (low, high) = (low.min(at), high.max(at));
    }
    (low - MARGIN, high + MARGIN)
}

/// Whether the bounds of the points and the window have a point in common.
fn meets(points: &[DVec2], (low, high): (DVec2, DVec2)) -> bool {
    let least = points.iter().copied().fold(DVec2::INFINITY, DVec2::min);
    let most = points.iter().copied().fold(DVec2::NEG_INFINITY, DVec2::max);
    least.cmple(high).all() && most.cmpge(low).all()
}

/// To three decimals, which is what a chart can show.
fn rounded(x: f64) -> f64 {
    (x * 1000.0).round() / 1000.0
}
