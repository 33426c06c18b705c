//! Speed bumps, which four of five recorded scenes have.

use gump_geometry::DVec2;
use gump_scene::{AreaKind, Rng};
use rand::Rng as _;

use crate::curve::Track;
use crate::network::Network;
use crate::plan::Plan;

// Recorded scenes (gpudrive/train, 137 of them): 108 have bumps, the median of those four; half are
// about a metre deep, some are raised tables. The other numbers are chosen by eye.
/// Share of scenes that may have bumps.
const SCENES: f64 = 0.9;
/// Share of the roads of such a scene that have them.
const ROADS: f64 = 0.7;
/// Roads with a higher limit have none, m/s. Too high: nobody faster than 14 m/s passes a recorded bump (32
/// passages); with less, too few scenes have any, because few of their slow roads are long enough.
const FASTEST: f64 = 30.0;
/// On roads with a higher limit nobody slows down for them, m/s: where a third of the drivers brakes to 6 m/s
/// on an arterial, the others queue behind them.
const SLOWING: f64 = 14.0;
/// Metres of road without bumps at its ends.
const ENDS: f64 = 14.0;
/// Distance between two bumps of a road, metres.
const SPACING: std::ops::Range<f64> = 35.0..90.0;
/// Share of raised tables among bumps.
const TABLES: f64 = 0.2;

/// Lays speed bumps across roads, as areas of the map and as places where some drivers slow down.
pub(crate) fn lay(network: &mut Network, plan: &Plan, trimmed: &[Track], rng: &mut Rng) {
    if !rng.random_bool(SCENES) {
        return;
    }
    for (road, track) in plan.roads.iter().zip(trimmed) {
        let slow = road.speed_limit < FASTEST && !road.freeway && !road.ring;
        if !slow || !rng.random_bool(ROADS) {
            continue;
        }
        let mut s = ENDS + rng.random_range(0.0..SPACING.end);
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
            for lane in lanes.filter(|l| l.connector.is_none() && l.speed_limit <= SLOWING) {
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
