//! Junctions are kept clear: nobody drives into one that it cannot leave.
//!
//! Who drives into an occupied junction at green stands in the way of those that occupy it, and of the
//! next phase. In a minute such vehicles hold each other in a ring that nothing dissolves.

use std::f64::consts::FRAC_PI_6;

use gump_geometry::{OrientedBox, angle_difference};
use gump_model::relative::graph::Shown;
use gump_model::relative::route::Route;
use gump_scene::{AgentKind, Lane, LaneId, MapGraph};

use crate::relative::approach::{OVER_M, lane_under};

// All were chosen by hand.

/// A vehicle slower than this stands, metres per second: one that creeps does not leave a junction
/// before another gets there.
const STANDS_MPS: f64 = 1.0;
/// A vehicle is on the lane behind the junction if it is this near to its centre, metres. One heads
/// along a lane within this angle, radians.
const ON_LANE_M: f64 = 1.5;
const ALONG: f64 = FRAC_PI_6;
/// Ways to and through a junction have at most so many lanes, those through it are at most so many,
/// and not longer than this, metres.
const LANES: usize = 6;
const WAYS: usize = 12;
const LONGEST_M: f64 = 60.0;
/// Distance between the places of a way that are looked at, and a vehicle's length there, metres.
const STEP_M: f64 = 1.0;
/// Space at each side of the way, and behind a vehicle that has left the junction, metres.
const SIDE_M: f64 = 0.1;
const BEHIND_M: f64 = 1.0;

/// The lane at whose end a vehicle should wait because the junction beyond is occupied, and the distance
/// from its centre to that end, metres: on each of its ways a vehicle stands across it, or, where a light
/// applies, anywhere before the place that it needs behind the junction.
///
/// `agents` are all, `own` the index of the vehicle, which takes no way but that of its `route`, if it
/// has one there. `closes` says who can close a junction: not those that are parked in it. `None` where
/// it may drive on, is in the junction already, or is farther than `reach` metres from it.
pub fn closed_entry<'m>(
    map: &'m MapGraph,
    agents: &[Shown],
    (own, route): (usize, Option<&Route>),
    reach: f64,
    is_lit: impl Fn(LaneId) -> bool,
    closes: impl Fn(usize) -> bool,
) -> Option<(&'m Lane, f64)> {
    let now = &agents[own];
    let is_vehicle = |agent: &Shown| agent.body.kind == AgentKind::Vehicle;
    let stands = |agent: &Shown| is_vehicle(agent) && agent.velocity().length() < STANDS_MPS;
    if !is_vehicle(now) || !agents.iter().any(stands) {
        return None;
    }
    let (mut lane, at) = lane_under(map, now.pose)?;
    let mut line = lane.centerline.length() - at;
    let front = now.body.length / 2.0;
    let is_meant = |lane: &Lane| route.is_some_and(|route| route.lanes().contains(&lane.id));
    // The last lane before the junction; lanes that fork before it leave the choice open, without a
    // route.
    for _ in 0..LANES {
        if line >= reach || lane.in_intersection {
            break;
        }
        let next: Vec<&Lane> = map.successors(lane.id).collect();
        if next.first()?.in_intersection {
            break;
        }
        lane = match next[..] {
            [only] => only,
            _ => *next.iter().find(|lane| is_meant(lane))?,
        };
        line += lane.centerline.length();
    }
    let leads_in = map.successors(lane.id).any(|lane| lane.in_intersection);
    if lane.in_intersection || !leads_in || line >= reach || line - front < -OVER_M {
        return None;
    }
    let far = |agent: &Shown| {
        let apart = agent.pose.position.distance(now.pose.position);
        apart > line + LONGEST_M + now.body.length + agent.body.length
    };
    let others = agents.iter().enumerate();
    let others = others.filter(|(j, _)| *j != own && closes(*j));
    let standing: Vec<&Shown> = others
        .map(|(_, agent)| agent)
        .filter(|agent| stands(agent) && !far(agent))
        .collect();
    if standing.is_empty() {
        return None;
    }
    let mut ways = Vec::new();
    walk(map, &mut vec![lane], &mut ways);
    let follows_route = |way: &Vec<&Lane>| {
        let mut inside = way[1..].iter().take_while(|lane| lane.in_intersection);
        inside.all(|lane| is_meant(lane))
    };
    if ways.iter().any(follows_route) {
        ways.retain(follows_route);
    }
    let is_closed = |way: &Vec<&Lane>| {
        let is_lit = way.iter().any(|lane| is_lit(lane.id));
        standing.iter().any(|other| {
            way[1..].iter().any(|lane| match lane.in_intersection {
                true => is_across(now, other, lane, is_lit),
                false => is_lit && is_behind_it(now, other, lane),
            })
        })
    };
    (!ways.is_empty() && ways.iter().all(is_closed)).then_some((lane, line))
}

/// Collects the ways through the junction behind the last lane of `way`, with the lane behind it.
fn walk<'m>(map: &'m MapGraph, way: &mut Vec<&'m Lane>, all: &mut Vec<Vec<&'m Lane>>) {
    let is_through = way.len() > 1 && !way[way.len() - 1].in_intersection;
    let mut next = map.successors(way[way.len() - 1].id).peekable();
    if is_through || way.len() > LANES || next.peek().is_none() {
        all.push(way.clone());
        return;
    }
    for lane in next {
        if all.len() < WAYS {
            way.push(lane);
            walk(map, way, all);
            way.pop();
        }
    }
}

/// Whether a vehicle that stands is in the way of another that follows a lane of the junction: across
/// it, or also along it.
fn is_across(now: &Shown, other: &Shown, lane: &Lane, also_along: bool) -> bool {
    let way = &lane.centerline;
    let foot = way.project(other.pose.position);
    let reach = (other.body.length + now.body.width) / 2.0 + other.body.width;
    if foot.distance > reach {
        return false;
    }
    let turned = angle_difference(way.pose_at(foot.arc_length).heading, other.pose.heading).abs();
    if !also_along && turned < ALONG {
        return false;
    }
    let its = OrientedBox {
        pose: other.pose,
        length: other.body.length,
        width: other.body.width,
    };
    let from = (foot.arc_length - reach).max(0.0);
    let to = (foot.arc_length + reach).min(way.length());
    let n = ((to - from) / STEP_M).ceil() as usize;
    (0..=n).any(|k| {
        let place = OrientedBox {
            pose: way.pose_at((from + STEP_M * k as f64).min(to)),
            length: STEP_M,
            width: now.body.width + 2.0 * SIDE_M,
        };
        place.overlaps(&its)
    })
}

/// Whether a vehicle stands on the lane behind the junction where another needs its place.
fn is_behind_it(now: &Shown, other: &Shown, lane: &Lane) -> bool {
    let foot = lane.foot(other.pose);
    let rear = foot.along_m - other.body.length / 2.0;
    let is_on = foot.lateral_m.abs() < ON_LANE_M && foot.along_m > 0.0;
    is_on && foot.turned < ALONG && rear < now.body.length + BEHIND_M
}

#[cfg(test)]
mod tests {
    use gump_geometry::{DVec2, Pose};
    use gump_model::relative::graph::Body;
    use gump_model::relative::route::Traveller;
    use gump_scene::{Seed, fixture};

    use super::*;

    /// A road along x with a junction from 0 to 20 m, in which 4 turns left.
    fn junction() -> MapGraph {
        let scenario = fixture::scenario(
            "lane 1: -60,0 0,0 next 2,4\nlane 2: 0,0 20,0 next 3\nlane 3: 20,0 90,0\n\
             lane 4: 0,0 8,2 12,10 next 5\nlane 5: 12,10 12,60\nego vehicle 0: -20,0",
        )
        .unwrap();
        let mut parts = scenario.map.parts().clone();
        for lane in [1, 3] {
            parts.lanes[lane].in_intersection = true;
        }
        MapGraph::new(parts).unwrap()
    }

    fn agent(kind: AgentKind, pose: Pose, speed: f64) -> Shown {
        let body = Body {
            kind,
            length: 4.5,
            width: 1.9,
            sized: true,
        };
        Shown::first(body, pose, DVec2::from_angle(pose.heading) * speed)
    }

    fn car(pose: Pose, speed: f64) -> Shown {
        agent(AgentKind::Vehicle, pose, speed)
    }

    const NORTH: f64 = std::f64::consts::FRAC_PI_2;

    /// Metres to the line where a vehicle at `x` has to wait among these others.
    fn closed(x: f64, others: &[Shown], is_lit: bool) -> Option<f64> {
        closed_on(None, x, others, is_lit)
    }

    /// The same with a route into this lane.
    fn closed_on(into: Option<i64>, x: f64, others: &[Shown], is_lit: bool) -> Option<f64> {
        let map = junction();
        let route = into.map(|lane| {
            let who = Traveller {
                pose: Pose::new(x, 0.0, 0.0),
                speed: 6.0,
                seed: Seed(0),
                remains: false,
            };
            let routes = (0..64).filter_map(|seed| {
                let seed = Seed(seed);
                Route::from_here(&map, Traveller { seed, ..who })
            });
            let mut routes = routes.filter(|route| route.lanes().contains(&LaneId(lane)));
            routes.next().unwrap()
        });
        let own = car(Pose::new(x, 0.0, 0.0), 6.0);
        let agents: Vec<Shown> = std::iter::once(own).chain(others.iter().copied()).collect();
        let found = closed_entry(
            &map,
            &agents,
            (0, route.as_ref()),
            25.0,
            |_| is_lit,
            |_| true,
        );
        found.map(|(lane, metres)| {
            assert_eq!(lane.id, LaneId(1));
            metres
        })
    }

    #[test]
    fn who_stands_across_every_way_closes_it() {
        let across = |x: f64| car(Pose::new(x, 0.5, NORTH), 0.0);
        // Before both ways part; in the straight one alone; it moves; beside them.
        assert_eq!(closed(-10.0, &[across(3.0)], false), Some(10.0));
        assert_eq!(closed(-10.0, &[across(18.0)], false), None);
        let moves = car(Pose::new(3.0, 0.5, NORTH), 3.0);
        assert_eq!(closed(-10.0, &[moves], false), None);
        let beside = car(Pose::new(3.0, -6.0, NORTH), 0.0);
        assert_eq!(closed(-10.0, &[beside], false), None);
        // Too far away, and over the line already.
        assert_eq!(closed(-30.0, &[across(3.0)], false), None);
        assert_eq!(closed(-1.0, &[across(3.0)], false), None);
        // People step aside.
        let walks = agent(AgentKind::Pedestrian, Pose::new(3.0, 0.5, NORTH), 0.0);
        assert_eq!(closed(-10.0, &[walks], false), None);
    }

    #[test]
    fn at_a_light_there_must_be_room_behind_the_junction() {
        let queue = |x: f64| {
            [
                car(Pose::new(x, 0.2, 0.0), 0.0),
                car(Pose::new(12.0, 14.0, NORTH), 0.0),
            ]
        };
        // The second vehicle closes the turn; the first one's rear is 2.75 or 6.75 m behind the
        // junction, and it needs 5.5 m.
        assert_eq!(closed(-10.0, &queue(25.0), true), Some(10.0));
        assert_eq!(closed(-10.0, &queue(29.0), true), None);
        // Without a light, and if only one of the ways is full.
        assert_eq!(closed(-10.0, &queue(25.0), false), None);
        assert_eq!(closed(-10.0, &queue(25.0)[..1], true), None);
        // That way is the route, or the other one is.
        assert_eq!(
            closed_on(Some(3), -10.0, &queue(25.0)[..1], true),
            Some(10.0)
        );
        assert_eq!(closed_on(Some(5), -10.0, &queue(25.0)[..1], true), None);
        // One that stands in the junction along the way, where both ways still lie together.
        let inside = car(Pose::new(2.5, 0.0, 0.0), 0.0);
        assert_eq!(closed(-10.0, &[inside], true), Some(10.0));
        assert_eq!(closed(-10.0, &[inside], false), None);
    }
}
