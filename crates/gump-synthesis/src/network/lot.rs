//! Parking lots beside the road: rows of places at right angles to it, in scenes like recorded ones
//! also at other angles.

use std::ops::RangeInclusive;

use gump_geometry::{DVec2, Polygon, Pose, wrap_angle};
use gump_scene::{AreaKind, Rng, RoadEdgeKind};
use rand::Rng as _;

use crate::curve::Track;
use crate::network::Network;
use crate::plan::Plan;

// Dimensions of lots, here and in the functions below, are common ones. They were chosen by eye and
// not varied.
/// From the curb to the near end of the places: sidewalk, strip of green, aisle; metres.
const SET_BACK: f64 = 7.0;
/// The same in scenes like recorded ones, where vehicles stand right behind the sidewalk or farther
/// back.
const REAL_SET_BACK: std::ops::Range<f64> = 3.5..9.0;
/// Share of lots of such scenes that are turned against the road, share of lots and of strips of bays
/// that have slanted places, and by how much, radians. A third of the recorded vehicles that stand off lanes stand aslant to the nearest one.
const TURNED: f64 = 0.45;
const MOST_TURNED: f64 = 0.8;
const SLANTED: f64 = 0.4;
const SLANT: std::ops::Range<f64> = 0.3..0.8;
/// Share of such lots with a curb on the three sides away from the road.
const ENCLOSED: f64 = 0.6;
/// Depth of a place, metres: vehicles that park are no longer.
const DEPTH: f64 = 5.6;
/// Width of the aisle between two pairs of rows, metres.
const AISLE: f64 = 6.4;
/// Metres that a lot keeps from everything else.
const CLEARANCE: f64 = 1.5;

impl Network {
    /// Lays out up to `n` lots of so many rows where there is room between the roads.
    pub(crate) fn lay_lots(
        &mut self,
        plan: &Plan,
        trimmed: &[Track],
        n: usize,
        rows: RangeInclusive<usize>,
        rng: &mut Rng,
    ) {
        let roads: Vec<Polygon> = self
            .furniture
            .drivable
            .iter()
            .filter_map(|ring| Polygon::new(ring.clone()))
            .collect();
        let mut lots: Vec<Polygon> = Vec::new();
        for _ in 0..3 * n {
            let road = rng.random_range(0..plan.roads.len());
            let left = rng.random_bool(0.5);
            let (r, track) = (&plan.roads[road], &trimmed[road]);
            let n_places = rng.random_range(5..14);
            let spacing = rng.random_range(2.7..3.1);
            // A range of one value draws nothing more, which keeps the scenes of lots of one row.
            let is_real = rows.start() != rows.end();
            let (slant, turned, set_back) = match is_real {
                true => (
                    draw_slant(rng),
                    draw_turned(rng),
                    rng.random_range(REAL_SET_BACK),
                ),
                false => (0.0, 0.0, SET_BACK),
            };
            let spacing = spacing / f64::cos(slant);
            let half = spacing * f64::from(n_places) / 2.0;
            if lots.len() == n || r.freeway || r.ring || track.length() < 2.0 * half + 12.0 {
                continue;
            }
            let s = rng.random_range(half + 4.0..track.length() - half - 4.0);
            let along = track.pose_at(s);
            let side = if left { 1.0 } else { -1.0 };
            // A frame on the curb whose +y points away from the road.
            let curb = Pose {
                position: along * DVec2::new(0.0, side * r.half_width(!left)),
                heading: if left {
                    along.heading
                } else {
                    wrap_angle(along.heading + std::f64::consts::PI)
                },
            };
            let n_rows = match is_real {
                true => rng.random_range(rows.clone()),
                false => *rows.start(),
            };
            // Turned about the middle of its near side, as far back as its corner then needs.
            let curb = curb * Pose::new(0.0, half * f64::sin(turned).abs(), turned);
            let corner = |x: f64, y: f64| curb * DVec2::new(x, y);
            // The second row of a pair is reached from behind.
            let behind = if n_rows.is_multiple_of(2) { AISLE } else { 0.0 };
            let far = row_start(set_back, n_rows - 1) + DEPTH + 0.5 + behind;
            let ring = vec![
                corner(-half, 0.4),
                corner(half, 0.4),
                corner(half, far),
                corner(-half, far),
            ];
            let places = [
                corner(-half, set_back - 1.5),
                corner(half, set_back - 1.5),
                ring[2],
                ring[3],
            ];
            let Some(ground) = Polygon::new(places.to_vec()) else {
                continue;
            };
            if roads
                .iter()
                .chain(&lots)
                .any(|other| is_near(&ground, other))
                || self.is_on_walk(&ground)
            {
                continue;
            }
            for (row, k) in (0..n_rows).flat_map(|row| (0..n_places).map(move |k| (row, k))) {
                let x = (f64::from(k) + 0.5) * spacing - half;
                let nose_in = if rng.random_bool(0.8) { 0.5 } else { -0.5 };
                let heading = wrap_angle(curb.heading + nose_in * std::f64::consts::PI + slant);
                self.lot_places.push(Pose {
                    position: corner(x, row_start(set_back, row) + DEPTH / 2.0),
                    heading,
                });
            }
            if is_real && rng.random_bool(ENCLOSED) {
                let edge = [ring[1], ring[2], ring[3], ring[0]].to_vec();
                self.furniture.edges.push((RoadEdgeKind::Boundary, edge));
            }
            self.furniture
                .areas
                .push((AreaKind::Driveway, ring.clone()));
            self.furniture.drivable.push(ring);
            lots.push(ground);
        }
    }

    fn is_on_walk(&self, ground: &Polygon) -> bool {
        self.walks
            .iter()
            .flat_map(|walk| walk.track.points())
            .any(|point| ground.signed_distance(*point) < CLEARANCE)
    }
}

/// The angle of the places of a lot or strip to the right one, radians; 0 for most.
pub(crate) fn draw_slant(rng: &mut Rng) -> f64 {
    if !rng.random_bool(SLANTED) {
        return 0.0;
    }
    let slant = rng.random_range(SLANT);
    if rng.random_bool(0.5) { slant } else { -slant }
}

/// The angle of a lot to its road, radians; 0 for most.
fn draw_turned(rng: &mut Rng) -> f64 {
    match rng.random_bool(TURNED) {
        true => rng.random_range(-MOST_TURNED..MOST_TURNED),
        false => 0.0,
    }
}

/// Metres from the curb to the near end of a row: rows lie back to back in pairs, with an aisle
/// between pairs.
fn row_start(set_back: f64, row: usize) -> f64 {
    set_back + row as f64 * DEPTH + (row / 2) as f64 * AISLE
}

/// True if the borders of two polygons come closer than the clearance, or one contains the other.
fn is_near(a: &Polygon, b: &Polygon) -> bool {
    let reach = DVec2::splat(CLEARANCE);
    let ((low, high), (their_low, their_high)) = (a.bounds(), b.bounds());
    if (low - reach).cmpgt(their_high).any() || (their_low - reach).cmpgt(high).any() {
        return false;
    }
    let close = |a: &Polygon, b: &Polygon| {
        a.edges().any(|(from, to)| {
            let n = (from.distance(to) / 2.0).ceil().max(1.0) as usize;
            (0..=n).any(|i| b.signed_distance(from.lerp(to, i as f64 / n as f64)) < CLEARANCE)
        })
    };
    close(a, b) || close(b, a)
}
