//! Lanes as recorded maps draw them: turns wider than drivers take them, and all of them not quite along
//! the ways that vehicles drive.

use std::f64::consts::{PI, TAU};

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

// Recorded vehicles that drive straight on head 0.0088 rad (median) away from their lane at 5 to 10 m/s and
// 0.0046 above 16 m/s, and keep that heading: a second and a half later it is hardly correlated with the
// lane's. On synthetic lanes that are drawn where they are driven it is 0.0034 and 0.0021, and steered away.
/// Mean angle between a centre line and the way that vehicles drive in a scene, radians: about twice as large
/// where traffic is slow as where it is fast, as on recorded roads.
const ASKEW: std::ops::Range<f64> = 0.003..0.013;
/// The same where more than this is allowed, m/s.
const ASKEW_FAST: std::ops::Range<f64> = 0.002..0.007;
const FAST_MPS: f64 = 15.0;
/// Lengths of its waves, metres, and how many there are.
const WAVES_M: std::ops::Range<f64> = 25.0..130.0;
const WAVES: usize = 3;
/// It begins and ends on the way, over this share of the lane's length and at most these metres.
const ENDS: (f64, f64) = (0.3, 10.0);

/// Draws all centre lines a little askew of the ways that vehicles drive.
pub(crate) fn skew(network: &mut Network, rng: &mut Rng) {
    let [slow, fast] = [rng.random_range(ASKEW), rng.random_range(ASKEW_FAST)];
    for lane in &mut network.lanes {
        let askew = match lane.speed_limit > FAST_MPS {
            true => fast,
            false => slow,
        };
        // Of a wave of this length and slope; several of them add up at random.
        let waves = [(); WAVES].map(|()| {
            let (length, phase) = (rng.random_range(WAVES_M), rng.random_range(0.0..TAU));
            let slope = askew * PI / 2.0 / (WAVES as f64).sqrt();
            (slope * length / TAU, TAU / length, phase)
        });
        let length = lane.length();
        let ends = (ENDS.0 * length).min(ENDS.1);
        let aside = |s: f64| {
            let near = (s.min(length - s) / ends).clamp(0.0, 1.0);
            let sum: f64 = waves
                .iter()
                .map(|(most, per_metre, phase)| most * (per_metre * s + phase).sin())
                .sum();
            sum * near * near * (3.0 - 2.0 * near)
        };
        let drawn = lane.drawn.take();
        let points = drawn.as_deref().unwrap_or(lane.track.points());
        let point = |(i, point): (usize, &DVec2)| {
            let s = (i as f64 * lane.track.step()).min(length);
            *point + lane.track.pose_at(s).direction().perp() * aside(s)
        };
        lane.drawn = Some(points.iter().enumerate().map(point).collect());
    }
}

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
