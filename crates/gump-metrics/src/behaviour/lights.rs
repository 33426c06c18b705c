//! Red lights passed, and lights that contradict one another.

use std::collections::{BTreeMap, BTreeSet};
use std::f64::consts::FRAC_PI_4;

use gump_geometry::{Polyline, Pose, angle_difference};
use gump_scene::{
    Lane, LaneId, Light, LightState, MapGraph, Scenario, stop_line, ways_beyond, ways_cross,
};

use super::track::{Take, Track};
use super::{Class, Counter, Measure, vehicles};
use crate::red_light::passes;

/// Lines passed within this time of the first belong to one passage, seconds: the lanes that fork
/// from an approach have a line each. Chosen by hand, as what follows.
const ONE_PASSAGE_S: f64 = 1.0;
/// The time, or distance, after which the followed lane is determined, seconds, metres: by then
/// lanes that fork have parted.
const FOLLOWED_S: f64 = 2.0;
const FOLLOWED_M: f64 = 8.0;
/// Weight of a radian of difference in heading, in metres, when the followed lane is determined: a
/// right angle weighs more than a lane's width.
const M_PER_RADIAN: f64 = 3.0;

/// A light that controls a lane, frame by frame.
struct Gate<'a> {
    lane: &'a Lane,
    /// Middle of the stop line, heading along the lane.
    line: Pose,
    states: Vec<Option<LightState>>,
}

/// Time that lights show one colour, and how often that ends.
///
/// The ratio of the two is the mean length of phases, also where most are cut: over a window that
/// begins at any moment, a phase contributes to either in proportion to how often it comes. A mean
/// over the phases that are seen from their beginning to their end would favour short ones.
struct Phases {
    colour: LightState,
    /// Number of frames that follow one in which a light has the colour.
    frames: usize,
    ends: usize,
}

impl Phases {
    fn of(colour: LightState) -> Self {
        Self {
            colour,
            frames: 0,
            ends: 0,
        }
    }

    /// Adds two successive frames of a light that is known in both.
    fn add(&mut self, was: LightState, now: LightState) {
        if was == self.colour {
            self.frames += 1;
            self.ends += usize::from(now != was);
        }
    }
}

/// A vehicle that passes a line.
struct Crossing<'a> {
    k: usize,
    gate: &'a Gate<'a>,
}

impl Counter<'_> {
    pub(super) fn red_lights(&mut self) {
        let gates = gates(self.map, self.take);
        for track in vehicles(self.tracks) {
            let crossings = self.crossings(track, &gates);
            let mut rest = crossings.as_slice();
            while let Some(first) = rest.first() {
                let until = first.k + self.take.steps(ONE_PASSAGE_S);
                let n = rest.iter().take_while(|c| c.k <= until).count();
                let (passage, later) = rest.split_at(n);
                rest = later;
                self.passage(track, passage);
            }
        }
    }

    /// Every line that a vehicle passes, in order of time.
    fn crossings<'g>(&self, track: &Track, gates: &'g [Gate<'g>]) -> Vec<Crossing<'g>> {
        let Some((low, high)) = track.bounds() else {
            return Vec::new();
        };
        let mut crossings = Vec::new();
        for gate in gates {
            let (at, width) = (gate.line.position, gate.lane.width);
            let is_far = at.cmplt(low - width).any() || at.cmpgt(high + width).any();
            if is_far {
                continue;
            }
            for k in self.take.ahead() {
                let Some((before, now)) = track.pose(k - 1).zip(track.pose(k)) else {
                    continue;
                };
                if passes(gate.line, width, before.position, now) {
                    crossings.push(Crossing { k, gate });
                }
            }
        }
        crossings.sort_by_key(|crossing| (crossing.k, crossing.gate.lane.id));
        crossings
    }

    /// Counts one passage by the light of the lane that is followed.
    fn passage(&mut self, track: &Track, passage: &[Crossing<'_>]) {
        let Some(last) = passage.last() else {
            return;
        };
        let Some(pose) = self.followed_to(track, last.k) else {
            return;
        };
        let off = |crossing: &&Crossing<'_>| {
            let centre = &crossing.gate.lane.centerline;
            let at = centre.project(pose.position);
            let heading = centre.pose_at(at.arc_length).heading;
            at.distance + M_PER_RADIAN * angle_difference(pose.heading, heading).abs()
        };
        let followed = passage.iter().min_by(|a, b| off(a).total_cmp(&off(b)));
        let Some((k, state)) = followed.and_then(|c| Some((c.k, c.gate.states[c.k]?))) else {
            return;
        };
        let is_red = state == LightState::Red;
        if state != LightState::Unknown {
            let events = f64::from(u8::from(is_red));
            self.add(Measure::RedLight, Class::Vehicle, events, 1.0);
        }
        if is_red {
            self.note(Measure::RedLight, track.id, None, k);
        }
    }

    /// Position of a vehicle at the time when its lane can be determined.
    fn followed_to(&self, track: &Track, k: usize) -> Option<Pose> {
        let from = track.pose(k)?;
        let later = (k..=k + self.take.steps(FOLLOWED_S)).filter_map(|k| track.pose(k));
        let mut last = from;
        for pose in later {
            last = pose;
            if pose.position.distance(from.position) >= FOLLOWED_M {
                break;
            }
        }
        Some(last)
    }

    /// Counts changes of lights, their time at red and the lengths of phases. Lights unknown in the
    /// present are left out: a world shows them to the end, while a recording sees them for a moment.
    pub(super) fn light_changes(&mut self) {
        let known = |state: Option<LightState>| state.filter(|s| *s != LightState::Unknown);
        let (mut seen, mut red, mut changes) = (0, 0, 0);
        let mut phases = [LightState::Red, LightState::Green].map(Phases::of);
        for gate in gates(self.map, self.take) {
            if known(gate.states[self.take.now]).is_none() {
                continue;
            }
            for k in self.take.ahead() {
                let Some(now) = known(gate.states[k]) else {
                    continue;
                };
                seen += 1;
                red += usize::from(now == LightState::Red);
                if let Some(was) = known(gate.states[k - 1]) {
                    changes += usize::from(was != now);
                    phases.iter_mut().for_each(|phases| phases.add(was, now));
                }
            }
        }
        for (measure, phases) in [Measure::RedPhase, Measure::GreenPhase]
            .into_iter()
            .zip(phases)
        {
            if phases.frames > 0 {
                let seconds = phases.frames as f64 * self.take.dt;
                self.add(measure, Class::Light, seconds, phases.ends as f64);
            }
        }
        if seen > 0 {
            let (minutes, all) = (self.minutes(seen), seen as f64);
            self.add(Measure::LightChange, Class::Light, changes as f64, minutes);
            self.add(Measure::LightRed, Class::Light, red as f64, all);
        }
    }

    pub(super) fn conflicting_greens(&mut self) {
        let (mut known, mut both) = (0, 0);
        for &(a, b) in &self.behaviour.crossing {
            for k in self.take.ahead() {
                let state = |lane| {
                    let light = self.take.frames[k].light(lane)?;
                    Some(light.state).filter(|state| *state != LightState::Unknown)
                };
                let Some(states) = state(a).zip(state(b)) else {
                    continue;
                };
                known += 1;
                both += usize::from(states == (LightState::Green, LightState::Green));
            }
        }
        if known > 0 {
            let (events, of) = (both as f64, known as f64);
            self.add(Measure::ConflictingGreen, Class::Light, events, of);
        }
    }
}

/// All lights of a take that control a lane of the map, by lane.
fn gates<'a>(map: &'a MapGraph, take: &Take<'_>) -> Vec<Gate<'a>> {
    let mut gates: BTreeMap<LaneId, Gate<'a>> = BTreeMap::new();
    for (k, frame) in take.frames.iter().enumerate() {
        for light in frame.lights() {
            let Some(lane) = map.lane(light.lane) else {
                continue;
            };
            let gate = gates.entry(light.lane).or_insert_with(|| Gate {
                lane,
                line: stop_line(lane, light),
                states: vec![None; take.frames.len()],
            });
            gate.states[k] = Some(light.state);
        }
    }
    gates.into_values().collect()
}

/// Pairs of lanes whose lights must not be green at the same time: their paths cross, and they come
/// from crossing roads. Left turns give way to oncoming traffic at green, so opposite roads do not
/// count.
pub(super) fn crossing(scenario: &Scenario) -> Vec<(LaneId, LaneId)> {
    let mut lights: BTreeMap<LaneId, &Light> = BTreeMap::new();
    for light in scenario.log.iter().flat_map(|frame| frame.lights()) {
        lights.entry(light.lane).or_insert(light);
    }
    let lanes: BTreeSet<LaneId> = lights.keys().copied().collect();
    let ways: Vec<(LaneId, f64, Vec<Polyline>)> = lanes
        .into_iter()
        .filter_map(|id| {
            let lane = scenario.map.lane(id)?;
            let line = stop_line(lane, lights[&id]);
            Some((id, line.heading, ways_beyond(&scenario.map, lane, line)))
        })
        .collect();
    let mut pairs = Vec::new();
    for (i, (a, heading, own)) in ways.iter().enumerate() {
        for (b, other_heading, others) in &ways[i + 1..] {
            let between = angle_difference(*heading, *other_heading).abs();
            let is_across = (FRAC_PI_4..=3.0 * FRAC_PI_4).contains(&between);
            let meet = || {
                own.iter()
                    .any(|one| others.iter().any(|other| ways_cross(one, other)))
            };
            if is_across && meet() {
                pairs.push((*a, *b));
            }
        }
    }
    pairs
}
