//! Standing, starting and stopping.

use std::collections::BTreeSet;
use std::f64::consts::FRAC_PI_6;

use gump_scene::{Agent, AgentId, AgentKind, Scenario};

use super::free_road::ON_LANE_M;
use super::reach::nearest;
use super::{Class, Counter, Key, MOMENTS, MOVES, Measure, STANDS, vehicles};
use crate::behaviour::Count;
use crate::behaviour::track::Track;

/// Tolerance for the jitter of a standing vehicle's box, metres.
const DRIFT_M: f64 = 0.5;
/// A parked vehicle farther than this from its place has moved, metres: well beyond jitter, half a
/// car's length. Chosen by hand.
const AWAY_M: f64 = 2.0;
/// Share of the log in which a parked vehicle must be observed; with less, it may have arrived or
/// left unseen. Chosen by hand.
const SEEN_SHARE: f64 = 0.5;
/// Duration of standing, after [`Track::pace`] first shows it, that makes a stop, seconds: not a
/// brief halt. Chosen by hand.
const STOP_S: f64 = 1.0;
/// Duration of standing without a reason after which a driver behind would be sure that it is not a
/// pause, seconds: the bound that result 23 has as its goal.
const LONG_S: f64 = 10.0;
/// Speeds at which a vehicle may come to rest within seconds, m/s: it moves, and is not on a fast road.
/// Recorded vehicles at these speeds stand after 8 s in one of six cases, faster ones hardly ever.
const SLOW: std::ops::Range<f64> = MOVES..12.0;
/// Interval at which the reasons of a vehicle that stands for long are looked for, seconds.
const LOOK_S: f64 = 1.0;

/// Vehicles of the present that stand for the whole log, as far as they are observed.
pub(super) fn parked(scenario: &Scenario) -> BTreeSet<AgentId> {
    let n_seen = |agent: &Agent| {
        let mut n = 0;
        for frame in &scenario.log {
            let Some(seen) = frame.agent(agent.id) else {
                continue;
            };
            let place = seen.state.pose.position;
            if place.distance(agent.state.pose.position) > DRIFT_M {
                return 0;
            }
            n += 1;
        }
        n
    };
    let enough = SEEN_SHARE * scenario.log.len() as f64;
    let vehicles = scenario.log[scenario.now].agents().iter();
    vehicles
        .filter(|agent| agent.kind == AgentKind::Vehicle && n_seen(agent) as f64 >= enough)
        .map(|agent| agent.id)
        .collect()
}

/// Starts and stops of a track.
#[derive(Default)]
struct Walk {
    /// Number of later frames with a known speed, and of those in which it moves.
    known: usize,
    moving: usize,
    /// Frames at which it starts.
    starts: Vec<usize>,
    /// Frames at which it begins to stand, and those at which that counts as a stop.
    stops: Vec<(usize, usize)>,
}

impl Counter<'_> {
    pub(super) fn standing(&mut self) {
        let scenario = self.behaviour.scenario;
        for seconds in MOMENTS {
            if seconds > self.behaviour.horizon_s {
                break;
            }
            let ahead = self.take.steps(seconds.into());
            let k = self.take.now + ahead;
            // While the log lasts, only agents that it still sees count: one that drives out of
            // sight is moving, and would be missing from the log alone.
            let logged = scenario.log.get(scenario.now + ahead);
            let newcomers = self.behaviour.newcomers;
            for track in self.tracks {
                let is_logged = logged.is_none_or(|frame| frame.agent(track.id).is_some());
                let Some(pace) = track.pace(k).filter(|_| newcomers || is_logged) else {
                    continue;
                };
                let count = Count {
                    events: f64::from(u8::from(pace < STANDS)),
                    of: 1.0,
                };
                let class = Class::of(track.kind);
                let key = |measure| Key {
                    measure,
                    class,
                    seconds,
                };
                self.seen.tally.add(key(Measure::Standing), count);
                let before = track.pace(self.take.now);
                if class == Class::Vehicle && before.is_some_and(|pace| SLOW.contains(&pace)) {
                    self.seen.tally.add(key(Measure::ComeToRest), count);
                }
                if before.is_some_and(|pace| pace >= STANDS) {
                    let events = pace;
                    let count = Count { events, of: 1.0 };
                    self.seen.tally.add(key(Measure::Speed), count);
                }
            }
        }
    }

    pub(super) fn stops_and_starts(&mut self) {
        let has_lanes = !self.map.lanes().is_empty();
        for track in self.tracks {
            let class = Class::of(track.kind);
            let walk = self.walk(track);
            let (known, moving) = (self.minutes(walk.known), self.minutes(walk.moving));
            self.add(Measure::SetOff, class, walk.starts.len() as f64, known);
            for &k in &walk.starts {
                self.note(Measure::SetOff, track.id, None, k);
            }
            if class != Class::Vehicle || !has_lanes {
                continue;
            }
            let mut n = 0;
            for &(from, until) in &walk.stops {
                if self.is_free(track, from, until) {
                    self.note(Measure::FreeRoadStop, track.id, None, from);
                    n += 1;
                }
            }
            self.add(Measure::FreeRoadStop, class, f64::from(n), moving);
            self.add(Measure::LaneChange, class, 0.0, moving);
        }
        if has_lanes {
            self.free_road_standing();
        }
        self.parked_moves();
    }

    fn free_road_standing(&mut self) {
        let (take, long) = (self.take, self.take.steps(LONG_S));
        for track in vehicles(self.tracks) {
            // Who is there for a shorter time cannot stand that long.
            let there = take.ahead().filter(|&k| track.pose(k).is_some()).count();
            let moves = |k: usize| track.pace(k).is_some_and(|pace| pace > MOVES);
            if there < long || !(0..take.frames.len()).any(moves) {
                continue;
            }
            let found = self.stands_long(track);
            let events = f64::from(u8::from(found.is_some()));
            self.add(Measure::FreeRoadStanding, Class::Vehicle, events, 1.0);
            if let Some(k) = found {
                self.note(Measure::FreeRoadStanding, track.id, None, k);
            }
        }
    }

    /// The frame at which a vehicle that has moved has stood for [`LONG_S`] after the present and
    /// had no reason to all that time.
    fn stands_long(&self, track: &Track) -> Option<usize> {
        let (now, take) = (self.take.now, self.take);
        let (look, long) = (take.steps(LOOK_S), take.steps(LONG_S));
        let mut has_moved = false;
        // The next frame to look at while it stands, and since when there is no reason.
        let (mut next, mut free): (Option<usize>, Option<usize>) = (None, None);
        for k in 0..take.frames.len() {
            let pace = track.pace(k);
            has_moved |= pace.is_some_and(|pace| pace > MOVES);
            if !has_moved || k < now || pace.is_none_or(|pace| pace >= STANDS) {
                (next, free) = (None, None);
                continue;
            }
            // It has stood since before the pace first shows it.
            let mut at = next.unwrap_or_else(|| k.saturating_sub(track.pace_steps()).max(now));
            while at <= k {
                if !self.is_free_at(track, at) {
                    free = None;
                } else if at - *free.get_or_insert(at) >= long {
                    return Some(at);
                }
                at += look;
            }
            next = Some(at);
        }
        None
    }

    fn parked_moves(&mut self) {
        for track in vehicles(self.tracks) {
            let Some(place) = track.pose(self.take.now) else {
                continue;
            };
            if !self.behaviour.parked.contains(&track.id) {
                continue;
            }
            let is_away = |&k: &usize| {
                let pose = track.pose(k);
                pose.is_some_and(|pose| pose.position.distance(place.position) > AWAY_M)
            };
            let away = self.take.ahead().find(is_away);
            let events = f64::from(u8::from(away.is_some()));
            self.add(Measure::ParkedMove, Class::Vehicle, events, 1.0);
            if nearest(self.map, place, ON_LANE_M, FRAC_PI_6).is_none() {
                self.add(Measure::RoadsideMove, Class::Vehicle, events, 1.0);
            }
            if let Some(k) = away {
                self.note(Measure::ParkedMove, track.id, None, k);
            }
        }
    }

    fn walk(&self, track: &Track) -> Walk {
        let (now, take) = (self.take.now, self.take);
        let stop_steps = take.steps(STOP_S);
        let (mut has_stood, mut has_moved) = (false, false);
        let mut since: Option<usize> = None;
        let mut walk = Walk::default();
        for k in 0..take.frames.len() {
            let Some(pace) = track.pace(k) else {
                since = None;
                continue;
            };
            let stands = pace < STANDS;
            if k > now {
                walk.known += 1;
                walk.moving += usize::from(pace > MOVES);
            }
            if !stands {
                since = None;
            }
            if pace > MOVES {
                if has_stood && k > now {
                    walk.starts.push(k);
                }
                (has_stood, has_moved) = (false, true);
            }
            if stands {
                has_stood = true;
                let first = *since.get_or_insert(k);
                // It has stood since before the pace first shows it.
                let began = first.saturating_sub(track.pace_steps());
                if has_moved && k - first >= stop_steps {
                    has_moved = false;
                    if began >= now {
                        walk.stops.push((began, k));
                    }
                }
            }
        }
        walk
    }
}
