//! Pedestrians: along sidewalks, around corners, and across the road when it is safe.

use std::collections::VecDeque;
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

/// Metres between the rows of a group.
const ROW: f64 = 1.2;
/// Metres by which companions stand before or behind their row, and to the side of the one before
/// them.
const UNEVEN: f64 = 0.15;
const BESIDE: std::ops::Range<f64> = 0.45..1.15;
/// Metres between the places of a person that are kept, at least.
const APART: f64 = 0.1;
/// Greatest amplitude of swaying, metres.
const SWAY: f64 = 0.14;
/// How fast companions catch up, m/s per metre, and their greatest speed as a multiple of the
/// leader's.
const CATCH_UP: f64 = 0.8;
const HASTE: f64 = 1.5;

/// Shares of those that reach a crosswalk that cross there, if they have to wait for a light or a vehicle
/// and if not. Chosen by hand.
const CROSSES: [f64; 2] = [0.1, 0.97];

/// How often people pause on sidewalks, per second, and for how long, seconds: of 424 pedestrians of
/// `datasets/benchmarks/recorded.toml#train` 2.4 % stand and walk on within nine seconds, and people here do
/// so at curbs as well.
const PAUSES: f64 = 1.0 / 500.0;
const PAUSE_S: std::ops::Range<f64> = 1.5..6.0;

/// By how much people here walk more slowly than on plain scenes, m/s: fitted to the mean speed.
const SLOWER_MPS: f64 = 0.1;

/// Share of those alone that run or ride a scooter, and their speed, m/s: of 766 pedestrians of
/// `datasets/benchmarks/recorded.toml#train` 1.4 % move at 2 m/s and more, at most at 4.9. Four in ten
/// of those on sidewalks are alone here.
const RUN: f64 = 0.12;
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

/// Where people are along the walk over a crosswalk, and what they do there.
#[derive(Clone, Copy, Debug)]
pub(crate) struct OnCrosswalk {
    /// Metres along the walk of the one ahead, and of the last one.
    pub(crate) first: f64,
    pub(crate) last: f64,
    pub(crate) activity: Activity,
}

/// How far to the side of each other people of a group walk, metres.
pub(crate) fn draw_beside(rng: &mut Rng) -> f64 {
    let part: f64 = rng.random_range(0.0..1.0);
    BESIDE.start + (BESIDE.end - BESIDE.start) * part.powf(1.3)
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
    /// Where the person was, the latest last, as far back as companions follow.
    trail: VecDeque<Pose>,
    /// The walk over the last crosswalk and its direction, while companions are still on the road.
    left: Option<(usize, bool)>,
    /// Amplitude of swaying to the sides, metres, and its initial phase.
    sway: (f64, f64),
    /// Seconds for which the person still pauses.
    pause: f64,
}

/// A companion of a pedestrian, beside or behind on the same way.
#[derive(Clone, Copy, Debug)]
struct Companion {
    id: i64,
    size: [f64; 3],
    /// Metres of way ahead of the person, and metres to the left of it.
    place: DVec2,
    pose: Pose,
    speed: f64,
}

impl Companion {
    /// Walks on for `dt` seconds towards its place, which moves at `speed` metres per second.
    fn follow(&mut self, place: Pose, speed: f64, dt: f64) {
        let behind = (self.pose.inverse() * place.position).x;
        let wanted = (speed + CATCH_UP * behind).clamp(0.0, HASTE * speed.max(1.0));
        self.speed += (wanted - self.speed).clamp(-2.0 * CHANGE * dt, CHANGE * dt);
        if self.speed < 0.02 {
            return;
        }
        let to = place * DVec2::new(CARROT, 0.0) - self.pose.position;
        stride(&mut self.pose, to, self.speed, dt);
    }
}

/// Walks for `dt` seconds, turning towards a point `to` metres away; returns the displacement.
fn stride(pose: &mut Pose, to: DVec2, speed: f64, dt: f64) -> DVec2 {
    let turn = angle_difference(to.to_angle(), pose.heading);
    // Turning on the spot would spin the box: the slower, the less it turns.
    let most = TURN_RATE * dt * (speed / 0.6).min(1.0);
    pose.heading = wrap_angle(pose.heading + (turn * 4.0 * dt).clamp(-most, most));
    let step = pose.direction() * (speed * dt);
    pose.position += step;
    step
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
            trail: VecDeque::new(),
            left: None,
            sway: (0.0, 0.0),
            pause: 0.0,
        }
    }

    /// Lets others walk with the person: ids follow each other from `first_id` on.
    pub(crate) fn accompany(&mut self, first_id: i64, n: usize, rng: &mut Rng) {
        self.size = draw_person_size(rng);
        self.sway = (rng.random_range(0.0..SWAY), rng.random_range(0.0..TAU));
        self.pace -= SLOWER_MPS;
        self.speed = self.pace;
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
            let size = draw_person_size(rng);
            let place = DVec2::new(
                -ROW * row + rng.random_range(-UNEVEN..UNEVEN),
                side * draw_beside(rng),
            );
            self.companions.push(Companion {
                id: first_id + k as i64,
                size,
                place,
                pose: Pose {
                    position: self.pose * place,
                    ..self.pose
                },
                speed: self.speed,
            });
        }
    }

    /// The boxes of those who walk with the person.
    pub(crate) fn companions(&self) -> impl Iterator<Item = Body> + '_ {
        self.companions.iter().map(|companion| Body {
            id: companion.id,
            group: self.id,
            size: companion.size,
            pose: companion.pose,
            ..self.body()
        })
    }

    /// Metres of way from the person to the last companion.
    fn depth(&self) -> f64 {
        let places = self.companions.iter().map(|companion| -companion.place.x);
        // Each drifts a little about its place as they walk.
        places.map(|back| back + SWAY).fold(0.0, f64::max)
    }

    /// Where the person was `back` metres of way ago: straight behind its first place before that.
    fn was(&self, back: f64) -> Pose {
        let (mut at, mut left) = (self.pose, back);
        for &earlier in self.trail.iter().rev() {
            let step = at.position.distance(earlier.position);
            if left <= step {
                break;
            }
            (at, left) = (earlier, left - step);
        }
        at * Pose::new(-left, 0.0, 0.0)
    }

    /// Moves the companions on for `dt` seconds, each to where the person was, and to its side.
    fn lead(&mut self, dt: f64) {
        if self.companions.is_empty() {
            return;
        }
        let last = self.trail.back();
        if last.is_none_or(|last| last.position.distance(self.pose.position) > APART) {
            self.trail.push_back(self.pose);
        }
        let most = (self.depth() / APART) as usize + 2;
        while self.trail.len() > most {
            self.trail.pop_front();
        }
        let mut companions = std::mem::take(&mut self.companions);
        for (k, companion) in companions.iter_mut().enumerate() {
            let at = self.sway.1 + 1.7 * k as f64;
            let drift = self.sway.0
                * DVec2::new(
                    (self.progress / 1.9 + at).sin(),
                    (self.progress / 2.6 - at).sin(),
                );
            let place = companion.place + drift;
            let on_way = self.was(-place.x);
            let place = on_way * Pose::new(0.0, place.y, 0.0);
            companion.follow(place, self.speed, dt);
        }
        self.companions = companions;
    }

    /// Where the person and its companions are on this crosswalk.
    pub(crate) fn on_crosswalk(
        &self,
        network: &Network,
        crosswalk: usize,
    ) -> impl Iterator<Item = OnCrosswalk> {
        let here = self.activity.map(|activity| {
            let way = (self.walk, self.forward);
            (way, self.progress, activity)
        });
        let behind = self.left.map(|(walk, forward)| {
            let end = network.walks[walk].track.length();
            ((walk, forward), end, Activity::Crosses { forward })
        });
        let places = [here, behind].into_iter().flatten();
        let places =
            places.filter(move |((walk, _), ..)| network.walks[*walk].crosswalk == Some(crosswalk));
        places.map(|((walk, forward), progress, activity)| {
            let track = &network.walks[walk].track;
            let along = |s: f64| if forward { s } else { track.length() - s };
            let (mut first, mut last) = (progress, progress);
            for progress in self.progress_of_companions(network, (walk, forward)) {
                (first, last) = (first.max(progress), last.min(progress));
            }
            OnCrosswalk {
                first: along(first),
                last: along(last),
                activity,
            }
        })
    }

    /// Metres along a walk where its companions are.
    fn progress_of_companions(
        &self,
        network: &Network,
        (walk, forward): (usize, bool),
    ) -> impl Iterator<Item = f64> {
        let track = &network.walks[walk].track;
        self.companions.iter().map(move |companion| {
            let s = track.project(companion.pose.position);
            if forward { s } else { track.length() - s }
        })
    }

    /// Forgets the crosswalk behind once all companions are off the road.
    fn forget_crosswalk(&mut self, network: &Network) {
        let is_over = |(walk, forward): (usize, bool)| {
            let Some(crosswalk) = network.walks[walk].crosswalk else {
                return true;
            };
            let (low, high) = network.crosswalks[crosswalk].on_road;
            let length = network.walks[walk].track.length();
            let curb = if forward { high } else { length - low };
            let mut progress = self.progress_of_companions(network, (walk, forward));
            progress.all(|progress| progress >= curb)
        };
        if self.left.is_some_and(is_over) {
            self.left = None;
        }
    }

    /// True once the person has left the scene.
    pub(crate) fn has_left(&self) -> bool {
        self.gone
    }

    pub(crate) fn body(&self) -> Body {
        Body {
            id: self.id,
            group: self.id,
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
        let step = stride(&mut self.pose, to, self.speed, dt);
        self.progress += step.dot(to.normalize_or_zero()).max(0.0);
    }
}

impl TrafficSimulation<'_> {
    /// Moves all pedestrians by one step.
    pub(super) fn step_people(&mut self) {
        for i in 0..self.people.len() {
            let mut person = self.people[i].clone();
            let mut limit = self.walking_limit(&mut person, i);
            if self.demand.scenery.is_real && self.pauses(&mut person) {
                limit = 0.0;
            }
            let push = self.push_from_others(&person, i);
            person.advance(self.network, limit, push, self.dt);
            let length = self.network.walks[person.walk].track.length();
            if person.progress >= length {
                self.choose_walk(&mut person, length);
            }
            person.lead(self.dt);
            person.forget_crosswalk(self.network);
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
                let may_go = self.may_go(index, person.pace);
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

    /// True if the lights leave enough time to cross at this pace, or there are none.
    fn may_go(&self, crosswalk: usize, pace: f64) -> bool {
        let crosswalk = &self.network.crosswalks[crosswalk];
        let width = crosswalk.on_road.1 - crosswalk.on_road.0;
        let cycle = self.network.junctions[crosswalk.junction].cycle.as_ref();
        cycle.is_none_or(|cycle| cycle.walk_time(crosswalk.leg, self.time) > 0.85 * width / pace)
    }

    /// True while the person pauses beside the road, as at a window or a telephone.
    fn pauses(&mut self, person: &mut Person) -> bool {
        person.pause -= self.dt;
        if person.pause < 0.0 && self.rng.random_bool(PAUSES * self.dt) {
            person.pause = self.rng.random_range(PAUSE_S);
        }
        person.pause > 0.0 && self.network.walks[person.walk].crosswalk.is_none()
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
        let crossing = choices
            .iter()
            .position(|(walk, _)| self.network.walks[*walk].crosswalk.is_some());
        let crosses = self.demand.scenery.is_real && {
            let walk = crossing.map(|i| &self.network.walks[choices[i].0]);
            let crosswalk = walk.and_then(|walk| walk.crosswalk);
            let goes_at_once = crosswalk.is_some_and(|crosswalk| {
                self.may_go(crosswalk, person.pace) && self.is_free_of_claims(crosswalk)
            });
            self.rng.random_bool(CROSSES[usize::from(goes_at_once)])
        };
        let stays = self.demand.scenery.is_real && !crosses;
        let suits =
            |(walk, _): &&(usize, bool)| !stays || self.network.walks[*walk].crosswalk.is_none();
        let others: Vec<(usize, bool)> = choices.iter().filter(suits).copied().collect();
        let others = if others.is_empty() { &choices } else { &others };
        let (walk, forward) = match crossing.filter(|_| crosses) {
            Some(crossing) => choices[crossing],
            None => others[self.rng.random_range(0..others.len())],
        };
        let has_crossed = self.network.walks[from].crosswalk.is_some();
        if has_crossed && !person.companions.is_empty() {
            person.left = Some((from, person.forward));
        }
        (person.walk, person.forward) = (walk, forward);
        person.progress -= length;
        person.activity = None;
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use gump_scene::Seed;

    use super::*;
    use crate::RoadFamily;
    use crate::layout::{Winding, draw_plan};
    use crate::traffic::{Demand, Scenery};

    /// Looks at every step of a minute of people at crossings: before and after it.
    fn watch(look: impl Fn(&[Person], &[Person], &Network)) {
        for seed in 0..3 {
            let mut rng = Seed(seed).rng();
            let plan = draw_plan(
                RoadFamily::SignalizedCrossing,
                120.0,
                Winding::Even,
                &mut rng,
            );
            let network = Network::new(&plan, &mut rng);
            let demand = Demand {
                moving: 0,
                parked: 0,
                people: 12,
                bicycles: 0,
                arrivals: 0.0,
                scenery: Scenery {
                    is_real: true,
                    ..Scenery::default()
                },
            };
            let mut traffic = TrafficSimulation::new(&network, demand, DT, rng);
            // Companions begin straight behind, wherever that is.
            (0..100).for_each(|_| traffic.step());
            for _ in 0..600 {
                let before = traffic.people.clone();
                traffic.step();
                look(&before, &traffic.people, &network);
            }
        }
    }

    const DT: f64 = 0.1;

    #[test]
    fn companions_walk_where_they_face() {
        watch(|before, after, _| {
            let places: BTreeMap<i64, Pose> = before
                .iter()
                .flat_map(Person::companions)
                .map(|body| (body.id, body.pose))
                .collect();
            for body in after.iter().flat_map(Person::companions) {
                let Some(place) = places.get(&body.id) else {
                    continue;
                };
                let velocity = (body.pose.position - place.position) / DT;
                let aside = velocity.dot(body.pose.direction().perp()).abs();
                assert!(aside < 0.15, "{aside} m/s to the side");
                assert!(velocity.length() < 3.0, "{velocity}");
            }
        });
    }

    #[test]
    fn companions_stay_together() {
        watch(|_, people, _| {
            for person in people {
                for body in person.companions() {
                    let apart = body.pose.position.distance(person.pose.position);
                    assert!(apart < person.depth() + 2.0, "{apart} m");
                }
            }
        });
    }

    #[test]
    fn a_group_is_on_a_crosswalk_until_its_last_has_left() {
        // Of a place on a walk in the other direction.
        const ROUNDING: f64 = 1e-9;
        let seen = std::cell::Cell::new(0);
        watch(|_, people, network| {
            for person in people {
                for body in person.companions() {
                    for walk in &network.walks {
                        let Some(crosswalk) = walk.crosswalk else {
                            continue;
                        };
                        let (low, high) = network.crosswalks[crosswalk].on_road;
                        let place = walk.track.project(body.pose.position);
                        let foot = walk.track.pose_at(place).position;
                        let is_on = (low + 0.6..high - 0.6).contains(&place)
                            && foot.distance(body.pose.position) < 1.5;
                        if !is_on {
                            continue;
                        }
                        seen.set(seen.get() + 1);
                        let covers = |at: OnCrosswalk| {
                            let (from, to) = (at.first.min(at.last), at.first.max(at.last));
                            matches!(at.activity, Activity::Crosses { .. })
                                && (from - ROUNDING..=to + ROUNDING).contains(&place)
                        };
                        let mut at = person.on_crosswalk(network, crosswalk);
                        assert!(at.any(covers), "at {place}");
                    }
                }
            }
        });
        assert!(seen.get() > 100, "{}", seen.get());
    }
}
