//! Conversion of tracks as stated by formats to the frames of a [`Scenario`].
//!
//! This module has the rules for missing and damaged data of tracks: unusable states and tracks are
//! dropped, counted and listed, and the rest is kept. Maps are built elsewhere (`features`,
//! `infer`). Start with [`assemble`].

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use gump_geometry::{DVec2, DVec3, Pose, dvec2, wrap_angle};
use gump_scene::{
    Agent, AgentId, AgentKind, AgentState, Frame, Light, MapGraph, MapParts, Route, Scenario,
    ScenarioTag,
};

use super::track::{State, Track};
use super::{infer, motion};
use crate::error::MAX_COORDINATE;
use crate::{Problem, ReadOptions, ReadReport};

/// Maximum number of frames of a recording: an hour at 50 Hz. An invalid time stamp could otherwise
/// require any amount of memory.
pub(crate) const MAX_STEPS: usize = 180_000;

/// Everything but the map of one scenario.
pub(crate) struct Recording {
    pub(crate) id: String,
    /// Seconds between steps.
    pub(crate) dt: f64,
    /// Number of steps; states beyond are dropped.
    pub(crate) steps: usize,
    /// Index of the present step.
    pub(crate) now: usize,
    /// The ego's id; `None` if it is not stated.
    pub(crate) ego: Option<i64>,
    pub(crate) tracks: Vec<Track>,
    /// Lights with their step.
    pub(crate) lights: Vec<(usize, Light)>,
    /// Prediction targets; `None` where the format has no list of them.
    pub(crate) targets: Option<Vec<i64>>,
    pub(crate) objects_of_interest: Vec<i64>,
    pub(crate) tags: Vec<ScenarioTag>,
    pub(crate) route: Option<Route>,
}

impl Recording {
    /// A recording without agents, for a map alone.
    pub(crate) fn of_nobody(id: String) -> Self {
        Self {
            id,
            dt: 0.1,
            steps: 0,
            now: 0,
            ego: None,
            tracks: Vec::new(),
            lights: Vec::new(),
            targets: None,
            objects_of_interest: Vec::new(),
            tags: Vec::new(),
            route: None,
        }
    }
}

/// Maximum length of an agent, metres: a road train measures 54 m.
const MAX_SIZE: f64 = 100.0;

/// The track to use as the ego where none is stated: the vehicle present now that is observed
/// longest; of several, the one that drives farthest.
pub(crate) fn best_covered(tracks: &[Track], now: usize) -> Option<i64> {
    let driven = |track: &Track| {
        let (first, last) = (track.states.first(), track.states.last());
        let ends = first
            .zip(last)
            .map(|(a, b)| a.position.distance(b.position));
        ends.unwrap_or_default()
    };
    let present = |track: &&Track| track.states.iter().any(|state| state.step == now);
    let vehicles = tracks
        .iter()
        .filter(|t| t.kind == AgentKind::Vehicle)
        .filter(present);
    let best = vehicles.max_by(|a, b| {
        let coverage = a.states.len().cmp(&b.states.len());
        // Of equals the first one counts, and `max_by` takes the last.
        coverage
            .then(driven(a).total_cmp(&driven(b)))
            .then(b.id.cmp(&a.id))
    });
    best.map(|track| track.id)
}

/// Builds the map and the frames, fills gaps, and checks the result.
///
/// Error: the first [`Problem`] that concerns the recording as a whole.
pub(crate) fn assemble(
    mut recording: Recording,
    mut parts: MapParts,
    options: ReadOptions,
    report: &mut ReadReport,
) -> Result<Scenario, Problem> {
    if recording.steps > MAX_STEPS {
        return Err(Problem::Unexpected {
            expected: "at most 180000 time steps",
            found: recording.steps.to_string().into(),
            place: "the recording".into(),
        });
    }
    infer::map(&mut parts, options, report);
    infer::limits_and_edges(&mut parts, options, report);
    let map = MapGraph::new(parts)?;
    sound_tracks(&mut recording, report);
    for track in &mut recording.tracks {
        if options.smooth {
            motion::smooth(track, recording.dt, report);
        }
        motion::complete(track, recording.now, recording.dt, options, report);
        complete_sizes(track, recording.now, options, report);
        complete_elevations(track, &map, options, report);
    }
    recording.tracks.retain(|track| !track.states.is_empty());
    if recording.tracks.is_empty() {
        let parked = options.park_an_ego.then(|| parked(&map)).flatten();
        let parked = parked.ok_or(Problem::NoAgents)?;
        report.infer("ego: parked on the longest lane", 1);
        (recording.steps, recording.now, recording.ego) = (1, 0, Some(parked.id));
        recording.lights.retain(|(step, _)| *step == 0);
        recording.targets = None;
        recording.tracks.push(parked);
    }
    let ego = recording.ego.or_else(|| {
        let best = options
            .infer_ego
            .then(|| best_covered(&recording.tracks, recording.now));
        let best = best.flatten();
        report.infer("ego: the vehicle seen longest", usize::from(best.is_some()));
        best
    });
    let ego = AgentId(ego.ok_or(Problem::NoEgo)?);
    infer::light_lanes(&mut recording.lights, &map, options, report);
    let ids = |ids: Vec<i64>| ids.into_iter().map(AgentId).collect::<Vec<_>>();
    let asks = recording.targets.is_some();
    let mut targets = ids(recording.targets.unwrap_or_default());
    targets.sort_unstable();
    targets.dedup();
    let mut scenario = Scenario {
        id: recording.id,
        map: Arc::new(map),
        route: recording.route.map(Arc::new),
        log: frames(recording.steps, &recording.tracks, recording.lights, report),
        dt: recording.dt,
        now: recording.now,
        ego,
        targets,
        objects_of_interest: ids(recording.objects_of_interest),
        tags: recording.tags,
    };
    scenario.validate()?;
    if !asks {
        infer::targets(&mut scenario, options, report);
    }
    infer::route(&mut scenario, options, report);
    Ok(scenario)
}

/// A vehicle that stands in the middle of the longest lane; `None` without lanes.
fn parked(map: &MapGraph) -> Option<Track> {
    let longest = map
        .lanes()
        .iter()
        .max_by(|a, b| a.centerline.length().total_cmp(&b.centerline.length()))?;
    let pose = longest
        .centerline
        .pose_at(longest.centerline.length() / 2.0);
    let kind = AgentKind::Vehicle;
    let [length, width, height] = kind.usual_size();
    let ground = map.elevation_at(pose.position).unwrap_or(0.0);
    let state = State {
        step: 0,
        position: pose.position.extend(ground + height / 2.0),
        heading: pose.heading,
        velocity: DVec2::ZERO,
        size: [length, width, height],
    };
    Some(Track {
        id: 0,
        kind,
        usual_size: kind.usual_size(),
        states: vec![state],
    })
}

/// Drops tracks and states that cannot be used; sorts states by step.
fn sound_tracks(recording: &mut Recording, report: &mut ReadReport) {
    let (steps, mut ids) = (recording.steps, BTreeSet::new());
    recording.tracks.retain_mut(|track| {
        let id = track.id;
        if !ids.insert(id) {
            report.drop_damaged("track whose id occurs before", || format!("track {id}"));
            return false;
        }
        track.states.retain(|state| {
            let value = state.position.to_array().into_iter();
            // An elevation may be missing; a place may not.
            let unsound = value
                .take(2)
                .find(|v| v.is_nan() || v.abs() > MAX_COORDINATE);
            if let Some(value) = unsound {
                report.drop_damaged("state that is no place on Earth", || {
                    format!("track {id} at step {}: coordinate {value}", state.step)
                });
            }
            if state.step >= steps {
                report.drop_damaged("state beyond the last step", || {
                    format!("track {id} at step {}, steps: {steps}", state.step)
                });
            }
            unsound.is_none() && state.step < steps
        });
        if !track.states.is_sorted_by_key(|state| state.step) {
            report.drop_damaged("order of a track that is not sorted by time", || {
                format!("track {id}")
            });
            track.states.sort_by_key(|state| state.step);
        }
        let n = track.states.len();
        track.states.dedup_by_key(|state| state.step);
        if track.states.len() < n {
            let twice = n - track.states.len();
            report.drop_damaged("second state of a track in one step", || {
                format!("track {id}, {twice} times")
            });
        }
        let empty = track.states.is_empty();
        report.drop("track without a valid state", usize::from(empty));
        !empty
    });
}

/// Gives every state a valid size: the first stated one, up to the present the first stated up to
/// then, or else the default of the class.
fn complete_sizes(track: &mut Track, now: usize, options: ReadOptions, report: &mut ReadReport) {
    let unstated = |size: &[f64; 3]| size[..2].iter().all(|extent| extent.is_nan());
    let mut states = track.states.iter();
    if let Some(damaged) = states.find(|s| !is_sized(s) && !unstated(&s.size)) {
        let (id, [length, width, _]) = (track.id, damaged.size);
        report.drop_damaged("size that is none", || {
            format!("track {id} at step {}: {length} x {width} m", damaged.step)
        });
    }
    let past = track.states.partition_point(|state| state.step <= now);
    let known = |states: &[State]| states.iter().find(|s| is_sized(s)).map(|s| s.size);
    let of_class = options.infer_sizes.then_some(track.usual_size);
    let by_then = known(&track.states[..past]);
    let ever = by_then.or_else(|| known(&track.states[past..]));
    let lacks = |states: &[State]| states.iter().any(|state| !is_sized(state));
    let by_class = lacks(&track.states[..past]) && by_then.is_none()
        || lacks(&track.states[past..]) && ever.is_none();
    if by_class {
        match of_class {
            Some(_) => report.infer("size of an agent by its class", 1),
            None if ever.is_none() => report.drop("track without a size", 1),
            None => report.drop("states before the first size of a track", 1),
        }
    }
    let (earlier, later) = track.states.split_at_mut(past);
    fill_sizes(earlier, by_then.or(of_class), options);
    fill_sizes(later, ever.or(of_class), options);
    track.states.retain(is_sized);
}

/// True if length and width are such; formats without heights have 0 there.
fn is_sized(state: &State) -> bool {
    let is_size = |extent: f64| extent > 0.0 && extent < MAX_SIZE;
    state.size[..2].iter().all(|&extent| is_size(extent))
}

fn fill_sizes(states: &mut [State], fallback: Option<[f64; 3]>, options: ReadOptions) {
    let Some(fallback) = fallback else { return };
    for state in states {
        if !is_sized(state) {
            state.size = fallback;
        }
        if !(0.0..MAX_SIZE).contains(&state.size[2]) {
            state.size[2] = if options.infer_sizes {
                fallback[2].max(0.0)
            } else {
                0.0
            };
        }
    }
}

/// Metres between two looks at the map's height: it changes slowly.
const ELEVATION_SPACING: f64 = 3.0;

/// Sets the elevation of agents without one to that of the map.
fn complete_elevations(
    track: &mut Track,
    map: &MapGraph,
    options: ReadOptions,
    report: &mut ReadReport,
) {
    let sound = |z: f64| z.abs() <= MAX_COORDINATE;
    if track.states.iter().all(|state| sound(state.position.z)) {
        return;
    }
    report.infer(
        "elevation of an agent from the map",
        usize::from(options.infer_elevation),
    );
    let mut last: Option<(DVec2, f64)> = None;
    for state in &mut track.states {
        if sound(state.position.z) {
            continue;
        }
        let place = state.position.truncate();
        let near = last.filter(|(at, _)| at.distance(place) < ELEVATION_SPACING);
        let (at, ground) = near.unwrap_or_else(|| {
            let ground = options
                .infer_elevation
                .then(|| map.elevation_at(place))
                .flatten();
            (place, ground.unwrap_or(0.0))
        });
        last = Some((at, ground));
        let lifted = options.infer_elevation && !map.lanes().is_empty();
        state.position.z = ground + if lifted { state.size[2] / 2.0 } else { 0.0 };
    }
}

fn frames(
    steps: usize,
    tracks: &[Track],
    lights: Vec<(usize, Light)>,
    report: &mut ReadReport,
) -> Vec<Frame> {
    let mut agents: Vec<Vec<Agent>> = vec![Vec::new(); steps];
    for track in tracks {
        for state in &track.states {
            agents[state.step].push(agent(track, state));
        }
    }
    let mut by_step: BTreeMap<usize, Vec<Light>> = BTreeMap::new();
    for (step, light) in lights {
        if step < steps {
            by_step.entry(step).or_default().push(light);
        } else {
            report.drop("light beyond the last step", 1);
        }
    }
    let frame = |(step, agents)| Frame::new(agents, by_step.remove(&step).unwrap_or_default());
    agents.into_iter().enumerate().map(frame).collect()
}

fn agent(track: &Track, state: &State) -> Agent {
    let [length, width, height] = state.size;
    let DVec3 { x, y, z } = state.position;
    Agent {
        id: AgentId(track.id),
        kind: track.kind,
        length,
        width,
        height,
        elevation: z,
        state: AgentState {
            pose: Pose::new(x, y, wrap_angle(state.heading)),
            velocity: dvec2(state.velocity.x, state.velocity.y),
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::complete::track::UNSTATED;
    use gump_geometry::dvec3;

    /// Sizes of a car in steps 0 to 3, the present being step 1; `None` is not stated.
    fn check(stated: [Option<f64>; 4], options: ReadOptions, expected: &[(usize, f64)]) {
        let state = |(step, length): (usize, &Option<f64>)| State {
            step,
            position: dvec3(0.0, 0.0, 0.0),
            heading: 0.0,
            velocity: DVec2::ZERO,
            size: length.map_or([UNSTATED; 3], |length| [length, 2.0, 1.5]),
        };
        let mut track = Track {
            id: 1,
            kind: AgentKind::Vehicle,
            usual_size: AgentKind::Vehicle.usual_size(),
            states: stated.iter().enumerate().map(state).collect(),
        };
        complete_sizes(&mut track, 1, options, &mut ReadReport::default());
        let found = track.states.iter().map(|state| (state.step, state.size[0]));
        assert_eq!(found.collect::<Vec<_>>(), expected, "{stated:?}");
    }

    #[test]
    fn sizes_up_to_the_present_come_from_frames_up_to_the_present() {
        let (all, stated) = (ReadOptions::ALL, ReadOptions::STATED);
        let (none, five) = (None, Some(5.0));
        let whole = [(0, 5.0), (1, 5.0), (2, 5.0), (3, 5.0)];
        check([five, none, none, none], all, &whole);
        check([none, five, none, none], stated, &whole);
        let later = [none, none, none, five];
        check(later, all, &[(0, 4.7), (1, 4.7), (2, 5.0), (3, 5.0)]);
        check(later, stated, &[(2, 5.0), (3, 5.0)]);
        check([none; 4], all, &[(0, 4.7), (1, 4.7), (2, 4.7), (3, 4.7)]);
        check([none; 4], stated, &[]);
    }
}
