//! Lanes that a stop sign applies to, where a format states only its position.
//!
//! In Waymo's maps, which state them, these are lanes of an intersection that begin abeam of the
//! sign, where vehicles stop; the sign stands on either side of them.

use gump_geometry::{Pose, angle_difference};
use gump_scene::{Lane, MapParts};

use crate::ReadReport;

// Chosen by hand; the test below counts how many of the lanes that signs of Waymo's maps state are
// found.
/// A ruled lane begins at most so far before or behind the sign, metres.
const MAX_ALONG: f64 = 3.0;
/// And at most so far to a side.
const MAX_ASIDE: f64 = 8.0;
/// Lanes that begin this near to the nearest one wait at the same line, metres: two lanes beside it.
const SAME_LINE: f64 = 8.0;
/// And in its direction to within this angle, radians: those that turn begin as those that do not.
const SAME_WAY: f64 = 0.6;

/// Gives signs their lanes if none of them has any.
pub(super) fn infer(parts: &mut MapParts, report: &mut ReadReport) {
    if parts.stop_signs.iter().any(|sign| !sign.lanes.is_empty()) {
        return;
    }
    let starts: Vec<(&Lane, Pose)> = parts
        .lanes
        .iter()
        .filter(|lane| lane.in_intersection && lane.centerline.length() > 0.0)
        .map(|lane| (lane, lane.centerline.pose_at(0.0)))
        .collect();
    for sign in &mut parts.stop_signs {
        let at = sign.position.truncate();
        let abeam = starts.iter().filter(|(_, start)| {
            let local = start.inverse() * at;
            local.x.abs() <= MAX_ALONG && local.y.abs() <= MAX_ASIDE
        });
        let abeam: Vec<_> = abeam.collect();
        let away = |start: &Pose| start.position.distance(at);
        let nearest = abeam
            .iter()
            .min_by(|a, b| away(&a.1).total_cmp(&away(&b.1)));
        let Some((_, nearest)) = nearest else {
            continue;
        };
        let with_it = |start: &Pose| {
            start.position.distance(nearest.position) <= SAME_LINE
                && angle_difference(start.heading, nearest.heading).abs() <= SAME_WAY
        };
        sign.lanes = abeam
            .iter()
            .filter(|(_, start)| with_it(start))
            .map(|(lane, _)| lane.id)
            .collect();
        report.infer("lane of a stop sign from its place", sign.lanes.len());
    }
}

#[cfg(test)]
#[path = "../../../../../tests/shared.rs"]
mod shared_data;

#[cfg(test)]
mod tests {
    use super::{shared_data, *};
    use gump_geometry::dvec3;
    use gump_scene::{LaneId, StopSign};

    fn sign(x: f64, y: f64) -> StopSign {
        StopSign {
            id: 90,
            position: dvec3(x, y, 2.0),
            lanes: Vec::new(),
        }
    }

    /// The lanes of signs at these places.
    fn ruled(parts: &mut MapParts, places: &[(f64, f64)]) -> Vec<Vec<i64>> {
        parts.stop_signs = places.iter().map(|(x, y)| sign(*x, *y)).collect();
        infer(parts, &mut ReadReport::default());
        let ids = |sign: &StopSign| sign.lanes.iter().map(|id| id.0).collect();
        parts.stop_signs.iter().map(ids).collect()
    }

    #[test]
    fn lanes_of_the_intersection_that_begin_abeam_are_ruled() {
        // Two lanes into a junction, 2 and 3 on through it, 4 the way out of the other direction.
        let scenario = gump_scene::fixture::scenario(
            "lane 1: -50,0 0,0 next 2,3
             lane 2: 0,0 20,0
             lane 3: 0,0 10,0 14,-8
             lane 4: 0,4 -50,4
             lane 5: 20,4 0,4 next 4
             ego vehicle 0: -20,0 velocity 5,0",
        )
        .unwrap();
        let mut parts = scenario.map.parts().clone();
        for lane in &mut parts.lanes {
            lane.in_intersection = [2, 3, 5].contains(&lane.id.0);
        }
        let found = ruled(&mut parts, &[(0.5, -3.0), (20.0, 7.0), (-30.0, -3.0)]);
        assert_eq!(found, [vec![2, 3], vec![5], vec![]]);
        // Where a sign states its lanes, the others rule none.
        parts.stop_signs = vec![sign(0.5, -3.0), sign(20.0, 7.0)];
        parts.stop_signs[1].lanes = vec![LaneId(5)];
        infer(&mut parts, &mut ReadReport::default());
        assert!(parts.stop_signs[0].lanes.is_empty());
    }

    /// On Waymo's maps most of the lanes that signs state are found, and hardly any other.
    #[test]
    fn stated_lanes_are_found_from_the_places_of_signs() {
        let Some(folder) = shared_data::shared("data/waymo") else {
            return;
        };
        let reader = crate::open(&folder).expect("the recorded scenes can be opened");
        let (mut stated, mut found, mut both) = (0, 0, 0);
        for scenario in reader {
            let map = scenario
                .expect("the recorded scenes can be read")
                .scenario
                .map;
            let mut parts = map.parts().clone();
            let truth: Vec<Vec<LaneId>> = parts
                .stop_signs
                .iter_mut()
                .map(|sign| std::mem::take(&mut sign.lanes))
                .collect();
            infer(&mut parts, &mut ReadReport::default());
            for (sign, truth) in parts.stop_signs.iter().zip(truth) {
                // Signs without lanes rule some that are beyond the map.
                if truth.is_empty() {
                    continue;
                }
                stated += truth.len();
                found += sign.lanes.len();
                both += sign.lanes.iter().filter(|id| truth.contains(id)).count();
            }
        }
        println!("{stated} lanes are stated, {found} found, {both} of them rightly");
        assert!(3 * both >= 2 * stated.min(found) && stated > 0);
    }
}
