//! New overlaps of boxes.

use gump_geometry::{DVec2, Pose};

use super::track::Track;
use super::{Class, Counter, Measure, STANDS};

/// Shallower overlaps do not count, metres: they are within tracker errors.
const DEEP_M: f64 = 0.1;

impl Counter<'_> {
    pub(super) fn overlaps(&mut self) {
        let tracks = self.tracks;
        let bounds: Vec<_> = tracks.iter().map(Track::bounds).collect();
        // Every class is compared with all agents, so that classes add up to all.
        for class in [
            Class::All,
            Class::Vehicle,
            Class::Pedestrian,
            Class::Bicycle,
        ] {
            self.add(Measure::NewOverlap, class, 0.0, tracks.len() as f64);
        }
        for (i, a) in tracks.iter().enumerate() {
            for (j, b) in tracks.iter().enumerate().skip(i + 1) {
                let reach = (a.length.hypot(a.width) + b.length.hypot(b.width)) / 2.0;
                let (Some(one), Some(other)) = (bounds[i], bounds[j]) else {
                    continue;
                };
                if is_apart(one, other, reach) {
                    continue;
                }
                if let Some(k) = self.new_overlap(a, b, reach) {
                    self.add(
                        Measure::NewOverlap,
                        Class::of_pair(a.kind, b.kind),
                        1.0,
                        0.0,
                    );
                    self.add(Measure::NewOverlap, Class::All, 1.0, 0.0);
                    self.blame(a, b, k);
                }
            }
        }
    }

    /// The agents at fault: those that moved, or both if both stood, as when boxes turn on the
    /// spot.
    fn blame(&mut self, a: &Track, b: &Track, k: usize) {
        let moved = |track: &Track| track.pace(k).is_none_or(|pace| pace >= STANDS);
        let both = moved(a) == moved(b);
        if both || moved(a) {
            self.note(Measure::NewOverlap, a.id, Some(b.id), k);
        }
        if both || moved(b) {
            self.note(Measure::NewOverlap, b.id, Some(a.id), k);
        }
    }

    /// The first frame after the present at which two agents overlap that do not in the present.
    fn new_overlap(&self, a: &Track, b: &Track, reach: f64) -> Option<usize> {
        let now = self.take.now;
        let at_present = a.oriented_box(now).zip(b.oriented_box(now));
        if at_present.is_some_and(|(a, b)| a.overlaps(&b)) {
            return None;
        }
        // Where neither has moved nothing has changed.
        let mut last: Option<(Pose, Pose)> = None;
        self.take.ahead().find(|&k| {
            let Some(poses) = a.poses[k].zip(b.poses[k]) else {
                return false;
            };
            let near = poses.0.position.distance_squared(poses.1.position) < reach * reach;
            if !near || last == Some(poses) {
                return false;
            }
            last = Some(poses);
            let boxes = a.oriented_box(k).zip(b.oriented_box(k));
            boxes.is_some_and(|(a, b)| a.overlaps(&b) && a.signed_distance(&b) < -DEEP_M)
        })
    }
}

/// True if the areas spanned by two tracks are farther apart than `reach`.
fn is_apart(one: (DVec2, DVec2), other: (DVec2, DVec2), reach: f64) -> bool {
    let gap = (other.0 - one.1).max(one.0 - other.1);
    gap.max_element() > reach
}
