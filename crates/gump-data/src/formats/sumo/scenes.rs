//! Cutting of scenarios from a long recording: a time window, an ego, and its surroundings.

use std::collections::VecDeque;
use std::path::PathBuf;
use std::sync::Arc;

use gump_geometry::{DVec2, wrap_angle};
use gump_scene::{Agent, AgentId, AgentKind, AgentState, Frame, Light, MapGraph, Scenario, Seed};
use rand::Rng as _;

use super::floating_cars::{FloatingCars, Placed, Snapshot};
use super::roads::Roads;
use super::signals::Signals;
use crate::complete::infer;
use crate::record::OVERLAP_TOLERANCE;
use crate::source::RecordSource;
use crate::{DataError, Problem, ReadOptions, RecordLocation, ScenarioRecord};

// Chosen by hand, here and in [`CutOptions::standard`] where it names no source.
/// Metres around a vehicle in which others make it an interesting ego.
const INTEREST_RANGE: f64 = 50.0;
/// More neighbours than this make no ego more interesting.
const MANY_NEIGHBORS: f64 = 12.0;
/// An ego drives at least this far in a window, metres.
const MIN_DRIVEN: f64 = 5.0;
/// An ego is a car or a van: so long, metres.
const EGO_LENGTH: [f64; 2] = [3.0, 7.0];
/// Time stamps may stray from the step by this, seconds: they are written with two digits.
const TIME_TOLERANCE: f64 = 0.011;

/// A recording may reach this far beyond its network, metres: sidewalks and long vehicles.
const MARGIN: f64 = 50.0;

/// Settings of cutting scenarios from a recording.
#[derive(Clone, Debug, PartialEq)]
pub struct CutOptions {
    /// Seconds before the present.
    pub history_s: f64,
    /// Seconds after the present.
    pub future_s: f64,
    /// Seconds left out between two windows.
    pub pause_s: f64,
    /// Agents further than this from the ego are left out, metres.
    pub sight_m: f64,
    /// The map reaches this far around the ego's way, metres.
    pub map_m: f64,
    /// Scenarios cut out of one window at most, each around another ego.
    pub egos: usize,
    /// Egos of one window are at least so far apart at the present, metres.
    pub apart_m: f64,
    /// One ego in so many stands still for the whole window; 0 for none.
    pub standing_one_in: u32,
    /// Leave out scenarios in which boxes overlap by more than 0.1 m at the present.
    pub without_overlaps: bool,
    /// The seed of the choice of egos.
    pub seed: Seed,
}

impl CutOptions {
    /// Nine seconds with the present at one, as the Waymo Open Motion Dataset has them; sight of
    /// 120 m, about what a roof-mounted lidar has.
    pub fn standard() -> Self {
        Self {
            history_s: 1.0,
            future_s: 8.0,
            pause_s: 0.0,
            sight_m: 120.0,
            map_m: 150.0,
            egos: 4,
            apart_m: 60.0,
            standing_one_in: 8,
            without_overlaps: false,
            seed: Seed(0),
        }
    }
}

/// The scenarios of a recording, window after window.
pub struct Scenes {
    cars: FloatingCars,
    roads: Arc<Roads>,
    signals: Signals,
    cut: CutOptions,
    options: ReadOptions,
    name: String,
    path: Arc<PathBuf>,
    window: Vec<Snapshot>,
    n_windows: u64,
    ready: VecDeque<(String, i64)>,
    is_broken: bool,
    skip_until: f64,
}

impl Scenes {
    pub(super) fn new(
        cars: FloatingCars,
        roads: Arc<Roads>,
        signals: Signals,
        cut: CutOptions,
        options: ReadOptions,
    ) -> Self {
        let path = Arc::new(cars.path().to_path_buf());
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let name = name.split('.').next().unwrap_or_default().to_owned();
        Self {
            cars,
            roads,
            signals,
            cut,
            options,
            name,
            path,
            window: Vec::new(),
            n_windows: 0,
            ready: VecDeque::new(),
            is_broken: false,
            skip_until: f64::NEG_INFINITY,
        }
    }

    /// Reads the next window; false at the end of the file.
    fn read_window(&mut self) -> Result<bool, DataError> {
        self.window.clear();
        let mut wanted = 2;
        while self.window.len() < wanted {
            let Some(snapshot) = self.cars.next()? else {
                return Ok(false);
            };
            if snapshot.time < self.skip_until {
                continue;
            }
            self.window.push(snapshot);
            let [first, second, ..] = &self.window[..] else {
                continue;
            };
            let dt = second.time - first.time;
            if self.is_steady(dt) {
                wanted = self.now(dt) + (self.cut.future_s / dt).round() as usize + 1;
            } else {
                // A gap, or a time that comes again, begins a new window.
                let last = self.window.pop();
                self.window.clear();
                self.window.extend(last);
                wanted = 2;
            }
        }
        if self.n_windows == 0 && !self.is_on_roads() {
            return Err(DataError::NoNetwork {
                path: self.path.to_path_buf(),
            });
        }
        let last = self.window.last().map_or(0.0, |snapshot| snapshot.time);
        self.skip_until = last + self.cut.pause_s;
        self.n_windows += 1;
        Ok(true)
    }

    /// True if the last two snapshots are one time step apart.
    fn is_steady(&self, dt: f64) -> bool {
        let [.., before, last] = &self.window[..] else {
            return false;
        };
        let found = last.time - before.time;
        (found - dt).abs() <= TIME_TOLERANCE && dt > TIME_TOLERANCE
    }

    /// False if most of what moves is outside of the network: it belongs to another recording.
    fn is_on_roads(&self) -> bool {
        let Some((min, max)) = self.roads.bounds() else {
            return false;
        };
        let bodies = || {
            self.window
                .iter()
                .flat_map(|snapshot| snapshot.bodies.values())
        };
        let inside = |placed: &&Placed| {
            let position = placed.pose.position;
            position.cmpge(min - MARGIN).all() && position.cmple(max + MARGIN).all()
        };
        2 * bodies().filter(inside).count() >= bodies().count()
    }

    fn now(&self, dt: f64) -> usize {
        (self.cut.history_s / dt).round() as usize
    }

    fn dt(&self) -> f64 {
        let n = self.window.len() - 1;
        let mean = (self.window[n].time - self.window[0].time) / n as f64;
        (mean * 1000.0).round() / 1000.0
    }

    /// Chooses the egos of the window: in traffic rather than alone, far from each other.
    fn choose_egos(&mut self) {
        let mut rng = self.cut.seed.fork(self.n_windows).rng();
        let now = &self.window[self.now(self.dt())].bodies;
        let mut ranked: Vec<(f64, i64, DVec2)> = Vec::new();
        for (&id, placed) in now {
            let draw: f64 = rng.random_range(0.0..1.0);
            let stands: f64 = rng.random_range(0.0..1.0);
            if placed.body.kind != AgentKind::Vehicle
                || !(EGO_LENGTH[0]..EGO_LENGTH[1]).contains(&placed.body.size[0])
            {
                continue;
            }
            let there: Option<Vec<DVec2>> = self
                .window
                .iter()
                .map(|snapshot| snapshot.bodies.get(&id).map(|p| p.pose.position))
                .collect();
            let Some(there) = there else { continue };
            let driven = there[0].distance(there[there.len() - 1]);
            let may_stand =
                stands * f64::from(self.cut.standing_one_in) < 1.0 && self.cut.standing_one_in > 0;
            if driven < MIN_DRIVEN && !may_stand {
                continue;
            }
            let here = placed.pose.position;
            let near = |p: &&Placed| p.pose.position.distance(here) < INTEREST_RANGE;
            let neighbors = now.values().filter(near).count() as f64;
            let interest = neighbors.min(MANY_NEIGHBORS) / MANY_NEIGHBORS;
            ranked.push((interest + draw, id, here));
        }
        ranked.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        let mut chosen: Vec<(i64, DVec2)> = Vec::new();
        for (_, id, here) in ranked {
            let apart = |(_, other): &(i64, DVec2)| other.distance(here) >= self.cut.apart_m;
            if chosen.len() < self.cut.egos && chosen.iter().all(apart) {
                chosen.push((id, here));
            }
        }
        let window = self.n_windows - 1;
        let named = chosen
            .iter()
            .map(|(id, _)| (format!("{}-{window:03}-{id}", self.name), *id));
        self.ready.extend(named);
    }

    /// The scenario around an ego; `None` if its boxes overlap and that is unwanted.
    fn scenario(&self, id: &str, ego: i64) -> Result<Option<ScenarioRecord>, DataError> {
        let dt = self.dt();
        let way: Vec<DVec2> = self
            .window
            .iter()
            .filter_map(|snapshot| Some(snapshot.bodies.get(&ego)?.pose.position))
            .collect();
        let mut report = self.roads.report().clone();
        report.merge(&self.cars.report);
        let stated = self
            .roads
            .around(&thin(&way, self.cut.map_m / 8.0), self.cut.map_m);
        let problem = |problem: Problem| DataError::Scenario {
            id: id.to_owned(),
            problem,
            place: RecordLocation {
                record: self.n_windows as usize - 1,
                offset: self.cars.offset(),
                path: self.path.to_path_buf(),
            },
        };
        let map = MapGraph::new(stated).map_err(|error| problem(error.into()))?;
        let log: Vec<Frame> = (0..self.window.len())
            .map(|step| self.frame(step, way[step], &map, dt))
            .collect();
        let now = self.now(dt);
        if self.cut.without_overlaps && has_overlap(&log[now]) {
            return Ok(None);
        }
        let targets = infer::choose_targets(&log, now, AgentId(ego));
        let mut scenario = Scenario {
            id: id.to_owned(),
            map: Arc::new(map),
            route: None,
            log,
            dt,
            now,
            ego: AgentId(ego),
            targets,
            objects_of_interest: Vec::new(),
            tags: Vec::new(),
        };
        scenario.validate().map_err(|error| problem(error.into()))?;
        infer::route(&mut scenario, self.options, &mut report);
        Ok(Some(ScenarioRecord {
            scenario,
            report,
            offset: self.cars.offset(),
            path: Arc::clone(&self.path),
        }))
    }

    fn frame(&self, step: usize, centre: DVec2, map: &MapGraph, dt: f64) -> Frame {
        let snapshot = &self.window[step];
        let in_sight = |placed: &Placed| placed.pose.position.distance(centre) <= self.cut.sight_m;
        let agents = snapshot
            .bodies
            .iter()
            .filter(|(_, placed)| in_sight(placed));
        let agents = agents
            .map(|(&id, placed)| self.agent(step, id, placed, dt))
            .collect();
        let lights = self.signals.at(snapshot.time, &self.roads);
        let known = |light: &Light| map.lane(light.lane).is_some();
        Frame::new(agents, lights.into_iter().filter(known).collect())
    }

    fn agent(&self, step: usize, id: i64, placed: &Placed, dt: f64) -> Agent {
        let at = |step: Option<usize>| {
            let snapshot = self.window.get(step?)?;
            snapshot.bodies.get(&id).map(|placed| placed.pose.position)
        };
        let here = placed.pose.position;
        // Velocities are differences of positions, centred where both neighbours exist; at the
        // present the next one is not known yet.
        let next = (step != self.now(dt)).then_some(step + 1);
        let velocity = match (at(step.checked_sub(1)), at(next)) {
            (Some(before), Some(after)) => (after - before) / (2.0 * dt),
            (Some(before), None) => (here - before) / dt,
            (None, Some(after)) => (after - here) / dt,
            (None, None) => DVec2::ZERO,
        };
        let [length, width, height] = placed.body.size;
        let mut pose = placed.pose;
        pose.heading = wrap_angle(pose.heading);
        Agent {
            id: AgentId(id),
            kind: placed.body.kind,
            length,
            width,
            height,
            elevation: placed.ground + height / 2.0,
            state: AgentState { pose, velocity },
        }
    }
}

impl RecordSource for Scenes {
    fn next_wanted(
        &mut self,
        wanted: &mut dyn FnMut(&str) -> bool,
    ) -> Option<Result<ScenarioRecord, DataError>> {
        loop {
            while let Some((id, ego)) = self.ready.pop_front() {
                if !wanted(&id) {
                    continue;
                }
                if let Some(record) = self.scenario(&id, ego).transpose() {
                    return Some(record);
                }
            }
            if self.is_broken {
                return None;
            }
            match self.read_window() {
                Ok(true) => self.choose_egos(),
                Ok(false) => return None,
                Err(error) => {
                    self.is_broken = true;
                    return Some(Err(error));
                }
            }
        }
    }
}

impl Iterator for Scenes {
    type Item = Result<ScenarioRecord, DataError>;

    fn next(&mut self) -> Option<Self::Item> {
        self.next_wanted(&mut |_| true)
    }
}

/// Points of a way no nearer to each other than `spacing`, the first and the last included.
fn thin(way: &[DVec2], spacing: f64) -> Vec<DVec2> {
    let mut kept: Vec<DVec2> = Vec::new();
    for &point in way {
        if kept
            .last()
            .is_none_or(|last| last.distance(point) >= spacing)
        {
            kept.push(point);
        }
    }
    kept.extend(way.last());
    kept
}

fn has_overlap(frame: &Frame) -> bool {
    let agents = frame.agents();
    agents.iter().enumerate().any(|(i, a)| {
        agents[i + 1..].iter().any(|b| {
            let (a, b) = (a.oriented_box(), b.oriented_box());
            a.overlaps(&b) && -a.signed_distance(&b) > OVERLAP_TOLERANCE
        })
    })
}
