//! The pace of an agent's log at the place where the agent is.
//!
//! In drives under the rules agents move freely, and rules prefer slow draws: whatever slows an agent
//! down is copied by the network, and slows it down more after the next update. On a free road
//! `faults` works against that. At junctions, in queues and on pavements nothing else than the log says
//! how fast one drives or walks. It says so as long as the agent is on its log's way, at any time: who
//! waited for a light starts when its log has started, and who turns left turns as fast as its log.

use std::cell::OnceCell;
use std::f64::consts::FRAC_PI_4;

use gump_geometry::{DVec2, OrientedBox, Pose, angle_difference};
use gump_model::relative::graph::Shown;
use gump_model::steps::TOKEN_DT;
use gump_scene::AgentKind;

// All were chosen by hand.

/// An agent is on its log's way if it is this near to it, metres, for what drives and what walks, and
/// its heading this near to the log's, radians.
const BESIDE_M: f64 = 1.0;
const BESIDE_ON_FOOT_M: f64 = 2.0;
const TURNED: f64 = FRAC_PI_4;
/// Of places on the way that are equally near, up to this, metres, the log's last one counts.
const SAME_M: f64 = 0.1;
/// The log is here if it is this near, metres, and stands if it moves no farther than that in a step,
/// metres.
const HERE_M: f64 = 0.3;
const STANDS_M: f64 = 0.1;
/// An agent is slow if it falls below this share of its log's speed and this, metres per second, ...
const SHARE: f64 = 0.8;
const SLOWER_MPS: f64 = 0.5;
/// ... or gains less than this in a step, metres per second, while it is slower than that.
const GAINS_MPS: f64 = 0.75;
/// It has nothing in its way if it could go on at that speed for so many steps, with this much space
/// ahead and at each side, metres, while others go on as they do.
const STEPS: usize = 6;
const SPACE_M: f64 = 2.0;
const SIDE_M: f64 = 0.3;
/// People walk around whoever is slower than this, metres per second.
const STILL_MPS: f64 = 0.3;
/// An agent is fast if it exceeds this share of its log's greatest speed within so many steps before and
/// after the place, and this, metres per second: who waited for others may find the road free.
const FASTER: f64 = 1.2;
const FASTER_MPS: f64 = 0.5;
const AROUND: usize = 3;
/// Beyond that speed and this, metres per second, what drives gains no more than this in a step, metres
/// per second, as much as `faults` allows it to lose on a free road.
const AS_FAST_MPS: f64 = 0.2;
const HASTY_MPS: f64 = 0.4;
/// One that is too fast loses at least this in a step, metres per second.
const LOSES_MPS: f64 = 0.5;

/// How fast an agent is expected to go on.
pub(super) struct Pace {
    /// Speed of its log, metres per second.
    speed: f64,
    /// Least speed if nothing is in the way, and greatest speed, metres per second.
    least: f64,
    most: f64,
    /// Greatest speed of its log around here, metres per second; infinite if it stands.
    fastest: f64,
    /// The way ahead, from the agent on, and whether nothing is in it.
    way: Vec<Pose>,
    is_clear: OnceCell<bool>,
}

impl Pace {
    /// The pace of an agent `now`, in frame `t` of its log, if it is on its log's way; `most` is the
    /// greatest speed for anything else, metres per second.
    pub(super) fn of_log(log: &[Option<Pose>], t: usize, now: &Shown, most: f64) -> Option<Self> {
        let place = Place::of(log, t, now)?;
        let speed = place.metres() / TOKEN_DT;
        let own = now.velocity().length();
        let least = (SHARE * speed - SLOWER_MPS).min(own + GAINS_MPS);
        // Who stands may start before its log does.
        let fastest = match place.fastest() {
            metres if metres < STANDS_M => f64::INFINITY,
            metres => metres / TOKEN_DT,
        };
        Some(Self {
            speed,
            least: least.min(most),
            most: (FASTER * fastest + FASTER_MPS).max(own - LOSES_MPS),
            fastest,
            way: place.way(now.pose),
            is_clear: OnceCell::new(),
        })
    }

    /// Speed of its log here, metres per second.
    pub(super) fn logged(&self) -> f64 {
        self.speed
    }

    /// By how much a move is slower or faster than that, metres per second; `others` are all other agents
    /// and their paces.
    pub(super) fn fault<'a>(
        &self,
        now: &Shown,
        step: &Pose,
        others: impl Iterator<Item = (&'a Shown, Option<&'a Self>)>,
    ) -> f64 {
        let next = step.position.length() / TOKEN_DT;
        let gained = next - now.velocity().length();
        let is_hasty = next > self.fastest + AS_FAST_MPS && gained > HASTY_MPS;
        if next > self.most || is_hasty && now.body.kind != AgentKind::Pedestrian {
            return (next - self.most).max(gained - HASTY_MPS);
        }
        let slow = (self.least - next).max(0.0);
        let is_clear = || *self.is_clear.get_or_init(|| self.is_clear(now, others));
        match slow > 0.0 && is_clear() {
            true => slow,
            false => 0.0,
        }
    }

    /// Whether an agent may go on with the least speed for a while, as far as others are concerned. Those
    /// that it touches already do not count, nor people for each other.
    fn is_clear<'a>(
        &self,
        now: &Shown,
        mut others: impl Iterator<Item = (&'a Shown, Option<&'a Self>)>,
    ) -> bool {
        let walks = now.body.kind == AgentKind::Pedestrian;
        let own: [Pose; STEPS + 1] =
            std::array::from_fn(|i| along(&self.way, self.least * TOKEN_DT * i as f64));
        let shape = |pose: Pose, of: &Shown, (ahead, side): (f64, f64)| OrientedBox {
            pose: pose * Pose::new(ahead / 2.0, 0.0, 0.0),
            length: of.body.length + ahead,
            width: of.body.width + 2.0 * side,
        };
        let bare = |of: &Shown| shape(of.pose, of, (0.0, 0.0));
        let reach = (now.body.length + now.body.width) / 2.0 + SPACE_M + SIDE_M;
        others.all(|(other, pace)| {
            let reach = reach + (other.body.length + other.body.width) / 2.0;
            let touches = || bare(now).overlaps(&bare(other));
            let meets = |(i, own): (usize, &Pose)| {
                let its = ahead(other, pace, i);
                own.position.distance_squared(its.position) < reach * reach
                    && shape(*own, now, (SPACE_M, SIDE_M)).overlaps(&shape(its, other, (0.0, 0.0)))
            };
            let is_person = other.body.kind == AgentKind::Pedestrian;
            let stands = other.velocity().length() < STILL_MPS;
            walks && (is_person || stands) || !own.iter().enumerate().any(meets) || touches()
        })
    }
}

/// Where an agent is on its log's way: in the step from frame `at`, after this part of it.
struct Place<'a> {
    log: &'a [Option<Pose>],
    at: usize,
    part: f64,
}

impl<'a> Place<'a> {
    fn of(log: &'a [Option<Pose>], t: usize, now: &Shown) -> Option<Self> {
        let here = now.pose.position;
        let near = |at: usize| {
            let [from, to] = [log[at]?, log[at + 1]?].map(|pose| pose.position);
            let way = to - from;
            let part = ((here - from).dot(way) / way.length_squared().max(1e-9)).clamp(0.0, 1.0);
            Some((at, part, here.distance(from + way * part)))
        };
        let steps: Vec<(usize, f64, f64)> =
            (0..log.len().saturating_sub(1)).filter_map(near).collect();
        let least = steps
            .iter()
            .map(|step| step.2)
            .fold(f64::INFINITY, f64::min);
        let beside = match now.body.kind {
            AgentKind::Pedestrian => BESIDE_ON_FOOT_M,
            _ => BESIDE_M,
        };
        if least > beside {
            return None;
        }
        let (mut at, mut part, _) = *steps.iter().rfind(|step| step.2 <= least + SAME_M)?;
        let pose = log[at]?.interpolate(log[at + 1]?, part);
        if angle_difference(pose.heading, now.pose.heading).abs() > TURNED {
            return None;
        }
        let is_here =
            |of: usize| log[of].is_some_and(|of| of.position.distance(pose.position) < HERE_M);
        let stands = |of: usize| {
            let both = log[of].zip(log[of + 1]);
            both.is_some_and(|(a, b)| a.position.distance(b.position) < STANDS_M)
        };
        if is_here(t) && log.get(t + 1).is_some_and(Option::is_some) {
            (at, part) = (t, 0.0);
        } else if at > t && (0..=at).any(|of| is_here(of) && stands(of)) {
            // The log has yet to wait here.
            return None;
        }
        Some(Self { log, at, part })
    }

    /// Metres that the log covers from a frame to the next, if it is known.
    fn step(&self, at: usize) -> Option<f64> {
        let (from, to) = ((*self.log.get(at)?)?, (*self.log.get(at + 1)?)?);
        Some(from.position.distance(to.position))
    }

    /// The same in the half second from here on; the last known if it ends before.
    fn metres(&self) -> f64 {
        let first = self.step(self.at).unwrap_or(0.0);
        let second = self.step(self.at + 1).unwrap_or(first);
        (1.0 - self.part) * first + self.part * second
    }

    /// The most that it covers in half a second around here.
    fn fastest(&self) -> f64 {
        let around = self.at.saturating_sub(AROUND)..=self.at + AROUND;
        around.filter_map(|at| self.step(at)).fold(0.0, f64::max)
    }

    /// The poses from the agent's on.
    fn way(&self, from: Pose) -> Vec<Pose> {
        let ahead = self.log[self.at + 1..].iter();
        let known = ahead.map_while(|pose| *pose);
        std::iter::once(from).chain(known).collect()
    }
}

/// Where an agent is after so many steps if it goes on as fast as now: on its log's way, or straight on.
fn ahead(of: &Shown, pace: Option<&Pace>, steps: usize) -> Pose {
    let moved = of.velocity() * (TOKEN_DT * steps as f64);
    match pace {
        Some(pace) => along(&pace.way, moved.length()),
        None => Pose {
            position: of.pose.position + moved,
            ..of.pose
        },
    }
}

/// The pose so many metres along a way, which goes on straight.
fn along(way: &[Pose], metres: f64) -> Pose {
    let mut left = metres;
    for pair in way.windows(2) {
        let length = pair[0].position.distance(pair[1].position);
        if left <= length {
            return pair[0].interpolate(pair[1], left / length.max(1e-9));
        }
        left -= length;
    }
    way[way.len() - 1]
        * Pose {
            position: DVec2::new(left, 0.0),
            heading: 0.0,
        }
}

#[cfg(test)]
mod tests {
    use gump_geometry::dvec2;
    use gump_model::relative::graph::Body;

    use super::*;

    fn agent(kind: AgentKind, (x, y): (f64, f64), speed: f64) -> Shown {
        let (length, width) = match kind {
            AgentKind::Pedestrian => (0.8, 0.8),
            _ => (4.5, 1.9),
        };
        let body = Body {
            kind,
            length,
            width,
            sized: true,
        };
        Shown::first(body, Pose::new(x, y, 0.0), dvec2(speed, 0.0))
    }

    fn car(at: (f64, f64), speed: f64) -> Shown {
        agent(AgentKind::Vehicle, at, speed)
    }

    /// A log that is at these places along x.
    fn log(places: &[f64]) -> Vec<Option<Pose>> {
        let pose = |x: &f64| Some(Pose::new(*x, 0.0, 0.0));
        places.iter().map(pose).collect()
    }

    /// It waits for three steps, and drives off.
    const QUEUED: [f64; 9] = [8.0, 10.0, 10.0, 10.0, 10.0, 10.5, 11.5, 13.0, 15.0];

    fn fault_among(log: &[Option<Pose>], t: usize, own: Shown, next: f64, others: &[Shown]) -> f64 {
        let pace = Pace::of_log(log, t, &own, f64::INFINITY);
        let step = Pose::new(next * TOKEN_DT, 0.0, 0.0);
        let others = others.iter().map(|other| (other, None));
        pace.map_or(0.0, |pace| pace.fault(&own, &step, others))
    }

    fn fault(log: &[Option<Pose>], t: usize, own: Shown, next: f64) -> f64 {
        fault_among(log, t, own, next, &[])
    }

    #[test]
    fn who_waited_starts_when_its_log_has_started() {
        let log = log(&QUEUED);
        let stays = |t: usize, x: f64| fault(&log, t, car((x, 0.0), 0.0), 0.0);
        // Before that, and as its log starts, which gains 1 m/s: 0.3 of it are missing.
        assert_eq!((1..4).map(|t| stays(t, 10.0)).sum::<f64>(), 0.0);
        assert!((stays(4, 10.0) - 0.3).abs() < 1e-9);
        // Later, also a little behind.
        assert!(stays(7, 10.1) > 0.2 && stays(7, 9.0) > 0.7);
        assert_eq!(fault(&log, 7, car((9.0, 0.0), 0.0), 0.8), 0.0);
    }

    #[test]
    fn before_its_log_has_waited_nobody_has_to_go_on() {
        let log = log(&[0.0, 4.0, 7.0, 9.0, 10.0, 10.0, 10.0, 12.0, 15.0]);
        assert_eq!(fault(&log, 2, car((9.95, 0.0), 0.5), 0.0), 0.0);
        assert!(fault(&log, 7, car((9.95, 0.0), 0.5), 0.0) > 0.0);
    }

    #[test]
    fn who_is_slower_than_its_log_gains() {
        let log = log(&[0.0, 4.0, 8.0, 12.0, 16.0, 20.0, 24.0, 28.0, 32.0, 36.0]);
        // 8 m/s: 5.9 are enough, and 0.75 more than now.
        assert!(fault(&log, 3, car((10.0, 0.5), 8.0), 5.0) > 0.89);
        assert_eq!(fault(&log, 3, car((10.0, 0.5), 8.0), 6.0), 0.0);
        assert!(fault(&log, 3, car((10.0, 0.0), 3.0), 3.5) > 0.2);
        assert_eq!(fault(&log, 3, car((10.0, 0.0), 3.0), 3.8), 0.0);
        // On another way, in another direction, and behind its end.
        assert_eq!(fault(&log, 3, car((10.0, 1.5), 8.0), 5.0), 0.0);
        let mut turned = car((10.0, 0.0), 8.0);
        turned.pose = Pose::new(10.0, 0.0, 1.0);
        assert_eq!(fault(&log, 3, turned, 5.0), 0.0);
        assert_eq!(fault(&log, 9, car((38.0, 0.0), 8.0), 5.0), 0.0);
        // Something else demands less.
        let slow = Pace::of_log(&log, 3, &car((10.0, 0.0), 8.0), 2.0).unwrap();
        let step = Pose::new(1.0, 0.0, 0.0);
        assert_eq!(
            slow.fault(&car((10.0, 0.0), 8.0), &step, std::iter::empty()),
            0.0
        );
    }

    #[test]
    fn nobody_is_much_faster_than_its_log_around_there() {
        let log = log(&[0.0, 4.0, 8.0, 12.0, 16.0, 20.0, 23.0, 25.0, 26.0, 26.5]);
        // 10.1 m/s are the most; one that is faster loses 0.5.
        assert!(fault(&log, 1, car((5.0, 0.0), 10.0), 10.6) > 0.4);
        // Nobody gains much beyond 8.
        assert!((fault(&log, 1, car((5.0, 0.0), 8.0), 8.7) - 0.3).abs() < 1e-9);
        assert_eq!(fault(&log, 1, car((5.0, 0.0), 6.0), 7.0), 0.0);
        assert_eq!(fault(&log, 1, car((5.0, 0.0), 10.0), 10.0), 0.0);
        assert!(fault(&log, 1, car((5.0, 0.0), 14.0), 14.0) > 0.4);
        assert_eq!(fault(&log, 1, car((5.0, 0.0), 14.0), 13.4), 0.0);
        // Where it slows down nobody has to.
        assert_eq!(fault(&log, 6, car((23.5, 0.0), 8.0), 8.0), 0.0);
    }

    #[test]
    fn who_has_somebody_in_the_way_may_wait() {
        let log = log(&[0.0, 4.0, 8.0, 12.0, 16.0, 20.0, 24.0, 28.0, 32.0, 36.0]);
        let waits =
            |other: Shown| fault_among(&log, 3, car((10.0, 0.0), 3.0), 2.0, &[other]) == 0.0;
        assert!(waits(car((16.0, 0.0), 0.0)) && waits(car((16.0, 0.0), 2.0)));
        assert!(!waits(car((17.0, 0.0), 6.0)) && !waits(car((16.0, 3.0), 0.0)));
        // One that comes the other way, and turns off before.
        let mut oncoming = car((24.0, 0.0), 0.0);
        oncoming = Shown::first(oncoming.body, Pose::new(24.0, 0.0, 3.1), dvec2(-6.0, 0.0));
        let turns = [
            (24.0, 0.0),
            (21.0, -1.5),
            (20.0, -4.0),
            (20.0, -7.0),
            (20.0, -10.0),
        ];
        let poses = turns.map(|(x, y)| Some(Pose::new(x, y, 3.1)));
        let its = Pace::of_log(&poses, 0, &oncoming, f64::INFINITY);
        let own = car((10.0, 0.0), 3.0);
        let pace = || Pace::of_log(&log, 3, &own, f64::INFINITY).unwrap();
        let with = |its: Option<&Pace>| {
            let others = std::iter::once((&oncoming, its));
            pace().fault(&own, &Pose::new(1.0, 0.0, 0.0), others)
        };
        assert!(with(None) == 0.0 && with(its.as_ref()) > 0.0);
        // People walk through each other, around who stands, and wait for who drives.
        let own = agent(AgentKind::Pedestrian, (10.0, 0.5), 1.0);
        let among = |kind, speed| {
            let other = agent(kind, (13.0, 0.0), speed);
            fault_among(&log, 3, own, 0.2, &[other])
        };
        assert!(among(AgentKind::Pedestrian, 0.0) > 0.0 && among(AgentKind::Vehicle, 0.0) > 0.0);
        assert_eq!(among(AgentKind::Vehicle, 0.5), 0.0);
    }
}
