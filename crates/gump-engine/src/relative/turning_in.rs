//! Vehicles that turn into driveways.

use gump_geometry::Pose;
use gump_model::relative::driveway::{Driveways, WayIn};
use gump_model::relative::graph::Shown;
use gump_model::steps::TOKEN_DT;
use gump_scene::{Agent, AgentKind, BendLimits, Lane, LaneId, MapGraph, Seed, bend_speed};

use crate::nucleus::uniform;
use crate::relative::approach::slowing_before;
use crate::relative::rules::steered;

// Chosen by hand, but for the shares, which are those of recorded scenes (decision 37).

/// Share of vehicles that turn in, of those that come to a way into a driveway and would be slower than
/// [`SLOW_MPS`] at the turn, metres per second, if they went on braking as they do, and of the others.
const TURN_IN: (f64, f64) = (0.08, 0.004);
const SLOW_MPS: f64 = 6.5;
/// A slower vehicle is not about to turn in, metres per second.
const STANDS_MPS: f64 = 0.5;
/// It is on its way there if its centre is within this of the way's, metres, and it heads along it within
/// this angle, radians; it has lost it beyond the second numbers.
const ON_WAY: (f64, f64) = (1.5, 0.5);
const LOST: (f64, f64) = (3.0, 1.2);
/// A move in the turn is drawn again if it ends farther from its way than this, metres, and than it began.
const STRAYS_M: f64 = 0.3;
/// Who strays with all draws steers onto its way: so many turns to each side are tried, the sharpest with
/// this acceleration to the side, metres per second squared, and by this, radians. Shorter moves count as so
/// long, metres.
const STEERS: i32 = 12;
const STEERS_MPS2: f64 = 5.0;
const STEERS_RAD: f64 = 0.6;
const SHORT_M: f64 = 1.0;
/// It decides this far before the turn at most, metres, and not if it had to brake harder than this for
/// it, m/s², down to this speed, metres per second.
const DECIDES_M: f64 = 16.0;
const BRAKES_MPS2: f64 = 3.0;
const TURNS_AT_MPS: f64 = 6.0;
/// Longer vehicles do not turn in, metres.
const LONGEST_M: f64 = 7.0;
/// Its front leaves the street so far before its centre, metres, and a little earlier.
const LEAVES_M: f64 = 6.0;
/// A body this near to the way, metres, leaves no room.
const ROOM_M: f64 = 2.2;
/// How drivers turn in.
const BENDS: BendLimits = BendLimits {
    lateral_mps2: 3.0,
    braking_mps2: 3.0,
    ahead_m: 30.0,
};

/// A way that a vehicle takes.
#[derive(Clone, Copy, Debug)]
pub(super) struct TakesWay<'a> {
    pub(super) way: &'a WayIn,
    pub(super) lane: &'a Lane,
    map: &'a MapGraph,
}

impl<'a> TakesWay<'a> {
    pub(super) fn of(driveways: &'a Driveways, lane: LaneId) -> Option<Self> {
        Some(Self {
            way: driveways.way(lane)?,
            lane: driveways.map.lane(lane)?,
            map: &driveways.map,
        })
    }

    /// Metres from its start.
    pub(super) fn at(&self, now: &Shown) -> f64 {
        let line = &self.lane.centerline;
        line.project(now.pose.position).arc_length
    }

    /// Whether the vehicle is about to leave the street, or has.
    pub(super) fn leaves_street(&self, now: &Shown) -> bool {
        self.at(now) > self.way.turns_off_m - LEAVES_M
    }

    /// Whether it gets farther from its way with this move, where that leaves the street.
    pub(super) fn strays(&self, now: &Shown, step: Pose) -> bool {
        let off = |pose: Pose| self.lane.centerline.project(pose.position).distance;
        let after = off(now.pose * step);
        self.leaves_street(now) && after > STRAYS_M && after > off(now.pose)
    }

    /// The move of the same length that ends nearest to its way, of those that turn no more sharply than
    /// drivers do there; `None` if this one ends as near.
    pub(super) fn steered(&self, now: &Shown, step: Pose) -> Option<Pose> {
        let length = step.position.length();
        let most = (STEERS_MPS2 * TOKEN_DT * TOKEN_DT / length.max(SHORT_M)).min(STEERS_RAD);
        // A radian beside the way's direction counts as a metre, as it soon costs one.
        let off = |pose: Pose| {
            let foot = self.lane.foot(pose);
            foot.lateral_m.abs() + foot.turned
        };
        let turns = (-STEERS..=STEERS).map(|k| most * f64::from(k) / f64::from(STEERS));
        let moves = turns.map(|turn| steered(step, turn));
        let moves = moves.map(|step| (off(now.pose * step), step));
        let (least, best) = moves.min_by(|a, b| a.0.total_cmp(&b.0))?;
        (least < off(now.pose * step)).then_some(best)
    }

    /// Whether the vehicle is no longer on it.
    pub(super) fn is_lost(&self, now: &Shown) -> bool {
        !is_on(self.lane, now, LOST)
    }

    /// The greatest speed for the turn and the end of the way, metres per second.
    pub(super) fn most(&self, now: &Shown) -> f64 {
        let at = self.at(now);
        let end = self.lane.centerline.length() - at;
        let bend = bend_speed(self.map, self.lane, at, BENDS);
        bend.min(slowing_before(now, end.max(0.0), 0.0))
    }
}

fn is_on(lane: &Lane, now: &Shown, (metres, radians): (f64, f64)) -> bool {
    let foot = lane.foot(now.pose);
    foot.lateral_m.abs() < metres && foot.turned < radians
}

/// The way that a vehicle decides to take now, if no other agent stands in it. `seed` is its own: it
/// decides once for each.
pub(super) fn decide<'a>(
    driveways: &Driveways,
    now: &Shown,
    seed: Seed,
    others: &(impl Iterator<Item = &'a Agent> + Clone),
) -> Option<LaneId> {
    let speed = now.velocity().length();
    let is_able = now.body.kind == AgentKind::Vehicle && now.body.length < LONGEST_M;
    if !is_able || speed < STANDS_MPS {
        return None;
    }
    let brakes = now.acceleration().min(0.0);
    let takes = |way: &&WayIn| {
        // Most are far away.
        if way.turns_off.distance(now.pose.position) > DECIDES_M {
            return false;
        }
        let Some(lane) = driveways.map.lane(way.lane) else {
            return false;
        };
        let line = &lane.centerline;
        if !is_on(lane, now, ON_WAY) {
            return false;
        }
        let left = way.turns_off_m - line.project(now.pose.position).arc_length;
        let is_slow = speed * speed + 2.0 * brakes * left < SLOW_MPS * SLOW_MPS;
        let share = if is_slow { TURN_IN.0 } else { TURN_IN.1 };
        if uniform(seed.fork(way.lane.0 as u64)) >= share {
            return false;
        }
        let braking = (speed * speed - TURNS_AT_MPS * TURNS_AT_MPS) / (2.0 * left.max(0.1));
        let is_free = |other: &Agent| {
            let on = line.project(other.state.pose.position);
            let is_behind = on.arc_length < way.turns_off_m + 1.0;
            is_behind || on.distance > ROOM_M || other.state.speed() > STANDS_MPS
        };
        left > 0.0 && braking < BRAKES_MPS2 && others.clone().all(is_free)
    };
    driveways.ways.iter().find(takes).map(|way| way.lane)
}
