//! The lanes that a vehicle may reach, and where on them things are.

use gump_geometry::DVec2;

use crate::{Lane, Light, MapGraph, stop_line};

/// A lane that a vehicle may reach.
#[derive(Clone, Copy, Debug)]
pub struct LaneAhead<'a> {
    /// The lane.
    pub lane: &'a Lane,
    /// Metres from the vehicle to the start of the lane, below 0 for the lane it is on.
    pub base_m: f64,
}

/// The place of a point on a lane that a vehicle may reach.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PointAhead {
    /// Metres along the path from the vehicle to the point, below 0 behind it.
    pub ahead_m: f64,
    /// Metres from the lane's centre to the point.
    pub beside_m: f64,
}

impl LaneAhead<'_> {
    /// The place of a point, world frame.
    pub fn locate(&self, point: DVec2) -> PointAhead {
        let foot = self.lane.centerline.project(point);
        PointAhead {
            ahead_m: self.base_m + foot.arc_length,
            beside_m: foot.distance,
        }
    }

    /// Metres from the vehicle to the stop line of a light of the lane.
    pub fn metres_to_stop_line(&self, light: &Light) -> f64 {
        self.locate(stop_line(self.lane, light).position).ahead_m
    }
}

/// The lane of a vehicle, `arc_m` metres from its start, all its successors within `metres`, and
/// whether any of them reaches that far.
pub fn lanes_ahead<'a>(
    map: &'a MapGraph,
    lane: &'a Lane,
    arc_m: f64,
    metres: f64,
) -> (Vec<LaneAhead<'a>>, bool) {
    let mut reached = vec![LaneAhead {
        lane,
        base_m: -arc_m,
    }];
    let (mut i, mut goes_on) = (0, false);
    while let Some(LaneAhead { lane, base_m }) = reached.get(i) {
        let (id, end_m) = (lane.id, base_m + lane.centerline.length());
        i += 1;
        if end_m >= metres {
            goes_on = true;
            continue;
        }
        for next in map.successors(id) {
            if reached.iter().all(|known| known.lane.id != next.id) {
                reached.push(LaneAhead {
                    lane: next,
                    base_m: end_m,
                });
            }
        }
    }
    (reached, goes_on)
}

#[cfg(test)]
mod tests {
    use crate::{LaneId, fixture};

    use super::*;

    #[test]
    fn every_branch_within_reach_is_found_once() {
        let scenario = fixture::scenario(
            "lane 1: 0,0 30,0 next 2,3\nlane 2: 30,0 60,0\nlane 3: 30,0 40,20 next 2\n\
             ego vehicle 0: 20,0",
        )
        .unwrap();
        let lane = scenario.map.lane(LaneId(1)).unwrap();
        let ids = |metres: f64| {
            let (reached, goes_on) = lanes_ahead(&scenario.map, lane, 20.0, metres);
            let ids: Vec<i64> = reached.iter().map(|part| part.lane.id.0).collect();
            (ids, reached[0].base_m, goes_on)
        };
        assert_eq!(ids(5.0), (vec![1], -20.0, true));
        assert_eq!(ids(15.0), (vec![1, 2, 3], -20.0, true));
        assert_eq!(ids(200.0), (vec![1, 2, 3], -20.0, false));
    }

    #[test]
    fn points_and_stop_lines_are_measured_from_the_vehicle() {
        let scenario = fixture::scenario(
            "lane 1: 0,0 30,0 next 2\nlane 2: 30,0 60,0\nlight 2 red: 50,0\nego vehicle 0: 20,0",
        )
        .unwrap();
        let lane = scenario.map.lane(LaneId(1)).unwrap();
        let (reached, _) = lanes_ahead(&scenario.map, lane, 20.0, 25.0);
        let [own, next] = reached[..] else {
            panic!("{reached:?}");
        };
        let place = |ahead_m, beside_m| PointAhead { ahead_m, beside_m };
        assert_eq!(own.locate(DVec2::new(15.0, 2.0)), place(-5.0, 2.0));
        assert_eq!(next.locate(DVec2::new(45.0, -3.0)), place(25.0, 3.0));
        let lights = scenario.present().now().lights();
        assert_eq!(next.metres_to_stop_line(&lights[0]), 30.0);
    }
}
