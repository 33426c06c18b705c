//! Agents that stand in a lane although nothing holds them.
//!
//! Training scenes last nine seconds, in which an agent that stands throughout is usually parked or
//! in a queue. In a longer rollout agents that have waited for each other, or for one that has
//! left, look like those and never start. Here it is decided from the map, the lights and the other
//! agents whether an agent could drive on; the world then shows such agents to the network as
//! moving slowly, without their past. Whether and how they start remains the network's decision.
//!
//! Two other places ask why a vehicle stands, for other purposes and therefore with other reasons:
//! `behaviour/free_road.rs` of `gump-metrics`, which counts stops, and `reason.rs` of
//! `gump-generate`, which rejects draws. All three find lanes and stop lines with `gump-scene`. Here
//! the question is not whether it makes sense to stand but whether an agent that has stood for long
//! has room to start:
//!
//! * A light holds unless another way ahead has green, since whoever waits may leave by that. In the
//!   other two a single light that is not green is a reason.
//! * Stop signs, junctions and the end of the road do not hold. Whoever stopped for them has stopped
//!   for long enough; at a junction only traffic that is about to cross holds.
//! * Agents hold within 5 m, the free path that a start needs, and vehicles that roll within 12 m; in the
//!   other two within 12 and 15 m, so that all of a queue has a reason.
//! * Bicycles, and agents that were seen to drive, count as in a lane farther from its centre.
//!
//! Vehicles that slow down for nothing are found by the same question, and people whom a vehicle waits for.

use std::f64::consts::FRAC_PI_2;

use gump_geometry::{DVec2, angle_difference, wrap_angle};
use gump_model::relative::route::Route;
use gump_model::steps::TOKEN_DT;
use gump_scene::{
    Agent, AgentKind, Lane, LaneAhead, LaneId, Light, LightState, MapGraph, lanes_ahead,
};

use crate::relative::approach::has_sign;
use crate::relative::rules::GENTLY;

// Chosen by hand when the rule was made (decision 26). Result 23 varies how long an agent has stood
// and how often it is redrawn, but none of these.

/// Maximum distance from a lane's centre of an agent in the lane, metres: for vehicles, whose side
/// is over the lane's edge beyond it, and for bicycles, which keep to the side.
const IN_LANE_M: f64 = 1.0;
const BESIDE_M: f64 = 2.0;
/// Maximum deviation from its direction, radians (20 degrees).
const ALONG: f64 = 0.35;
/// The same of agents that were seen to drive, which may stand across their lane or between two.
/// Made for one film of a drop-off (result 23).
const ASTRAY_M: f64 = 2.5;
const TURNED: f64 = 0.9;
/// [`ASTRAY_M`] in a junction, where there is space between lanes and nobody parks.
const ASTRAY_INSIDE_M: f64 = 4.0;
/// Distance ahead within which lights and crossing traffic are considered, metres.
const LOOK_M: f64 = 25.0;
/// Space beside the path for people, from the side of the agent, metres, unless they have stood
/// there for as long.
const SIDE_OF_PEOPLE_M: f64 = 1.0;
/// The room that a start needs: ahead a car's length.
const USUAL: Room = Room {
    ahead_m: 5.0,
    beside_m: 0.3,
    returns: true,
    insists: false,
};
/// The room that others must leave for one that rolls to have no reason to slow down.
const ROLLING: Room = Room {
    ahead_m: 12.0,
    ..USUAL
};
/// The room that suffices for agents that hold each other.
const TIGHT: Room = Room {
    ahead_m: 2.0,
    beside_m: 0.1,
    returns: false,
    insists: false,
};
/// Crossing traffic within this time is let pass, seconds, ...
const GAP_S: f64 = 4.0;
/// ... if it comes this near to the path, from its own side, metres, ...
const NEAR_PATH_M: f64 = 1.5;
/// ... and moves faster than this, metres per second.
const MOVES: f64 = 0.5;
/// Who has waited for so long beyond its patience insists, seconds: crossing vehicles that can still stop
/// before it do not hold it any more. Streams that never end would.
pub(super) const INSISTS_S: f64 = 5.0;
/// In a junction patience is at most this, seconds, longer than a benchmark of 8 s shows: who stands
/// there stands in the way. Vehicles that hold each other there squeeze past at once.
const INSIDE_S: f64 = 9.0;
/// After a benchmark's time it is at most this, seconds, for who drove in by a light that is green no
/// more: the next phase is about to come.
pub(super) const CLEARS_S: f64 = 1.0;
/// After a benchmark's time it is at most this, seconds, for who was seen to drive, ...
const DRIVEN_S: f64 = 3.0;
/// ... and for as long at a light that has been green for as long. Of the lights that turn green, one in ten
/// was missed for over six seconds, in logs none (result 47). With 1 and 2 s the minutes of result 53 are the
/// same.
pub(super) const AT_GREEN_S: f64 = 1.5;
/// After a benchmark's time one that was seen to drive passes those who were not, and have stood as long, if
/// they are this far from the middle of all lanes, metres: who has waited at red since the start is not.
const PASSES_M: f64 = 0.5;
/// A way to a place in a junction has at most so many lanes from its light on.
const HOPS: usize = 4;
/// One that does not squeeze past by then backs up, seconds, ...
const STUCK_S: f64 = 12.0;
/// ... on a road, where an oncoming vehicle has stood before it for so long, sooner, ...
const OPPOSED_S: f64 = 4.0;
/// ... if there is so much room behind it, and so much beside that, metres.
const BEHIND_M: f64 = 3.0;
const BESIDE_IT_M: f64 = 0.3;
/// After a benchmark's time people who have stood this long before a vehicle that has stood as long walk
/// on, seconds.
const BEFORE_VEHICLE_S: f64 = 2.0;
/// One who is still there after so long cannot walk straight on, and turns to a side of the vehicle,
/// seconds. These were chosen by hand.
const ASIDE_S: f64 = 6.0;
/// It does not walk where a vehicle stands within this of these places on its way, metres.
const WALKING_ROOM_M: f64 = 0.4;
const STEPS_ASIDE_M: [f64; 3] = [0.8, 1.6, 2.4];
/// A vehicle no faster than this may come to a stop within a step, metres per second.
const ROLLS_MPS: f64 = 4.0;
/// Agents that wait for each other are within this, metres, and meet at more than this angle,
/// radians.
const MEETING_M: f64 = 25.0;
const CROSSES: f64 = 0.52;
/// Who meets another at more than this angle comes the other way, radians.
const OPPOSITE: f64 = 2.6;

/// An agent of a frame, and what is known of its past.
#[derive(Clone, Copy, Debug)]
pub(super) struct Standing<'r> {
    pub(super) agent: Agent,
    /// Time that it has stood, seconds; 0 if it moves.
    pub(super) waited_s: f64,
    /// Time after which it goes if it could, seconds.
    pub(super) patience_s: f64,
    /// Whether it was seen to drive: it is not parked, wherever it stands.
    pub(super) has_driven: bool,
    /// Where it means to go; other ways ahead do not count then.
    pub(super) route: Option<&'r Route>,
}

/// The room that others must leave.
struct Room {
    /// Beyond the front bumper, metres.
    ahead_m: f64,
    /// From the side of the agent, metres.
    beside_m: f64,
    /// Whether the path to the lane's centre is included.
    returns: bool,
    /// Whether crossing vehicles that can still stop are left out.
    insists: bool,
}

/// What those may do who have stood for longer than their patience, by index.
#[derive(Debug)]
pub(super) struct Released {
    /// They could go on.
    pub(super) go: Vec<usize>,
    /// Vehicles that roll slowly, and have nothing to slow down for.
    pub(super) roll: Vec<usize>,
    /// They stand in the way of others, as these in theirs, and have room to back up.
    pub(super) back_up: Vec<BackUp>,
    /// People who stand before a vehicle for so long that they turn away to one of its sides, with their new
    /// heading, radians.
    pub(super) aside: Vec<(usize, f64)>,
}

/// A vehicle that backs up.
#[derive(Clone, Debug)]
pub(super) struct BackUp {
    /// Its index.
    pub(super) who: usize,
    /// Those that it stands in the way of.
    pub(super) blocks: Vec<usize>,
    /// Whether these are on another lane of a road: to pass it they have to swerve.
    pub(super) is_on_road: bool,
}

/// Returns the agents that have stood for longer than their patience and could go on, or back up.
///
/// A vehicle or bicycle in a lane could if no agent is on the path ahead or about to cross it, no
/// light forbids it, and of those whose paths meet there it has waited longest. After twice the time,
/// in a junction at once, less room suffices between vehicles that stand across each other's paths.
/// In a junction, and if it `is_late` where oncoming vehicles block each other, the vehicle that came last
/// backs up where even that is missing for [`STUCK_S`], or for [`OPPOSED_S`] on a road.
/// A pedestrian could if it stands on the path of a vehicle or bicycle that has waited as long.
/// `agents` are all of the frame; the lights of the lanes `fresh` have just changed. If it `is_late`, those
/// clear a junction whose light has changed, those who were seen to drive start sooner, people walk on before
/// vehicles sooner, and vehicles that roll without a reason to slow down are returned as well.
pub(super) fn released(
    map: &MapGraph,
    lights: &[Light],
    fresh: &[LaneId],
    agents: &[Standing<'_>],
    is_late: bool,
) -> Released {
    let inside = |one: &Standing<'_>| match one.waited_s {
        _ if one.patience_s.is_infinite() => false,
        waited if waited > INSIDE_S => is_inside(map, one),
        waited => is_late && waited > CLEARS_S && has_to_clear(map, lights, one),
    };
    let inside: Vec<bool> = agents.iter().map(inside).collect();
    let waits = |i: &usize| inside[*i] || agents[*i].waited_s > agents[*i].patience_s;
    let is_due = |i: &usize| waits(i) || is_late && has_waited(map, (lights, fresh), &agents[*i]);
    let waiting: Vec<usize> = (0..agents.len()).filter(is_due).collect();
    let walks = |i: usize| agents[i].agent.kind == AgentKind::Pedestrian;
    let (mut free, mut people, mut stuck) = (Vec::new(), Vec::new(), Vec::new());
    for &i in &waiting {
        let agent = &agents[i].agent;
        let reached = ahead(map, &agents[i]);
        if reached.is_empty() {
            continue;
        }
        let insists = agents[i].waited_s > agents[i].patience_s + INSISTS_S;
        let is_held = |room: Room| {
            let room = Room { insists, ..room };
            let passes = |other: &Standing<'_>| {
                let drives = is_late && agents[i].has_driven && !other.has_driven;
                drives && other.waited_s >= agents[i].waited_s && is_aside(map, &other.agent)
            };
            let holding = |&j: &usize| {
                let stays = waits(&j);
                let holds = || holds(&reached, agent, &agents[j].agent, stays, &room);
                j != i && holds() && !passes(&agents[j])
            };
            (0..agents.len()).filter(holding).collect::<Vec<_>>()
        };
        let holding = is_held(USUAL);
        people.extend(holding.iter().copied().filter(|&j| walks(j) && waits(&j)));
        // Vehicles that have held each other for long squeeze past.
        let turn =
            |other: &Agent| angle_difference(agent.state.pose.heading, other.state.pose.heading);
        let crosses = |j: &usize| waits(j) && !walks(*j) && turn(&agents[*j].agent).abs() > CROSSES;
        let squeezes = || {
            let is_long = inside[i] || agents[i].waited_s > 2.0 * agents[i].patience_s;
            is_long && holding.iter().all(crosses) && is_held(TIGHT).is_empty()
        };
        if !is_shut(&reached, lights, agent) && (holding.is_empty() || squeezes()) {
            free.push((i, reached));
        } else if holding.iter().any(|&j| {
            let is_across = || stands_across(agent, &agents[j].agent);
            inside[i] && is_across() || is_late && faces(map, &agents[i], &agents[j])
        }) {
            stuck.push(i);
        }
    }
    let in_the_way = match is_late {
        true => in_the_way(map, agents),
        false => Vec::new(),
    };
    people.extend(in_the_way.iter().map(|(person, _)| *person));
    let aside = |&(i, j): &(usize, usize)| {
        let is_long = agents[i].waited_s > ASIDE_S;
        is_long.then(|| (i, way_aside(agents, i, &agents[j].agent)))
    };
    let aside = in_the_way.iter().filter_map(aside).collect();
    let rolls = |i: &usize| {
        let agent = &agents[*i].agent;
        let speed = agent.state.speed();
        let is_slow = speed > MOVES && speed < ROLLS_MPS;
        if !is_late || !is_slow || agent.kind != AgentKind::Vehicle {
            return false;
        }
        let reached = ahead(map, &agents[*i]);
        let is_held = || {
            let others = agents.iter().enumerate().filter(|(j, _)| j != i);
            let mut others = others.map(|(j, other)| (waits(&j), &other.agent));
            others.any(|(stays, other)| holds(&reached, agent, other, stays, &ROLLING))
        };
        let is_signed = || reached.iter().any(|part| has_sign(map, part.lane));
        !reached.is_empty() && !is_shut(&reached, lights, agent) && !is_signed() && !is_held()
    };
    let roll = (0..agents.len()).filter(rolls).collect();
    let goes_first = |(i, own): &(usize, Vec<LaneAhead<'_>>), (j, its): &(usize, Vec<_>)| {
        let (one, other) = (&agents[*i], &agents[*j]);
        let (from, of) = (one.agent.state.pose, other.agent.state.pose);
        let turn = angle_difference(from.heading, of.heading);
        came_later(one, other)
            && turn.abs() > CROSSES
            && from.position.distance(of.position) < MEETING_M
            && meet(own, its)
    };
    let is_next = |one: &&(usize, Vec<_>)| !free.iter().any(|other| goes_first(one, other));
    let mut next: Vec<usize> = free.iter().filter(is_next).map(|(i, _)| *i).collect();
    next.extend(people);
    next.sort_unstable();
    next.dedup();
    Released {
        go: next,
        roll,
        back_up: backing(map, agents, &stuck),
        aside,
    }
}

/// People who stand on the path of a vehicle, and that vehicle, both for [`BEFORE_VEHICLE_S`].
fn in_the_way(map: &MapGraph, agents: &[Standing<'_>]) -> Vec<(usize, usize)> {
    let stand = |kind: AgentKind| {
        let all = agents.iter().enumerate();
        all.filter(move |(_, one)| one.agent.kind == kind && one.waited_s > BEFORE_VEHICLE_S)
    };
    let mut found = Vec::new();
    // Not those driven from outside.
    let people = stand(AgentKind::Pedestrian).filter(|(_, one)| one.patience_s.is_finite());
    for (j, person) in people {
        let at = person.agent.state.pose.position;
        let holds_one = |one: &Standing<'_>| {
            let reach = one.agent.length + USUAL.ahead_m + SIDE_OF_PEOPLE_M;
            one.agent.state.pose.position.distance(at) < reach && {
                let reached = ahead(map, one);
                !reached.is_empty() && holds(&reached, &one.agent, &person.agent, true, &USUAL)
            }
        };
        let vehicle = stand(AgentKind::Vehicle).find(|(_, one)| holds_one(one));
        found.extend(vehicle.map(|(i, _)| (j, i)));
    }
    found
}

/// The heading in which a person leaves the path of a vehicle: to the nearer side, if no vehicle stands
/// there, else to the other one.
fn way_aside(agents: &[Standing<'_>], person: usize, vehicle: &Agent) -> f64 {
    let at = agents[person].agent.state.pose.position;
    let vehicle = vehicle.state.pose;
    let side = (vehicle.inverse() * at).y;
    let to = |side: f64| wrap_angle(vehicle.heading + FRAC_PI_2.copysign(side));
    let is_free = |heading: &f64| {
        let way = DVec2::from_angle(*heading);
        let vehicles = agents.iter().map(|one| &one.agent);
        let mut vehicles = vehicles.filter(|agent| agent.kind == AgentKind::Vehicle);
        !vehicles.any(|agent| {
            let (length, width) = (agent.length, agent.width);
            let room = DVec2::new(length, width) / 2.0 + WALKING_ROOM_M;
            let pose = agent.state.pose.inverse();
            STEPS_ASIDE_M.iter().any(|step| {
                let local = pose * (at + way * *step);
                local.abs().cmple(room).all()
            })
        })
    };
    let sides = [to(side), to(-side)];
    sides.into_iter().find(is_free).unwrap_or(sides[0])
}

/// Whether an agent has waited less than another; of those that have waited as long the last one has.
fn came_later(one: &Standing<'_>, other: &Standing<'_>) -> bool {
    (-one.waited_s, one.agent.id) > (-other.waited_s, other.agent.id)
}

/// Whether another vehicle or bicycle stands at an angle to an agent.
fn stands_across(agent: &Agent, other: &Agent) -> bool {
    let drives = matches!(other.kind, AgentKind::Vehicle | AgentKind::Bicycle);
    let turn = angle_difference(agent.state.pose.heading, other.state.pose.heading);
    drives && other.state.speed() < MOVES && turn.abs() > CROSSES
}

/// Time after which a vehicle that oncoming ones hold backs up, seconds.
fn backs_up_after(map: &MapGraph, one: &Standing<'_>) -> f64 {
    match is_inside(map, one) {
        true => STUCK_S,
        false => OPPOSED_S,
    }
}

/// Whether another vehicle that was seen to drive has stood for long, and comes the other way.
fn faces(map: &MapGraph, one: &Standing<'_>, other: &Standing<'_>) -> bool {
    let (agent, its) = (&one.agent, &other.agent);
    let turn = angle_difference(agent.state.pose.heading, its.state.pose.heading);
    its.kind == AgentKind::Vehicle
        && other.has_driven
        && other.waited_s > backs_up_after(map, other)
        && turn.abs() > OPPOSITE
}

/// Those that back up, of the agents that are held by others that stand across their path in a junction, or
/// come the other way: the vehicle that came last of those that have room behind and stand in the way of
/// another themselves.
fn backing(map: &MapGraph, agents: &[Standing<'_>], stuck: &[usize]) -> Vec<BackUp> {
    let apart = |one: &Agent, other: &Agent| {
        let (from, to) = (one.state.pose.position, other.state.pose.position);
        from.distance(to)
    };
    let blocked = |i: usize| -> Vec<usize> {
        let agent = &agents[i].agent;
        let is_blocked = |other: &Standing<'_>| {
            let reached = ahead(map, other);
            !reached.is_empty() && holds(&reached, &other.agent, agent, true, &USUAL)
        };
        let others = agents.iter().enumerate();
        let others = others.filter(|(_, other)| {
            let is_across = || stands_across(agent, &other.agent) && is_inside(map, other);
            apart(agent, &other.agent) < MEETING_M
                && (is_across() || faces(map, &agents[i], other))
                && is_blocked(other)
        });
        others.map(|(j, _)| j).collect()
    };
    let could = |one: &BackUp| {
        let who = &agents[one.who];
        let is_opposed = |&j: &usize| faces(map, who, &agents[j]);
        let after = match one.blocks.iter().all(is_opposed) {
            true => backs_up_after(map, who),
            false => STUCK_S,
        };
        let all = agents.iter().map(|other| &other.agent);
        !one.blocks.is_empty() && who.waited_s > after && has_room_behind(&who.agent, all)
    };
    let drives = |&i: &usize| agents[i].agent.kind == AgentKind::Vehicle;
    let all = stuck.iter().copied().filter(drives).map(|who| BackUp {
        who,
        blocks: blocked(who),
        is_on_road: !is_inside(map, &agents[who]),
    });
    let could: Vec<_> = all.filter(could).collect();
    let is_last = |i: usize| {
        let near = |j: usize| apart(&agents[j].agent, &agents[i].agent) < MEETING_M;
        let mut others = could.iter().filter(|other| near(other.who));
        !others.any(|other| came_later(&agents[other.who], &agents[i]))
    };
    could
        .iter()
        .filter(|one| is_last(one.who))
        .cloned()
        .collect()
}

/// Whether nobody is behind an agent, or about to come there.
pub(super) fn has_room_behind<'a>(agent: &Agent, mut all: impl Iterator<Item = &'a Agent>) -> bool {
    let own = agent.state.pose.inverse();
    let beside = agent.width / 2.0 + BESIDE_IT_M;
    !all.any(|other| {
        let metres = agent.length / 2.0 + BEHIND_M + GAP_S * other.state.speed();
        let is_behind = |point: DVec2| {
            let place = own * point;
            (-metres..0.0).contains(&place.x) && place.y.abs() < beside
        };
        let body = other.oriented_box().corners();
        let mut body = body.into_iter().chain([other.state.pose.position]);
        other.id != agent.id && body.any(is_behind)
    })
}

/// Whether an agent is on a lane of a junction, or was driving and is between its lanes.
fn is_inside(map: &MapGraph, one: &Standing<'_>) -> bool {
    let beside = if one.has_driven {
        ASTRAY_INSIDE_M
    } else {
        IN_LANE_M
    };
    let mut near = map.lanes_near(one.agent.state.pose.position, beside);
    near.next().is_some_and(|(lane, _)| lane.in_intersection)
}

/// Whether an agent of a made scene waits if it stands: it is in a lane, or in a junction, where nobody
/// parks.
pub(super) fn waits_if_made(map: &MapGraph, agent: &Agent) -> bool {
    let pose = agent.state.pose;
    let beside = match agent.kind {
        AgentKind::Vehicle => IN_LANE_M,
        AgentKind::Bicycle => BESIDE_M,
        _ => return false,
    };
    let mut lanes = map.lanes_near(pose.position, beside);
    let mut near = map.lanes_near(pose.position, ASTRAY_INSIDE_M);
    lanes.any(|(lane, _)| lane.foot(pose).turned < ALONG)
        || near.next().is_some_and(|(lane, _)| lane.in_intersection)
}

/// Whether an agent was driving and is on a lane of a junction whose light has ended its green.
fn has_to_clear(map: &MapGraph, lights: &[Light], one: &Standing<'_>) -> bool {
    if !one.has_driven || lights.is_empty() {
        return false;
    }
    let lane = ahead(map, one).first().map(|part| part.lane);
    let inside = lane.filter(|lane| lane.in_intersection);
    // The light belongs to the lane that leads in, or to the first one inside.
    let way_in = std::iter::successors(inside, |lane| match lane.in_intersection {
        true => map.predecessors(lane.id).next(),
        false => None,
    });
    let light_of = |lane: &Lane| lights.iter().find(|light| light.lane == lane.id);
    let light = way_in.take(HOPS).find_map(light_of);
    light.is_some_and(|light| matches!(light.state, LightState::Red | LightState::Yellow))
}

/// Whether two agents' lanes ahead come within [`NEAR_PATH_M`] of each other.
fn meet(own: &[LaneAhead<'_>], its: &[LaneAhead<'_>]) -> bool {
    let on_own = |point: DVec2| {
        own.iter().any(|part| {
            let place = part.locate(point);
            place.beside_m <= NEAR_PATH_M && (0.0..LOOK_M).contains(&place.ahead_m)
        })
    };
    its.iter().any(|part| {
        let from = (-part.base_m).max(0.0);
        let to = (LOOK_M - part.base_m).min(part.lane.centerline.length());
        let steps = ((to - from) / NEAR_PATH_M).max(0.0) as usize;
        let at = |k: usize| from + NEAR_PATH_M * k as f64;
        (0..=steps).any(|k| on_own(part.lane.centerline.pose_at(at(k)).position))
    })
}

/// The lane that a vehicle or bicycle stands in and those that follow within [`LOOK_M`], of its route if it
/// is on one; empty for agents beside the lanes. Distances are from its front bumper.
fn ahead<'m>(map: &'m MapGraph, standing: &Standing<'_>) -> Vec<LaneAhead<'m>> {
    let agent = &standing.agent;
    let (beside, turned) = match (agent.kind, standing.has_driven) {
        (AgentKind::Vehicle | AgentKind::Bicycle, true) => (ASTRAY_INSIDE_M, TURNED),
        (AgentKind::Vehicle, false) => (IN_LANE_M, ALONG),
        (AgentKind::Bicycle, false) => (BESIDE_M, ALONG),
        _ => return Vec::new(),
    };
    let pose = agent.state.pose;
    let along = |lane: &Lane| {
        let foot = lane.foot(pose);
        (foot.turned < turned).then_some(foot.along_m)
    };
    let near = map.lanes_near(pose.position, beside);
    let near = near.filter(|(lane, metres)| *metres <= ASTRAY_M || lane.in_intersection);
    let on: Vec<_> = near
        .filter_map(|(lane, _)| Some((lane, along(lane)?)))
        .collect();
    let is_meant = |lane: &Lane| {
        let route = standing.route;
        route.is_some_and(|route| route.lanes().contains(&lane.id))
    };
    let meant = on.iter().find(|(lane, _)| is_meant(lane));
    let Some(&(lane, at)) = meant.or(on.first()) else {
        return Vec::new();
    };
    let mut reached = lanes_ahead(map, lane, at + agent.length / 2.0, LOOK_M).0;
    if meant.is_some() {
        reached.retain(|part| is_meant(part.lane));
    }
    reached
}

/// Whether the lights ahead forbid every way on: also to who stands over the line up to its middle.
fn is_shut(reached: &[LaneAhead<'_>], lights: &[Light], agent: &Agent) -> bool {
    let mut is_one_shut = false;
    for part in reached {
        for light in lights.iter().filter(|light| light.lane == part.lane.id) {
            if !is_before(part, light, agent) {
                continue;
            }
            if light.state == LightState::Green {
                return false;
            }
            is_one_shut = true;
        }
    }
    is_one_shut
}

/// Whether one that was seen to drive, and would do so by itself, has stood for longer than drivers whose way
/// is free. Lights that are `fresh` have just changed.
fn has_waited(map: &MapGraph, (lights, fresh): (&[Light], &[LaneId]), one: &Standing<'_>) -> bool {
    if !one.has_driven || one.patience_s.is_infinite() || one.waited_s <= AT_GREEN_S {
        return false;
    }
    let is_green = || {
        let mut greens = lights
            .iter()
            .filter(|light| light.state == LightState::Green && !fresh.contains(&light.lane));
        let reached = ahead(map, one);
        let is_ahead = |light: &Light| {
            let mut parts = reached.iter().filter(|part| part.lane.id == light.lane);
            parts.any(|part| is_before(part, light, &one.agent))
        };
        greens.any(is_ahead)
    };
    one.waited_s > DRIVEN_S || is_green()
}

/// Whether a vehicle is parked beside the middle of all lanes, as far as where it stands tells.
fn is_aside(map: &MapGraph, other: &Agent) -> bool {
    let mut lanes = map.lanes_near(other.state.pose.position, PASSES_M);
    other.kind == AgentKind::Vehicle && lanes.next().is_none()
}

/// Whether an agent is near a light's line, and its middle not over it.
fn is_before(part: &LaneAhead<'_>, light: &Light, agent: &Agent) -> bool {
    (-agent.length / 2.0..LOOK_M).contains(&part.metres_to_stop_line(light))
}

/// Whether another agent is in the way, or will be when it crosses; one that `stays` is not about to
/// step onto the path.
fn holds(
    reached: &[LaneAhead<'_>],
    agent: &Agent,
    other: &Agent,
    stays: bool,
    room: &Room,
) -> bool {
    let (pose, at) = (other.state.pose, other.state.pose.position);
    let own = agent.state.pose;
    let reach = LOOK_M + agent.length + other.length + GAP_S * other.state.speed();
    if at.distance(own.position) > reach {
        return false;
    }
    let side = match other.kind {
        AgentKind::Pedestrian | AgentKind::Bicycle if !stays => SIDE_OF_PEOPLE_M,
        _ => room.beside_m,
    };
    let corners = other.oriented_box().corners();
    let is_ahead = |point: DVec2, beside: f64, metres: f64| {
        reached.iter().any(|part| {
            let place = part.locate(point);
            place.beside_m <= beside && (0.0..metres).contains(&place.ahead_m)
        })
    };
    // Bicycles keep to the side of their lane; vehicles far from its centre return to it.
    let aside = reached[0].lane.centerline.project(own.position).distance;
    let aside = match agent.kind {
        _ if !room.returns => 0.0,
        AgentKind::Bicycle => aside.min(BESIDE_M),
        _ => aside.min(IN_LANE_M),
    };
    let mut body = corners.into_iter().chain([at]);
    if body.any(|point| is_ahead(point, agent.width / 2.0 + side + aside, room.ahead_m)) {
        return true;
    }
    let velocity = other.state.velocity;
    if other.state.speed() < MOVES || angle_difference(pose.heading, own.heading).abs() < ALONG {
        return false;
    }
    let beside = NEAR_PATH_M + other.width / 2.0;
    // It drives along the path ahead.
    let leads = reached.iter().any(|part| {
        let place = part.locate(at);
        let way = &part.lane.centerline;
        let way = way.pose_at(way.project(at).arc_length).heading;
        place.beside_m <= IN_LANE_M
            && (0.0..LOOK_M).contains(&place.ahead_m)
            && angle_difference(way, pose.heading).abs() < ALONG
    });
    if leads {
        return false;
    }
    let steps = (GAP_S * 2.0) as usize;
    let mut times = (1..=steps).map(|k| 0.5 * k as f64);
    let meets_s = times.find(|time_s| is_ahead(at + velocity * *time_s, beside, LOOK_M));
    let speed = other.state.speed();
    let stops_m = speed * speed / (2.0 * GENTLY) + speed * TOKEN_DT + other.length / 2.0;
    let can_stop = |time_s: f64| other.kind == AgentKind::Vehicle && time_s * speed > stops_m;
    meets_s.is_some_and(|time_s| !(room.insists && can_stop(time_s)))
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use gump_model::relative::route::Traveller;
    use gump_scene::{AgentId, LaneId, Scenario, Seed, fixture};

    use super::*;

    /// Ids of the agents that could go, given their waiting times, seconds.
    fn free(scenario: &Scenario, waited: &[(i64, f64)]) -> Vec<i64> {
        free_after(false, scenario, waited)
    }

    fn free_after(has_driven: bool, scenario: &Scenario, waited: &[(i64, f64)]) -> Vec<i64> {
        let scene = scenario.present();
        let since = |id: AgentId| waited.iter().find(|(of, _)| *of == id.0);
        let agents = scene.now().agents().iter();
        let agents: Vec<_> = agents
            .map(|agent| Standing {
                agent: *agent,
                waited_s: since(agent.id).map_or(0.0, |(_, s)| *s),
                patience_s: 4.0,
                has_driven,
                route: None,
            })
            .collect();
        let found = released(scene.map, scene.now().lights(), &[], &agents, false);
        found.go.into_iter().map(|i| agents[i].agent.id.0).collect()
    }

    fn scenario(text: &str) -> Scenario {
        fixture::scenario(text).unwrap()
    }

    #[test]
    fn a_free_road_holds_nobody_and_a_leader_does() {
        let road = |rest: &str| scenario(&format!("lane 1: 0,0 200,0\n{rest}"));
        let two = road("ego vehicle 0: 20,0\nagent vehicle 1: 27,0\nagent vehicle 2: 27,6");
        let waited = [(0, 9.0), (1, 9.0), (2, 9.0)];
        // The second has the road to itself, the third is parked beside it.
        assert_eq!(free(&two, &waited), [1]);
        assert!(free(&two, &[(0, 9.0), (1, 3.0)]).is_empty());
        let bicycle = road("ego bicycle 0: 20,-1.5\nagent pedestrian 1: 25,-2.5");
        assert!(free(&bicycle, &[(0, 9.0)]).is_empty());
        let alone = road("ego bicycle 0: 20,-1.5\nagent pedestrian 1: 25,4");
        assert_eq!(free(&alone, &[(0, 9.0)]), [0]);
    }

    #[test]
    fn red_lights_and_crossing_traffic_hold() {
        let lanes = "lane 1: 0,0 30,0 next 2\nlane 2: 30,0 60,0\nlane 3: 45,-60 45,60\n";
        let waiting = |rest: &str| scenario(&format!("{lanes}ego vehicle 0: 26,0\n{rest}"));
        let waited = [(0, 9.0)];
        assert_eq!(free(&waiting(""), &waited), [0]);
        assert!(free(&waiting("light 1 red: 30,0"), &waited).is_empty());
        assert_eq!(free(&waiting("light 1 green: 30,0"), &waited), [0]);
        let crossing = |y: f64, speed: f64| {
            waiting(&format!(
                "agent vehicle 1: 45,{y} heading 1.5708 velocity 0,{speed}"
            ))
        };
        assert!(free(&crossing(-20.0, 8.0), &waited).is_empty());
        // It has passed, or does not move.
        assert_eq!(free(&crossing(20.0, 8.0), &waited), [0]);
        assert_eq!(free(&crossing(-20.0, 0.0), &waited), [0]);
    }

    #[test]
    fn who_was_seen_to_drive_starts_soon_most_at_green() {
        let goes = |light: &str, waited_s: f64, fresh: &[LaneId], (has_driven, is_late)| {
            let text = format!("lane 1: 0,0 30,0 next 2\nlane 2: 30,0 90,0\n{light}");
            let scenario = scenario(&format!("{text}\nego vehicle 0: 26,0"));
            let scene = scenario.present();
            let ego = Standing {
                agent: *scene.ego_now(),
                waited_s,
                patience_s: 20.0,
                has_driven,
                route: None,
            };
            let found = released(scene.map, scene.now().lights(), fresh, &[ego], is_late);
            !found.go.is_empty()
        };
        let green = "light 1 green: 30,0";
        assert!(goes(green, 2.0, &[], (true, true)));
        assert!(!goes(green, 1.0, &[], (true, true)));
        assert!(!goes(green, 2.0, &[LaneId(1)], (true, true)));
        assert!(!goes("light 1 red: 30,0", 9.0, &[], (true, true)));
        // Elsewhere later, and who may be parked, or within a benchmark's time, not for long.
        assert!(!goes("", 2.0, &[], (true, true)) && goes("", 3.5, &[], (true, true)));
        assert!(!goes(green, 9.0, &[], (false, true)) && !goes(green, 9.0, &[], (true, false)));
    }

    #[test]
    fn who_was_seen_to_drive_passes_those_who_are_parked_beside_its_way() {
        let goes = |y: f64, its_wait: f64, has_driven: bool| {
            let text = format!("lane 1: 0,0 90,0\nego vehicle 0: 26,0.5\nagent vehicle 1: 32,{y}");
            let scenario = scenario(&text);
            let scene = scenario.present();
            let of = |agent: &Agent| Standing {
                agent: *agent,
                waited_s: if agent.id.0 == 0 { 9.0 } else { its_wait },
                patience_s: 20.0,
                has_driven: agent.id.0 == 0 || has_driven,
                route: None,
            };
            let agents: Vec<_> = scene.now().agents().iter().map(of).collect();
            released(scene.map, &[], &[], &agents, true).go.contains(&0)
        };
        assert!(goes(-1.0, 30.0, false));
        assert!(!goes(-0.2, 30.0, false), "in its way");
        assert!(
            !goes(-1.0, 30.0, true) && !goes(-1.0, 5.0, false),
            "it may go on"
        );
    }

    #[test]
    fn who_insists_is_not_held_by_those_who_can_still_stop() {
        let lanes = "lane 1: 0,0 30,0 next 2\nlane 2: 30,0 60,0\nlane 3: 45,-60 45,60\n";
        let crossing = |y: f64| {
            scenario(&format!(
                "{lanes}ego vehicle 0: 26,0\n\
                 agent vehicle 1: 45,{y} heading 1.5708 velocity 0,8"
            ))
        };
        let (far, near) = (crossing(-25.0), crossing(-6.0));
        assert!(free(&far, &[(0, 9.0)]).is_empty());
        assert_eq!(free(&far, &[(0, 9.5)]), [0]);
        assert!(free(&near, &[(0, 9.5)]).is_empty());
    }

    #[test]
    fn who_rolls_has_a_reason_to_stop_or_is_told_apart() {
        let lanes = "lane 1: 0,0 30,0 next 2,3\nlane 2: 30,0 60,0\nlane 3: 30,0 60,20\n";
        let rolling = |speed: f64, rest: &str| {
            let scenario = scenario(&format!(
                "{lanes}ego vehicle 0: 20,0 velocity {speed},0\n{rest}"
            ));
            let scene = scenario.present();
            let agents = scene.now().agents().iter();
            let agents: Vec<_> = agents
                .map(|agent| Standing {
                    agent: *agent,
                    waited_s: 0.0,
                    patience_s: 4.0,
                    has_driven: true,
                    route: None,
                })
                .collect();
            let rolls = |is_late: bool| {
                let found = released(scene.map, scene.now().lights(), &[], &agents, is_late);
                found.roll.contains(&0)
            };
            assert!(!rolls(false));
            rolls(true)
        };
        assert!(rolling(2.0, ""));
        assert!(!rolling(0.0, "") && !rolling(8.0, ""));
        assert!(!rolling(2.0, "agent vehicle 1: 27,0"));
        assert!(rolling(2.0, "agent vehicle 1: 37,0"));
        assert!(!rolling(2.0, "light 1 red: 30,0"));
        assert!(!rolling(2.0, "light 1 yellow: 30,0"));
        // One way is open, and it means to take any.
        assert!(rolling(2.0, "light 2 red: 30,0\nlight 3 green: 30,0"));
    }

    #[test]
    fn people_walk_on_before_a_vehicle_that_waits_for_them() {
        let gone = |rest: &str, is_late: bool, waited: [f64; 2]| {
            let scenario = scenario(&format!(
                "lane 1: 0,0 90,0\nego vehicle 0: 20,0\nagent pedestrian 1: 25,0.5\n\
                 agent pedestrian 2: 25,5\n{rest}"
            ));
            let scene = scenario.present();
            let agents = scene.now().agents().iter();
            let agents: Vec<_> = agents
                .map(|agent| Standing {
                    agent: *agent,
                    waited_s: waited[usize::from(agent.id.0 > 0)],
                    patience_s: 9.0,
                    has_driven: true,
                    route: None,
                })
                .collect();
            let released = released(scene.map, scene.now().lights(), &[], &agents, is_late);
            (released.go, released.aside)
        };
        assert_eq!(gone("", true, [3.0, 3.0]), (vec![1], vec![]));
        for (is_late, waited) in [(false, [3.0, 3.0]), (true, [1.0, 3.0]), (true, [3.0, 1.0])] {
            assert_eq!(gone("", is_late, waited), (vec![], vec![]));
        }
        // Later to the side of the vehicle on which it stands, the left one.
        assert_eq!(gone("", true, [3.0, 7.0]), (vec![1], vec![(1, FRAC_PI_2)]));
        // Unless another vehicle stands there.
        let beside = "agent vehicle 3: 26,2.5";
        assert_eq!(gone(beside, true, [3.0, 7.0]).1, [(1, -FRAC_PI_2)]);
    }

    #[test]
    fn routes_tell_which_light_holds() {
        let scenario = scenario(
            "lane 1: 0,0 30,0 next 2,3\nlane 2: 30,0 90,0\nlane 3: 30,0 40,20
             light 2 red: 30,0\nlight 3 green: 30,0\nego vehicle 0: 26,0",
        );
        let scene = scenario.present();
        let goes = |way: i64| {
            let who = |seed: u64| Traveller {
                pose: scene.ego_now().state.pose,
                speed: 0.0,
                seed: Seed(seed),
                remains: false,
            };
            let routes = (0..64).filter_map(|seed| Route::from_here(scene.map, who(seed)));
            let route = routes
                .into_iter()
                .find(|route| route.lanes().contains(&LaneId(way)))
                .unwrap();
            let ego = Standing {
                agent: *scene.ego_now(),
                waited_s: 9.0,
                patience_s: 4.0,
                has_driven: true,
                route: Some(&route),
            };
            !released(scene.map, scene.now().lights(), &[], &[ego], true)
                .go
                .is_empty()
        };
        assert_eq!([goes(2), goes(3)], [false, true]);
    }

    #[test]
    fn who_was_seen_to_drive_is_not_parked() {
        let astray = |pose: &str| scenario(&format!("lane 1: 0,0 200,0\nego vehicle 0: {pose}"));
        let waited = [(0, 9.0)];
        for pose in ["20,2", "20,0 heading 0.7"] {
            assert!(free(&astray(pose), &waited).is_empty(), "{pose}");
            assert_eq!(free_after(true, &astray(pose), &waited), [0], "{pose}");
        }
        assert!(free_after(true, &astray("20,3.8"), &waited).is_empty());
        // Between the lanes of a junction nobody parks.
        let mut junction = astray("20,3.8");
        let mut parts = junction.map.parts().clone();
        parts.lanes[0].in_intersection = true;
        junction.map = Arc::new(MapGraph::new(parts).unwrap());
        assert_eq!(free_after(true, &junction, &waited), [0]);
        assert!(free(&junction, &waited).is_empty());
    }

    #[test]
    fn pedestrians_leave_the_path_of_those_who_wait_for_them() {
        let with = |y: f64| {
            let road = "lane 1: 0,0 200,0\nego vehicle 0: 20,0\n";
            scenario(&format!("{road}agent pedestrian 1: 26,{y}"))
        };
        assert_eq!(free(&with(0.5), &[(0, 9.0), (1, 9.0)]), [1]);
        assert!(free(&with(0.5), &[(0, 9.0), (1, 2.0)]).is_empty());
        assert!(free(&with(0.5), &[(0, 2.0), (1, 9.0)]).is_empty());
        // Beside the path it holds as long as it may step onto it.
        assert_eq!(free(&with(1.8), &[(0, 9.0), (1, 9.0)]), [0]);
        assert!(free(&with(1.8), &[(0, 9.0), (1, 2.0)]).is_empty());
        assert_eq!(free(&with(4.0), &[(0, 9.0), (1, 9.0)]), [0]);
    }

    #[test]
    fn of_two_that_wait_for_each_other_the_first_goes() {
        let crossing = scenario(
            "lane 1: 0,0 60,0\nlane 2: 30,-40 30,40\n\
             ego vehicle 0: 20,0\nagent vehicle 1: 30,-12 heading 1.5708",
        );
        assert_eq!(free(&crossing, &[(0, 9.0), (1, 12.0)]), [1]);
        assert_eq!(free(&crossing, &[(0, 9.0), (1, 9.0)]), [0]);
        assert_eq!(free(&crossing, &[(0, 9.0), (1, 1.0)]), [0]);
    }

    #[test]
    fn oncoming_vehicles_do_not_wait_for_each_other() {
        let road = scenario(
            "lane 1: 0,0 60,0\nlane 2: 60,4 0,4\n\
             ego vehicle 0: 20,0\nagent vehicle 1: 35,4 heading 3.1416",
        );
        assert_eq!(free(&road, &[(0, 9.0), (1, 12.0)]), [0, 1]);
    }

    #[test]
    fn vehicles_that_hold_each_other_squeeze_past_after_twice_the_time() {
        // Each is in the room that the other would need, 0.2 m beside its path.
        let crossing = scenario(
            "lane 1: 0,0 60,0\nlane 2: 30,-40 30,40\n\
             ego vehicle 0: 26.4,0\nagent vehicle 1: 30,-3.6 heading 1.5708",
        );
        assert!(free(&crossing, &[(0, 7.0), (1, 7.0)]).is_empty());
        assert_eq!(free(&crossing, &[(0, 9.0), (1, 9.0)]), [0]);
        // One that has just come may move on by itself.
        assert!(free(&crossing, &[(0, 1.0), (1, 9.0)]).is_empty());
    }

    #[test]
    fn in_a_junction_patience_ends_after_nine_seconds() {
        let scenario = scenario(
            "lane 1: 0,0 60,0\nlane 2: 30,-40 30,40\n\
             ego vehicle 0: 26.4,0\nagent vehicle 1: 30,-3.6 heading 1.5708",
        );
        let scene = scenario.present();
        let go = |inside: bool, waited_s: f64, patience_s: f64| {
            let mut parts = scenario.map.parts().clone();
            for lane in &mut parts.lanes {
                lane.in_intersection = inside;
            }
            let standing = |agent: &Agent| Standing {
                agent: *agent,
                waited_s,
                patience_s,
                has_driven: true,
                route: None,
            };
            let agents: Vec<_> = scene.now().agents().iter().map(standing).collect();
            released(&MapGraph::new(parts).unwrap(), &[], &[], &agents, false).go
        };
        // They hold each other, 0.2 m beside their paths.
        assert_eq!(go(true, 9.5, 20.0), [0]);
        assert!(go(false, 9.5, 20.0).is_empty() && go(true, 8.5, 20.0).is_empty());
        // One that is driven from outside is not released.
        assert!(go(true, 9.5, f64::INFINITY).is_empty());
    }

    #[test]
    fn who_waits_in_a_junction_clears_it_when_its_light_has_changed() {
        // It waits on the second lane inside, behind the light's.
        let go = |rest: &str, waited_s: f64, is_late: bool| {
            let scenario = scenario(&format!(
                "lane 1: 0,0 20,0 next 2\nlane 2: 20,0 24,0 next 3\nlane 3: 24,0 50,0 next 4\n\
                 lane 4: 50,0 90,0\nego vehicle 0: 30,0\n{rest}"
            ));
            let mut parts = scenario.map.parts().clone();
            for lane in [1, 2] {
                parts.lanes[lane].in_intersection = true;
            }
            let standing = |agent: &Agent| Standing {
                agent: *agent,
                waited_s: if agent.id.0 == 0 { waited_s } else { 0.0 },
                patience_s: 20.0,
                has_driven: true,
                route: None,
            };
            let scene = scenario.present();
            let agents: Vec<_> = scene.now().agents().iter().map(standing).collect();
            let map = MapGraph::new(parts).unwrap();
            released(&map, scene.now().lights(), &[], &agents, is_late).go
        };
        for (lane, state, goes) in [
            (2, "red", true),
            (2, "yellow", true),
            (2, "green", false),
            (1, "red", true),
            (4, "red", false),
        ] {
            let light = format!("light {lane} {state}: {},0", 20 * lane - 20);
            assert_eq!(go(&light, 1.5, true), [0][..usize::from(goes)], "{light}");
        }
        let red = "light 2 red: 20,0";
        assert!(go(red, 1.0, true).is_empty() && go(red, 1.5, false).is_empty());
        let crosses = "agent vehicle 1: 40,-20 heading 1.5708 velocity 0,8";
        assert!(go(&format!("{red}\n{crosses}"), 1.5, true).is_empty());
        // One that has turned into the same road before it does not cross.
        let leads = "agent vehicle 1: 44,0.5 heading 0.2 velocity 5,1";
        assert_eq!(go(&format!("{red}\n{leads}"), 1.5, true), [0]);
    }

    #[test]
    fn of_vehicles_stuck_in_a_junction_the_last_one_backs_up() {
        let back = |more: &str, waited: [f64; 2], inside: bool| {
            // Each stands in the path of the other.
            let scenario = scenario(&format!(
                "lane 1: 0,0 60,0\nlane 2: 30,-40 30,40\n\
                 ego vehicle 0: 27.3,0\nagent vehicle 1: 30,-3.2 heading 1.5708\n{more}"
            ));
            let mut parts = scenario.map.parts().clone();
            for lane in &mut parts.lanes {
                lane.in_intersection = inside;
            }
            let standing = |agent: &Agent| Standing {
                agent: *agent,
                waited_s: *waited.get(agent.id.0 as usize).unwrap_or(&0.0),
                patience_s: 20.0,
                has_driven: true,
                route: None,
            };
            let scene = scenario.present();
            let agents: Vec<_> = scene.now().agents().iter().map(standing).collect();
            let released = released(&MapGraph::new(parts).unwrap(), &[], &[], &agents, false);
            assert!(released.go.is_empty(), "{released:?}");
            let back_up = released.back_up.iter();
            back_up.map(|one| one.who).collect::<Vec<_>>()
        };
        assert_eq!(back("", [13.0, 20.0], true), [0]);
        assert_eq!(back("", [20.0, 13.0], true), [1]);
        assert!(back("", [13.0, 20.0], false).is_empty());
        assert!(back("", [11.0, 11.0], true).is_empty());
        // Without room behind the last one it is the other; nor may somebody be about to come there.
        let behind = "agent vehicle 2: 21,0";
        assert_eq!(back(behind, [13.0, 20.0], true), [1]);
        let coming = "agent vehicle 2: 12,0 velocity 3,0";
        assert_eq!(back(coming, [13.0, 20.0], true), [1]);
        let far = "agent vehicle 2: 12,0";
        assert_eq!(back(far, [13.0, 20.0], true), [0]);
    }

    #[test]
    fn of_oncoming_vehicles_that_block_each_other_the_last_one_backs_up() {
        let back = |waited: [f64; 2], is_parked: bool, is_late: bool| {
            // On a road that is too narrow for two.
            let scenario = scenario(
                "lane 1: 0,0 60,0\nlane 2: 60,2.4 0,2.4\n\
                 ego vehicle 0: 27,0.5\nagent vehicle 1: 33,1.9 heading 3.1416",
            );
            let standing = |agent: &Agent| Standing {
                agent: *agent,
                waited_s: waited[agent.id.0 as usize],
                patience_s: 20.0,
                has_driven: !(is_parked && agent.id.0 == 1),
                route: None,
            };
            let scene = scenario.present();
            let agents: Vec<_> = scene.now().agents().iter().map(standing).collect();
            let released = released(scene.map, &[], &[], &agents, is_late);
            let back_up = released
                .back_up
                .iter()
                .inspect(|one| assert!(one.is_on_road));
            back_up
                .map(|one| (one.who, one.blocks.clone()))
                .collect::<Vec<_>>()
        };
        assert_eq!(back([13.0, 20.0], false, true), [(0, vec![1])]);
        assert_eq!(back([20.0, 13.0], false, true), [(1, vec![0])]);
        assert_eq!(back([5.0, 6.0], false, true), [(0, vec![1])]);
        assert!(back([5.0, 3.0], false, true).is_empty());
        assert!(back([13.0, 20.0], true, true).is_empty());
        assert!(back([13.0, 20.0], false, false).is_empty());
    }
}
