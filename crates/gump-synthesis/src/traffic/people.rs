//! Pedestrians: along sidewalks, around corners, and across the road when it is safe.

use std::f64::consts::TAU;

use gump_geometry::{DVec2, Pose, angle_difference, wrap_angle};
use gump_scene::{AgentKind, Rng};
use rand::Rng as _;

use super::size::draw_person_size;
use super::{Body, TrafficSimulation};
use crate::network::Network;

// Chosen by eye.
/// Metres ahead on the walk that a person steers to.
const CARROT: f64 = 1.6;
/// Fastest turn of a person, radians per second.
const TURN_RATE: f64 = 1.6;
/// Fastest change of walking speed, m/s².
const CHANGE: f64 = 1.2;

/// Share of those alone that run or ride a scooter, and their speed, m/s: of 766 pedestrians of
/// `datasets/benchmarks/recorded.toml#train` 1.4 % move at 2 m/s and more, at most at 4.9. One in ten
/// is alone here.
const RUN: f64 = 0.3;
const RUN_MPS: std::ops::Range<f64> = 2.4..4.9;

/// The activity of a person at a crosswalk.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Activity {
    /// Stands at the curb; `may_go` if lights do not forbid it.
    Waits {
        /// Lights permit crossing, or there are none.
        may_go: bool,
    },
    /// Is on the road.
    Crosses {
        /// In the direction of the crosswalk's walk.
        forward: bool,
    },
}

/// A person on a walk.
#[derive(Clone, Debug)]
pub(crate) struct Person {
    id: i64,
    size: [f64; 3],
    walk: usize,
    forward: bool,
    /// Metres along the walk from where the person entered it.
    progress: f64,
    /// Metres right of the walk's middle.
    aside: f64,
    pace: f64,
    speed: f64,
    pose: Pose,
    activity: Option<Activity>,
    gone: bool,
    companions: Vec<Companion>,
    /// Amplitude of swaying to the sides, metres, and its initial phase.
    sway: (f64, f64),
}

/// A companion of a pedestrian, at about the same place beside or behind.
#[derive(Clone, Copy, Debug)]
struct Companion {
    id: i64,
    size: [f64; 3],
    /// Metres ahead and to the left of the person.
    place: DVec2,
}

impl Person {
    /// A person `progress` metres along a walk.
    pub(crate) fn new(
        id: i64,
        network: &Network,
        (walk, forward, progress): (usize, bool, f64),
        rng: &mut Rng,
    ) -> Self {
        let pace = rng.random_range(0.9..1.7);
        // Right of the middle, so that people who meet pass each other.
        let aside = rng.random_range(0.5..1.1);
        let track = &network.walks[walk].track;
        let s = if forward {
            progress
        } else {
            track.length() - progress
        };
        let on_walk = track.pose_at(s);
        let heading = if forward {
            on_walk.heading
        } else {
            wrap_angle(on_walk.heading + std::f64::consts::PI)
        };
        let position = on_walk.position - DVec2::from_angle(heading).perp() * aside;
        Self {
            id,
            size: [
                rng.random_range(0.55..0.95),
                rng.random_range(0.55..0.9),
                rng.random_range(1.5..1.9),
            ],
            walk,
            forward,
            progress,
            aside,
            pace,
            speed: pace,
            pose: Pose { position, heading },
            activity: None,
            gone: false,
            companions: Vec::new(),
            sway: (0.0, 0.0),
        }
    }

    /// Lets others walk with the person: ids follow each other from `first_id` on.
    pub(crate) fn accompany(&mut self, first_id: i64, n: usize, rng: &mut Rng) {
        self.size = draw_person_size(rng);
        self.sway = (rng.random_range(0.0..0.14), rng.random_range(0.0..TAU));
        if n == 0 && rng.random_bool(RUN) {
            self.pace = rng.random_range(RUN_MPS);
            self.speed = self.pace;
        }
        if n > 0 {
            // Leaves room on the right, so that companions stay on the sidewalk.
            let shift = self.aside - rng.random_range(0.25..0.45);
            self.aside -= shift;
            self.pose.position += self.pose.direction().perp() * shift;
        }
        for k in 0..n {
            let row = k.div_ceil(2) as f64;
            let side = if k % 2 == 0 { -1.0 } else { 0.0 };
            self.companions.push(Companion {
                id: first_id + k as i64,
                size: draw_person_size(rng),
                place: DVec2::new(
                    -1.35 * row + rng.random_range(-0.15..0.15),
                    side * rng.random_range(0.95..1.15),
                ),
            });
        }
    }

    /// The boxes of those who walk with the person.
    pub(crate) fn companions(&self) -> impl Iterator<Item = Body> + '_ {
        // Each drifts a little about its place as they walk.
        let drift = |k: usize| {
            let at = self.sway.1 + 1.7 * k as f64;
            self.sway.0
                * DVec2::new(
                    (self.progress / 1.9 + at).sin(),
                    (self.progress / 2.6 - at).sin(),
                )
        };
        self.companions
            .iter()
            .enumerate()
            .map(move |(k, companion)| Body {
                id: companion.id,
                size: companion.size,
                pose: Pose {
                    position: self.pose * (companion.place + drift(k)),
                    ..self.pose
                },
                ..self.body()
            })
    }

    /// The crosswalk the person is at, where along its walk, and what the person does there.
    pub(crate) fn on_crosswalk(&self, network: &Network) -> Option<(usize, f64, Activity)> {
        let walk = &network.walks[self.walk];
        let length = walk.track.length();
        let place = if self.forward {
            self.progress
        } else {
            length - self.progress
        };
        Some((walk.crosswalk?, place, self.activity?))
    }

    /// True once the person has left the scene.
    pub(crate) fn has_left(&self) -> bool {
        self.gone
    }

    pub(crate) fn body(&self) -> Body {
        Body {
            id: self.id,
            kind: AgentKind::Pedestrian,
            size: self.size,
            pose: self.pose,
            is_mobile: true,
            place: None,
        }
    }

    fn ends(&self, network: &Network) -> [usize; 2] {
        let [a, b] = network.walks[self.walk].ends;
        if self.forward { [a, b] } else { [b, a] }
    }

    /// The point to walk to: ahead on the walk, a little to the right of its middle.
    fn carrot(&self, network: &Network) -> DVec2 {
        let track = &network.walks[self.walk].track;
        let ahead = self.progress + CARROT.max(0.8 * self.speed);
        let (s, sign) = if self.forward {
            (ahead, 1.0)
        } else {
            (track.length() - ahead, -1.0)
        };
        let pose = track.pose_at(s);
        let aside = self.aside + self.sway.0 * (self.progress / 2.2 + self.sway.1).sin();
        pose.position - pose.direction().perp() * (aside * sign)
    }

    /// Walks on for `dt` seconds towards the carrot, moved by `push`, at up to `limit` metres per
    /// second.
    fn advance(&mut self, network: &Network, limit: f64, push: DVec2, dt: f64) {
        let wanted = self.pace.min(limit);
        self.speed += (wanted - self.speed).clamp(-2.0 * CHANGE * dt, CHANGE * dt);
        self.speed = self.speed.max(0.0);
        if self.speed < 0.02 {
            return;
        }
        let to = self.carrot(network) + push - self.pose.position;
        let turn = angle_difference(to.to_angle(), self.pose.heading);
        // Turning on the spot would spin the box: the slower, the less it turns.
        let most = TURN_RATE * dt * (self.speed / 0.6).min(1.0);
        self.pose.heading = wrap_angle(self.pose.heading + (turn * 4.0 * dt).clamp(-most, most));
        let step = self.pose.direction() * (self.speed * dt);
        self.pose.position += step;
        self.progress += step.dot(to.normalize_or_zero()).max(0.0);
    }
}

impl TrafficSimulation<'_> {
    /// Moves all pedestrians by one step.
    pub(super) fn step_people(&mut self) {
        for i in 0..self.people.len() {
            let mut person = self.people[i].clone();
            let limit = self.walking_limit(&mut person, i);
            let push = self.push_from_others(&person, i);
            person.advance(self.network, limit, push, self.dt);
            let length = self.network.walks[person.walk].track.length();
            if person.progress >= length {
                self.choose_walk(&mut person, length);
            }
            self.people[i] = person;
        }
        self.people.retain(|person| !person.has_left());
    }

    /// Returns the speed limit of the person, metres per second; decides about stepping onto a
    /// crosswalk.
    fn walking_limit(&self, person: &mut Person, i: usize) -> f64 {
        let walk = &self.network.walks[person.walk];
        if let Some(crosswalk) = walk.crosswalk {
            let index = crosswalk;
            let crosswalk = &self.network.crosswalks[crosswalk];
            let near_curb = crosswalk
                .on_road
                .0
                .min(walk.track.length() - crosswalk.on_road.1);
            let waiting = !matches!(person.activity, Some(Activity::Crosses { .. }));
            if waiting {
                let width = crosswalk.on_road.1 - crosswalk.on_road.0;
                let cycle = self.network.junctions[crosswalk.junction].cycle.as_ref();
                let may_go = cycle.is_none_or(|cycle| {
                    cycle.walk_time(crosswalk.leg, self.time) > 0.85 * width / person.pace
                });
                if may_go && self.is_free_of_claims(index) {
                    person.activity = Some(Activity::Crosses {
                        forward: person.forward,
                    });
                } else {
                    person.activity = Some(Activity::Waits { may_go });
                    let left = near_curb - 0.9 - person.progress;
                    return if left < 0.05 {
                        0.0
                    } else {
                        (2.0 * CHANGE * left).sqrt()
                    };
                }
            }
        } else {
            person.activity = None;
        }
        self.limit_behind_others(person, i)
    }

    /// Slows down behind a slower pedestrian; of two that meet, the first in the list goes first.
    fn limit_behind_others(&self, person: &Person, i: usize) -> f64 {
        let mut limit = f64::INFINITY;
        // Who runs needs more room to slow down.
        let sight = 2.2 + (person.speed - 1.7).max(0.0);
        for (j, other) in self.people.iter().enumerate() {
            let local = person.pose.inverse() * other.pose.position;
            let turn = angle_difference(other.pose.heading, person.pose.heading).abs();
            if j == i || local.x <= 0.0 || local.x > sight || local.y.abs() > 0.85 {
                continue;
            }
            let theirs = other.speed * turn.cos();
            if turn < 1.0 || turn < 2.2 && j < i || other.speed < 0.1 {
                limit = f64::min(limit, theirs.max(0.0) + 0.8 * (local.x - 1.15));
            }
        }
        limit.max(0.0)
    }

    /// Returns the displacement of the point that a person steers to by people near by, metres.
    fn push_from_others(&self, person: &Person, i: usize) -> DVec2 {
        let away = |(j, other): (usize, &Person)| {
            let gap = person.pose.position - other.pose.position;
            let distance = gap.length();
            if j == i || !(1e-3..=1.8).contains(&distance) {
                return DVec2::ZERO;
            }
            // Sideways only: slowing down is decided elsewhere.
            let left = person.pose.direction().perp();
            let side = if gap.dot(left) >= 0.0 { 1.0 } else { -1.0 };
            left * (side * 0.8 * (1.8 - distance))
        };
        self.people.iter().enumerate().map(away).sum()
    }

    /// Chooses where to go on at the end of a walk.
    fn choose_walk(&mut self, person: &mut Person, length: f64) {
        let node = person.ends(self.network)[1];
        let from = person.walk;
        let choices: Vec<(usize, bool)> = self
            .network
            .walks
            .iter()
            .enumerate()
            .filter(|(walk, _)| *walk != from)
            .flat_map(|(walk, w)| {
                [(walk, true, w.ends[0]), (walk, false, w.ends[1])]
                    .into_iter()
                    .filter(|(_, _, end)| *end == node)
                    .map(|(walk, forward, _)| (walk, forward))
            })
            .collect();
        if choices.is_empty() {
            person.gone = true;
            return;
        }
        // Most people that reach a crosswalk cross there.
        let crossing = choices
            .iter()
            .position(|(walk, _)| self.network.walks[*walk].crosswalk.is_some());
        let crosses = self.demand.scenery.is_real && self.rng.random_bool(0.85);
        let (walk, forward) = match crossing.filter(|_| crosses) {
            Some(crossing) => choices[crossing],
            None => choices[self.rng.random_range(0..choices.len())],
        };
        (person.walk, person.forward) = (walk, forward);
        person.progress -= length;
        person.activity = None;
    }
}
