//! Moves that no driver would make, as far as the rules of traffic do not forbid them.
//!
//! In drives under the rules the network's own motion is its target. What is judged here is the
//! speed: rules prefer slow draws, so that vehicles would slow down on free roads, more with each
//! update; and a vehicle that comes to a bend too fast leaves the road whatever is drawn then. One
//! that comes to a red light or a stop sign too fast runs it, and one that comes to a junction before
//! others takes their way (`right_of_way`). And the direction at junctions: who turns neither way where
//! the road ends drives off it. Queues would leave later with each update, too: who stands and has room
//! is drawn again, which makes it start sooner or later.

use std::cell::OnceCell;

use gump_engine::relative::approach::{
    BRAKES_MPS2, ROLLS_MPS, before_line, has_sign, lane_under, lanes_under,
};
use gump_geometry::{Pose, angle_difference};
use gump_model::relative::graph::{Lights, Shown};
use gump_model::steps::TOKEN_DT;
use gump_scene::{
    AgentKind, BendLimits, Lane, LaneAhead, LightState, MapGraph, approach_speed, bend_speed,
    lanes_ahead,
};

// All were chosen by hand.

/// A vehicle slows down if it loses more than this in a step of half a second, metres per second, ...
const SLOWS_MPS: f64 = 0.4;
/// ... on a straight path: if it turns no more than this in the step, radians, ...
const STRAIGHT: f64 = 0.06;
/// ... for no reason if it is on a lane that goes on for this distance without a junction or a stop
/// sign, metres, sees nothing else (`View::has_room`), and is not faster than drivers like to be before
/// a bend.
const FREE_M: f64 = 35.0;
const EASY: BendLimits = BendLimits {
    lateral_mps2: 2.5,
    braking_mps2: 1.5,
    ahead_m: 80.0,
};
/// What hardly a driver exceeds. A vehicle that is faster than this allows loses ...
const HARD: BendLimits = BendLimits {
    lateral_mps2: 4.0,
    braking_mps2: BRAKES_MPS2,
    ahead_m: 60.0,
};
/// The same where bends do not count.
const STRAIGHT_ON: BendLimits = BendLimits {
    lateral_mps2: f64::INFINITY,
    ..HARD
};
/// ... at least this in a step, metres per second.
const BRAKES_MPS: f64 = 2.0;
/// A move is as fast as the log, or as slow, up to this, metres per second.
const AS_LOGGED_MPS: f64 = 0.2;
/// A right turn at red is allowed from this speed, metres per second; it turns by more than this,
/// radians.
const TURNS_AT_RED_MPS: f64 = 2.0;
const RIGHT: f64 = 0.52;
/// Most that a vehicle gains in a step, that it loses, and its greatest lateral acceleration times
/// the duration of a step, metres per second: 4, 8 and 5 m/s².
const GAINS_MPS: f64 = 2.0;
const LOSES_MPS: f64 = 4.0;
const SIDEWAYS_MPS: f64 = 2.5;

/// A vehicle is at a junction if its lane is in one or leads into one within this, metres. There its
/// next pose is to be this near to a lane's centre, metres, ...
const JUNCTION_M: f64 = 10.0;
const NEAR_LANE_M: f64 = 1.8;
/// ... and to its direction, radians. A radian beyond counts as this much, metres per second; lanes
/// farther away than this are not considered, metres.
const ALONG: f64 = 0.4;
const PER_RADIAN: f64 = 4.0;
const LOOK_M: f64 = 5.0;

/// A vehicle that stands, or moves no farther than this in a step, metres, has this fault, metres per
/// second, ...
pub(super) const CREEPS_M: f64 = 0.15;
const STAYS_MPS: f64 = 0.3;
/// ... if it has room, and no junction or stop sign within this, metres, or one that is open to it.
const START_M: f64 = 12.0;
/// How far a vehicle comes in its first step, metres: 1.6 m/s².
const STARTS_M: f64 = 0.2;

/// The road ahead of a vehicle.
pub(super) struct Road<'a> {
    streets: &'a MapGraph,
    lights: &'a Lights,
    /// The lane that it is on, and its distance from the start, metres.
    on: Option<(&'a Lane, f64)>,
    /// Greatest speed for the bends, lights, signs and vehicles with right of way ahead, metres per
    /// second.
    most: f64,
    /// The same of who does not start or hurry at yellow.
    calm: f64,
    /// The same for vehicles with right of way alone.
    gives_way: f64,
    /// Whether it is at a junction.
    turns: bool,
    /// Whether it has nothing to slow down for, or to stand for; determined when it is asked for.
    is_free: OnceCell<bool>,
    /// Whether the light that it comes to is green; determined likewise.
    is_open: OnceCell<bool>,
    /// Whether it is judged at all.
    drives: bool,
}

impl<'a> Road<'a> {
    /// Of an agent; those that stay where they are, and who is not a vehicle, have no faults.
    pub(super) fn ahead_of(
        now: &Shown,
        stays: bool,
        streets: &'a MapGraph,
        lights: &'a Lights,
    ) -> Self {
        let drives = now.body.kind == AgentKind::Vehicle && !stays;
        let on = drives.then(|| lane_under(streets, now.pose)).flatten();
        let most = |closed: &[LightState]| match drives {
            true => most_speed(streets, lights, now, HARD, closed),
            false => f64::INFINITY,
        };
        let is_yellow = |(_, colour, _): &(_, LightState, _)| *colour == LightState::Yellow;
        let red = most(&[LightState::Red]);
        Self {
            streets,
            lights,
            on,
            most: red,
            calm: match lights.by_lane.iter().any(is_yellow) {
                true => most(&[LightState::Red, LightState::Yellow]),
                false => red,
            },
            gives_way: f64::INFINITY,
            turns: on.is_some_and(|on| is_at_junction(streets, on)),
            is_free: OnceCell::new(),
            is_open: OnceCell::new(),
            drives,
        }
    }

    /// The same of a vehicle that has to let others pass at this speed at most, metres per second;
    /// infinite for one that has not.
    pub(super) fn yielding(self, most: f64) -> Self {
        Self {
            most: self.most.min(most),
            calm: self.calm.min(most),
            gives_way: most,
            ..self
        }
    }

    /// The same of a vehicle that may stop at green.
    pub(super) fn blind_to_green(self) -> Self {
        Self {
            is_open: OnceCell::from(false),
            ..self
        }
    }

    /// The greatest speed for bends, lights, signs and vehicles with right of way of who need not hurry,
    /// metres per second.
    pub(super) fn calm(&self) -> f64 {
        self.calm
    }

    /// The move of a vehicle that stands at a green light with nothing in its way.
    ///
    /// A network that has once missed the start stands on: in logs, who stands for long at green has a
    /// reason. Then all its draws stand, and it would never learn to start.
    pub(super) fn starts(&self, now: &Shown, has_room: impl Fn() -> bool) -> Option<Pose> {
        let speed = now.velocity().length();
        let starts = self.drives
            && speed * TOKEN_DT <= CREEPS_M
            && self.is_open()
            && self.is_free(speed, has_room);
        starts.then_some(Pose::new(STARTS_M, 0.0, 0.0))
    }

    /// The same move of a vehicle that is too fast for a bend, a light, a sign or others' right of way:
    /// it brakes as rollouts under rules do where nothing else is drawn.
    pub(super) fn braked(&self, now: &Shown, step: &Pose) -> Option<Pose> {
        let speed = now.velocity().length();
        let most = self.most.max(speed - BRAKES_MPS) * TOKEN_DT;
        let length = step.position.length();
        let is_fast = self.drives && length > most;
        is_fast.then(|| match most <= CREEPS_M {
            true => Pose::IDENTITY,
            false => Pose::IDENTITY.interpolate(*step, most / length),
        })
    }

    /// Whether a vehicle at this speed has nothing to slow down for, or to stand for.
    fn is_free(&self, speed: f64, has_room: impl Fn() -> bool) -> bool {
        let stands = speed * TOKEN_DT <= CREEPS_M;
        let of_road = || match self.on {
            Some(on) if stands => self.is_open() || may_start(self.streets, self.lights, on),
            Some(on) if self.is_open() => crosses(self.streets, on, speed),
            Some(on) => goes_on(self.streets, on, speed),
            None => false,
        };
        *self
            .is_free
            .get_or_init(|| self.gives_way.is_infinite() && of_road() && has_room())
    }

    /// Whether it comes to a light, and all lanes that it may enter there are green.
    fn is_open(&self) -> bool {
        let is_open = |on| is_open(self.streets, self.lights, on);
        *self.is_open.get_or_init(|| self.on.is_some_and(is_open))
    }

    /// Whether no junction, stop sign or light is near that could hold a vehicle here: one that stands
    /// for long is parked, unless an agent is in its way.
    pub(super) fn is_away_from_junctions(&self) -> bool {
        let Some((lane, at)) = self.on else {
            return false;
        };
        let (ahead, _) = lanes_ahead(self.streets, lane, at, FREE_M);
        let lit = |part: &LaneAhead<'_>| self.lights.colour(part.lane.id).is_some();
        !ahead.iter().any(lit) && goes_on(self.streets, (lane, at), 0.0)
    }

    /// By how much a move is beyond what drivers do, metres per second; 0 for one that they make.
    ///
    /// `has_room` says whether the vehicle sees nothing to slow down for, or to stand for. `logged` is the
    /// speed of its log here, metres per second, if it is on its log's way. No bend is too sharp for that;
    /// and at a junction the log may be as slow for a reason that the vehicle does not see, unless the
    /// light is green. Elsewhere it would learn to slow down for nothing.
    pub(super) fn fault(
        &self,
        now: &Shown,
        step: &Pose,
        logged: Option<f64>,
        has_room: impl Fn() -> bool,
    ) -> f64 {
        if !self.drives {
            return 0.0;
        }
        let speed = now.velocity().length();
        let next = step.position.length() / TOKEN_DT;
        let lost = speed - next;
        let turn = step.heading.abs();
        let body = (-lost - GAINS_MPS).max(0.0)
            + (lost - LOSES_MPS).max(0.0)
            + (next * turn - SIDEWAYS_MPS).max(0.0);
        let is_fast = next > self.most;
        let most = match logged {
            Some(logged) if is_fast && next < logged + AS_LOGGED_MPS => {
                let closed = [LightState::Red];
                let most = most_speed(self.streets, self.lights, now, STRAIGHT_ON, &closed);
                most.min(self.gives_way)
            }
            _ => self.most,
        };
        let bend = (next - most).min(BRAKES_MPS - lost).max(0.0);
        let stands = speed * TOKEN_DT <= CREEPS_M;
        let as_slow = logged.is_some_and(|logged| next > logged - AS_LOGGED_MPS);
        // The log may have come here, and waited, while the light was red.
        let has_reason = as_slow && self.turns && !self.is_open();
        let is_free = || !has_reason && self.is_free(speed, &has_room);
        let slow = match lost > SLOWS_MPS && turn <= STRAIGHT && is_free() {
            true => lost - SLOWS_MPS,
            false => 0.0,
        };
        let stays = match stands && step.position.length() <= CREEPS_M && is_free() {
            true => STAYS_MPS,
            false => 0.0,
        };
        let astray = match self.turns {
            true => astray(self.streets, now.pose * *step),
            false => 0.0,
        };
        body + bend + slow + stays + astray
    }
}

/// The greatest speed of a vehicle for what is ahead, on the lane that allows most: in a junction lanes
/// lie upon each other, and it may be on any of them. Lights of these colours are closed.
fn most_speed(
    streets: &MapGraph,
    lights: &Lights,
    now: &Shown,
    limits: BendLimits,
    closed: &[LightState],
) -> f64 {
    let entering = |lane: &Lane, metres: f64| {
        let light = before_light(now, lane, metres, lights, closed);
        light.min(before_sign(streets, now, lane, metres))
    };
    let of =
        |(lane, at, _): (&Lane, f64, f64)| approach_speed(streets, lane, at, limits, &entering);
    let speeds = lanes_under(streets, now.pose).map(of);
    speeds.reduce(f64::max).unwrap_or(f64::INFINITY)
}

fn is_at_junction(streets: &MapGraph, (lane, at): (&Lane, f64)) -> bool {
    let is_near = lane.centerline.length() - at < JUNCTION_M;
    let mut next = streets.successors(lane.id);
    lane.in_intersection || is_near && next.any(|next| next.in_intersection)
}

/// By how much a pose at a junction is off the lanes and their directions, metres per second.
fn astray(streets: &MapGraph, pose: Pose) -> f64 {
    let near = streets.lanes_near(pose.position, LOOK_M);
    let off = near.map(|(lane, distance)| {
        let turned = lane.foot(pose).turned;
        (distance - NEAR_LANE_M).max(0.0) + PER_RADIAN * (turned - ALONG).max(0.0)
    });
    off.fold(LOOK_M - NEAR_LANE_M, f64::min)
}

/// The greatest speed of a vehicle before a lane that starts `metres` ahead, for its light, if that has
/// one of these colours, metres per second.
fn before_light(
    now: &Shown,
    lane: &Lane,
    metres: f64,
    lights: &Lights,
    closed: &[LightState],
) -> f64 {
    if !lights
        .colour(lane.id)
        .is_some_and(|colour| closed.contains(&colour))
    {
        return f64::INFINITY;
    }
    let way = &lane.centerline;
    let turn = angle_difference(way.pose_at(way.length()).heading, way.pose_at(0.0).heading);
    let least = if turn < -RIGHT { TURNS_AT_RED_MPS } else { 0.0 };
    before_line(now, metres, least)
}

/// The same for its stop sign, at which drivers roll on at most.
fn before_sign(streets: &MapGraph, now: &Shown, lane: &Lane, metres: f64) -> f64 {
    let ends = |before: &Lane| !before.in_intersection && has_sign(streets, before);
    let stops = match has_sign(streets, lane) {
        true => lane.in_intersection,
        false => streets.predecessors(lane.id).any(ends),
    };
    match stops {
        true => before_line(now, metres, ROLLS_MPS),
        false => f64::INFINITY,
    }
}

/// Where vehicles stop for signs.
pub(super) fn sign_lines(streets: &MapGraph) -> impl Iterator<Item = Pose> + '_ {
    let signed = streets.stop_signs().iter().flat_map(|sign| &sign.lanes);
    signed.filter_map(|id| {
        let lane = streets.lane(*id)?;
        let way = &lane.centerline;
        Some(way.pose_at(if lane.in_intersection {
            0.0
        } else {
            way.length()
        }))
    })
}

/// Whether a lane goes on from here without a junction, a stop sign or a bend that drivers at this
/// speed slow down for.
fn goes_on(streets: &MapGraph, (lane, at): (&Lane, f64), speed: f64) -> bool {
    let (ahead, goes_on) = lanes_ahead(streets, lane, at, FREE_M);
    let is_open = |part: &LaneAhead<'_>| {
        let is_junction = part.lane.in_intersection && part.lane.id != lane.id;
        !is_junction && !has_sign(streets, part.lane)
    };
    goes_on && ahead.iter().all(is_open) && speed < bend_speed(streets, lane, at, EASY)
}

/// Whether a lane goes on from here, through a junction, without a stop sign or a bend on any of its
/// ways that drivers at this speed slow down for.
fn crosses(streets: &MapGraph, (lane, at): (&Lane, f64), speed: f64) -> bool {
    let (ahead, goes_on) = lanes_ahead(streets, lane, at, FREE_M);
    let is_easy = |part: &LaneAhead<'_>| {
        let braked = 2.0 * EASY.braking_mps2 * part.base_m.max(0.0);
        speed < bend_speed(streets, part.lane, 0.0, EASY).hypot(braked.sqrt())
    };
    goes_on
        && !ahead.iter().any(|part| has_sign(streets, part.lane))
        && ahead[1..].iter().all(is_easy)
        && speed < bend_speed(streets, lane, at, EASY)
}

/// Whether a vehicle that stands may start as far as the road is concerned: no junction or stop sign is
/// near, it is in a junction, or all that its lane leads to, but left turns, is green.
fn may_start(streets: &MapGraph, lights: &Lights, (lane, at): (&Lane, f64)) -> bool {
    let (ahead, _) = lanes_ahead(streets, lane, at, START_M);
    let closed = |part: &&LaneAhead<'_>| {
        let lane = part.lane;
        let turn = || {
            let way = &lane.centerline;
            let end = way.pose_at(way.length()).heading;
            angle_difference(end, way.pose_at(0.0).heading)
        };
        let is_open = lights.colour(lane.id) == Some(LightState::Green) && turn() < RIGHT;
        lane.in_intersection && !is_open
    };
    let ends = ahead.len() == 1 && lane.centerline.length() - at < START_M;
    let signed = ahead.iter().any(|part| has_sign(streets, part.lane));
    lane.in_intersection || !ends && !signed && !ahead[1..].iter().any(|part| closed(&part))
}

/// Whether a lane leads to a junction within [`FREE_M`], and all lanes that it enters there are green.
fn is_open(streets: &MapGraph, lights: &Lights, (lane, at): (&Lane, f64)) -> bool {
    let (ahead, _) = lanes_ahead(streets, lane, at, FREE_M);
    let is_green = |part: &LaneAhead<'_>| lights.colour(part.lane.id) == Some(LightState::Green);
    let mut entries = ahead[1..]
        .iter()
        .filter(|part| enters(streets, part.lane))
        .peekable();
    !lane.in_intersection && entries.peek().is_some() && entries.all(is_green)
}

/// Whether a lane leads into a junction. Turns may consist of several lanes, of which only the first has a
/// light.
fn enters(streets: &MapGraph, lane: &Lane) -> bool {
    lane.in_intersection
        && !streets
            .predecessors(lane.id)
            .any(|from| from.in_intersection)
}

#[cfg(test)]
mod tests {
    use gump_geometry::{DVec3, dvec2};
    use gump_model::relative::graph::Body;
    use gump_scene::{LaneId, StopSign, fixture};

    use super::*;

    const BODY: Body = Body {
        kind: AgentKind::Vehicle,
        length: 4.5,
        width: 1.9,
        sized: true,
    };

    fn streets(text: &str) -> MapGraph {
        let scenario = fixture::scenario(&format!("{text}\nego vehicle 0: 5,0")).unwrap();
        MapGraph::new(scenario.map.parts().clone()).unwrap()
    }

    /// A road of 200 m with a junction from 60 to 90 m, lane 2.
    fn junction() -> MapGraph {
        let road = "lane 1: 0,0 60,0 next 2\nlane 2: 60,0 90,0 next 3\nlane 3: 90,0 200,0";
        let mut parts = streets(road).parts().clone();
        parts.lanes[1].in_intersection = true;
        MapGraph::new(parts).unwrap()
    }

    /// The fault of a vehicle at `x` on the lane along x that drives at `speed` and then at `next`
    /// m/s, turning by so many radians.
    fn fault(streets: &MapGraph, x: f64, (speed, next): (f64, f64), turn: f64) -> f64 {
        let now = Shown::first(BODY, Pose::new(x, 0.0, 0.0), dvec2(speed, 0.0));
        let step = Pose::new(next * TOKEN_DT, 0.0, turn);
        let lights = Lights::default();
        Road::ahead_of(&now, false, streets, &lights).fault(&now, &step, None, || true)
    }

    #[test]
    fn at_red_who_can_stops() {
        let map = streets(
            "lane 1: 0,0 60,0 next 2\nlane 2: 60,0 120,0\n\
             lane 3: 0,50 60,50 next 4\nlane 4: 60,50 66,48 68,30",
        );
        let at = |(x, y): (f64, f64), (speed, next): (f64, f64), colour: LightState| {
            let now = Shown::first(BODY, Pose::new(x, y, 0.0), dvec2(speed, 0.0));
            let by_lane = [2, 4].map(|lane| (LaneId(lane), colour, None)).to_vec();
            let lights = Lights { by_lane };
            let road = Road::ahead_of(&now, false, &map, &lights);
            road.fault(&now, &Pose::new(next * TOKEN_DT, 0.0, 0.0), None, || false)
        };
        let red = |x: f64, speeds| at((x, 0.0), speeds, LightState::Red);
        // The front is 18 m from the line: 10.4 m/s are the most.
        assert!(red(39.75, (12.0, 12.0)) > 1.0 && red(39.75, (12.0, 9.9)) == 0.0);
        assert_eq!(at((39.75, 0.0), (12.0, 12.0), LightState::Green), 0.0);
        // Standing before it, and a little over it.
        assert!(red(57.5, (0.0, 2.0)) > 0.0 && red(58.0, (0.0, 1.0)) > 0.0);
        assert_eq!(red(57.5, (0.0, 0.0)), 0.0);
        // Too late to stop, or past the line.
        assert!(red(50.0, (12.0, 12.0)) == 0.0 && red(59.0, (3.0, 3.0)) == 0.0);
        // A right turn goes slowly.
        let right = |next: f64| at((57.5, 50.0), (1.5, next), LightState::Red);
        assert!(right(1.9) == 0.0 && right(3.4) > 0.0);
    }

    #[test]
    fn at_yellow_nobody_has_to_hurry() {
        let map = streets("lane 1: 0,0 60,0 next 2\nlane 2: 60,0 120,0");
        let calm = |colour: LightState, speed: f64| {
            let now = Shown::first(BODY, Pose::new(47.75, 0.0, 0.0), dvec2(speed, 0.0));
            let by_lane = vec![(LaneId(2), colour, None)];
            Road::ahead_of(&now, false, &map, &Lights { by_lane }).calm()
        };
        // 10 m before the line; at 12 m/s it is too late to stop.
        assert!((calm(LightState::Yellow, 5.0) - 60.0_f64.sqrt()).abs() < 0.2);
        assert!(calm(LightState::Green, 5.0).is_infinite());
        assert!(calm(LightState::Yellow, 12.0).is_infinite());
    }

    #[test]
    fn what_its_log_does_in_a_junction_has_a_reason() {
        let map = junction();
        let lights = Lights::default();
        let stays = |x: f64, logged: Option<f64>| {
            let now = Shown::first(BODY, Pose::new(x, 0.0, 0.0), dvec2(0.0, 0.0));
            let road = Road::ahead_of(&now, false, &map, &lights);
            road.fault(&now, &Pose::IDENTITY, logged, || true) > 0.0
        };
        assert!(stays(75.0, None) && !stays(75.0, Some(0.0)) && stays(75.0, Some(1.0)));
        assert!(stays(30.0, None) && stays(30.0, Some(0.0)));
    }

    #[test]
    fn at_a_stop_sign_nobody_is_fast() {
        let map = |lane: i64| {
            let mut parts = junction().parts().clone();
            parts.stop_signs.push(StopSign {
                id: 9,
                position: DVec3::new(60.0, -3.0, 0.0),
                lanes: vec![LaneId(lane)],
            });
            MapGraph::new(parts).unwrap()
        };
        // It applies to the lane before the line, or to the one behind it.
        for map in [map(1), map(2)] {
            let lines: Vec<Pose> = sign_lines(&map).collect();
            assert_eq!(lines, [Pose::new(60.0, 0.0, 0.0)]);
            // Its front is 10 m from the line: 8.1 m/s are the most.
            assert!(fault(&map, 47.75, (10.0, 10.0), 0.0) > 1.0);
            assert_eq!(fault(&map, 47.75, (8.5, 8.0), 0.0), 0.0);
            // At the line; on a clear road it is none, nor where it could not stop any more.
            assert!(fault(&map, 57.7, (3.4, 3.2), 0.0) > 0.5);
            assert!(fault(&map, 57.7, (3.0, 2.4), 0.0) == 0.0);
            assert!(fault(&junction(), 57.7, (3.4, 3.2), 0.0) == 0.0);
            assert!(fault(&map, 57.0, (12.0, 12.0), 0.0) == 0.0);
        }
    }

    #[test]
    fn who_gives_way_brakes_and_does_not_start() {
        let map = junction();
        let lights = Lights::default();
        let at = |x: f64, (speed, next): (f64, f64), most: f64| {
            let now = Shown::first(BODY, Pose::new(x, 0.0, 0.0), dvec2(speed, 0.0));
            let road = Road::ahead_of(&now, false, &map, &lights).yielding(most);
            road.fault(&now, &Pose::new(next * TOKEN_DT, 0.0, 0.0), None, || true)
        };
        assert!(at(40.0, (8.0, 8.0), 6.0) > 1.0 && at(40.0, (8.0, 6.0), 6.0) == 0.0);
        // In a junction it may stand for others.
        assert!(at(75.0, (0.0, 2.0), 0.0) > 0.0 && at(75.0, (0.0, 0.0), 0.0) == 0.0);
        assert!(at(75.0, (0.0, 0.0), f64::INFINITY) > 0.0);
    }

    #[test]
    fn who_stands_away_from_junctions_and_lights_is_parked() {
        let map = junction();
        let red = Lights {
            by_lane: vec![(LaneId(2), LightState::Red, None)],
        };
        let left = |x: f64, lights: &Lights| {
            let now = Shown::first(BODY, Pose::new(x, 0.0, 0.0), dvec2(0.0, 0.0));
            Road::ahead_of(&now, false, &map, lights).is_away_from_junctions()
        };
        let none = Lights::default();
        assert!(left(120.0, &none) && left(10.0, &none) && !left(40.0, &none));
        assert!(!left(75.0, &red) && !left(180.0, &none));
    }

    #[test]
    fn slowing_down_on_a_free_road_is_a_fault_and_at_a_junction_is_none() {
        let map = junction();
        let loses = |x: f64| fault(&map, x, (10.0, 9.0), 0.0);
        assert!((loses(10.0) - 0.6).abs() < 1e-9, "{}", loses(10.0));
        // In the junction and beyond it the road is free again; before it and before its end not.
        assert!(loses(70.0) > 0.0 && loses(100.0) > 0.0);
        assert!(loses(40.0) == 0.0 && loses(180.0) == 0.0);
        // Less, or in a turn.
        assert_eq!(fault(&map, 10.0, (10.0, 9.7), 0.0), 0.0);
        assert_eq!(fault(&map, 10.0, (10.0, 9.0), 0.1), 0.0);
    }

    #[test]
    fn at_green_nobody_slows_down_more_than_the_turn_needs() {
        let after = |colour: Option<LightState>, way: &str| {
            let road = format!("lane 1: 0,0 60,0 next 2\nlane 2: 60,0 {way} next 3\nlane 3: ");
            let end = way.rsplit(' ').next().unwrap();
            let beyond = if end == "90,0" { "200,0" } else { "70,-100" };
            let mut parts = streets(&format!("{road}{end} {beyond}")).parts().clone();
            parts.lanes[1].in_intersection = true;
            let map = MapGraph::new(parts).unwrap();
            move |x: f64, (speed, next): (f64, f64), logged: Option<f64>| {
                let now = Shown::first(BODY, Pose::new(x, 0.0, 0.0), dvec2(speed, 0.0));
                let by_lane = colour.map(|colour| (LaneId(2), colour, None));
                let lights = Lights {
                    by_lane: by_lane.into_iter().collect(),
                };
                let road = Road::ahead_of(&now, false, &map, &lights);
                let step = Pose::new(next * TOKEN_DT, 0.0, 0.0);
                road.fault(&now, &step, logged, || true)
            }
        };
        let green = after(Some(LightState::Green), "90,0");
        assert!((green(40.0, (8.0, 7.0), None) - 0.6).abs() < 1e-9);
        assert_eq!(green(40.0, (8.0, 7.7), None), 0.0);
        // Its log waited here; the light was red then.
        assert!(green(56.0, (2.0, 1.0), Some(1.0)) > 0.5);
        assert!(green(57.5, (0.0, 0.0), Some(0.0)) > 0.0);
        for colour in [None, Some(LightState::Yellow), Some(LightState::Red)] {
            let held = after(colour, "90,0");
            assert_eq!(held(40.0, (8.0, 7.0), None), 0.0);
            assert_eq!(held(57.5, (0.0, 0.0), Some(0.0)), 0.0);
        }
        // A turn with a radius of 7 m: 4.2 m/s are comfortable there, some 8 m/s 13 m before it.
        let bend = "63,-0.5 66,-2 68,-4 69.5,-6.5 70,-9";
        let right = after(Some(LightState::Green), bend);
        assert_eq!(right(47.0, (10.0, 9.0), None), 0.0);
        assert!(right(47.0, (6.0, 5.0), None) > 0.5);
        // Who stands at green starts, if nobody is to be let pass.
        let starts = |x: f64, colour: LightState, most: f64| {
            let map = junction();
            let now = Shown::first(BODY, Pose::new(x, 0.0, 0.0), dvec2(0.0, 0.0));
            let lights = Lights {
                by_lane: vec![(LaneId(2), colour, None)],
            };
            let road = Road::ahead_of(&now, false, &map, &lights).yielding(most);
            road.starts(&now, || true)
        };
        let free = |x: f64, colour: LightState| starts(x, colour, f64::INFINITY);
        let step = free(50.0, LightState::Green).unwrap();
        assert!(step.position.x > CREEPS_M);
        assert_eq!(starts(50.0, LightState::Green, 0.0), None);
        assert_eq!(free(50.0, LightState::Red), None);
        assert_eq!(free(10.0, LightState::Green), None);
    }

    #[test]
    fn who_stands_and_has_room_starts_unless_a_junction_is_closed() {
        let map = junction();
        let stays = |x: f64, colour: Option<LightState>, has_room: bool| {
            let now = Shown::first(BODY, Pose::new(x, 0.0, 0.0), dvec2(0.0, 0.0));
            let by_lane = colour.map(|colour| (LaneId(2), colour, None));
            let lights = Lights {
                by_lane: by_lane.into_iter().collect(),
            };
            let road = Road::ahead_of(&now, false, &map, &lights);
            assert_eq!(
                road.fault(&now, &Pose::new(0.5, 0.0, 0.0), None, || has_room),
                0.0
            );
            road.fault(&now, &Pose::IDENTITY, None, || has_room) > 0.0
        };
        use LightState::{Green, Red};
        // In the lane, with and without room; at the line, by its light; in the junction.
        assert!(stays(30.0, None, true) && !stays(30.0, None, false));
        assert!(!stays(55.0, None, true) && !stays(55.0, Some(Red), true));
        assert!(stays(55.0, Some(Green), true) && stays(75.0, Some(Red), true));
        // At the end of the map.
        assert!(!stays(195.0, None, true));
    }

    #[test]
    fn off_the_lane_or_across_it_nothing_is_free() {
        let map = streets("lane 1: 0,0 200,0");
        assert!(lane_under(&map, Pose::new(10.0, 0.5, 0.1)).is_some());
        assert!(lane_under(&map, Pose::new(10.0, 1.5, 0.0)).is_none());
        assert!(lane_under(&map, Pose::new(10.0, 0.0, 1.0)).is_none());
    }

    #[test]
    fn before_a_bend_who_is_fast_slows_down() {
        // A right angle after 60 m.
        let map = streets("lane 1: 0,0 60,0 60,80");
        let at = |x: f64, speeds: (f64, f64)| fault(&map, x, speeds, 0.0);
        assert!(at(40.0, (14.0, 14.0)) > 1.9 && at(40.0, (14.0, 13.0)) > 0.9);
        assert_eq!(at(40.0, (14.0, 11.9)), 0.0);
        // Its log is as fast, or slower.
        let now = Shown::first(BODY, Pose::new(40.0, 0.0, 0.0), dvec2(14.0, 0.0));
        let step = Pose::new(7.0, 0.0, 0.0);
        let logged = |speed: f64, lights: &Lights| {
            let road = Road::ahead_of(&now, false, &map, lights);
            road.fault(&now, &step, Some(speed), || false)
        };
        assert!(logged(14.0, &Lights::default()) == 0.0 && logged(12.0, &Lights::default()) > 1.9);
        // Far enough away, or slow enough; and slowing down early is none either.
        assert!(at(10.0, (14.0, 14.0)) == 0.0 && at(40.0, (8.0, 8.0)) == 0.0);
        assert_eq!(at(20.0, (14.0, 13.0)), 0.0);
    }

    #[test]
    fn who_is_too_fast_for_what_is_ahead_brakes_without_a_fault() {
        let map = streets("lane 1: 0,0 60,0 next 2\nlane 2: 60,0 120,0");
        let braked = |colour: LightState, (speed, next): (f64, f64)| {
            let now = Shown::first(BODY, Pose::new(39.75, 0.0, 0.0), dvec2(speed, 0.0));
            let by_lane = vec![(LaneId(2), colour, None)];
            let lights = Lights { by_lane };
            let road = Road::ahead_of(&now, false, &map, &lights);
            let step = Pose::new(next * TOKEN_DT, 0.0, 0.0);
            let before = road.fault(&now, &step, None, || false);
            let step = road.braked(&now, &step)?;
            let after = road.fault(&now, &step, None, || false);
            Some((
                step.position.length() / TOKEN_DT,
                before > 1.0 && after < 1e-9,
            ))
        };
        // 18 m before the line: 10.4 m/s are the most, or what 4 m/s² leave.
        let (speed, is_mended) = braked(LightState::Red, (12.0, 12.0)).unwrap();
        assert!((speed - 10.39).abs() < 0.01 && is_mended, "{speed}");
        let (speed, is_mended) = braked(LightState::Red, (13.5, 13.5)).unwrap();
        assert!((speed - 11.5).abs() < 0.01 && is_mended, "{speed}");
        assert_eq!(braked(LightState::Green, (12.0, 12.0)), None);
        assert_eq!(braked(LightState::Red, (12.0, 10.0)), None);
        // Who cannot stop any more drives on.
        assert_eq!(braked(LightState::Red, (18.0, 18.0)), None);
        // At the line nobody creeps over it.
        let now = Shown::first(BODY, Pose::new(57.8, 0.0, 0.0), dvec2(0.0, 0.0));
        let lights = Lights {
            by_lane: vec![(LaneId(2), LightState::Red, None)],
        };
        let road = Road::ahead_of(&now, false, &map, &lights);
        let stays = road.braked(&now, &Pose::new(1.0, 0.0, 0.0));
        assert_eq!(stays, Some(Pose::IDENTITY));
    }

    #[test]
    fn where_the_road_ends_in_a_junction_who_turns_neither_way_is_astray() {
        let text = "lane 1: 0,0 40,0 next 2,3\nlane 2: 40,0 46,1 51,6 52,12 52,60\n\
                    lane 3: 40,0 46,-1 51,-6 52,-12 52,-60";
        let mut parts = streets(text).parts().clone();
        parts.lanes[1].in_intersection = true;
        parts.lanes[2].in_intersection = true;
        let map = MapGraph::new(parts).unwrap();
        let at = |x: f64, turn: f64| fault(&map, x, (5.0, 5.0), turn);
        // Still in the lane; then straight on, and along one of the lanes that turn.
        assert_eq!(at(33.0, 0.0), 0.0);
        assert!(at(44.0, 0.0) > 0.5 && at(44.0, 0.35) < at(44.0, 0.0));
        // Elsewhere vehicles may leave the lanes.
        let straight = streets("lane 1: 0,0 200,0");
        assert_eq!(fault(&straight, 50.0, (5.0, 5.0), 0.45), 0.0);
    }

    #[test]
    fn no_one_jumps() {
        let map = streets("lane 1: 0,0 200,0");
        let at = |speeds, turn| fault(&map, 180.0, speeds, turn);
        assert!(at((8.0, 11.0), 0.0) > 0.9 && at((8.0, 9.9), 0.0) == 0.0);
        assert!(at((10.0, 5.0), 0.0) > 0.9 && at((10.0, 6.5), 0.0) == 0.0);
        // 3.6 and 6 m/s² sideways.
        assert!(at((12.0, 12.0), 0.15) == 0.0 && at((12.0, 12.0), 0.25) > 0.4);
    }
}
