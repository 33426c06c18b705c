//! Lanes inside intersections.
//!
//! A lane is inside one if its centre line crosses that of another lane at the same level, or if it
//! forks from or joins with a lane that is: a right turn crosses nothing, but shares its start with
//! the straight lane. Forks and merges alone are no intersections; freeways have them.

use std::collections::BTreeMap;

use gump_geometry::{DVec2, simplify};
use gump_scene::{Lane, LaneId};

use crate::ReadReport;

/// Tolerance of simplified centre lines, metres; a tenth of the narrowest lane.
const TOLERANCE: f64 = 0.15;
/// Lines that meet at less than this angle (sine of 15 degrees) run together rather than cross.
/// Chosen by hand.
const MIN_SINE: f64 = 0.26;
/// Roads further apart than this in height pass over each other; a vehicle with a load must fit
/// between them, so real overpasses leave more.
const MAX_STEP: f64 = 2.5;

struct Shape {
    points: Vec<(DVec2, f64)>,
    min: DVec2,
    max: DVec2,
}

/// Marks lanes as `in_intersection`, in addition to those that are already.
pub(super) fn infer(lanes: &mut [Lane], report: &mut ReadReport) {
    let shapes: Vec<Shape> = lanes.iter().map(Shape::of).collect();
    let mut crossing = vec![false; lanes.len()];
    for i in 0..lanes.len() {
        for j in i + 1..lanes.len() {
            let candidates = !(crossing[i] && crossing[j]) && shapes[i].may_touch(&shapes[j]);
            if candidates && !related(&lanes[i], &lanes[j]) && shapes[i].crosses(&shapes[j]) {
                crossing[i] = true;
                crossing[j] = true;
            }
        }
    }
    let by_id: BTreeMap<LaneId, usize> = lanes.iter().zip(0..).map(|(l, i)| (l.id, i)).collect();
    let mut inside = crossing.clone();
    for (i, lane) in lanes.iter().enumerate().filter(|(i, _)| crossing[*i]) {
        let index = |id: &LaneId| by_id.get(id).map(|&k| &lanes[k]);
        let forks = lane.predecessors.iter().filter_map(index);
        let joins = lane.successors.iter().filter_map(index);
        let siblings = forks
            .flat_map(|before| &before.successors)
            .chain(joins.flat_map(|after| &after.predecessors));
        for sibling in siblings.filter_map(|id| by_id.get(id)) {
            inside[*sibling] = true;
        }
        inside[i] = true;
    }
    let mut added = 0;
    for (lane, inside) in lanes.iter_mut().zip(inside) {
        added += usize::from(inside && !lane.in_intersection);
        lane.in_intersection |= inside;
    }
    report.infer("lane inside an intersection", added);
}

/// Lanes that touch by construction: one leads to the other, or they share an end.
fn related(a: &Lane, b: &Lane) -> bool {
    let shares = |a: &[LaneId], b: &[LaneId]| a.iter().any(|id| b.contains(id));
    a.successors.contains(&b.id)
        || b.successors.contains(&a.id)
        || shares(&a.successors, &b.successors)
        || shares(&a.predecessors, &b.predecessors)
}

impl Shape {
    fn of(lane: &Lane) -> Self {
        let all = lane.centerline.points();
        let kept = simplify(all, TOLERANCE);
        let points: Vec<_> = kept.iter().map(|&i| (all[i], lane.elevation[i])).collect();
        let fold =
            |start, f: fn(DVec2, DVec2) -> DVec2| points.iter().fold(start, |m, p| f(m, p.0));
        Self {
            min: fold(DVec2::INFINITY, DVec2::min),
            max: fold(DVec2::NEG_INFINITY, DVec2::max),
            points,
        }
    }

    fn may_touch(&self, other: &Self) -> bool {
        self.min.cmple(other.max).all() && other.min.cmple(self.max).all()
    }

    fn crosses(&self, other: &Self) -> bool {
        self.points.windows(2).any(|a| {
            let (low, high) = (a[0].0.min(a[1].0), a[0].0.max(a[1].0));
            low.cmple(other.max).all()
                && high.cmpge(other.min).all()
                && other.points.windows(2).any(|b| segments_cross(a, b))
        })
    }
}

/// True if the segments cross inside both, at an angle and at one level.
fn segments_cross(a: &[(DVec2, f64)], b: &[(DVec2, f64)]) -> bool {
    let (along_a, along_b) = (a[1].0 - a[0].0, b[1].0 - b[0].0);
    let determinant = along_a.perp_dot(along_b);
    if determinant.abs() <= MIN_SINE * along_a.length() * along_b.length() {
        return false;
    }
    let between = b[0].0 - a[0].0;
    let s = between.perp_dot(along_b) / determinant;
    let t = between.perp_dot(along_a) / determinant;
    if !(0.0..1.0).contains(&s) || !(0.0..1.0).contains(&t) {
        return false;
    }
    let height = |p: &[(DVec2, f64)], t: f64| p[0].1 + t * (p[1].1 - p[0].1);
    (height(a, s) - height(b, t)).abs() < MAX_STEP
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The ids of the lanes found inside an intersection; each lane is lifted to `height(id)`.
    fn check(text: &str, height: fn(i64) -> f64, expected: &[i64]) {
        let scenario = gump_scene::fixture::scenario(text).unwrap();
        let mut lanes = scenario.map.lanes().to_vec();
        for lane in &mut lanes {
            let z = height(lane.id.0);
            lane.elevation.iter_mut().for_each(|e| *e = z);
        }
        let mut report = ReadReport::default();
        infer(&mut lanes, &mut report);
        let inside = lanes.iter().filter(|l| l.in_intersection);
        assert_eq!(inside.map(|l| l.id.0).collect::<Vec<_>>(), expected);
        assert_eq!(
            report.inferred.get("lane inside an intersection").copied(),
            (!expected.is_empty()).then_some(expected.len())
        );
    }

    const CROSS: &str = "
        lane 1: -50,0 -10,0 next 2,3
        lane 2: -10,0 10,0 next 4
        lane 3: -10,0 -4,-2 -2,-10
        lane 4: 10,0 50,0
        lane 5: 0,-10 0,10
        ego vehicle 0: -20,0 velocity 5,0";

    #[test]
    fn crossing_lanes_and_their_forks_are_inside() {
        check(CROSS, |_| 0.0, &[2, 3, 5]);
    }

    #[test]
    fn an_overpass_is_no_intersection() {
        check(CROSS, |id| if id == 5 { 6.0 } else { 0.0 }, &[]);
    }

    #[test]
    fn a_fork_alone_is_no_intersection() {
        let text = "
            lane 1: -50,0 0,0 next 2,3
            lane 2: 0,0 50,0
            lane 3: 0,0 50,-8
            ego vehicle 0: -20,0 velocity 5,0";
        check(text, |_| 0.0, &[]);
    }
}
