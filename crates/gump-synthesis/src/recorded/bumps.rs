//! Speed bumps, which four of five recorded scenes have.

use gump_geometry::DVec2;
use gump_scene::{AreaKind, Rng};
use rand::Rng as _;

use crate::curve::Track;
use crate::network::Network;
use crate::plan::{Plan, RoadPlan};

// Recorded scenes (gpudrive/train, 137 of them): 108 have bumps, the median of those four; half are
// about a metre deep, some are raised tables. The other numbers are chosen by eye.
/// Share of scenes that may have bumps.
const SCENES: f64 = 0.97;
/// Share of the slow roads of such a scene that have them, besides one that always has.
const ROADS: f64 = 0.4;
/// Roads with a higher limit have none, m/s: nobody faster than this passes a recorded bump (32 passages).
const FASTEST: f64 = 14.0;
/// Metres of road without bumps at its ends.
const ENDS: f64 = 8.0;
/// Distance between two bumps of a road, metres.
const SPACING: std::ops::Range<f64> = 50.0..120.0;
/// Share of raised tables among bumps.
const TABLES: f64 = 0.2;

/// Lays speed bumps across roads, as areas of the map and as places where some drivers slow down.
pub(crate) fn lay(network: &mut Network, plan: &Plan, trimmed: &[Track], rng: &mut Rng) {
    if !rng.random_bool(SCENES) {
        return;
    }
    let is_slow = |road: &RoadPlan| road.speed_limit < FASTEST && !road.freeway && !road.ring;
    let long = |track: &Track| track.length() > 2.0 * ENDS;
    let roads = plan.roads.iter().zip(trimmed);
    let mut roads: Vec<_> = roads.filter(|(road, t)| is_slow(road) && long(t)).collect();
    if roads.is_empty() {
        return;
    }
    let always = rng.random_range(0..roads.len());
    roads.swap(0, always);
    for (i, (road, track)) in roads.into_iter().enumerate() {
        if i > 0 && !rng.random_bool(ROADS) {
            continue;
        }
        let room = track.length() - 2.0 * ENDS;
        let mut s = ENDS + rng.random_range(0.0..room.min(SPACING.end));
        while s < track.length() - ENDS {
            let along = track.pose_at(s);
            let (left, right) = (road.half_width(false), road.half_width(true));
            let half = 0.5
                * match rng.random_bool(TABLES) {
                    true => rng.random_range(4.0..7.5),
                    false => rng.random_range(0.8..2.0),
                };
            let corners = [(-half, -right), (half, -right), (half, left), (-half, left)];
            let ring = corners.map(|(x, y)| along * DVec2::new(x, y)).to_vec();
            network.furniture.areas.push((AreaKind::SpeedBump, ring));
            let lanes = network.lanes.iter_mut();
            for lane in lanes.filter(|l| l.connector.is_none()) {
                let foot = lane.track.project(along.position);
                let local = along.inverse() * lane.track.pose_at(foot).position;
                if local.x.abs() < 1.0 && (-right..left).contains(&local.y) {
                    lane.bumps.push(foot);
                }
            }
            s += rng.random_range(SPACING);
        }
    }
}
