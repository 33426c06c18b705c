//! Rejection of draws in which objects would overlap each other or leave the road.
//!
//! Objects of a frame are drawn independently, given surrogates of each other, so two of them may
//! choose the same place. An object that would overlap another within the next second and a half,
//! and a vehicle that would leave the road, are redrawn a few times at most, and the draw that
//! stays clear longest is kept. The whole path is checked, every tenth of a second, not only the
//! poses half a second apart: at 10 m/s those are a car's length apart, and crossing cars or thin
//! road edges would be missed. An object that is off the road may return or stay as far off as it
//! is. If no draw is clear, the object brakes if that helps. In full autoregression, objects give
//! way to those drawn before them. The paper has no such rule; without it, random draws cause
//! collisions that do not occur in logs.

#[cfg(test)]
mod tests;

use std::f64::consts::PI;

use gump_geometry::{OrientedBox, Pose, angle_difference};
use gump_model::local_context::{Edge, LaneMap, metres_across, metres_off};

/// Poses of a chunk that must be clear: 1.5 s, in which [`BRAKING`] stops a vehicle from 7.5 m/s.
/// Not varied.
pub(crate) const POSES: usize = 3;
/// Number of positions checked between two poses, including the second: every 0.1 s.
const PLACES: usize = 5;
/// A path, from 0.1 s on.
pub(crate) type Way = [Pose; POSES * PLACES];
/// An object over an edge by less than this is on the road, metres, and one that is off it counts
/// as farther off only beyond this: bins and maps are not more precise.
const SLACK_M: f64 = 0.05;
/// Objects whose headings differ by less go the same way, radians (30 degrees).
const ALONGSIDE: f64 = 0.52;
/// One comes by another if it heads within this angle of the opposite way, radians, is this far before it
/// at most, and this far on its left at least, metres. Chosen by hand.
const OPPOSITE: f64 = 0.35;
const COMES_BY_M: f64 = 25.0;
const BY_M: f64 = 0.3;
/// Braking of a vehicle without a clear path, metres per second squared: firm, on a dry road. Not
/// tuned.
pub(crate) const BRAKING: f64 = 5.0;
/// The way through poses half a second apart; what comes from nowhere is at the first all along.
pub(crate) fn way(from: Option<Pose>, poses: [Pose; POSES]) -> Way {
    std::array::from_fn(|i| {
        let (to, step) = (i / PLACES, i % PLACES + 1);
        let from = match to {
            0 => from.unwrap_or(poses[0]),
            to => poses[to - 1],
        };
        from.interpolate(poses[to], step as f64 / PLACES as f64)
    })
}

/// Objects of a frame, with their paths.
#[derive(Default)]
pub(crate) struct Footprints {
    pub(crate) members: Vec<Member>,
}

/// An object with its path.
pub(crate) struct Member {
    length: f64,
    width: f64,
    pub(crate) before: Option<Pose>,
    /// Previous speed, metres per second.
    pub(crate) speed: f64,
    ahead: Way,
    /// The road edges in reach, which it must not cross; none for objects other than vehicles.
    edges: Vec<Edge>,
    /// Its previous distance off the road, metres.
    off: f64,
    /// Driven objects are where they are.
    pub(crate) is_driven: bool,
    /// Others do not keep clear of it.
    pub(crate) is_ignored: bool,
    /// Whether it is a pedestrian, which does not keep clear of other pedestrians: the boxes of
    /// people side by side overlap in recordings.
    pub(crate) walks: bool,
    reach: f64,
}

impl Member {
    /// An object of this length and width, metres, that moves at `speed`, metres per second, along
    /// `ahead`; driven objects cannot be redrawn.
    pub(crate) fn new(
        [length, width]: [f64; 2],
        before: Option<Pose>,
        speed: f64,
        ahead: Way,
        is_driven: bool,
    ) -> Self {
        Self {
            length,
            width,
            before,
            speed,
            ahead,
            edges: Vec::new(),
            off: 0.0,
            is_driven,
            is_ignored: false,
            walks: false,
            reach: length.hypot(width) / 2.0,
        }
    }

    fn at(&self, pose: Pose) -> OrientedBox {
        OrientedBox {
            pose,
            length: self.length,
            width: self.width,
        }
    }

    /// Number of positions before the object leaves the road, or is farther off it than before.
    fn places_on_road(&self, ahead: &Way) -> usize {
        if self.edges.is_empty() || self.stays(ahead) {
            return ahead.len();
        }
        let mut most = self.off;
        let leaves = |pose: &Pose| {
            let body = self.at(*pose);
            let off = match most > SLACK_M {
                true => metres_off(&body, self.reach, &self.edges),
                false => metres_across(&body, self.reach, &self.edges),
            };
            let leaves = off > most + SLACK_M;
            most = most.min(off);
            leaves
        };
        ahead.iter().position(leaves).unwrap_or(ahead.len())
    }

    /// True if a path leads nowhere.
    fn stays(&self, ahead: &Way) -> bool {
        let near = |pose: &Pose, before: Pose| {
            pose.position.distance(before.position) < SLACK_M / 2.0
                && angle_difference(pose.heading, before.heading).abs() < SLACK_M / 2.0
        };
        let stands = |before: Pose| ahead.iter().all(|pose| near(pose, before));
        self.before.is_some_and(stands)
    }

    /// Sets the road edges that it might cross on its path, and its distance off the road.
    pub(crate) fn look_for_edges(&mut self, lane_map: &LaneMap) {
        let Some(before) = self.before else {
            return;
        };
        // As far as its path, or its speed in the same 1.5 s, takes it, and a metre to spare.
        let radius = self.reach + (self.moves() + 1.0).max(self.speed * 1.5);
        let near = lane_map.edges_near(before.position, radius);
        self.edges = near
            .filter(|edge| edge.from.distance(before.position) <= radius)
            .collect();
        self.off = metres_off(&self.at(before), self.reach, &self.edges);
    }

    fn moves(&self) -> f64 {
        let before = self.before.map_or(self.ahead[0].position, |p| p.position);
        self.ahead[self.ahead.len() - 1].position.distance(before)
    }
}

impl Footprints {
    /// These objects.
    pub(crate) fn new(members: Vec<Member>) -> Self {
        Self { members }
    }

    /// The objects from `first` on to be redrawn: those that leave the road, and of two that
    /// conflict the one that moves more, unless only the other may be redrawn.
    pub(crate) fn unclear(&self, first: usize) -> Vec<usize> {
        let leaves = |member: &Member| member.places_on_road(&member.ahead) < member.ahead.len();
        let mut unclear: Vec<bool> = self.members.iter().map(leaves).collect();
        for (i, a) in self.members.iter().enumerate() {
            for (j, b) in self.members.iter().enumerate().skip(first.max(i + 1)) {
                if a.is_ignored || b.is_ignored || clear_places(a, &a.ahead, b) == a.ahead.len() {
                    continue;
                }
                let a_gives_way =
                    i >= first && (b.is_driven || (!a.is_driven && a.moves() > b.moves()));
                unclear[if a_gives_way { i } else { j }] = true;
            }
        }
        let driven = |i: &usize| self.members[*i].is_driven;
        (first..unclear.len())
            .filter(|i| unclear[*i] && !driven(i))
            .collect()
    }

    /// True if the path of an object leaves the road.
    pub(crate) fn leaves_road(&self, i: usize) -> bool {
        let member = &self.members[i];
        member.places_on_road(&member.ahead) < member.ahead.len()
    }

    /// Whether an object conflicts with another one.
    pub(crate) fn meets_another(&self, i: usize) -> bool {
        let mut others = self.others(i);
        others.any(|other| self.conflict(i, other))
    }

    /// Whether an object conflicts with one beside it that goes the same way, or one that is about to come
    /// by on its left.
    pub(crate) fn is_pressed(&self, i: usize) -> bool {
        let member = &self.members[i];
        let beside = |other: &&Member| is_beside(member, other) || comes_by(member, other);
        let mut beside = self.others(i).filter(beside);
        !member.is_driven && beside.any(|other| self.conflict(i, other))
    }

    /// Those that an object keeps clear of.
    fn others(&self, i: usize) -> impl Iterator<Item = &Member> {
        let others = self.members.iter().enumerate();
        let others = others.filter(move |(j, other)| *j != i && !other.is_ignored);
        others.map(|(_, other)| other)
    }

    fn conflict(&self, i: usize, other: &Member) -> bool {
        let member = &self.members[i];
        clear_places(member, &member.ahead, other) < member.ahead.len()
    }

    /// Accepts a draw of an object if it stays clear of all others, and on the road, longer than
    /// the present one.
    pub(crate) fn improve(&mut self, i: usize, ahead: &Way) -> bool {
        let member = &self.members[i];
        let clear = |ahead: &Way| {
            let clear = self
                .others(i)
                .map(|other| clear_places(member, ahead, other));
            let on_road = member.places_on_road(ahead);
            clear.fold(on_road, usize::min)
        };
        let better = clear(ahead) > clear(&member.ahead);
        if better {
            self.members[i].ahead = *ahead;
        }
        better
    }
}

/// Whether two objects were side by side, at least in part, and headed the same way.
fn is_beside(a: &Member, b: &Member) -> bool {
    let Some((p, q)) = a.before.zip(b.before) else {
        return false;
    };
    let away = p.inverse() * q.position;
    angle_difference(p.heading, q.heading).abs() < ALONGSIDE
        && away.x.abs() < (a.length + b.length) / 2.0
        && !(a.walks || b.walks)
}

/// Whether the second of two objects is about to come by the first one, on whose left it is.
fn comes_by(a: &Member, b: &Member) -> bool {
    let Some((p, q)) = a.before.zip(b.before) else {
        return false;
    };
    let away = p.inverse() * q.position;
    let turn = angle_difference(p.heading, q.heading).abs();
    turn > PI - OPPOSITE
        && (0.0..COMES_BY_M).contains(&away.x)
        && away.y > BY_M
        && !(a.walks || b.walks)
}

/// Number of positions before two objects, the first of them on its path `ahead`, overlap; all of
/// them for a pair that already overlaps, since no draw can undo that.
fn clear_places(a: &Member, ahead: &Way, b: &Member) -> usize {
    if a.walks && b.walks {
        return ahead.len();
    }
    let reach = a.reach + b.reach;
    let meets = |(p, q): (&Pose, &Pose)| {
        p.position.distance_squared(q.position) < reach * reach && a.at(*p).overlaps(&b.at(*q))
    };
    let first = ahead.iter().zip(&b.ahead).position(meets);
    match (first, a.before.zip(b.before)) {
        (None, _) => ahead.len(),
        (Some(_), Some((p, q))) if a.at(p).overlaps(&b.at(q)) => ahead.len(),
        (Some(first), _) => first,
    }
}
