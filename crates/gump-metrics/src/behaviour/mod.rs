//! Events that a driver would notice in traffic, counted in the same way in futures and in the log.
//!
//! Realism measures the likelihood of the log under many futures. A parked car that pulls out in
//! each of them lowers it little, because most of its steps are still likely. Here it is counted as
//! an event.
//!
//! | measure | event | per |
//! |---|---|---|
//! | `parked_move` | a vehicle that stood for the whole log (never over 0.5 m from its present place, seen in at least half of the frames) gets over 2 m away from it | vehicle that stood, in a lane or beside the lanes |
//! | `roadside_move` | the same of those that are beside the lanes in the present: not within 1 m of the centre of one that they are along within 30 degrees | such a vehicle |
//! | `free_road_stop` | a vehicle that has moved stands for at least 1 s, for no reason that can be seen: `free_road.rs` lists the reasons | minute that vehicles move |
//! | `free_road_standing` | a vehicle that has moved then stands for at least 10 s after the present, without such a reason at any of these seconds; each vehicle once | vehicle that moves, before or after the present, and is there for at least 10 s after it |
//! | `new_overlap` | a pair of boxes is over 0.1 m deep in one another and did not overlap in the present; each pair once | agent, of all classes |
//! | `hard_acceleration` | the velocity changes by more than 8 m/s² over half a second; times less than 0.5 s apart are one event | minute that agents are there |
//! | `slip` | a vehicle faster than 1 m/s slides sideways at more than 0.5 m/s wherever its rear axle may be | time that vehicles move |
//! | `red_light` | a vehicle passes the stop line of the lane that it then follows at red | passage of a line whose light is known |
//! | `lane_change` | a vehicle goes over to a lane beside its own, each held for a second, outside of intersections | minute that vehicles move |
//! | `road_exit` | the centre of a vehicle that was on the road gets over 0.5 m beyond its edge (see [`metres_off_road`](crate::metres_off_road)) | minute that vehicles move, on maps with a border |
//! | `set_off` | who stood for a second goes faster than 1 m/s | minute that agents are there |
//! | `standing` | over the last second the agent got less than 0.3 m away; at some moments | agent that is there and that the log also sees then |
//! | `come_to_rest` | a vehicle that drove at 1 to 12 m/s over the last second before the present stands, at the same moments | vehicle that drove so and that the log also sees then |
//! | `speed_mps` | speed over the last second, m/s, of an agent that did not stand in the present, at the same moments | agent that did not stand and that the log also sees then |
//! | `near_ego` | an agent is within 100 m of the ego, at the same moments; only [with newcomers](Behaviour::with_newcomers) | ego that is there |
//! | `ego_on_lane` | the ego is within 5 m of the centre of a lane for cars, at the same moments; likewise | ego that is there, on maps with lanes |
//! | `conflicting_green` | two lights are green at once whose lanes cross, coming from roads at 45 to 135 degrees | time that the colours of such pairs are known |
//! | `light_change` | a light that controls a lane of the map, and whose colour is known in the present, changes it | minute that its colour is known |
//! | `light_red` | such a light is red | time that its colour is known |
//! | `red_phase_s`, `green_phase_s` | seconds that such a light is red, or green | red, or green, that ends while its colour is known |
//!
//! To *stand* is to move less than 0.3 m within a second, to *move* more than 1 m. Speeds are
//! computed from positions, not from velocities that a tracker or a network states. Counted are
//! moving kinds of agents that are in the present frame; where agents enter and leave, see
//! [`Behaviour::with_newcomers`]. Futures that end before the horizon have no `parked_move`,
//! `roadside_move`, `new_overlap` and `free_road_standing`, which grow with time.
//!
//! Few phases of lights begin and end within the 8 s of a log. `red_phase_s` and `green_phase_s` are
//! therefore the total time of the colour divided by the number of its ends, over all lights and
//! futures. That estimates the mean length of phases although most are cut by the window, if the
//! present is at a moment that has nothing to do with the lights: a light that keeps its colour
//! throughout adds its time and no end. Where no phase ends there is no value, and with few ends the
//! interval is wide.
//!
//! Lights control lanes, not turns: a legal right turn at red after a stop counts as a red light
//! here. The same happens in the log, so values should be compared with the log's.
//!
//! Start with [`Behaviour`]. [`Conduct`] lists the events by agent, and [`judge`] combines them
//! with realism.
//!
//! ```
//! use gump_metrics::behaviour::{Behaviour, Class, Measure};
//!
//! let scenario = gump_scene::fixture::scenario(
//!     "lane 1: -50,0 250,0
//!      ego vehicle 0: 0,0 velocity 8,0
//!      agent vehicle 1: 40,0",
//! ).unwrap();
//! let tally = Behaviour::new(&scenario, 8).log().tally;
//! // The ego drives into the one that stands: one pair, two agents.
//! assert_eq!(tally.count(Measure::NewOverlap, Class::All, 8).rate(), Some(0.5));
//! assert_eq!(tally.count(Measure::Standing, Class::Vehicle, 4).rate(), Some(0.5));
//! ```

mod body;
mod conduct;
mod free_road;
mod lane_change;
mod lights;
mod measure;
mod overlap;
pub(crate) mod reach;
mod road;
mod standing;
mod surroundings;
#[cfg(test)]
mod tests;
mod track;

use std::collections::BTreeSet;

use gump_scene::{AgentId, AgentKind, LaneId, MapGraph, Rollout, Scenario};
use rayon::prelude::*;

pub use conduct::{Conduct, Deed, Judged, judge};
pub use measure::{Class, Count, Incident, Key, Measure, Seen, Tally};
use track::{Take, Track};

/// Times at which standing agents are counted, seconds after the present: denser at first, up to
/// the horizons of 8, 30 and 60 s that are evaluated.
pub const MOMENTS: [u32; 8] = [2, 4, 8, 10, 20, 30, 40, 60];

/// An agent slower than this stands, m/s: a tracker's jitter of 10 cm is 0.1 m/s over a second.
const STANDS: f64 = 0.3;
/// An agent faster than this moves, m/s, a slow walk. Between the two it neither stands nor moves,
/// so that who creeps does not start and stop all the time. Chosen by hand.
const MOVES: f64 = 1.0;

/// Counts events in the futures of one scenario.
pub struct Behaviour<'a> {
    scenario: &'a Scenario,
    horizon_s: u32,
    newcomers: bool,
    /// Vehicles that stand for the whole log.
    parked: BTreeSet<AgentId>,
    /// Pairs of lanes with lights that must not be green at the same time.
    crossing: Vec<(LaneId, LaneId)>,
}

impl<'a> Behaviour<'a> {
    /// Examines `horizon_s` seconds from the present of `scenario`.
    pub fn new(scenario: &'a Scenario, horizon_s: u32) -> Self {
        Self {
            scenario,
            horizon_s,
            newcomers: false,
            parked: standing::parked(scenario),
            crossing: lights::crossing(scenario),
        }
    }

    /// Also counts agents that are not in the present frame, in futures and in the log: for worlds
    /// in which agents enter and leave.
    pub fn with_newcomers(self) -> Self {
        Self {
            newcomers: true,
            ..self
        }
    }

    /// The events of the log; none if it ends with the present.
    pub fn log(&self) -> Seen {
        self.see(&Take::of_log(self.scenario, self.horizon_s.into()))
    }

    /// The events of a future that starts in the present of the scenario.
    pub fn of(&self, rollout: &Rollout) -> Seen {
        self.see(&Take::of_rollout(rollout, self.horizon_s.into()))
    }

    /// The sum of the counts of several futures.
    pub fn tally(&self, rollouts: &[Rollout]) -> Tally {
        let seen: Vec<Tally> = rollouts.par_iter().map(|one| self.of(one).tally).collect();
        let mut sum = Tally::default();
        for tally in &seen {
            sum.merge(tally);
        }
        sum
    }

    /// Vehicles that stand for the whole log.
    pub fn parked(&self) -> impl Iterator<Item = AgentId> + '_ {
        self.parked.iter().copied()
    }

    fn see(&self, take: &Take<'_>) -> Seen {
        let mut counter = Counter {
            behaviour: self,
            take,
            tracks: &take.tracks(self.newcomers),
            map: &self.scenario.map,
            seen: Seen::default(),
        };
        counter.standing();
        counter.surroundings();
        counter.stops_and_starts();
        counter.body();
        counter.overlaps();
        counter.lane_changes();
        counter.road_exits();
        counter.red_lights();
        counter.conflicting_greens();
        counter.light_changes();
        let mut seen = counter.seen;
        seen.incidents.sort_by(|a, b| {
            (a.measure, a.agent)
                .cmp(&(b.measure, b.agent))
                .then(a.at_s.total_cmp(&b.at_s))
        });
        seen
    }
}

/// One future or log while it is counted.
struct Counter<'a> {
    behaviour: &'a Behaviour<'a>,
    take: &'a Take<'a>,
    tracks: &'a [Track],
    map: &'a MapGraph,
    seen: Seen,
}

impl Counter<'_> {
    /// Adds to a line of the table that is about the whole horizon.
    fn add(&mut self, measure: Measure, class: Class, events: f64, of: f64) {
        if measure.needs_whole_horizon() && !self.take.is_whole {
            return;
        }
        let key = Key {
            measure,
            class,
            seconds: self.behaviour.horizon_s,
        };
        self.seen.tally.add(key, Count { events, of });
    }

    /// Records an event of an agent at frame `k`.
    fn note(&mut self, measure: Measure, agent: AgentId, other: Option<AgentId>, k: usize) {
        self.seen.incidents.push(Incident {
            measure,
            agent,
            other,
            at_s: self.take.at_s(k),
        });
    }

    /// This number of frames in minutes.
    fn minutes(&self, frames: usize) -> f64 {
        frames as f64 * self.take.dt / 60.0
    }
}

/// Vehicles among tracks.
fn vehicles(tracks: &[Track]) -> impl Iterator<Item = &Track> {
    tracks
        .iter()
        .filter(|track| track.kind == AgentKind::Vehicle)
}
