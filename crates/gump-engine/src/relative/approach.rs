//! What a vehicle comes to on its lane: lines at which it stops, bends, and the lane itself.
//!
//! Used by the rules of sampling (`right_of_way`, `keep_clear`) and by training, which judges drives.

use std::f64::consts::FRAC_PI_6;

use gump_geometry::Pose;
use gump_model::relative::graph::Shown;
use gump_model::relative::route::Route;
use gump_model::steps::TOKEN_DT;
use gump_scene::{BendLimits, Lane, MapGraph, approach_speed};

// All were chosen by hand.

/// A vehicle is on a lane if its centre is within this distance of the lane's, and it heads along it
/// within this angle.
const IN_LANE_M: f64 = 1.0;
const IN_LANE: f64 = FRAC_PI_6;
/// Hardly a driver brakes harder than this without need, m/s².
pub const BRAKES_MPS2: f64 = 3.0;
/// One that would have to brake harder than this for a line drives on, m/s²: below the 8 of a dry road.
pub const HARDEST_MPS2: f64 = 6.0;
/// The distance that a vehicle's front may be over a line and it still waits, metres.
pub const OVER_M: f64 = 0.5;
/// Drivers roll past stop signs at this speed at most, metres per second: hardly a recorded one is faster
/// at the line.
pub const ROLLS_MPS: f64 = 2.5;
/// How drivers take bends: 99.8 % of the steps of recorded vehicles over 3 m/s on lanes are slower, 99.2 to
/// 99.4 % of SUMO's (result 40).
const BENDS: BendLimits = BendLimits {
    lateral_mps2: 5.0,
    braking_mps2: 4.0,
    ahead_m: 40.0,
};
/// A slower vehicle can take any bend, metres per second.
const SLOW_MPS: f64 = 3.0;

/// The greatest speed of a vehicle before a line that it crosses at `least` metres per second at most;
/// infinite if it is over the line, or too fast to get there.
pub fn before_line(now: &Shown, metres: f64, least: f64) -> f64 {
    let room = metres - now.body.length / 2.0;
    let squared = now.velocity().length_squared() - least * least;
    if room < -OVER_M || squared > 2.0 * HARDEST_MPS2 * (room + OVER_M) {
        return f64::INFINITY;
    }
    (least * least + 2.0 * BRAKES_MPS2 * room.max(0.0)).sqrt()
}

/// The greatest speed of the next step after which a vehicle can still cross a line at `least` metres per
/// second, or stop before it at 0; infinite as in [`before_line`].
pub fn slowing_before(now: &Shown, metres: f64, least: f64) -> f64 {
    if before_line(now, metres, least).is_infinite() {
        return f64::INFINITY;
    }
    let room = (metres - now.body.length / 2.0).max(0.0);
    let squared = (2.0 * room + least * least / BRAKES_MPS2) / BRAKES_MPS2;
    let speed = BRAKES_MPS2 * ((TOKEN_DT * TOKEN_DT + squared).sqrt() - TOKEN_DT);
    speed.max(least)
}

/// The greatest speed from which a vehicle can take the bends ahead, metres per second: those of its route
/// where it is on it, else those of the fastest way from the lanes that it may be on. Infinite on none.
pub fn speed_for_bends(streets: &MapGraph, now: &Shown, route: Option<&Route>) -> f64 {
    if now.velocity().length() < SLOW_MPS {
        return f64::INFINITY;
    }
    let along = |route: Option<&Route>| {
        let is_meant = |lane: &Lane| route.is_none_or(|route| route.lanes().contains(&lane.id));
        let entering = |lane: &Lane, _| if is_meant(lane) { f64::INFINITY } else { 0.0 };
        lanes_under(streets, now.pose)
            .filter(|(lane, ..)| is_meant(lane))
            .map(|(lane, at, _)| approach_speed(streets, lane, at, BENDS, &entering))
            .reduce(f64::max)
    };
    let meant = route.and_then(|route| along(Some(route)));
    meant.or_else(|| along(None)).unwrap_or(f64::INFINITY)
}

/// Whether a stop sign applies to a lane: at its start if it is in a junction, at its end otherwise.
pub fn has_sign(streets: &MapGraph, lane: &Lane) -> bool {
    streets.stop_signs_of(lane.id).next().is_some()
}

/// The lane that a vehicle is on, and its distance from the start, metres.
pub fn lane_under(streets: &MapGraph, pose: Pose) -> Option<(&Lane, f64)> {
    let on = lanes_under(streets, pose);
    let (lane, at, _) = on.min_by(|a, b| a.2.total_cmp(&b.2))?;
    Some((lane, at))
}

/// All lanes that it may be on, its distance from the start, and from the centre, metres.
pub fn lanes_under(streets: &MapGraph, pose: Pose) -> impl Iterator<Item = (&Lane, f64, f64)> {
    let lanes = streets.lanes_near(pose.position, IN_LANE_M);
    lanes.filter_map(move |(lane, distance)| {
        let foot = lane.foot(pose);
        (foot.turned <= IN_LANE).then_some((lane, foot.along_m, distance))
    })
}

#[cfg(test)]
mod tests {
    use gump_geometry::DVec2;
    use gump_model::relative::graph::Body;
    use gump_model::relative::route::Traveller;
    use gump_scene::{AgentKind, LaneId, Seed, fixture};

    use super::*;

    /// A road that goes on and turns left by a right angle of 12 m.
    fn fork() -> MapGraph {
        let turn = (0..=12).map(|i| {
            let angle = f64::from(i) / 12.0 * std::f64::consts::FRAC_PI_2;
            format!(" {},{}", 12.0 * angle.sin(), 12.0 * (1.0 - angle.cos()))
        });
        let text = format!(
            "lane 1: -80,0 0,0 next 2,3\nlane 2: 0,0 80,0\nlane 3:{} 12,60\nego vehicle 0: -80,0",
            turn.collect::<String>()
        );
        let map = fixture::scenario(&text).unwrap().map;
        MapGraph::new(map.parts().clone()).unwrap()
    }

    fn car(x: f64, y: f64, speed: f64) -> Shown {
        let body = Body {
            kind: AgentKind::Vehicle,
            length: 4.5,
            width: 2.0,
            sized: true,
        };
        Shown::first(body, Pose::new(x, y, 0.0), DVec2::new(speed, 0.0))
    }

    #[test]
    fn bends_limit_the_speed_on_the_way_that_is_meant() {
        let map = fork();
        let bound_for = |now: &Shown, lane: i64| {
            let who = |seed: u64| Traveller {
                pose: now.pose,
                speed: 6.0,
                seed: Seed(seed),
                remains: false,
            };
            let routes = (0..64).filter_map(|seed| Route::from_here(&map, who(seed)));
            let mut routes = routes.filter(|route| route.lanes().contains(&LaneId(lane)));
            routes.next().unwrap()
        };
        let now = car(-20.0, 0.0, 12.0);
        let speed = |lane: i64| speed_for_bends(&map, &now, Some(&bound_for(&now, lane)));
        // The root of 5 m/s² · 12 m in the bend, and 4 m/s² over the 20 m before it, give or take a step.
        let braked = |metres: f64| (60.0 + 8.0 * metres).sqrt();
        assert!(
            (braked(16.0)..=braked(24.5)).contains(&speed(3)),
            "{}",
            speed(3)
        );
        assert!(speed(2).is_infinite());
        // Without a route any way may be meant; slow vehicles and those on no lane are left alone.
        assert!(speed_for_bends(&map, &now, None).is_infinite());
        let slow = car(-2.0, 0.0, 2.0);
        assert!(speed_for_bends(&map, &slow, Some(&bound_for(&slow, 3))).is_infinite());
        assert!(speed_for_bends(&map, &car(-20.0, 5.0, 12.0), None).is_infinite());
    }

    #[test]
    fn who_is_off_its_route_may_take_any_way() {
        let map = fork();
        let start = car(-20.0, 0.0, 12.0);
        let who = |seed: u64| Traveller {
            pose: start.pose,
            speed: 6.0,
            seed: Seed(seed),
            remains: false,
        };
        let routes = (0..64).filter_map(|seed| Route::from_here(&map, who(seed)));
        let mut turns = routes.filter(|route| route.lanes().contains(&LaneId(3)));
        let route = turns.next().unwrap();
        let on = car(40.0, 0.0, 12.0);
        assert!(speed_for_bends(&map, &on, Some(&route)).is_infinite());
    }
}
