//! Sampling rules for the relative network: moves that would overlap an agent, leave the road, run a
//! red light or a stop sign, lead into an occupied junction or take the right of way are redrawn, and
//! kinematically impossible moves are limited.
//!
//! They are those of the sequence network (`rejection`, `kinematic_limits`). That network predicts
//! three poses at once; here the second part of the checked horizon, one second, continues the
//! drawn move.

use gump_geometry::{Polyline, Pose, angle_difference};
use gump_model::local_context::LaneMap;
use gump_model::relative::graph::{Lights, Shown};
use gump_model::relative::route::Route;
use gump_model::steps::TOKEN_DT;
use gump_scene::{
    AgentKind, AgentState, Lane, LaneId, Light, LightState, MapGraph, stop_line, ways_beyond,
};

use crate::kinematic_limits::Limits;
use crate::rejection::{BRAKING, Footprints, Member, POSES, Way, way};
use crate::relative::approach::{HARDEST_MPS2, OVER_M, speed_for_bends};
use crate::relative::keep_clear::closed_entry;
use crate::relative::right_of_way::{Course, course_in, courses, speed_for_signs, yielding_speed};
use crate::relative::turning_in::TakesWay;

// The thresholds are chosen by hand; none has been varied in a measurement.

/// A slower agent is not braked but stands, as does one that braking makes slower, metres per second: a
/// quarter of a metre in a step.
const CREEPING: f64 = 0.5;
/// Lines of one junction lie within this, metres: those of neighbouring lanes may be staggered.
const ONE_LINE_M: f64 = 4.0;
/// A path that turns right by more than this is a right turn, radians (30 degrees).
const RIGHT: f64 = 0.52;
/// A vehicle slower than this may turn right at red, metres per second: slowed to a fast walk. A
/// full stop is not demanded.
const TURNS_AT_RED: f64 = 2.0;
/// Braking for a light begins where this deceleration is sufficient, metres per second squared; it never
/// exceeds [`HARDEST_MPS2`].
pub(super) const GENTLY: f64 = 4.0;
/// Who can stop for a yellow light with this does, metres per second squared: the others pass before it is
/// red.
const FOR_YELLOW_MPS2: f64 = 3.0;

/// The greatest acceleration in any direction that a dry road allows, metres per second squared. A draw
/// of standing at 14 m/s is rare, but would stop a car within its own length.
const GRIP_MPS2: f64 = 8.0;

/// A vehicle's rear axle is this far behind its centre, metres, ...
const AXLE_M: f64 = 1.4;
/// ... and slides at most this far in a step, metres, and metres per metre ahead: recorded vehicles slide
/// at more than 0.5 m/s in less than 0.1 % of the time (results 18 and 42). Slower ones slide farther in SUMO,
/// which turns vehicles about their fronts (result 39).
const SLIDES_M: (f64, f64) = (0.08, 0.015);
const SLIDES_SLOW_M: (f64, f64) = (0.75, 0.1);

/// Beyond the place where it could stop, a vehicle looks this far for a junction, metres.
const LOOK_M: f64 = 2.0;

/// Share of a turn that is left in the next step of a predicted path. Of the logged moves of SUMO's
/// training scenes 0.49 % would be redrawn, with 1 (the turn goes on) 0.68, with 0 0.84 (result 32).
const TURNS_ON: f64 = 0.7;

/// Who walks slower speeds up to this at most, metres per second: of recorded steps of people 0.3 % are
/// faster, up to 5.4 m/s. The network has seen few who run, and drives them on to 36 m/s (result 42).
const RUNS_MPS: f64 = 4.0;

/// Draws the moves of agents, given by index, again for an attempt.
pub(super) type Again<'a> = dyn FnMut(&[usize], usize) -> Vec<Pose> + 'a;

/// The move nearest to one that an agent can make, both in its own frame: what it drives on grips and
/// does not slide, and nobody on foot speeds up beyond a run. Training holds free drives to the same.
pub fn kinematically_limited(now: &Shown, step: Pose) -> Pose {
    if now.body.kind == AgentKind::Pedestrian {
        return at_a_run(now, step);
    }
    let Some(limits) = Limits::of(now.body.kind) else {
        return step;
    };
    let step = without_sliding(now, with_grip(now, step));
    let moved = AgentState {
        pose: now.pose * step,
        velocity: step.position / TOKEN_DT,
    };
    let kept = limits.keep(now.pose, moved).pose;
    if kept == moved.pose {
        return step;
    }
    now.pose.inverse() * kept
}

/// The same move of a person, as far as somebody who runs comes, or as before if that is farther.
fn at_a_run(now: &Shown, step: Pose) -> Pose {
    let most = now.velocity().length().max(RUNS_MPS) * TOKEN_DT;
    let length = step.position.length();
    match length > most {
        true => Pose {
            position: step.position * (most / length),
            ..step
        },
        false => step,
    }
}

/// The move nearest to one that tyres allow: velocity changes by no more than [`GRIP_MPS2`].
fn with_grip(now: &Shown, step: Pose) -> Pose {
    let before = now.pose.inverse().rotate(now.velocity());
    let change = (step.position / TOKEN_DT - before).length();
    let most = GRIP_MPS2 * TOKEN_DT;
    if change <= most {
        return step;
    }
    let on = Pose {
        position: before * TOKEN_DT,
        heading: 0.0,
    };
    on.interpolate(step, most / change)
}

/// The same move of a vehicle with the heading of one that does not slide: its rear axle follows the mean
/// of its headings, up to [`SLIDES_M`]. Where it goes stays as drawn; a network that sees itself slide
/// along its lane goes on to the road's edge, one that sees itself turned steers back.
fn without_sliding(now: &Shown, step: Pose) -> Pose {
    let ahead = step.position.x;
    if now.body.kind != AgentKind::Vehicle || ahead <= 0.0 {
        return step;
    }
    let lever = 0.5 * ahead + AXLE_M;
    let slides = step.position.y - lever * step.heading;
    let most = (SLIDES_M.0 + SLIDES_M.1 * ahead).max(SLIDES_SLOW_M.0 - SLIDES_SLOW_M.1 * ahead);
    Pose {
        heading: step.heading + (slides - slides.clamp(-most, most)) / lever,
        ..step
    }
}

/// The line at which a light stops vehicles.
#[derive(Clone, Debug)]
pub(super) struct StopLine {
    pub(super) lane: LaneId,
    /// Its middle, heading along the lane.
    line: Pose,
    width: f64,
    /// Whether all paths behind it turn right, which is allowed at red after a stop.
    is_right: bool,
}

impl StopLine {
    /// Those of lights of a map.
    pub(super) fn of(map: &MapGraph, lights: &[Light]) -> Vec<Self> {
        let of = |light: &Light| {
            let lane = map.lane(light.lane)?;
            let line = stop_line(lane, light);
            let turns_right = |way: &Polyline| {
                let end = way.pose_at(way.length()).heading;
                angle_difference(end, way.pose_at(0.0).heading) < -RIGHT
            };
            let ways = ways_beyond(map, lane, line);
            Some(Self {
                lane: lane.id,
                line,
                width: lane.width,
                is_right: !ways.is_empty() && ways.iter().all(turns_right),
            })
        };
        lights.iter().filter_map(of).collect()
    }

    /// The line at the end of a lane that leads into a junction.
    fn at_end(lane: &Lane) -> Self {
        let way = &lane.centerline;
        Self {
            lane: lane.id,
            line: way.pose_at(way.length()),
            width: lane.width,
            is_right: false,
        }
    }

    /// The remaining distance of a front bumper to the line, metres.
    fn room(&self, now: &Shown) -> f64 {
        let local = self.line.inverse() * now.pose.position;
        -local.x - now.body.length / 2.0 + OVER_M
    }

    /// Whether an agent's front bumper crosses the line with this move, or cannot stop before it afterwards
    /// by braking so hard, metres per second squared. One that stands with its front over the line crosses
    /// it when it moves on.
    fn is_crossed(&self, now: &Shown, step: Pose, braking: f64) -> bool {
        let half = now.body.length / 2.0;
        let to = now.pose * step;
        // Within 60 degrees of the lane: others cross or leave it.
        let along = to.direction().dot(self.line.direction()) > 0.5;
        let ahead = |pose: Pose| self.line.inverse() * (pose.position + pose.direction() * half);
        let (before, after) = (ahead(now.pose), ahead(to));
        let speed = step.position.length() / TOKEN_DT;
        let reach = after.x + speed * speed / (2.0 * braking);
        let stands = now.velocity().length() < CREEPING;
        let over = if stands { half } else { OVER_M };
        let stop = before.x.max(OVER_M);
        along && before.x <= over && reach > stop && after.y.abs() <= self.width / 2.0
    }
}

/// The lines that an agent crosses with a move: the nearest ones, since those behind them belong to
/// another junction, and of these that of its route, since those beside it are of other ways.
fn crossed<'l>(
    now: &Shown,
    step: Pose,
    lines: &[(&'l StopLine, LightState)],
    route: Option<&Route>,
) -> Vec<(&'l StopLine, LightState)> {
    let mut all: Vec<_> = lines.to_vec();
    all.retain(|(line, state)| {
        let braking = match state {
            LightState::Yellow => FOR_YELLOW_MPS2,
            _ => GENTLY,
        };
        line.is_crossed(now, step, braking)
    });
    let nearest = all.iter().map(|(line, _)| line.room(now));
    let nearest = nearest.fold(f64::INFINITY, f64::min);
    all.retain(|(line, _)| line.room(now) < nearest + ONE_LINE_M);
    let is_meant = |line: &StopLine| route.is_some_and(|route| route.lanes().contains(&line.lane));
    if all.iter().any(|(line, _)| is_meant(line)) {
        all.retain(|(line, _)| is_meant(line));
    }
    all
}

/// The same move with the braking needed to stop after this many metres.
fn slowed(now: &Shown, step: Pose, room: f64) -> Pose {
    let (speed, length) = (now.velocity().length(), step.position.length());
    let braking = (speed * speed / (2.0 * room.max(0.1))).min(HARDEST_MPS2);
    let slower = (speed - braking * TOKEN_DT).max(0.0);
    if length < 1e-6 || slower < CREEPING {
        return Pose::IDENTITY;
    }
    let metres = (slower * TOKEN_DT).min(room.max(0.0));
    Pose::IDENTITY.interpolate(step, (metres / length).min(1.0))
}

/// Whether no light lets an agent make this move, of those whose lines it crosses.
fn runs_light(now: &Shown, crossed: &[(&StopLine, LightState)]) -> bool {
    let speed = now.velocity().length();
    let is_shut = |(line, state): &(&StopLine, LightState)| match state {
        LightState::Red => !(line.is_right && speed < TURNS_AT_RED),
        LightState::Yellow => speed * speed <= 2.0 * FOR_YELLOW_MPS2 * line.room(now),
        _ => false,
    };
    !crossed.is_empty() && crossed.iter().all(is_shut)
}

/// What the rules of traffic forbid: lines that vehicles may not cross, and speeds at which they would
/// not let others pass.
pub(super) struct Shut<'l> {
    /// Those of lights, and what they show.
    lights: Vec<(&'l StopLine, LightState)>,
    /// Those before occupied junctions, by agent.
    entries: Vec<Option<StopLine>>,
    /// Where agents mean to go.
    routes: Vec<Option<&'l Route>>,
    /// The ways into driveways that they take.
    turns_in: Vec<Option<TakesWay<'l>>>,
    /// The greatest speed for those that have the right of way, for stop signs and for bends, by agent,
    /// metres per second.
    most: Vec<f64>,
}

/// What is known of an agent beside what it shows.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Known<'r> {
    /// Nobody waits for it.
    pub(super) is_unheeded: bool,
    /// It closes no junction, and nobody has to let it pass.
    pub(super) is_parked: bool,
    /// It lets everybody pass.
    pub(super) stands_back: bool,
    /// It has waited for so long that others let it pass.
    pub(super) insists: bool,
    /// Where it means to go.
    pub(super) route: Option<&'r Route>,
    /// The way into a driveway that it takes.
    pub(super) turns_in: Option<TakesWay<'r>>,
}

impl<'l> Shut<'l> {
    /// For agents with these lights, which show these colours.
    pub(super) fn of(
        map: &MapGraph,
        agents: &[Shown],
        known: &[Known<'l>],
        lights: impl Iterator<Item = (&'l StopLine, LightState)>,
        colours: &Lights,
    ) -> Self {
        let is_lit = |lane| colours.colour(lane).is_some();
        let closes = |i: usize| !known[i].is_unheeded && !known[i].is_parked;
        let comes = |i: usize| !known[i].is_unheeded && !known[i].stands_back;
        let entry = |i: usize| {
            let speed = agents[i].velocity().length();
            let stop = speed * speed / (2.0 * GENTLY) + speed * TOKEN_DT;
            let reach = stop + agents[i].body.length / 2.0 + LOOK_M;
            let (lane, _) = closed_entry(map, agents, (i, known[i].route), reach, is_lit, closes)?;
            Some(StopLine::at_end(lane))
        };
        let ways = |i: usize| match agents[i].body.kind {
            AgentKind::Vehicle | AgentKind::Bicycle if comes(i) => match known[i].turns_in {
                Some(way) => vec![course_in(way, colours, &agents[i])],
                None => {
                    let mut ways = courses(map, colours, &agents[i], known[i].route);
                    if known[i].insists {
                        ways.iter_mut().for_each(Course::insist);
                    }
                    ways
                }
            },
            _ => Vec::new(),
        };
        let ways: Vec<Vec<Course>> = (0..agents.len()).map(ways).collect();
        let most = |i: usize| {
            let others = ways.iter().enumerate();
            let others = others.filter(|(j, _)| *j != i && !known[*j].is_parked);
            let yielding = yielding_speed(&ways[i], &others.map(|(_, way)| &way[..]));
            let least = yielding.min(speed_for_signs(&ways[i]));
            match agents[i].body.kind {
                AgentKind::Vehicle => least.min(match &known[i].turns_in {
                    Some(way) => way.most(&agents[i]),
                    None => speed_for_bends(map, &agents[i], known[i].route),
                }),
                _ => least,
            }
        };
        Self {
            lights: lights.collect(),
            entries: (0..agents.len()).map(entry).collect(),
            routes: known.iter().map(|known| known.route).collect(),
            turns_in: known.iter().map(|known| known.turns_in).collect(),
            most: (0..agents.len()).map(most).collect(),
        }
    }

    /// Whether an agent crosses one with this move, takes another's right of way, is too fast for a stop
    /// sign or a bend, or strays from its way into a driveway.
    pub(super) fn forbids(&self, agents: &[Shown], i: usize, step: Pose) -> bool {
        let now = &agents[i];
        let entry = self.entries[i].as_ref();
        entry.is_some_and(|line| line.is_crossed(now, step, GENTLY))
            || runs_light(now, &self.crossed(now, i, step))
            || step.position.length() / TOKEN_DT > self.at_most(now, i)
            || self.turns_in[i].is_some_and(|way| way.strays(now, step))
    }

    /// The greatest speed of an agent for others, signs and bends, metres per second: it brakes no harder
    /// than [`GENTLY`].
    fn at_most(&self, now: &Shown, i: usize) -> f64 {
        self.most[i].max(now.velocity().length() - GENTLY * TOKEN_DT)
    }

    /// The lines of lights that it crosses with this move.
    fn crossed(&self, now: &Shown, i: usize, step: Pose) -> Vec<(&'l StopLine, LightState)> {
        crossed(now, step, &self.lights, self.routes[i])
    }

    /// The remaining distance to the first shut one that it crosses, metres.
    fn room(&self, now: &Shown, i: usize, step: Pose) -> f64 {
        let mut lights = self.crossed(now, i, step);
        if !runs_light(now, &lights) {
            lights.clear();
        }
        let entry = self.entries[i].as_ref();
        let entry = entry.filter(|line| line.is_crossed(now, step, GENTLY));
        let lines = lights.into_iter().map(|(line, _)| line).chain(entry);
        lines
            .map(|line| line.room(now))
            .fold(f64::INFINITY, f64::min)
    }
}

/// Redraws moves of vehicles over a red light, into an occupied junction or into the way of one that has
/// the right of way, up to `redraws` times each; a vehicle without another move brakes, if that stops it, and
/// steers onto its way into a driveway.
pub(super) fn obey_lines(
    agents: &[Shown],
    driven: Option<usize>,
    shut: &Shut<'_>,
    redraws: usize,
    moves: &mut [Pose],
    again: &mut Again<'_>,
) {
    let runs = |i: usize, step: Pose| shut.forbids(agents, i, step);
    let is_bound = |i: &usize| agents[*i].body.kind == AgentKind::Vehicle && driven != Some(*i);
    let mut left: Vec<usize> = (0..agents.len())
        .filter(is_bound)
        .filter(|&i| runs(i, moves[i]))
        .collect();
    for attempt in 0..redraws {
        if left.is_empty() {
            return;
        }
        let drawn = again(&left, attempt);
        let mut still = Vec::new();
        for (&i, step) in left.iter().zip(drawn) {
            match runs(i, step) {
                true => still.push(i),
                false => moves[i] = step,
            }
        }
        left = still;
    }
    for i in left {
        let now = &agents[i];
        let speed = now.velocity().length();
        let stands = speed < CREEPING;
        // An agent that can no longer stop before the line drives on.
        let room = shut.room(now, i, moves[i]);
        if room.is_finite() && (stands || speed * speed / (2.0 * HARDEST_MPS2) <= room) {
            moves[i] = slowed(now, moves[i], room);
        }
        let (most, length) = (shut.at_most(now, i) * TOKEN_DT, moves[i].position.length());
        if length > most {
            moves[i] = match most < CREEPING * TOKEN_DT {
                true => Pose::IDENTITY,
                false => Pose::IDENTITY.interpolate(moves[i], most / length),
            };
        }
        let way = shut.turns_in[i].filter(|way| way.strays(now, moves[i]));
        if let Some(step) = way.and_then(|way| way.steered(now, moves[i])) {
            moves[i] = step;
        }
    }
}

/// Attempts of [`draw_again`], and what is added to those of [`resolve`] where [`obey_lines`] has drawn
/// before: both count from 0, and draws of the same attempt are the same.
pub(super) const STARTS: usize = 1 << 10;
pub(super) const HALTS: usize = STARTS + 1;
pub(super) const RESOLVES: usize = 1 << 11;

/// Draws the moves of these agents once more, whatever comes: of those that stand or slow down although
/// nothing holds them, and those that come to a halt or set off without need. More draws would dissolve all
/// queues that recorded and simulated logs show (result 23).
pub(super) fn draw_again(who: &[usize], attempt: usize, moves: &mut [Pose], again: &mut Again<'_>) {
    if who.is_empty() {
        return;
    }
    for (&i, step) in who.iter().zip(again(who, attempt)) {
        moves[i] = step;
    }
}

/// An agent that is driven from outside.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Driven {
    /// Its index.
    pub index: usize,
    /// Whether others are kept clear of it.
    pub is_heeded: bool,
}

/// Redraws moves that are not clear, up to `redraws` times each; a vehicle that would leave the road
/// with all of them steers back, agents that would run into one beside them steer away from it, and an
/// agent without a clear path brakes. Vehicles may not leave the road, except where `may_leave` holds for
/// their index.
pub fn resolve(
    agents: &[Shown],
    driven: Option<Driven>,
    (lane_map, may_leave): (&LaneMap, &dyn Fn(usize) -> bool),
    redraws: usize,
    moves: &mut [Pose],
    again: &mut Again<'_>,
) {
    let is_driven = |i: usize| driven.filter(|driven| driven.index == i);
    let members = agents
        .iter()
        .zip(&*moves)
        .enumerate()
        .map(|(i, (now, step))| {
            let mut member = Member::new(
                [now.body.length, now.body.width],
                Some(now.pose),
                now.velocity().length(),
                ahead(now.pose, *step),
                is_driven(i).is_some(),
            );
            member.walks = now.body.kind == AgentKind::Pedestrian;
            member.is_ignored = is_driven(i).is_some_and(|driven| !driven.is_heeded);
            if now.body.kind == AgentKind::Vehicle && !member.is_driven && !may_leave(i) {
                member.look_for_edges(lane_map);
            }
            member
        });
    let mut crowd = Footprints::new(members.collect());
    for attempt in 0..redraws {
        let unclear = crowd.unclear(0);
        if unclear.is_empty() {
            return;
        }
        for (&i, step) in unclear.iter().zip(again(&unclear, attempt)) {
            if crowd.improve(i, &ahead(agents[i].pose, step)) {
                moves[i] = step;
            }
        }
    }
    let turns: Vec<f64> = moves.iter().map(|step| step.heading).collect();
    // From no turn back to the road, and within its own turn away from others.
    let mut steer = |crowd: &mut Footprints,
                     (i, from): (usize, f64),
                     needs_to: &dyn Fn(&Footprints) -> bool| {
        let drawn = moves[i];
        for turn in STEERS_RAD {
            let turn = from + turn;
            let step = steered(drawn, turn);
            if needs_to(crowd)
                && holds(&agents[i], turn)
                && crowd.improve(i, &ahead(agents[i].pose, step))
            {
                moves[i] = step;
            }
        }
    };
    for i in crowd.unclear(0).into_iter().filter(|&i| !may_leave(i)) {
        steer(&mut crowd, (i, 0.0), &|crowd| crowd.leaves_road(i));
    }
    for (i, turn) in turns.into_iter().enumerate() {
        steer(&mut crowd, (i, turn), &|crowd| crowd.is_pressed(i));
    }
    for i in crowd.unclear(0) {
        // One that stands before the road's edge would stand there for ever, in the way of others, if only
        // the edge held it.
        let stands = agents[i].velocity().length() < CREEPING;
        if stands && crowd.leaves_road(i) && !crowd.meets_another(i) {
            continue;
        }
        let Some((step, way)) = braking(&agents[i], moves[i]) else {
            continue;
        };
        if crowd.improve(i, &way) {
            moves[i] = step;
        }
    }
}

/// Turns within a move that are tried for a vehicle that would leave the road, or added to that of an agent
/// that would run into one beside it, radians, the slightest first.
const STEERS_RAD: [f64; 10] = [
    0.04, -0.04, 0.08, -0.08, 0.12, -0.12, 0.16, -0.16, 0.2, -0.2,
];
/// The acceleration to the side that such a turn may take, metres per second squared: half of what a
/// dry road holds.
const STEERS_MPS2: f64 = GRIP_MPS2 / 2.0;

/// A move of the same length, forwards or backwards, that turns by so much.
pub(super) fn steered(step: Pose, turn: f64) -> Pose {
    let length = step.position.length().copysign(step.position.x);
    let (sin, cos) = (turn / 2.0).sin_cos();
    Pose::new(length * cos, length * sin, turn)
}

/// True if a dry road allows a turn by so much within a move.
fn holds(now: &Shown, turn: f64) -> bool {
    now.velocity().length() * turn.abs() / TOKEN_DT <= STEERS_MPS2
}

/// The path of an agent that continues as in the next half second, but turns less and less.
fn ahead(from: Pose, step: Pose) -> Way {
    let (mut at, mut step) = (from, step);
    let poses: [Pose; POSES] = std::array::from_fn(|_| {
        at = at * step;
        step.heading *= TURNS_ON;
        step.position.y *= TURNS_ON;
        at
    });
    way(Some(from), poses)
}

/// The move of an agent that brakes on its path, and that path; one that creeps stands.
fn braking(now: &Shown, step: Pose) -> Option<(Pose, Way)> {
    let (speed, length) = (now.velocity().length(), step.position.length());
    if length < 1e-6 {
        return None;
    }
    if speed < CREEPING {
        return Some((Pose::IDENTITY, way(Some(now.pose), [now.pose; POSES])));
    }
    let stop = speed / BRAKING;
    let metres = |t: f64| {
        let t = t.min(stop);
        speed * t - 0.5 * BRAKING * t * t
    };
    // Along the arc of the move: so many moves, and a part of one.
    let along = |metres: f64| {
        let moves = metres / length;
        let whole = (0..moves as usize).fold(Pose::IDENTITY, |at, _| at * step);
        whole * Pose::IDENTITY.interpolate(step, moves.fract())
    };
    let poses: [Pose; POSES] =
        std::array::from_fn(|i| now.pose * along(metres(TOKEN_DT * (i + 1) as f64)));
    Some((along(metres(TOKEN_DT)), way(Some(now.pose), poses)))
}

#[cfg(test)]
mod tests {
    use gump_geometry::{DVec2, OrientedBox};
    use gump_model::relative::graph::Body;
    use gump_model::relative::route::Traveller;
    use gump_scene::{Seed, fixture};

    use super::*;

    fn car(x: f64, step: f64) -> Shown {
        let body = Body {
            kind: AgentKind::Vehicle,
            length: 4.0,
            width: 2.0,
            sized: true,
        };
        Shown::first(
            body,
            Pose::new(x - step, 0.0, 0.0),
            DVec2::new(2.0 * step, 0.0),
        )
        .then(Pose::new(x, 0.0, 0.0))
    }

    fn driven(index: usize, is_heeded: bool) -> Option<Driven> {
        Some(Driven { index, is_heeded })
    }

    fn straight(step: f64) -> Pose {
        Pose::new(step, 0.0, 0.0)
    }

    #[test]
    fn who_would_run_into_another_is_drawn_again() {
        let agents = [car(0.0, 4.0), car(9.0, 0.0)];
        let mut moves = [straight(4.0), Pose::IDENTITY];
        let mut calls = Vec::new();
        let lane_map = LaneMap::default();
        resolve(
            &agents,
            None,
            (&lane_map, &|_| false),
            4,
            &mut moves,
            &mut |who, attempt| {
                calls.push((who.to_vec(), attempt));
                who.iter()
                    .map(|_| straight([4.5, 1.0][attempt.min(1)]))
                    .collect()
            },
        );
        assert_eq!(calls, [(vec![0], 0), (vec![0], 1)]);
        assert_eq!(moves, [straight(1.0), Pose::IDENTITY]);
    }

    #[test]
    fn who_steers_back_keeps_pace_gear_and_grip() {
        for step in [straight(6.0), straight(-0.5)] {
            let turned = steered(step, -0.16);
            let length = turned.position.length();
            assert!((length - step.position.length()).abs() < 1e-9);
            assert!(turned.position.x * step.position.x > 0.0, "{turned:?}");
            assert!(turned.position.y * step.position.x < 0.0, "{turned:?}");
        }
        // A step of 6 m is 12 m/s: 0.16 rad take 3.8 m/s², 0.2 rad 4.8.
        assert!(holds(&car(0.0, 6.0), 0.16) && !holds(&car(0.0, 6.0), -0.2));
    }

    #[test]
    fn who_finds_no_way_brakes_and_the_driven_are_left_alone() {
        let agents = [car(0.0, 4.0), car(9.0, 0.0)];
        let lane_map = LaneMap::default();
        let settled = |driven: Option<Driven>| {
            let mut moves = [straight(4.0), Pose::IDENTITY];
            resolve(
                &agents,
                driven,
                (&lane_map, &|_| false),
                2,
                &mut moves,
                &mut |who, _| who.iter().map(|_| straight(4.0)).collect(),
            );
            moves
        };
        // 8 m/s, braking at 5 m/s² for half a second.
        let braked = settled(None)[0].position.x;
        assert!((braked - 3.375).abs() < 1e-9, "{braked}");
        assert_eq!(settled(driven(0, true))[0], straight(4.0));
    }

    /// The moves of two agents on an open place, whose draws are all the same.
    fn redrawn_alike(agents: &[Shown], drawn: [Pose; 2]) -> [Pose; 2] {
        let (mut moves, lane_map) = (drawn, LaneMap::default());
        let mut again = |who: &[usize], _: usize| who.iter().map(|&i| drawn[i]).collect();
        let edges = (&lane_map, &(|_| false) as &dyn Fn(usize) -> bool);
        resolve(agents, None, edges, 2, &mut moves, &mut again);
        moves
    }

    #[test]
    fn vehicles_side_by_side_keep_off_each_other() {
        let beside = |y: f64, heading: f64| {
            let mut other = car(0.0, 5.0);
            other.pose = Pose::new(-1.0, y, heading);
            other
        };
        let drifts = Pose::new(5.0, -0.6, -0.05);
        let agents = [car(0.0, 5.0), beside(2.6, 0.0)];
        let moves = redrawn_alike(&agents, [straight(5.0), drifts]);
        let next: Vec<Shown> = (0..2)
            .map(|i| agents[i].then(agents[i].pose * moves[i]))
            .collect();
        let body = |now: &Shown| OrientedBox {
            pose: now.pose,
            length: now.body.length,
            width: now.body.width,
        };
        assert!(!body(&next[0]).overlaps(&body(&next[1])));
        // Neither brakes for it.
        let metres = moves.map(|step| step.position.length());
        assert!(
            (metres[0] - 5.0).abs() < 1e-9 && (metres[1] - drifts.position.length()).abs() < 1e-9
        );
        // Who turns turns less.
        let turns = Pose::new(4.0, -0.6, -0.2);
        let turned = redrawn_alike(&agents, [straight(5.0), turns])[1].heading;
        assert!((-0.17..-0.1).contains(&turned), "{turned}");
        // Who has come by the other way is no neighbour to steer away from.
        let oncoming = [car(0.0, 5.0), beside(2.6, std::f64::consts::PI)];
        let met = redrawn_alike(&oncoming, [straight(5.0), Pose::new(5.0, 0.9, 0.05)]);
        assert!(
            met.iter()
                .all(|step| step.heading == 0.0 || step.heading == 0.05),
            "{met:?}"
        );
    }

    #[test]
    fn oncoming_vehicles_pass_each_other_on_the_right() {
        let oncoming = |y: f64| {
            let mut other = car(0.0, 3.0);
            other.pose = Pose::new(14.0, y, std::f64::consts::PI);
            [car(0.0, 3.0), other]
        };
        // The bodies are two metres wide: one of them keeps to the right, and neither brakes.
        let moves = redrawn_alike(&oncoming(1.8), [straight(3.0); 2]);
        let keeps_pace = |step: &Pose| (step.position.length() - 3.0).abs() < 1e-9;
        assert!(moves.iter().all(keeps_pace), "{moves:?}");
        assert!(moves.iter().all(|step| step.heading <= 0.0), "{moves:?}");
        assert!(moves.iter().any(|step| step.heading < 0.0), "{moves:?}");
        // On the wrong side they brake.
        let moves = redrawn_alike(&oncoming(-1.8), [straight(3.0); 2]);
        let is_slower = |step: &Pose| step.position.length() < 3.0;
        assert!(moves.iter().any(is_slower), "{moves:?}");
        assert!(moves.iter().all(|step| step.heading == 0.0), "{moves:?}");
    }

    #[test]
    fn who_creeps_stands_before_it_touches_another() {
        let agents = [car(0.0, 0.2), car(4.1, 0.0)];
        let moves = redrawn_alike(&agents, [straight(0.2), Pose::IDENTITY]);
        assert_eq!(moves, [Pose::IDENTITY; 2]);
    }

    #[test]
    fn who_stands_before_the_road_s_edge_is_held_by_others_alone() {
        let map = fixture::scenario(
            "lane 1: -50,0 0,0
             edge: 2.6,-30 2.6,30
             ego vehicle 0: 0,0",
        )
        .unwrap()
        .map;
        let lane_map = LaneMap::of_edges(&map, &[DVec2::ZERO], 50.0);
        let edges = (&lane_map, &(|_| false) as &dyn Fn(usize) -> bool);
        let moved = |beyond: f64| {
            let agents = [car(0.0, 0.0), car(beyond, 0.0)];
            let mut moves = [straight(1.0), Pose::IDENTITY];
            resolve(&agents, None, edges, 1, &mut moves, &mut |who, _| {
                vec![straight(1.0); who.len()]
            });
            moves[0]
        };
        assert_eq!(moved(40.0), straight(1.0));
        assert_eq!(moved(5.0), Pose::IDENTITY);
    }

    #[test]
    fn a_driven_agent_may_be_left_to_the_network() {
        let agents = [car(0.0, 4.0), car(9.0, 0.0)];
        let lane_map = LaneMap::default();
        let follower = |yields: bool| {
            let mut moves = [straight(4.0), Pose::IDENTITY];
            resolve(
                &agents,
                driven(1, yields),
                (&lane_map, &|_| false),
                2,
                &mut moves,
                &mut |_, _| vec![straight(1.0)],
            );
            moves[0]
        };
        assert_eq!(follower(true), straight(1.0));
        assert_eq!(follower(false), straight(4.0));
    }

    #[test]
    fn a_turn_comes_to_an_end() {
        let turning = Pose::new(3.0, 0.5, 0.4);
        let way = ahead(Pose::IDENTITY, turning);
        let turns = [4, 9, 14].map(|i: usize| way[i].heading);
        let expected = [0.4, 0.4 * 1.7, 0.4 * (1.7 + 0.49)];
        assert!(
            turns
                .iter()
                .zip(expected)
                .all(|(a, b)| (a - b).abs() < 1e-9),
            "{turns:?}"
        );
    }

    #[test]
    fn rules_do_not_draw_the_same_moves() {
        // A vehicle that ran a light until the last attempt, and would then run into another.
        let mut streams = std::collections::BTreeSet::new();
        let agents = [car(0.0, 4.0), car(9.0, 0.0)];
        let mut moves = [straight(4.0), Pose::IDENTITY];
        let mut again = |who: &[usize], attempt: usize| {
            assert!(streams.insert(attempt), "{attempt} twice");
            vec![straight(4.0); who.len()]
        };
        draw_again(&[], STARTS, &mut moves, &mut |_, _| unreachable!("nobody"));
        draw_again(&[1], STARTS, &mut moves, &mut again);
        assert_eq!(moves, [straight(4.0); 2]);
        draw_again(&[0], HALTS, &mut moves, &mut again);
        let line = StopLine {
            lane: LaneId(1),
            line: Pose::new(4.0, 0.0, 0.0),
            width: 4.0,
            is_right: false,
        };
        let shut = lit(&[(&line, LightState::Red)]);
        obey_lines(&agents[..1], None, &shut, 3, &mut moves[..1], &mut again);
        moves = [straight(4.0), Pose::IDENTITY];
        let lane_map = LaneMap::default();
        let edges = (&lane_map, &(|_| false) as &dyn Fn(usize) -> bool);
        let mut lawful = |who: &[usize], attempt| again(who, RESOLVES + attempt);
        resolve(&agents, None, edges, 3, &mut moves, &mut lawful);
        assert_eq!(streams.len(), 8);
    }

    /// Lines of lights only, for one agent.
    fn lit<'l>(lights: &[(&'l StopLine, LightState)]) -> Shut<'l> {
        Shut {
            lights: lights.to_vec(),
            entries: vec![None],
            routes: vec![None],
            turns_in: vec![None],
            most: vec![f64::INFINITY],
        }
    }

    #[test]
    fn nobody_drives_into_an_occupied_junction() {
        let scenario = fixture::scenario(
            "lane 1: -60,0 0,0 next 2\nlane 2: 0,0 20,0 next 3\nlane 3: 20,0 90,0\n\
             ego vehicle 0: -20,0",
        )
        .unwrap();
        let mut parts = scenario.map.parts().clone();
        parts.lanes[1].in_intersection = true;
        let map = MapGraph::new(parts).unwrap();
        let moved_past = |across: Pose, is_parked: bool, drawn: f64| {
            let mut other = car(0.0, 0.0);
            other.pose = across;
            let agents = [car(-8.0, 3.0), other];
            let shut = Shut::of(
                &map,
                &agents,
                &[
                    Known::default(),
                    Known {
                        is_parked,
                        ..Known::default()
                    },
                ],
                std::iter::empty(),
                &Lights::default(),
            );
            let mut moves = [straight(5.0), Pose::IDENTITY];
            let mut again = |who: &[usize], _: usize| vec![straight(drawn); who.len()];
            obey_lines(&agents, None, &shut, 3, &mut moves, &mut again);
            moves[0].position.x
        };
        let moved = |across: Pose, drawn: f64| moved_past(across, false, drawn);
        let across = Pose::new(10.0, 1.0, std::f64::consts::FRAC_PI_2);
        // Its front is 6 m before the line. Drawn again it is slow enough; else it brakes with 2.8 m/s².
        assert_eq!(moved(across, 2.0), 2.0);
        assert!(
            (moved(across, 5.0) - 2.31).abs() < 0.01,
            "{}",
            moved(across, 5.0)
        );
        let beside = Pose::new(10.0, 9.0, std::f64::consts::FRAC_PI_2);
        assert_eq!(moved(beside, 2.0), 5.0);
        // Nobody waits for one that is parked there.
        assert_eq!(moved_past(across, true, 2.0), 5.0);
    }

    #[test]
    fn who_has_to_give_way_is_slow_enough_or_brakes() {
        let settled = |most: f64, drawn: f64| {
            let shut = Shut {
                most: vec![most],
                ..lit(&[])
            };
            let mut moves = [straight(3.0)];
            let mut again = |who: &[usize], _: usize| vec![straight(drawn); who.len()];
            obey_lines(&[car(0.0, 3.0)], None, &shut, 3, &mut moves, &mut again);
            moves[0].position.x
        };
        assert_eq!(settled(f64::INFINITY, 1.0), 3.0);
        // At 6 m/s; it loses 2 in the step at most, and is held to 5.
        assert_eq!((settled(5.0, 2.4), settled(5.0, 3.0)), (2.4, 2.5));
        assert_eq!((settled(0.0, 1.9), settled(0.0, 3.0)), (1.9, 2.0));
    }

    #[test]
    fn nobody_runs_a_red_light_but_who_cannot_stop() {
        let line = StopLine {
            lane: LaneId(1),
            line: Pose::new(5.0, 0.0, 0.0),
            width: 3.5,
            is_right: false,
        };
        let settled = |car: Shown, step: f64, lights: &[(&StopLine, LightState)], drawn: f64| {
            let mut moves = [straight(step)];
            let mut again = |who: &[usize], _: usize| vec![straight(drawn); who.len()];
            obey_lines(&[car], None, &lit(lights), 3, &mut moves, &mut again);
            moves[0].position.x
        };
        let red = [(&line, LightState::Red)];
        // Its front is at 2 m and would be at 6.
        assert_eq!(settled(car(0.0, 1.0), 4.0, &red, 1.0), 1.0);
        // It would stop before the line, but could not stay there in the next half second.
        assert_eq!(settled(car(0.0, 2.0), 2.9, &red, 1.0), 1.0);
        assert_eq!(
            settled(car(0.0, 1.0), 4.0, &[(&line, LightState::Green)], 1.0),
            4.0
        );
        // One way behind the line is open.
        let open = [(&line, LightState::Red), (&line, LightState::Green)];
        assert_eq!(settled(car(0.0, 1.0), 4.0, &open, 1.0), 4.0);
        // At yellow, 3.5 m before the line, one at 4 m/s stops, one at 6 would have to brake with 5 m/s².
        let yellow = [(&line, LightState::Yellow)];
        assert_eq!(settled(car(0.0, 2.0), 2.5, &yellow, 1.0), 1.0);
        assert_eq!(settled(car(0.0, 3.0), 3.0, &yellow, 1.0), 3.0);
        // No other draw: it brakes, or stays where it stands.
        let braked = settled(car(0.0, 2.5), 4.0, &red, 4.0);
        assert!(braked < 2.6, "{braked}");
        assert_eq!(settled(car(0.0, 0.0), 4.0, &red, 4.0), 0.0);
        // At 16 m/s three metres before the line.
        assert_eq!(settled(car(0.0, 8.0), 8.0, &red, 8.0), 8.0);
        // Over the line already.
        assert_eq!(settled(car(4.0, 4.0), 4.0, &red, 1.0), 4.0);
        // It stands with its front 1.5 m over the line, or with its middle: the first waits there.
        assert_eq!(settled(car(4.5, 0.0), 4.0, &red, 4.0), 0.0);
        assert_eq!(settled(car(4.5, 0.0), 0.0, &red, 4.0), 0.0);
        assert_eq!(settled(car(5.5, 0.0), 4.0, &red, 1.0), 4.0);
        let right = StopLine {
            is_right: true,
            ..line.clone()
        };
        let red = [(&right, LightState::Red)];
        assert_eq!(settled(car(4.5, 0.0), 4.0, &red, 1.0), 4.0);
        assert_eq!(settled(car(0.0, 0.5), 4.0, &red, 1.0), 4.0);
        assert_eq!(settled(car(0.0, 2.0), 4.0, &red, 1.0), 1.0);
    }

    #[test]
    fn the_light_of_a_route_is_the_one_that_counts() {
        // Straight on and to the right from one line, 5 m ahead.
        let map = fixture::scenario(
            "lane 1: -60,0 5,0 next 2,3\nlane 2: 5,0 60,0\nlane 3: 5,0 9,-1 11,-3 12,-7\n\
             light 2 red: 5,0\nlight 3 red: 5,0\nego vehicle 0: -20,0",
        )
        .unwrap();
        let lights: Vec<Light> = map.present().now().lights().to_vec();
        let lines = StopLine::of(&map.map, &lights);
        let shut: Vec<_> = lines.iter().map(|line| (line, LightState::Red)).collect();
        let now = car(2.0, 0.5);
        let goes = |way: i64| {
            let who = |seed: u64| Traveller {
                pose: now.pose,
                speed: 1.0,
                seed: Seed(seed),
                remains: false,
            };
            let routes = (0..64).filter_map(|seed| Route::from_here(&map.map, who(seed)));
            let route = routes
                .into_iter()
                .find(|route| route.lanes().contains(&LaneId(way)))
                .unwrap();
            let shut = Shut {
                routes: vec![Some(&route)],
                ..lit(&shut)
            };
            shut.forbids(&[now], 0, straight(2.0))
        };
        // To the right after a stop; one without a route may mean to.
        assert_eq!([goes(2), goes(3)], [true, false]);
        assert!(!lit(&shut).forbids(&[now], 0, straight(2.0)));
    }

    #[test]
    fn who_sees_red_in_time_stands_before_the_line() {
        for speed in [6.0, 10.0, 13.0, 16.0] {
            for start in [30.0, 33.0, 36.0, 39.0, 42.0, 60.0] {
                let line = StopLine {
                    lane: LaneId(1),
                    line: Pose::new(start, 0.0, 0.0),
                    width: 3.5,
                    is_right: false,
                };
                let green = StopLine {
                    line: Pose::new(start + 12.0, 0.0, 0.0),
                    ..line.clone()
                };
                let lights = [(&line, LightState::Red), (&green, LightState::Green)];
                let mut now = car(0.0, speed * TOKEN_DT);
                // It always wants to go on as fast.
                for _ in 0..40 {
                    let mut moves = [straight(speed * TOKEN_DT)];
                    let mut again = |_: &[usize], _: usize| vec![straight(speed * TOKEN_DT)];
                    obey_lines(&[now], None, &lit(&lights), 2, &mut moves, &mut again);
                    now = now.then(now.pose * moves[0]);
                }
                let front = now.pose.position.x + 2.0;
                let range = start - 4.0..=start + OVER_M;
                assert!(range.contains(&front), "{speed} m/s, {start} m: {front}");
            }
        }
    }

    #[test]
    fn people_run_and_no_faster() {
        let body = Body {
            kind: AgentKind::Pedestrian,
            length: 0.7,
            width: 0.7,
            sized: true,
        };
        let person = |speed| Shown::first(body, Pose::IDENTITY, DVec2::new(speed, 0.0));
        let next = |speed, step: Pose| kinematically_limited(&person(speed), step).position;
        let far = Pose::new(3.0, 1.0, 0.3);
        let length = |p: DVec2| p.length() / TOKEN_DT;
        assert!((length(next(1.5, far)) - RUNS_MPS).abs() < 1e-9);
        // Who is faster than that already goes on so, and gains nothing.
        assert!((length(next(5.0, far)) - 5.0).abs() < 1e-9);
        let walk = Pose::new(0.7, 0.1, 0.1);
        assert_eq!(kinematically_limited(&person(1.4), walk), walk);
    }

    #[test]
    fn nobody_slips_sideways_or_turns_on_the_spot() {
        let kept = kinematically_limited(&car(0.0, 1.0), Pose::new(1.0, 2.0, 1.0));
        assert!(kept.position.y < 0.5 && kept.heading < 0.3, "{kept:?}");
        let fine = Pose::new(4.0, 0.1, 0.05);
        assert_eq!(kinematically_limited(&car(0.0, 4.0), fine), fine);
    }

    #[test]
    fn who_moves_sideways_is_turned() {
        // One metre to the side at 16 m/s, heading along the road.
        let kept = kinematically_limited(&car(0.0, 8.0), Pose::new(8.0, 1.0, 0.0));
        assert_eq!(kept.position, DVec2::new(8.0, 1.0));
        assert!((kept.heading - (1.0 - 0.2) / 5.4).abs() < 1e-9, "{kept:?}");
        // It would turn to the left, but goes to the right.
        let kept = kinematically_limited(&car(0.0, 8.0), Pose::new(8.0, -0.5, 0.1));
        assert!(kept.heading < 0.0, "{kept:?}");
        // A turn at 4 m/s, about its front; and a person walks as it likes.
        let turn = Pose::new(2.0, 0.6, 0.4);
        assert_eq!(kinematically_limited(&car(0.0, 2.0), turn), turn);
        let mut person = car(0.0, 1.0);
        person.body.kind = AgentKind::Pedestrian;
        let aside = Pose::new(0.5, 0.8, 0.0);
        assert_eq!(kinematically_limited(&person, aside), aside);
    }

    #[test]
    fn nobody_stops_or_swerves_harder_than_the_road_holds() {
        // 14 m/s, of which 4 m/s can be lost in half a second.
        let stopped = kinematically_limited(&car(0.0, 7.0), Pose::IDENTITY);
        assert!((stopped.position - DVec2::new(5.0, 0.0)).length() < 1e-9);
        let swerved = kinematically_limited(&car(0.0, 7.0), Pose::new(6.0, 3.0, 0.8));
        let change = (swerved.position / TOKEN_DT - DVec2::new(14.0, 0.0)).length();
        assert!(
            (change - 4.0).abs() < 1e-9 && swerved.heading < 0.6,
            "{swerved:?}"
        );
        let hard = Pose::new(5.2, 0.0, 0.0);
        assert_eq!(kinematically_limited(&car(0.0, 7.0), hard), hard);
    }
}
