//! Curbs between places: recorded ones enclose groups of vehicles in bays.

use gump_geometry::{DVec2, Pose};
use gump_scene::{Rng, RoadEdgeKind};
use rand::Rng as _;

use crate::network::Network;
use crate::plan::BAY_DEPTH;

// All were chosen by eye.
/// Share of the strips of bays that have islands.
const STRIPS: f64 = 0.6;
/// Distance between two islands, metres: two to seven places.
const SPACING: std::ops::Range<f64> = 6.0..22.0;
/// Width of an island along the strip, metres.
const WIDTH: std::ops::Range<f64> = 0.8..2.4;
/// Metres from the end of an island to the lane.
const SHORT: f64 = 0.7;

/// A curb that juts out from the edge of the road.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Island {
    /// Its middle.
    pose: Pose,
    half_width: f64,
}

impl Island {
    /// Whether a vehicle whose middle is there would stand on it.
    pub(crate) fn is_under(&self, position: DVec2) -> bool {
        let local = self.pose.inverse() * position;
        local.x.abs() < self.half_width + 1.2 && local.y.abs() < BAY_DEPTH
    }
}

/// Adds islands to strips of bays, as edges of the road.
pub(crate) fn lay(network: &mut Network, rng: &mut Rng) -> Vec<Island> {
    let mut islands = Vec::new();
    for strip in &network.bays {
        if !rng.random_bool(STRIPS) {
            continue;
        }
        let spacing = rng.random_range(SPACING);
        let half_width = rng.random_range(WIDTH) / 2.0;
        let mut s = rng.random_range(2.0..2.0 + spacing);
        while s < strip.length() - 2.0 {
            let pose = strip.pose_at(s);
            // The curb is on the right of the strip, the road on the left of its edges.
            let (curb, lane) = (-BAY_DEPTH / 2.0, BAY_DEPTH / 2.0 - SHORT);
            let corners = [
                (-half_width, curb),
                (-half_width, lane),
                (half_width, lane),
                (half_width, curb),
            ];
            let line = corners.map(|(x, y)| pose * DVec2::new(x, y)).to_vec();
            network.furniture.edges.push((RoadEdgeKind::Boundary, line));
            islands.push(Island { pose, half_width });
            s += spacing;
        }
    }
    islands
}
