//! Signed distances between boxes, and from each scored agent to the nearest other.

use super::assemble::SimulatedAgents;
use super::config::Algorithm;
use super::input::State;

/// The distance used where there is no other box. Source, as of the rounding: the challenge's
/// published metric code.
pub(crate) const FAR: f32 = 1e10;

/// Share of a box's half width that rounds its corners since 2024.
pub(crate) const ROUNDING_2024: f32 = 0.7;

/// Rounding can move a distance at world coordinates by far less than this, metres: neighbouring
/// f32 values are a millimetre apart at 10 km.
const MARGIN: f32 = 0.05;

type Corners = [[f32; 2]; 4];

/// Corners of a box, counter-clockwise from its front left.
pub(crate) fn box_corners(
    center: [f32; 2],
    heading: f32,
    length: f32,
    width: f32,
) -> [[f32; 2]; 4] {
    let (s, c) = (heading.sin(), heading.cos());
    let (l, w) = (length / 2.0, width / 2.0);
    [[l, w], [-l, w], [-l, -w], [l, -w]]
        .map(|[x, y]| [c * x - s * y + center[0], s * x + c * y + center[1]])
}

/// A box without the rim that rounds its corners, and the rim.
fn core(state: &State, rounding: f32) -> (Corners, f32) {
    let [length, width, _] = state.size;
    let rim = length.min(width) * rounding / 2.0;
    let [x, y, _] = state.position;
    let corners = box_corners([x, y], state.heading, length - 2.0 * rim, width - 2.0 * rim);
    (corners, rim)
}

/// Distance between the boxes of two states in the plane, metres; negative if they overlap: by so
/// much one would have to move.
///
/// `rounding` from 0 (sharp corners) to 1 (half discs at the ends).
#[cfg(test)]
pub(crate) fn signed_box_distance(a: &State, b: &State, rounding: f32) -> f32 {
    let (corners_a, rim_a) = core(a, rounding);
    let (corners_b, rim_b) = core(b, rounding);
    signed_distance(&corners_a, &corners_b) - rim_a - rim_b
}

/// As the reference: distance of the origin from the Minkowski difference, of which the two boxes
/// give the edges in turn.
fn signed_distance(a: &Corners, b: &Corners) -> f32 {
    let b = b.map(|[x, y]| [-x, -y]);
    let (start_a, direction_a) = lowest(a);
    let (start_b, direction_b) = lowest(&b);
    const STAY_FIRST: [usize; 8] = [0, 0, 1, 1, 2, 2, 3, 3];
    const MOVE_FIRST: [usize; 8] = [0, 1, 1, 2, 2, 3, 3, 0];
    let (order_a, order_b) = if cross(direction_a, direction_b) >= 0.0 {
        (MOVE_FIRST, STAY_FIRST)
    } else {
        (STAY_FIRST, MOVE_FIRST)
    };
    let sum: [[f32; 2]; 8] = std::array::from_fn(|j| {
        let p = a[(order_a[j] + start_a) % 4];
        let q = b[(order_b[j] + start_b) % 4];
        [p[0] + q[0], p[1] + q[1]]
    });
    let (mut nearest, mut inside) = (f32::INFINITY, true);
    for j in 0..8 {
        let (from, to) = (sum[j], sum[(j + 1) % 8]);
        let edge = [to[0] - from[0], to[1] - from[1]];
        let length = norm(edge);
        let tangent = [edge[0] / length, edge[1] / length];
        let origin = [-from[0], -from[1]];
        let beside = tangent[1] * origin[0] - tangent[0] * origin[1];
        // An edge of no length makes both NaN, and every comparison with them false.
        inside &= beside <= 0.0;
        let along = (tangent[0] * origin[0] + tangent[1] * origin[1]) / length;
        if (0.0..=1.0).contains(&along) {
            nearest = nearest.min(beside.abs());
        }
        nearest = nearest.min(norm(origin));
    }
    if inside { -nearest } else { nearest }
}

/// The first corner of the lowest y, and the direction of the edge that starts there.
fn lowest(corners: &Corners) -> (usize, [f32; 2]) {
    let lower = |best: usize, i: usize| {
        if corners[i][1] < corners[best][1] {
            i
        } else {
            best
        }
    };
    let start = (1..4).fold(0, lower);
    let (from, to) = (corners[start], corners[(start + 1) % 4]);
    let edge = [to[0] - from[0], to[1] - from[1]];
    let length = norm(edge);
    (start, [edge[0] / length, edge[1] / length])
}

fn cross(a: [f32; 2], b: [f32; 2]) -> f32 {
    a[0] * b[1] - a[1] * b[0]
}

fn norm(v: [f32; 2]) -> f32 {
    (v[0] * v[0] + v[1] * v[1]).sqrt()
}

/// Distance from one agent to the nearest other at the steps from `first`, [`FAR`] without one.
pub(crate) fn nearest_object(
    simulated: &SimulatedAgents,
    agent: usize,
    first: usize,
    algorithm: Algorithm,
) -> Vec<f32> {
    let rounding = if algorithm.is_2023() {
        0.0
    } else {
        ROUNDING_2024
    };
    let own = simulated.states(agent);
    let others = (0..simulated.n_agents()).filter(|&other| other != agent);
    let others: Vec<_> = others.map(|other| simulated.states(other)).collect();
    // The last nearest is likely near again; testing it first lets the others be skipped.
    let mut hint = 0;
    let mut reaches = vec![0.0; others.len()];
    (first..own.len())
        .map(|step| {
            let state = &own[step];
            if !state.valid {
                return FAR;
            }
            let (core_a, rim_a) = core(state, rounding);
            let measure = |other: &State| {
                let (core_b, rim_b) = core(other, rounding);
                signed_distance(&core_a, &core_b) - rim_a - rim_b
            };
            for (reach, other) in reaches.iter_mut().zip(&others) {
                *reach = least_distance(state, &other[step]);
            }
            let mut nearest = FAR;
            let first = hint.min(others.len());
            let rest = (0..others.len()).filter(|&other| other != first);
            for other in (first..others.len()).take(1).chain(rest) {
                let there = &others[other][step];
                if there.valid && reaches[other] < nearest {
                    let distance = measure(there);
                    if distance < nearest {
                        (nearest, hint) = (distance, other);
                    }
                }
            }
            nearest
        })
        .collect()
}

/// A lower bound of the distance of two boxes, from the discs around them.
fn least_distance(a: &State, b: &State) -> f32 {
    let radius = |s: &State| norm([s.size[0], s.size[1]]) / 2.0;
    let between = [b.position[0] - a.position[0], b.position[1] - a.position[1]];
    norm(between) - radius(a) - radius(b) - MARGIN
}
