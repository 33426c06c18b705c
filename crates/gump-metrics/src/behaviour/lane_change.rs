//! Changes to an adjacent lane.

use std::f64::consts::FRAC_PI_6;

use gump_geometry::Pose;
use gump_scene::{Lane, MapGraph};

use super::reach::{along, nearest};
use super::track::Track;
use super::{Class, Counter, Measure, vehicles};

/// Interval at which the lane of a vehicle is determined, seconds: a change takes several. Chosen
/// by hand, as what follows.
const LOOK_S: f64 = 0.5;
/// Number of intervals for which a lane must be held before and after the change: a second.
const HELD: usize = 2;
/// A vehicle stays on its lane until it is this many lane widths beside the centre line: beyond the
/// border at 0.5, so that one on the line does not go back and forth.
const KEEP: f64 = 0.6;
/// Distance of adjacent lanes, metres: from narrow ones to wide ones with a strip between.
const BESIDE_M: std::ops::RangeInclusive<f64> = 2.0..=6.0;
/// A vehicle that moves less than this does not change lanes, metres.
const SHORT_M: f64 = 5.0;

impl Counter<'_> {
    /// Minutes of moving are added where stops are counted.
    pub(super) fn lane_changes(&mut self) {
        if self.map.lanes().is_empty() {
            return;
        }
        for track in vehicles(self.tracks) {
            let span = track.bounds();
            if span.is_none_or(|(low, high)| low.distance(high) < SHORT_M) {
                continue;
            }
            for k in self.changes_of(track) {
                self.add(Measure::LaneChange, Class::Vehicle, 1.0, 0.0);
                self.note(Measure::LaneChange, track.id, None, k);
            }
        }
    }

    fn changes_of(&self, track: &Track) -> Vec<usize> {
        let stride = self.take.steps(LOOK_S);
        let first = self.take.now % stride;
        // The lane, for how many looks, and at which frame it was changed to, if it was.
        let mut on: Option<(&Lane, usize, Option<usize>)> = None;
        let mut changes = Vec::new();
        for k in (first..self.take.frames.len()).step_by(stride) {
            let Some(pose) = track.pose(k) else {
                continue;
            };
            let kept = on.and_then(|(lane, ..)| follow(self.map, lane, pose));
            on = match (on, kept) {
                (Some((_, held, changed)), Some(lane)) => {
                    let held = held + 1;
                    let is_change = held == HELD && changed.is_some_and(|k| k > self.take.now);
                    changes.extend(changed.filter(|_| is_change));
                    Some((lane, held, changed))
                }
                (before, _) => nearest_lane(self.map, pose).map(|lane| {
                    let from = before.filter(|(_, held, _)| *held >= HELD);
                    let changes =
                        from.is_some_and(|(from, ..)| is_beside(self.map, from, lane, pose));
                    (lane, 1, changes.then_some(k))
                }),
            };
        }
        changes
    }
}

fn nearest_lane(map: &MapGraph, pose: Pose) -> Option<&Lane> {
    let widest = 2.5;
    let (lane, at) = nearest(map, pose, widest, FRAC_PI_6)?;
    (at.distance <= lane.width / 2.0).then_some(lane)
}

/// The lane itself or one of its successors, whichever is nearest; `None` if the vehicle has left
/// all of them.
fn follow<'a>(map: &'a MapGraph, lane: &'a Lane, pose: Pose) -> Option<&'a Lane> {
    let near = onward(map, lane).filter_map(|lane| {
        let at = along(lane, pose, 1.5 * FRAC_PI_6)?;
        (at.distance <= KEEP * lane.width).then_some((lane, at.distance))
    });
    let nearest = near.min_by(|a, b| a.1.total_cmp(&b.1));
    nearest.map(|(lane, _)| lane)
}

/// A lane, its successors, and theirs.
fn onward<'a>(map: &'a MapGraph, lane: &'a Lane) -> impl Iterator<Item = &'a Lane> {
    let next = map.successors(lane.id);
    let after = map
        .successors(lane.id)
        .flat_map(|next| map.successors(next.id));
    std::iter::once(lane).chain(next).chain(after)
}

/// True if a vehicle that is on `to` now is beside the successors of `from`, so that it did not get
/// there by driving on.
fn is_beside(map: &MapGraph, from: &Lane, to: &Lane, pose: Pose) -> bool {
    if from.in_intersection || to.in_intersection {
        return false;
    }
    if onward(map, from).any(|lane| lane.id == to.id) {
        return false;
    }
    let parallel = onward(map, from).filter_map(|lane| {
        let at = along(lane, pose, FRAC_PI_6)?;
        // Past an end the distance is not that to a lane beside.
        let inside = 0.1..=lane.centerline.length() - 0.1;
        inside.contains(&at.arc_length).then_some(at.distance)
    });
    parallel
        .min_by(f64::total_cmp)
        .is_some_and(|distance| BESIDE_M.contains(&distance))
}
