//! Stop lines of lights, the paths of traffic past them, and whether two such paths cross.

use std::f64::consts::FRAC_PI_6;

use gump_geometry::{DVec2, Polyline, Pose, angle_difference, segments_intersect};

use crate::{Lane, Light, MapGraph};

/// Lanes that start, or end, so near to one another fork, or join, and do not cross, metres: less
/// than lanes beside each other are apart. Chosen by hand.
const FORK_M: f64 = 2.0;

/// The middle of the stop line of a light, heading along its lane.
///
/// The line lies at the light's stop point; without one, at the entry of a lane inside an
/// intersection and at the end of any other.
pub fn stop_line(lane: &Lane, light: &Light) -> Pose {
    let center = &lane.centerline;
    center.pose_at(match light.stop_point {
        Some(point) => center.project(point).arc_length,
        None if lane.in_intersection => 0.0,
        None => center.length(),
    })
}

/// The path of traffic that has passed the stop line of a lane: the rest of the lane, or, where the
/// line is at its end, the lanes that follow.
pub fn ways_beyond(map: &MapGraph, lane: &Lane, line: Pose) -> Vec<Polyline> {
    let centre = &lane.centerline;
    let from = centre.project(line.position).arc_length;
    if from < centre.length() - FORK_M {
        return vec![centre.slice(from, centre.length())];
    }
    let next = map.successors(lane.id);
    next.map(|lane| lane.centerline.clone()).collect()
}

/// True if two paths cross at more than 30 degrees; paths that fork or join do not cross.
pub fn ways_cross(one: &Polyline, other: &Polyline) -> bool {
    let ((a, b), (c, d)) = (ends(one), ends(other));
    if is_near(a, c) || is_near(b, d) {
        return false;
    }
    one.segments().any(|(a, b)| {
        other.segments().any(|(c, d)| {
            let angle = || angle_difference((b - a).to_angle(), (d - c).to_angle()).abs();
            segments_intersect(a, b, c, d) && angle() > FRAC_PI_6
        })
    })
}

/// True if two paths begin apart and end in the same place.
pub fn ways_join(one: &Polyline, other: &Polyline) -> bool {
    let ((a, b), (c, d)) = (ends(one), ends(other));
    !is_near(a, c) && is_near(b, d)
}

fn ends(line: &Polyline) -> (DVec2, DVec2) {
    let points = line.points();
    (points[0], points[points.len() - 1])
}

fn is_near(p: DVec2, q: DVec2) -> bool {
    p.distance(q) < FORK_M
}

#[cfg(test)]
mod tests {
    use gump_geometry::dvec2;

    use super::*;
    use crate::{LaneId, fixture};

    #[test]
    fn forks_and_joins_do_not_cross() {
        let line = |points: &[(f64, f64)]| {
            let points = points.iter().map(|&(x, y)| dvec2(x, y)).collect();
            Polyline::new(points).unwrap()
        };
        let east = line(&[(0.0, 0.0), (20.0, 0.0)]);
        let north = line(&[(10.0, -10.0), (10.0, 10.0)]);
        let fork = line(&[(0.0, 0.0), (8.0, 0.0), (10.0, 10.0)]);
        let join = line(&[(10.0, -10.0), (12.0, 0.0), (20.0, 0.0)]);
        assert!(ways_cross(&east, &north) && !ways_join(&east, &north));
        assert!(!ways_cross(&east, &fork) && !ways_join(&east, &fork));
        assert!(!ways_cross(&east, &join) && ways_join(&east, &join));
    }

    #[test]
    fn ways_go_on_from_the_line() {
        let scenario = fixture::scenario(
            "lane 1: 0,0 40,0 next 2,3
             lane 2: 40,0 60,0
             lane 3: 40,0 50,9
             light 1 red:
             ego vehicle 0: 0,0",
        )
        .unwrap();
        let lane = scenario.map.lane(LaneId(1)).unwrap();
        let light = scenario.present().now().lights()[0];
        let line = stop_line(lane, &light);
        assert_eq!(line.position, dvec2(40.0, 0.0));
        assert_eq!(ways_beyond(&scenario.map, lane, line).len(), 2);
        let early = Light {
            stop_point: Some(dvec2(30.0, 1.0)),
            ..light
        };
        let ways = ways_beyond(&scenario.map, lane, stop_line(lane, &early));
        assert!((ways[0].length() - 10.0).abs() < 1e-9 && ways.len() == 1);
    }
}
