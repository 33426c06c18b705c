//! Observations of a scene: its tracks and their motion. Positions of agents relative to the road
//! are in `surroundings`.

use std::collections::BTreeMap;

use gump_geometry::angle_difference;
use gump_scene::{Agent, AgentId, AgentKind, Scenario};

use super::surroundings::{note_place, note_road, note_room};
use super::{Statistic as M, StatisticClass, Statistics};

// Definitions of the measures. Chosen by hand; `configs/targets/waymo-like.toml` was counted with
// them and has to be counted anew if they change.
/// Slower agents stand, m/s.
pub(super) const STANDING: f64 = 0.3;
/// A track that is ever faster than this drives, m/s.
const DRIVES: f64 = 1.0;
/// A parked track stays this near to its first position, metres.
const PARKED_REACH: f64 = 1.0;
/// Shorter tracks count neither as parked nor as driving, seconds.
const LONG_ENOUGH_S: f64 = 2.0;
/// Interval at which the surroundings of agents are examined, seconds.
const LOOK_EVERY_S: f64 = 1.0;
/// Metres around the ego in which an agent is near.
const NEAR: f64 = 60.0;
/// Slower moving agents crawl, m/s.
const CRAWLS: f64 = 3.0;
/// How far ahead changes of speed look, seconds.
const CHANGE_S: f64 = 4.0;
/// Over how long fast turns are measured, seconds.
const TURN_S: f64 = 1.0;
/// Fast turns are those of faster agents, m/s.
const FAST: f64 = 14.0;
/// Speeds at which the classes of changes of speed begin, m/s.
const SPEED_CLASSES: [(f64, M); 6] = [
    (1.0, M::SpeedChange1To4),
    (4.0, M::SpeedChange4To8),
    (8.0, M::SpeedChange8To12),
    (12.0, M::SpeedChange12To16),
    (16.0, M::SpeedChange16To22),
    (22.0, M::SpeedChangeAbove22),
];
/// Interval of jitter measurements, independent of the frame rate, seconds.
const JITTER_S: f64 = 0.1;

/// A track: indices of frames and the agent in each.
pub(super) type Track<'a> = Vec<(usize, &'a Agent)>;

/// Records all observations of a scene.
pub(super) fn observe(scenario: &Scenario, statistics: &mut Statistics) {
    let mut tracks: BTreeMap<AgentId, Track<'_>> = BTreeMap::new();
    for (step, frame) in scenario.log.iter().enumerate() {
        for agent in frame.agents().iter().filter(|agent| agent.kind.is_moving()) {
            tracks.entry(agent.id).or_default().push((step, agent));
        }
    }
    for (id, track) in &tracks {
        note_track(scenario, track, *id == scenario.ego, statistics);
    }
    note_numbers(scenario, tracks.values(), statistics);
    let stride = (LOOK_EVERY_S / scenario.dt).round().max(1.0) as usize;
    for step in (scenario.now % stride..scenario.log.len()).step_by(stride) {
        note_room(scenario, step, statistics);
    }
    note_road(scenario, statistics);
}

/// Records a track as a whole and its steps.
fn note_track(scenario: &Scenario, track: &Track<'_>, is_ego: bool, statistics: &mut Statistics) {
    let (first, last) = (track[0], track[track.len() - 1]);
    let class: StatisticClass = Some(first.1.kind);
    let end = scenario.log.len() - 1;
    statistics.note(M::Length, class, median(track, |agent| agent.length));
    statistics.note(M::Width, class, median(track, |agent| agent.width));
    if !is_ego {
        // The ego carries the sensors, so its own track is always whole.
        let presence = track.len() as f64 / scenario.log.len() as f64;
        statistics.note(M::Presence, class, presence);
        statistics.note_if(M::BeginsLate, class, first.0 > 0);
        statistics.note_if(M::EndsEarly, class, last.0 < end);
        let gaps = track.windows(2).any(|pair| pair[1].0 > pair[0].0 + 1);
        statistics.note_if(M::Interrupted, class, gaps);
    }
    let start = first.1.state.pose.position;
    let reach = track
        .iter()
        .map(|(_, agent)| agent.state.pose.position.distance(start))
        .fold(0.0, f64::max);
    let seconds = (last.0 - first.0) as f64 * scenario.dt;
    let mut parked = false;
    if seconds >= LONG_ENOUGH_S {
        parked = reach < PARKED_REACH;
        let drives = track.iter().any(|(_, agent)| agent.state.speed() > DRIVES);
        let stands = track
            .iter()
            .any(|(_, agent)| agent.state.speed() < STANDING);
        statistics.note_if(M::Parked, class, parked);
        statistics.note_if(M::StopsAndGoes, class, drives && stands);
    }
    for (_, agent) in track {
        let speed = agent.state.speed();
        statistics.note_if(M::Standing, class, speed < STANDING);
        if speed >= STANDING {
            statistics.note(M::Speed, class, speed);
            statistics.note_if(M::Crawling, class, speed < CRAWLS);
        }
        if parked {
            statistics.note(M::ParkedSpeed, class, speed);
        }
    }
    note_steps(scenario.dt, track, parked, statistics);
    note_what_follows(scenario, track, statistics);
    let stride = (LOOK_EVERY_S / scenario.dt).round().max(1.0) as usize;
    let looked_at = track
        .iter()
        .filter(|(step, _)| step % stride == scenario.now % stride);
    for (step, agent) in looked_at {
        let ego = scenario.log[*step].agent(scenario.ego);
        if let Some(ego) = ego.filter(|ego| ego.id != agent.id) {
            let distance = ego.state.pose.position.distance(agent.state.pose.position);
            statistics.note(M::EgoDistance, class, distance);
        }
        note_place(scenario, agent, parked, statistics);
    }
}

/// Records values that need more than one step: acceleration, turning and jitter.
fn note_steps(dt: f64, track: &Track<'_>, parked: bool, statistics: &mut Statistics) {
    let class: StatisticClass = Some(track[0].1.kind);
    for triple in track.windows(3) {
        let [(a, before), (_, now), (c, after)] = [triple[0], triple[1], triple[2]];
        if c - a != 2 || now.state.speed() < STANDING {
            continue;
        }
        let change = (after.state.velocity - before.state.velocity) / (2.0 * dt);
        let along = change.dot(now.state.pose.direction());
        statistics.note(M::Acceleration, class, along);
        let turn = angle_difference(after.state.pose.heading, before.state.pose.heading);
        statistics.note(M::YawRate, class, (turn / (2.0 * dt)).abs());
    }
    if !parked {
        return;
    }
    for pair in track.windows(2).filter(|pair| pair[1].0 == pair[0].0 + 1) {
        let [before, after] = [pair[0].1.state.pose, pair[1].1.state.pose];
        // Independent errors differ by the same at any rate; slow ones by as much as time passes.
        let per_step = JITTER_S / dt.max(JITTER_S);
        let moved = before.position.distance(after.position);
        let turned = angle_difference(after.heading, before.heading).abs();
        statistics.note(M::Jitter, class, moved * per_step);
        statistics.note(M::HeadingJitter, class, turned * per_step);
    }
}

/// Records how the speed of an agent of a given speed changes, and how much fast agents turn. Means
/// over all steps say nothing of this: a set in which everyone speeds up and brakes has the mean
/// speed of one in which everyone keeps it.
fn note_what_follows(scenario: &Scenario, track: &Track<'_>, statistics: &mut Statistics) {
    let class: StatisticClass = Some(track[0].1.kind);
    let steps = |seconds: f64| (seconds / scenario.dt).round().max(1.0) as usize;
    let (change, turn, stride) = (steps(CHANGE_S), steps(TURN_S), steps(LOOK_EVERY_S));
    for (i, (step, agent)) in track.iter().enumerate() {
        if step % stride != scenario.now % stride {
            continue;
        }
        // Only where the agent is present all along.
        let after = |n: usize| track.get(i + n).filter(|later| later.0 == step + n);
        let speed = agent.state.speed();
        let of_speed = SPEED_CLASSES.iter().rfind(|(from, _)| speed >= *from);
        if let Some(((_, measure), (_, later))) = of_speed.zip(after(change)) {
            statistics.note(*measure, class, later.state.speed() - speed);
        }
        if let Some((_, later)) = after(turn).filter(|_| speed >= FAST) {
            let [from, to] = [agent, later].map(|agent| agent.state.pose.heading);
            statistics.note(M::FastTurn, class, angle_difference(to, from).abs());
        }
    }
}

/// Records numbers of agents, and the ego.
fn note_numbers<'a>(
    scenario: &Scenario,
    tracks: impl Iterator<Item = &'a Track<'a>>,
    statistics: &mut Statistics,
) {
    let mut n_tracks = [0.0; AgentKind::MOVING.len()];
    let index = |kind| AgentKind::MOVING.iter().position(|k| *k == kind);
    for track in tracks {
        if let Some(i) = index(track[0].1.kind) {
            n_tracks[i] += 1.0;
        }
    }
    let present = scenario.present();
    let now = present.now().agents();
    let ego = now.iter().find(|agent| agent.id == scenario.ego);
    for (kind, tracks) in AgentKind::MOVING.into_iter().zip(n_tracks) {
        let class = Some(kind);
        let of_kind = || now.iter().filter(move |agent| agent.kind == kind);
        statistics.note(M::Tracks, class, tracks);
        statistics.note(M::Agents, class, of_kind().count() as f64);
        if let Some(ego) = ego {
            let here = ego.state.pose.position;
            let near = of_kind().filter(|a| a.state.pose.position.distance(here) < NEAR);
            statistics.note(M::AgentsNear, class, near.count() as f64);
        }
    }
    if let Some(ego) = ego {
        statistics.note(M::EgoSpeed, None, ego.state.speed());
        statistics.note_if(M::EgoStands, None, ego.state.speed() < STANDING);
    }
}

fn median(track: &Track<'_>, of: impl Fn(&Agent) -> f64) -> f64 {
    let mut values: Vec<f64> = track.iter().map(|(_, agent)| of(agent)).collect();
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}
