//! Who gives way at junctions.
//!
//! The rules of sampling look 1.5 s ahead, along each agent's last turn. Two vehicles whose lanes
//! cross in a junction see each other too late by that: both drive in, and brake or touch in the
//! middle. Here vehicles are looked at along their lanes, for as long as it takes to stop gently, and
//! the one that has to give way gets a greatest speed.

use gump_geometry::{DVec2, OrientedBox, angle_difference};
use gump_model::relative::graph::{Lights, Shown};
use gump_model::relative::route::Route;
use gump_scene::{Lane, LightState, MapGraph};

use crate::relative::approach::{
    OVER_M, ROLLS_MPS, before_line, has_sign, lane_under, slowing_before,
};
use crate::relative::turning_in::TakesWay;

// All were chosen by hand.

/// Courses are this long, metres, with a point every metre.
const REACH_M: usize = 40;
/// At most this many courses per vehicle, and lanes per course.
const COURSES: usize = 6;
const LANES: usize = 8;
/// Two courses meet where they are nearer than half of both widths and this, metres, ...
const BESIDE_M: f64 = 0.4;
/// or, for those that are so from the start, so much nearer, metres, ...
const CLOSER_M: [f64; 3] = [0.0, 0.4, 0.8];
/// ... for this far at most, metres: lanes that merge stay together.
const TOGETHER_M: f64 = 6.0;
/// Who comes to the place of meeting later than this does not count, seconds; nor do two that are there
/// with this between them, seconds.
const SOON_S: f64 = 5.0;
const APART_S: f64 = 0.8;
/// A vehicle slower than this is not about to come, metres per second.
const MOVES_MPS: f64 = 1.0;
/// A slower one than this starts, metres per second, with accelerations between these, m/s².
const SLOW_MPS: f64 = 6.0;
const STARTS_MPS2: (f64, f64) = (1.0, 1.5);
/// One that gives way stops this far before the place, metres.
const BEFORE_M: f64 = 1.0;
/// Who insists has its front nearer to the line than this, metres.
const AT_LINE_M: f64 = 4.0;
/// Who stands across the way of another stands at more than this angle to it, radians, with a corner
/// nearer to the path of its side than this, metres.
const ACROSS: f64 = 0.5;
const SIDE_M: f64 = 0.3;
/// A course turns if its direction changes by more than this, radians, and is opposite to another if they
/// differ from half a turn by less than this, radians.
const TURNS: f64 = 0.5;
const OPPOSITE: f64 = 0.8;

/// A way of a vehicle along its lanes.
pub struct Course {
    /// Every metre from its centre.
    points: Vec<DVec2>,
    /// The least and the greatest coordinates of these.
    bounds: (DVec2, DVec2),
    /// Direction at the start, in a junction that of its lane, radians, and by how much it turns, to the
    /// left above 0.
    heading: f64,
    turn: f64,
    /// Metres to the first junction that it drives into; `None` if there is none.
    line_m: Option<f64>,
    /// Whether it is in a junction now.
    is_inside: bool,
    /// Whether a stop sign applies at the line.
    is_signed: bool,
    /// Whether the light at the line is red, and whether there is one.
    is_red: bool,
    is_lit: bool,
    /// Whether it goes before those who can still stop, see [`Self::insist`].
    insists: bool,
    now: Shown,
}

/// The ways ahead of a vehicle that is on a lane, shortest turn first; only that of its route, where it
/// is on it.
pub fn courses(
    streets: &MapGraph,
    lights: &Lights,
    now: &Shown,
    route: Option<&Route>,
) -> Vec<Course> {
    let Some((lane, at)) = lane_under(streets, now.pose) else {
        return Vec::new();
    };
    let mut all = Vec::new();
    let mut way = vec![lane];
    walk(
        (streets, route),
        &mut way,
        lane.centerline.length() - at,
        &mut all,
    );
    let course = |way: &Vec<&Lane>| course(streets, lights, now, way, at);
    let mut courses: Vec<Course> = all.iter().map(course).collect();
    courses.sort_by(|a, b| a.turn.abs().total_cmp(&b.turn.abs()));
    courses
}

/// The way of a vehicle into a driveway: before the turn it waits where it leaves the street, in the turn
/// it is in the way of those that come.
pub(super) fn course_in(way: TakesWay<'_>, lights: &Lights, now: &Shown) -> Course {
    let at = way.at(now);
    let mut course = course(&MapGraph::default(), lights, now, &[way.lane], at);
    let room = way.way.turns_off_m - at;
    course.is_inside = room < -OVER_M;
    course.line_m = (!course.is_inside).then_some(room + now.body.length / 2.0);
    course
}

/// Collects the ways from the last lane of `way`, which ends `metres` ahead.
fn walk<'a>(
    (streets, route): (&'a MapGraph, Option<&Route>),
    way: &mut Vec<&'a Lane>,
    metres: f64,
    all: &mut Vec<Vec<&'a Lane>>,
) {
    let last = way[way.len() - 1];
    let mut next = streets.successors(last.id).peekable();
    if metres >= REACH_M as f64 || way.len() == LANES || next.peek().is_none() {
        all.push(way.clone());
        return;
    }
    let meant = route.and_then(|route| route.after(last.id));
    for lane in next.filter(|lane| meant.is_none_or(|meant| lane.id == meant)) {
        if all.len() < COURSES {
            way.push(lane);
            walk(
                (streets, route),
                way,
                metres + lane.centerline.length(),
                all,
            );
            way.pop();
        }
    }
}

fn course(streets: &MapGraph, lights: &Lights, now: &Shown, way: &[&Lane], at: f64) -> Course {
    let (mut points, mut base, mut line) = (Vec::new(), -at, None);
    let mut last = (way[0], at);
    let is_inside = way[0].in_intersection;
    // Who turns left does so to the end of the turn.
    let heading = match is_inside {
        true => way[0].centerline.pose_at(0.0).heading,
        false => way[0].centerline.pose_at(at).heading,
    };
    for (i, lane) in way.iter().enumerate() {
        let length = lane.centerline.length();
        if i > 0 && line.is_none() && lane.in_intersection && !way[i - 1].in_intersection {
            line = Some((base, way[i - 1], *lane));
        }
        while points.len() <= REACH_M && points.len() as f64 <= base + length {
            points.push(lane.centerline.point_at(points.len() as f64 - base));
            last = (*lane, points.len() as f64 - 1.0 - base);
        }
        base += length;
    }
    let end = last.0.centerline.pose_at(last.1).heading;
    let least = points.iter().copied().fold(DVec2::INFINITY, DVec2::min);
    let greatest = points.iter().copied().fold(DVec2::NEG_INFINITY, DVec2::max);
    Course {
        points,
        bounds: (least, greatest),
        heading,
        turn: angle_difference(end, heading),
        line_m: line.filter(|_| !is_inside).map(|(metres, ..)| metres),
        is_inside,
        is_signed: line
            .is_some_and(|(_, before, lane)| has_sign(streets, before) || has_sign(streets, lane)),
        is_red: line.is_some_and(|(_, _, lane)| lights.colour(lane.id) == Some(LightState::Red)),
        is_lit: line.is_some_and(|(_, _, lane)| lights.colour(lane.id).is_some()),
        insists: false,
        now: *now,
    }
}

/// The greatest speed of a vehicle for those that it has to let pass, metres per second: on the best of
/// its courses, and on the straightest one before those that stand across it. Infinite if there is
/// nobody. `others` are the courses of each other vehicle, the likeliest first.
pub fn yielding_speed<'a>(
    own: &[Course],
    others: &(impl Iterator<Item = &'a [Course]> + Clone),
) -> f64 {
    let least = |limit: &dyn Fn(&Course) -> Option<f64>| {
        let limits = others.clone().filter_map(|other| limit(other.first()?));
        limits.fold(f64::INFINITY, f64::min)
    };
    let lets_pass = own.iter().map(|own| least(&|other| own.limit(other)));
    let leaves_room = own
        .first()
        .map(|own| least(&|other| own.leaves_room(other)));
    let best = lets_pass.reduce(f64::max).unwrap_or(f64::INFINITY);
    best.min(leaves_room.unwrap_or(f64::INFINITY))
}

/// The greatest speed of a vehicle for stop signs, metres per second, on the best of its courses.
pub fn speed_for_signs(own: &[Course]) -> f64 {
    let before = |own: &Course| match own.line_m {
        Some(line) if own.is_signed => slowing_before(&own.now, line, ROLLS_MPS),
        _ => f64::INFINITY,
    };
    own.iter()
        .map(before)
        .reduce(f64::max)
        .unwrap_or(f64::INFINITY)
}

/// Whether one turns left before another that comes from the opposite direction and does not.
fn turns_left_before(one: &Course, other: &Course) -> bool {
    let opposite =
        angle_difference(one.heading, other.heading).abs() > std::f64::consts::PI - OPPOSITE;
    opposite && one.turn > TURNS && other.turn < TURNS
}

/// Where two courses meet, metres from the centres.
struct Meeting {
    own: (f64, f64),
    other: (f64, f64),
}

impl Course {
    fn speed(&self) -> f64 {
        self.now.velocity().length()
    }

    /// It has waited at a junction for so long that it goes before those who can still stop, if it is at
    /// the line and no light rules there: streams that never end would hold it for ever.
    pub(super) fn insist(&mut self) {
        let front = self.now.body.length / 2.0;
        let is_at_line = |line: f64| line - front < AT_LINE_M;
        self.insists = !self.is_lit && self.line_m.is_some_and(is_at_line);
    }

    /// The greatest speed if this one has to let another pass.
    fn limit(&self, other: &Self) -> Option<f64> {
        let stays_out = !other.is_inside && (other.is_red || (self.is_signed && other.stops()));
        if (self.line_m.is_none() && !self.is_inside) || stays_out {
            return None;
        }
        let half = 0.5 * (self.now.body.length + other.now.body.length);
        let apart = self.now.pose.position.distance(other.now.pose.position);
        if apart > self.reach(half) + other.reach(half) + self.beside(other) {
            return None;
        }
        let meeting = self.meets(other)?;
        let can_stop =
            |course: &Self, place: f64| before_line(&course.now, place - BEFORE_M, 0.0).is_finite();
        let is_bound = !can_stop(other, meeting.other.0) && can_stop(self, meeting.own.0);
        if !self.expects(other, is_bound) {
            return None;
        }
        let mine = self.times(meeting.own, half);
        let its = other.times(meeting.other, half);
        let is_soon = mine.0 < SOON_S && its.0 < SOON_S;
        // It cannot be told when one that stands has gone.
        let has_gone = other.speed() >= MOVES_MPS && mine.0 > its.1 + APART_S;
        let is_apart = has_gone || its.0 > mine.1 + APART_S;
        if !is_soon || is_apart || !(is_bound || self.gives_way(other, mine.0 > its.0)) {
            return None;
        }
        let place = meeting.own.0 - BEFORE_M;
        // It waits at the line, if it is not over it and can still stop there.
        let front = self.now.body.length / 2.0;
        let line = self
            .line_m
            .filter(|line| *line < place && line - front > -OVER_M);
        let at_line = line
            .map(|line| slowing_before(&self.now, line, 0.0))
            .filter(|speed| speed.is_finite());
        Some(at_line.unwrap_or_else(|| slowing_before(&self.now, place, 0.0)))
    }

    /// Whether it has yet to stop at a sign.
    fn stops(&self) -> bool {
        let front = self.now.body.length / 2.0;
        self.is_signed && self.line_m.is_some_and(|line| line - front > OVER_M)
    }

    /// Whether another is about to come: it moves, or it waits in the junction, and not to let this one
    /// pass. `is_bound` says that it is too late for that.
    fn expects(&self, other: &Self, is_bound: bool) -> bool {
        let waits_for_it = turns_left_before(other, self) && !is_bound;
        other.speed() >= MOVES_MPS || other.insists || (other.is_inside && !waits_for_it)
    }

    /// The greatest speed before another that stands in a junction across its way: it stops where the
    /// other can still drive on, and not at its bumper.
    fn leaves_room(&self, other: &Self) -> Option<f64> {
        let turned = angle_difference(self.now.pose.heading, other.now.pose.heading).abs();
        let apart = self.now.pose.position.distance(other.now.pose.position);
        if other.speed() >= MOVES_MPS
            || !other.is_inside
            || turned < ACROSS
            || apart > REACH_M as f64 + other.now.body.length
        {
            return None;
        }
        let corners = OrientedBox {
            pose: other.now.pose,
            length: other.now.body.length,
            width: other.now.body.width,
        }
        .corners();
        let near = 0.5 * self.now.body.width + SIDE_M;
        let blocks = |corner: &DVec2| {
            let squared = |point: &DVec2| point.distance_squared(*corner);
            self.points.iter().any(|point| squared(point) < near * near)
        };
        if !corners.iter().any(blocks) {
            return None;
        }
        let place = self.meets(other)?.own.0 - BEFORE_M;
        Some(slowing_before(&self.now, place, 0.0))
    }

    /// Whether it has to let another pass that it meets; `is_later` says who comes there first.
    fn gives_way(&self, other: &Self, is_later: bool) -> bool {
        if !self.is_inside && !other.is_inside && self.insists != other.insists {
            return other.insists;
        }
        let turns_left = turns_left_before(self, other);
        if turns_left != turns_left_before(other, self) {
            return turns_left;
        }
        if self.is_inside != other.is_inside {
            return other.is_inside;
        }
        if !self.is_inside && self.is_signed != other.is_signed {
            return self.is_signed;
        }
        is_later
    }

    /// Seconds until it comes to a stretch of its course, at the earliest, and has left it, at the latest.
    fn times(&self, (from, to): (f64, f64), half: f64) -> (f64, f64) {
        let speed = self.speed();
        let until = |metres: f64, starts: f64| match metres > 0.0 {
            true if speed < SLOW_MPS => {
                ((speed * speed + 2.0 * starts * metres).sqrt() - speed) / starts
            }
            true => metres / speed,
            false => 0.0,
        };
        (
            until(from - half, STARTS_MPS2.1),
            until(to + half, STARTS_MPS2.0),
        )
    }

    /// A place farther ahead than this is not reached soon, metres.
    fn reach(&self, half: f64) -> f64 {
        let driven = match self.speed() {
            speed if speed < SLOW_MPS => speed * SOON_S + 0.5 * STARTS_MPS2.1 * SOON_S * SOON_S,
            speed => speed * SOON_S,
        };
        driven + half
    }

    /// Two courses meet where they are nearer than this, metres.
    fn beside(&self, other: &Self) -> f64 {
        0.5 * (self.now.body.width + other.now.body.width) + BESIDE_M
    }

    /// The first stretch on which two courses are beside or on each other, if they come from apart.
    fn meets(&self, other: &Self) -> Option<Meeting> {
        let near = self.beside(other);
        let lies_beyond = |one: &Self, of: &Self| (one.bounds.0 - of.bounds.1).max_element() > near;
        if lies_beyond(self, other) || lies_beyond(other, self) {
            return None;
        }
        // One that turns left may have driven beside the oncoming lane before.
        CLOSER_M
            .iter()
            .find_map(|closer| self.meets_within(other, near - closer))
    }

    /// As [`Self::meets`], where courses are beside each other if they are nearer than this, metres.
    fn meets_within(&self, other: &Self, near: f64) -> Option<Meeting> {
        let (least, greatest) = (other.bounds.0 - near, other.bounds.1 + near);
        let hits = |point: &DVec2| {
            let is_outside = (least - *point).max(*point - greatest).max_element() > 0.0;
            if is_outside {
                return None;
            }
            let distance = |(j, of): (usize, &DVec2)| (of.distance_squared(*point), j);
            let nearest = other.points.iter().enumerate().map(distance);
            let nearest = nearest.min_by(|a, b| a.0.total_cmp(&b.0))?;
            (nearest.0 < near * near).then_some(nearest.1 as f64)
        };
        let mut found: Option<Meeting> = None;
        for (i, point) in self.points.iter().enumerate() {
            match (hits(point), &mut found) {
                // One behind the other, or already beside each other.
                (Some(at), None) if i == 0 || at == 0.0 => return None,
                (Some(at), None) => {
                    found = Some(Meeting {
                        own: (i as f64, i as f64),
                        other: (at, at),
                    });
                }
                (Some(at), Some(meeting)) => {
                    meeting.own.1 = i as f64;
                    meeting.other = (meeting.other.0.min(at), meeting.other.1.max(at));
                }
                (None, None) => {}
                (None, Some(_)) => break,
            }
        }
        let mut meeting = found.filter(|at| at.other.0 > 0.0)?;
        for stretch in [&mut meeting.own, &mut meeting.other] {
            stretch.1 = stretch.1.min(stretch.0 + TOGETHER_M);
        }
        Some(meeting)
    }
}

#[cfg(test)]
mod tests {
    use gump_geometry::{DVec3, Pose};
    use gump_model::relative::graph::Body;
    use gump_model::relative::route::Traveller;
    use gump_scene::{AgentKind, LaneId, StopSign, fixture};

    use super::*;

    /// Lanes from the west, the south and the east meet; 12 turns left from the west. Those of the
    /// junction are 2, 5, 8 and 12; a stop sign applies to those stated.
    fn crossing(signed: &[i64]) -> MapGraph {
        let scenario = fixture::scenario(
            "lane 1: 0,0 40,0 next 2,12\nlane 2: 40,0 60,0 next 3\nlane 3: 60,0 120,0\n\
             lane 4: 52,-60 52,-10 next 5\nlane 5: 52,-10 52,10 next 6\nlane 6: 52,10 52,60\n\
             lane 7: 120,5 60,5 next 8\nlane 8: 60,5 40,5 next 9\nlane 9: 40,5 0,5\n\
             lane 12: 40,0 46,1 50,4 52,10 next 6\nego vehicle 0: 5,0",
        )
        .unwrap();
        let mut parts = scenario.map.parts().clone();
        for lane in &mut parts.lanes {
            lane.in_intersection = [2, 5, 8, 12].contains(&lane.id.0);
        }
        parts.stop_signs.push(StopSign {
            id: 20,
            position: DVec3::ZERO,
            lanes: signed.iter().map(|id| LaneId(*id)).collect(),
        });
        MapGraph::new(parts).unwrap()
    }

    const WEST: f64 = 0.0;
    const SOUTH: f64 = std::f64::consts::FRAC_PI_2;
    const EAST: f64 = std::f64::consts::PI;

    fn car((x, y): (f64, f64), heading: f64, speed: f64) -> Shown {
        let body = Body {
            kind: AgentKind::Vehicle,
            length: 4.5,
            width: 1.9,
            sized: true,
        };
        let velocity = DVec2::from_angle(heading) * speed;
        Shown::first(body, Pose::new(x, y, heading), velocity)
    }

    #[test]
    fn who_has_a_route_has_one_course() {
        let map = &crossing(&[]);
        let own = car((20.0, 0.0), WEST, 8.0);
        let turns = |route: Option<&Route>| {
            let courses = courses(map, &Lights::default(), &own, route);
            let turns = courses.iter().map(|course| course.turn > TURNS);
            turns.collect::<Vec<bool>>()
        };
        assert_eq!(turns(None), [false, true]);
        for seed in (0..8).map(gump_scene::Seed) {
            let speed = 8.0;
            let who = |pose| Traveller {
                pose,
                speed,
                seed,
                remains: false,
            };
            let route = Route::from_here(map, who(own.pose)).unwrap();
            assert_eq!(turns(Some(&route)), [route.lanes()[1] == LaneId(12)]);
        }
        // One that it is not on tells nothing.
        let other = Traveller {
            pose: Pose::new(52.0, -40.0, SOUTH),
            speed: 8.0,
            seed: gump_scene::Seed(1),
            remains: false,
        };
        let other = Route::from_here(map, other);
        assert_eq!(turns(other.as_ref()), [false, true]);
    }

    /// The greatest speeds of two vehicles for each other.
    fn speeds(map: &MapGraph, lights: &Lights, own: Shown, other: Shown) -> (f64, f64) {
        let [own, other] = [own, other].map(|now| courses(map, lights, &now, None));
        let of = |one: &[Course], to: &Vec<Course>| yielding_speed(one, &std::iter::once(&to[..]));
        (of(&own, &other), of(&other, &own))
    }

    #[test]
    fn stop_signs_are_rolled_past_at_most() {
        let (signed, open) = (crossing(&[1]), crossing(&[]));
        let speed = |map: &MapGraph, x: f64, speed: f64| {
            let now = car((x, 0.0), WEST, speed);
            speed_for_signs(&courses(map, &Lights::default(), &now, None))
        };
        // 7.75 m before the line; half a second later it slows down at 3 m/s² to 2.5 m/s there.
        let before = speed(&signed, 30.0, 8.0);
        let left = 7.75 - 0.5 * before;
        assert!((before * before - 2.0 * 3.0 * left - 2.5 * 2.5).abs() < 1e-9);
        assert_eq!(speed(&signed, 37.7, 2.0), 2.5);
        assert_eq!(speed(&signed, 41.0, 2.0), f64::INFINITY);
        assert_eq!(speed(&signed, 37.7, 8.0), f64::INFINITY);
        assert_eq!(speed(&open, 30.0, 8.0), f64::INFINITY);
    }

    #[test]
    fn who_comes_later_gives_way() {
        let map = crossing(&[]);
        let meet = |x: f64, speed: f64, other: f64| {
            let own = car((x, 0.0), WEST, speed);
            speeds(
                &map,
                &Lights::default(),
                own,
                car((52.0, -30.0), SOUTH, other),
            )
        };
        // 32 m at 8 m/s and 30 m at 10: the line is 20 m ahead.
        let (own, other) = meet(20.0, 8.0, 10.0);
        // It stops at 3 m/s² in the 17.75 m that its front has, after half a second at this speed.
        assert!((17.75 - own / 2.0 - own * own / 6.0).abs() < 0.1, "{own}");
        assert!(other.is_infinite());
        // The other one later; with seconds between them; and who stands does not come.
        assert!(meet(25.0, 10.0, 7.0).0.is_infinite() && meet(25.0, 10.0, 7.0).1.is_finite());
        assert_eq!(meet(-10.0, 8.0, 10.0), (f64::INFINITY, f64::INFINITY));
        assert!(meet(20.0, 8.0, 0.0).0.is_infinite());
        // At the line it waits.
        assert_eq!(meet(38.0, 0.0, 9.0).0, 0.0);
    }

    #[test]
    fn signs_and_lights_decide_before_that() {
        let (own, other) = (car((20.0, 0.0), WEST, 8.0), car((52.0, -30.0), SOUTH, 10.0));
        let signed = crossing(&[4]);
        let (west, south) = speeds(&signed, &Lights::default(), own, other);
        assert!(west.is_infinite() && south.is_finite());
        // Who has red does not come.
        let lights = Lights {
            by_lane: vec![(LaneId(5), LightState::Red, None)],
        };
        let map = crossing(&[]);
        let west = |lights: &Lights| speeds(&map, lights, own, other).0;
        assert!(west(&Lights::default()).is_finite() && west(&lights).is_infinite());
    }

    #[test]
    fn who_is_inside_goes_on_and_who_turns_left_waits() {
        let map = crossing(&[]);
        let none = Lights::default();
        let inside = speeds(
            &map,
            &none,
            car((42.0, 0.0), WEST, 4.0),
            car((52.0, -18.0), SOUTH, 8.0),
        );
        assert!(inside.0.is_infinite() && inside.1.is_finite());
        // On the lane that turns left, where it crosses the oncoming lane.
        let turning = car((44.0, 0.7), 0.17, 4.0);
        let (own, other) = speeds(&map, &none, turning, car((75.0, 5.0), EAST, 9.0));
        assert!(own.is_finite() && other.is_infinite(), "{own} {other}");
        // Before the junction it may still drive straight on.
        let undecided = car((36.0, 0.0), WEST, 5.0);
        let (own, other) = speeds(&map, &none, undecided, car((75.0, 5.0), EAST, 9.0));
        assert!(own.is_infinite() && other.is_infinite());
    }

    #[test]
    fn who_stands_in_the_junction_is_expected_to_go_on() {
        let map = crossing(&[]);
        let none = Lights::default();
        // Both stand inside, 8 and 3 m before the lanes cross.
        let (own, other) = speeds(
            &map,
            &none,
            car((44.0, 0.0), WEST, 0.0),
            car((52.0, -3.0), SOUTH, 0.0),
        );
        assert!(own.is_finite() && other.is_infinite(), "{own} {other}");
        // Who waits to turn left lets the other one pass, ...
        let straight = car((66.0, 5.0), EAST, 5.0);
        let (own, other) = speeds(&map, &none, car((44.0, 0.7), 0.17, 0.0), straight);
        assert!(own.is_finite() && other.is_infinite(), "{own} {other}");
        // ... unless it stands in its way already: then that one stops where the turn goes on.
        let (own, other) = speeds(&map, &none, car((49.0, 2.9), 0.8, 0.0), straight);
        assert!(own.is_infinite() && other < 5.0, "{own} {other}");
        let at_the_line = car((61.0, 5.0), EAST, 0.0);
        let (_, other) = speeds(&map, &none, car((49.0, 2.9), 0.8, 0.0), at_the_line);
        // It may start, but not up to the bumper.
        assert!(other < 5.0, "{other}");
    }

    #[test]
    fn who_insists_goes_before_those_who_can_still_stop() {
        let map = crossing(&[]);
        // One waits at its line, another comes from the south.
        let meet = |x: f64, (y, speed): (f64, f64), lights: &Lights| {
            let south = courses(&map, lights, &car((52.0, y), SOUTH, speed), None);
            let mut west = courses(&map, lights, &car((x, 0.0), WEST, 0.0), None);
            west.truncate(1);
            west.iter_mut().for_each(Course::insist);
            let yields =
                |own: &[Course], other: &[Course]| yielding_speed(own, &std::iter::once(other));
            (yields(&west, &south), yields(&south, &west))
        };
        let none = Lights::default();
        let (west, south) = meet(37.5, (-30.0, 9.0), &none);
        assert!(west.is_infinite() && south < 9.0, "{west} {south}");
        // The other is in the junction; it is not at its line; a light rules.
        let (west, south) = meet(37.5, (-8.0, 3.0), &none);
        assert!(west.is_finite() && south.is_infinite(), "{west} {south}");
        let (west, south) = meet(30.0, (-20.0, 9.0), &none);
        assert!(south.is_infinite(), "{west} {south}");
        let lights = Lights {
            by_lane: vec![(LaneId(2), LightState::Green, None)],
        };
        let (west, south) = meet(37.5, (-30.0, 9.0), &lights);
        assert!(west < 1.0 && south.is_infinite(), "{west} {south}");
    }

    #[test]
    fn who_has_to_stop_at_a_sign_first_is_not_waited_for() {
        let map = crossing(&[1, 4]);
        let speed = |other: f64| {
            let own = car((37.7, 0.0), WEST, 0.0);
            let other = car((52.0, other), SOUTH, 6.0);
            speeds(&map, &Lights::default(), own, other).0
        };
        // 5 m before its line, and over it.
        assert!(speed(-17.25).is_infinite() && speed(-11.0).is_finite());
    }

    #[test]
    fn who_has_turned_beside_the_oncoming_lane_is_let_pass() {
        // Its centre is nearer to that lane than two vehicles' that keep their distance.
        let scenario = fixture::scenario(
            "lane 1: 0,0 40,0 next 2\nlane 2: 40,0 46,0.6 52,3 56,8\n\
             lane 7: 120,2.2 66,2.2 next 8\nlane 8: 66,2.2 30,2.2 next 9\nlane 9: 30,2.2 0,2.2\n\
             ego vehicle 0: 5,0",
        )
        .unwrap();
        let mut parts = scenario.map.parts().clone();
        for lane in &mut parts.lanes {
            lane.in_intersection = [2, 8].contains(&lane.id.0);
        }
        let map = MapGraph::new(parts).unwrap();
        let turning = car((44.5, 0.4), 0.1, 3.0);
        let none = Lights::default();
        let (own, other) = speeds(&map, &none, turning, car((64.0, 2.2), EAST, 8.0));
        assert!(own.is_infinite() && other.is_finite(), "{own} {other}");
    }

    #[test]
    fn one_behind_the_other_is_no_matter_of_right_of_way() {
        let map = crossing(&[]);
        let follow = [car((20.0, 0.0), WEST, 8.0), car((32.0, 0.0), WEST, 6.0)];
        let (own, other) = speeds(&map, &Lights::default(), follow[0], follow[1]);
        assert!(own.is_infinite() && other.is_infinite());
        // Away from junctions there is none.
        let beyond = car((70.0, 0.0), WEST, 8.0);
        let (own, other) = speeds(
            &map,
            &Lights::default(),
            beyond,
            car((90.0, 5.0), EAST, 8.0),
        );
        assert!(own.is_infinite() && other.is_infinite());
    }
}
