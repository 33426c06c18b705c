//! Speeds at which vehicles can take the bends ahead, and stop for what stops them.

use gump_geometry::{DVec2, angle_difference};

use crate::{Lane, MapGraph};

/// Distance of the points between which the way turns, metres: a turn at a junction has three or
/// more of them, and the noise of a recorded centre line is small beside it. Chosen by hand.
const STEP_M: f64 = 4.0;
/// Less is the rounding of a straight line, radians.
const STRAIGHT: f64 = 1e-6;
/// Maximum number of lanes in a row: short ones may form a circle.
const LANES: usize = 10;

/// What a driver accepts on the way to a bend and in it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BendLimits {
    /// Lateral acceleration, metres per second squared.
    pub lateral_mps2: f64,
    /// Deceleration before the bend, metres per second squared.
    pub braking_mps2: f64,
    /// Distance that is looked ahead, metres.
    pub ahead_m: f64,
}

/// The greatest speed of a vehicle on `lane`, `arc_m` metres from its start, from which it can take
/// the bends of some way ahead, metres per second; infinite where a way is straight, or ends.
///
/// In a bend of radius `r` the speed is at most the root of `lateral_mps2 · r`, and before it what
/// `braking_mps2` reduces to that. Where lanes fork, the way that allows the greatest speed counts.
///
/// ```
/// use gump_scene::{BendLimits, LaneId, bend_speed, fixture};
///
/// // A right angle counts as a bend of a few metres: points are 4 m apart.
/// let scenario = fixture::scenario("lane 1: 0,0 50,0 50,-50\nego vehicle 0: 0,0").unwrap();
/// let lane = scenario.map.lane(LaneId(1)).unwrap();
/// let limits = BendLimits { lateral_mps2: 3.0, braking_mps2: 2.0, ahead_m: 60.0 };
/// let speed = |at: f64| bend_speed(&scenario.map, lane, at, limits);
/// assert!(speed(40.0) < 8.0 && speed(4.0) > 12.0);
/// assert!(speed(60.0).is_infinite());
/// ```
pub fn bend_speed(map: &MapGraph, lane: &Lane, arc_m: f64, limits: BendLimits) -> f64 {
    approach_speed(map, lane, arc_m, limits, &|_, _| f64::INFINITY)
}

/// As [`bend_speed`], for ways on which some lanes limit the speed too.
///
/// `entering` gets a lane that a way leads into and the distance to its start, metres, and returns the
/// greatest speed that the vehicle may have now, metres per second; infinite for a lane that is open.
pub fn approach_speed(
    map: &MapGraph,
    lane: &Lane,
    arc_m: f64,
    limits: BendLimits,
    entering: &dyn Fn(&Lane, f64) -> f64,
) -> f64 {
    let start = lane.centerline.pose_at(arc_m);
    let way = Way {
        from: start.position,
        heading: start.heading,
        turns_over_m: STEP_M / 2.0,
        driven_m: 0.0,
    };
    let rules = Rules {
        map,
        limits,
        entering,
    };
    rules.walk(lane, arc_m + STEP_M, way, LANES)
}

/// The way up to its last point.
#[derive(Clone, Copy)]
struct Way {
    from: DVec2,
    /// Direction in which it came there, radians.
    heading: f64,
    /// Distance over which the next step turns, metres: a step's direction is that at its middle.
    turns_over_m: f64,
    /// Its length, metres.
    driven_m: f64,
}

/// What limits the speed.
struct Rules<'a> {
    map: &'a MapGraph,
    limits: BendLimits,
    entering: &'a dyn Fn(&Lane, f64) -> f64,
}

impl Rules<'_> {
    /// The speed for what is beyond the end of `way`, whose next point is `at` metres along `lane`.
    fn walk(&self, lane: &Lane, mut at: f64, mut way: Way, left: usize) -> f64 {
        let limits = self.limits;
        let mut least = f64::INFINITY;
        let length = lane.centerline.length();
        while at <= length {
            if way.driven_m > limits.ahead_m {
                return least;
            }
            let point = lane.centerline.pose_at(at).position;
            let heading = (point - way.from).to_angle();
            let turn = angle_difference(heading, way.heading).abs();
            if turn > STRAIGHT {
                let squared = limits.lateral_mps2 * way.turns_over_m / turn;
                least = least.min((squared + 2.0 * limits.braking_mps2 * way.driven_m).sqrt());
            }
            way = Way {
                from: point,
                heading,
                turns_over_m: STEP_M,
                driven_m: way.driven_m + STEP_M,
            };
            at += STEP_M;
        }
        let end_m = way.driven_m + length - (at - STEP_M);
        let next = self.map.successors(lane.id).filter(|_| left > 0);
        let best = next
            .map(|next| {
                let beyond = self.walk(next, at - length, way, left - 1);
                beyond.min((self.entering)(next, end_m))
            })
            .reduce(f64::max);
        best.map_or(least, |best| least.min(best))
    }
}

#[cfg(test)]
mod tests {
    use crate::{LaneId, fixture};

    use super::*;

    const LIMITS: BendLimits = BendLimits {
        lateral_mps2: 4.0,
        braking_mps2: 2.0,
        ahead_m: 60.0,
    };

    fn speed(map: &str, at: f64) -> f64 {
        let scenario = fixture::scenario(&format!("{map}\nego vehicle 0: 0,0")).unwrap();
        let lane = scenario.map.lane(LaneId(1)).unwrap();
        bend_speed(&scenario.map, lane, at, LIMITS)
    }

    /// Points of a circle of radius `r` to the left after 40 m straight on.
    fn circle(r: f64) -> String {
        let points = (0..=40).map(|i| {
            let angle = f64::from(i) / 40.0 * 1.5;
            format!(" {},{}", 40.0 + r * angle.sin(), r * (1.0 - angle.cos()))
        });
        format!("lane 1: 0,0{}", points.collect::<String>())
    }

    #[test]
    fn a_circle_has_its_speed() {
        for r in [12.0, 30.0] {
            let inside = speed(&circle(r), 44.0);
            let expected = (4.0 * r).sqrt();
            assert!((inside / expected - 1.0).abs() < 0.05, "{inside} for {r} m");
            // 32 m before it, give or take a step.
            let before = speed(&circle(r), 8.0);
            let braked = |metres: f64| (4.0 * r + 4.0 * metres).sqrt();
            assert!((braked(28.0)..=braked(36.5)).contains(&before), "{before}");
        }
    }

    #[test]
    fn the_straighter_of_two_ways_counts() {
        let fork = "lane 1: 0,0 30,0 next 2,3\nlane 2: 30,0 80,0\nlane 3: 30,0 30,-40";
        assert!(speed(fork, 10.0) > 100.0);
        let turns = "lane 1: 0,0 30,0 next 2,3\nlane 2: 30,0 30,40\nlane 3: 30,0 30,-40";
        assert!(speed(turns, 10.0) < 10.0);
    }

    #[test]
    fn a_closed_lane_counts_at_its_start_unless_another_is_open() {
        let fork = "lane 1: 0,0 30,0 next 2,3\nlane 2: 30,0 80,0\nlane 3: 30,0 80,0.5";
        let scenario = fixture::scenario(&format!("{fork}\nego vehicle 0: 0,0")).unwrap();
        let map = &scenario.map;
        let lane = map.lane(LaneId(1)).unwrap();
        let speed = |closed: &[i64]| {
            let entering = |lane: &Lane, metres: f64| match closed.contains(&lane.id.0) {
                true => metres,
                false => f64::INFINITY,
            };
            approach_speed(map, lane, 13.0, LIMITS, &entering)
        };
        assert!((speed(&[2, 3]) - 17.0).abs() < 1e-9, "{}", speed(&[2, 3]));
        assert!(speed(&[2]) > 20.0 && speed(&[3]) > 100.0);
    }

    #[test]
    fn lanes_in_a_circle_end_the_search() {
        // Half a turn at each end; and lanes too short for a point on each of them.
        assert!(speed("lane 1: 0,0 10,0 next 2\nlane 2: 10,0 0,0 next 1", 0.0) < 10.0);
        assert!(speed("lane 1: 0,0 1,0 next 2\nlane 2: 1,0 0,0 next 1", 0.0) > 0.0);
    }
}
