//! Turns as recorded maps draw them: wider than drivers take them.

use std::f64::consts::PI;

use gump_geometry::DVec2;
use gump_scene::Rng;
use rand::Rng as _;

use crate::network::{Network, Turn};

// Recorded vehicles that turn faster than 0.15 rad/s are 0.7 m inside of the lane's centre line (median;
// quartiles 0 and 1.2 m), in left and right turns alike, and synthetic ones drive on it.
/// Metres by which the middle of a centre line is drawn outside of the way that vehicles drive, ...
const WIDE: std::ops::Range<f64> = 0.0..2.5;
/// ... but no more than this share of its length, which keeps short turns from becoming hairpins.
/// Chosen by eye.
const OF_LENGTH: f64 = 0.1;

/// Draws the centre lines of turns wider than vehicles drive.
pub(crate) fn widen(network: &mut Network, rng: &mut Rng) {
    for lane in &mut network.lanes {
        let outside = match &lane.connector {
            Some(connector) if connector.turn == Turn::Left => -1.0,
            Some(connector) if connector.turn == Turn::Right => 1.0,
            _ => continue,
        };
        if lane.is_bike_lane() || lane.in_ring {
            continue;
        }
        let length = lane.length();
        let wide = outside * rng.random_range(WIDE).min(OF_LENGTH * length);
        let point = |(i, _): (usize, &DVec2)| {
            let s = (i as f64 * lane.track.step()).min(length);
            let aside = wide * (PI * s / length).sin().powi(2);
            lane.track.pose_at(s) * DVec2::new(0.0, aside)
        };
        let points = lane.track.points().iter().enumerate().map(point).collect();
        lane.drawn = Some(points);
    }
}
