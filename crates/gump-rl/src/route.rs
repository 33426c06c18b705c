//! The route beyond the end of the log: what formats state, or inference finds, mostly ends with
//! the last lane that the recorded driver reached.
//!
//! An observation of such a route would tell how far he drives, and lack the lights ahead of one
//! who waits.

use std::sync::Arc;

use gump_geometry::{LineIndex, Polyline};
use gump_scene::{Route, Scenario};

/// Metres of route beyond the place where the ego's log ends: 8 s, the default horizon, at 30 m/s,
/// the highest speed of the default dynamics.
const BEYOND: f64 = 8.0 * 30.0;

/// A lane whose centre is farther than this from the end of the path does not continue it, metres.
/// Chosen by hand: less than to the lane beside it.
const JOINED: f64 = 2.0;

/// The extension keeps this distance from the given path, metres, so that positions near that path
/// are as far along the route as they were without it. Chosen by hand: two lanes and a half.
const APART: f64 = 10.0;

/// More lanes than this in a row are a loop of lanes without length.
const MOST_LANES: usize = 100;

/// The route of a scenario, extended along the straightest successors of its last lane to at least
/// 240 m beyond the end of the ego's log.
///
/// It ends earlier where the map does, and before a lane that is already part of it or comes back
/// to the given path. `None` without a route.
pub(crate) fn extended(scenario: &Scenario) -> Option<Arc<Route>> {
    let mut route = Route::clone(scenario.route.as_deref()?);
    let map = &scenario.map;
    let Some(mut last) = route.lanes.last().and_then(|&id| map.lane(id)) else {
        return Some(route.into());
    };
    let (given, index) = (&route.path, LineIndex::new(&route.path));
    let driven = scenario.log[scenario.now..].iter();
    let end_of_log = driven
        .filter_map(|frame| frame.agent(scenario.ego))
        .next_back()
        .map_or(0.0, |ego| {
            index.project(given, ego.state.pose.position).arc_length
        });
    let returns = |line: &Polyline| {
        let points = line.resample(APART / 4.0);
        points.points().iter().any(|&point| {
            let foot = index.project(given, point);
            foot.distance < APART && foot.arc_length < given.length() - APART
        })
    };
    let foot = last.centerline.project(given.point_at(given.length()));
    if foot.distance > JOINED {
        return Some(route.into());
    }
    let mut points = given.points().to_vec();
    let rest = last.centerline.slice(foot.arc_length, f64::INFINITY);
    let mut beyond = given.length() - end_of_log + rest.length();
    if rest.length() > 0.0 {
        points.extend(rest.points());
    }
    for _ in 0..MOST_LANES {
        if beyond >= BEYOND {
            break;
        }
        let next = map.straightest_successor(last);
        let is_new = |id| !route.lanes.contains(&id);
        let Some(next) = next.filter(|next| is_new(next.id) && !returns(&next.centerline)) else {
            break;
        };
        points.extend(next.centerline.points());
        beyond += next.centerline.length();
        route.lanes.push(next.id);
        last = next;
    }
    points.dedup_by(|b, a| a.distance(*b) < 1e-6);
    if let Some(path) = Polyline::new(points) {
        route.path = path;
    }
    Some(route.into())
}

#[cfg(test)]
mod tests {
    use gump_scene::fixture;

    use super::*;

    fn check(text: &str, lanes: &[i64], length: f64) {
        let route = extended(&fixture::scenario(text).unwrap()).unwrap();
        let found: Vec<i64> = route.lanes.iter().map(|id| id.0).collect();
        assert_eq!(found, lanes);
        let found = route.path.length();
        assert!((found - length).abs() < 1e-6, "{found}");
    }

    #[test]
    fn the_route_goes_on_along_the_straightest_lanes() {
        // The log ends at 90, so that lane 5 is not needed.
        check(
            "lane 1: 0,0 100,0 next 3,2\nlane 2: 100,0 200,0 next 4\nlane 3: 100,0 110,20 110,90
             lane 4: 200,0 350,0 next 5\nlane 5: 350,0 400,0
             route 1\nego vehicle 0: 10,0 velocity 10,0",
            &[1, 2, 4],
            350.0,
        );
    }

    #[test]
    fn the_route_ends_with_the_map() {
        check(
            "lane 1: 0,0 100,0 next 2\nlane 2: 100,0 200,0\nroute 1\nego vehicle 0: 10,0",
            &[1, 2],
            200.0,
        );
        check(
            "lane 1: 0,0 100,0\nroute 1\nego vehicle 0: 10,0",
            &[1],
            100.0,
        );
        let text = "lane 1: 0,0 100,0\nego vehicle 0: 10,0";
        assert!(extended(&fixture::scenario(text).unwrap()).is_none());
    }

    #[test]
    fn the_route_does_not_come_back_to_itself() {
        // Lane 3 turns round and runs beside lane 1; lane 2 leads back into it.
        check(
            "lane 1: 0,0 100,0 next 2\nlane 2: 100,0 150,0 150,60 50,60 next 3
             lane 3: 50,60 50,4 0,4\nroute 1\nego vehicle 0: 10,0",
            &[1, 2],
            310.0,
        );
        check(
            "lane 1: 0,0 40,0 next 2\nlane 2: 40,0 60,0 60,15 -30,15 -30,0 -12,0 next 1
             route 1\nego vehicle 0: 10,0",
            &[1, 2],
            198.0,
        );
    }
}
