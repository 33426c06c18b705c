//! One step of a gated recurrent unit, row by row, and its gradient.
//!
//! Gates stand in rows `[3C]`: reset, update, candidate.

use crate::rows::exp;

/// One step of one row in place: `h` becomes the next state; gates `[3C]` as in PyTorch's: reset, update, candidate.
#[inline(always)]
pub fn gru_row(x_gates: &[f32], h_gates: &[f32], h: &mut [f32]) {
    let c = h.len();
    let (x, g) = (gates(x_gates, 0, c), gates(h_gates, 0, c));
    for (j, h) in h.iter_mut().enumerate() {
        let r = sigmoid(x[0][j] + g[0][j]);
        let z = sigmoid(x[1][j] + g[1][j]);
        *h = next(z, candidate(x[2][j], r, g[2][j]), *h);
    }
}

/// As [`gru_row`], which also keeps what the gradient needs: `[4C]`, both sigmoids, the candidate
/// and the candidate's hidden gate. One loop per gate, each over slices of one length, so that all
/// are compiled to vectors.
#[inline(always)]
pub fn kept_row(x: [&[f32]; 3], g: [&[f32]; 3], h: &mut [f32], kept: &mut [f32]) {
    let [r, z, n, gate] = quarters_mut(kept);
    for ((r, x), g) in r.iter_mut().zip(x[0]).zip(g[0]) {
        *r = sigmoid(x + g);
    }
    for ((z, x), g) in z.iter_mut().zip(x[1]).zip(g[1]) {
        *z = sigmoid(x + g);
    }
    gate.copy_from_slice(g[2]);
    for (((n, x), g), r) in n.iter_mut().zip(x[2]).zip(&*gate).zip(&*r) {
        *n = candidate(*x, *r, *g);
    }
    for ((h, z), n) in h.iter_mut().zip(&*z).zip(&*n) {
        *h = next(*z, *n, *h);
    }
}

#[inline(always)]
fn quarters_mut(row: &mut [f32]) -> [&mut [f32]; 4] {
    let (low, high) = row.split_at_mut(row.len() / 2);
    let (a, b) = low.split_at_mut(low.len() / 2);
    let (c, d) = high.split_at_mut(high.len() / 2);
    [a, b, c, d]
}

#[inline(always)]
fn thirds_mut(row: &mut [f32]) -> [&mut [f32]; 3] {
    let (a, rest) = row.split_at_mut(row.len() / 3);
    let (b, c) = rest.split_at_mut(rest.len() / 2);
    [a, b, c]
}

/// The three gate rows of row `row`.
#[inline(always)]
pub fn gates(all: &[f32], row: usize, c: usize) -> [&[f32]; 3] {
    let row = &all[row * 3 * c..(row + 1) * 3 * c];
    [&row[..c], &row[c..2 * c], &row[2 * c..]]
}

#[inline(always)]
fn candidate(x: f32, r: f32, g: f32) -> f32 {
    2.0 * sigmoid(2.0 * (x + r * g)) - 1.0
}

#[inline(always)]
fn next(z: f32, n: f32, h: f32) -> f32 {
    (1.0 - z) * n + z * h
}

#[inline(always)]
fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

/// `dh` is the gradient of the state after the step on entry, and the part that reaches the state
/// before it directly on return; `kept` is as [`kept_row`] left it.
#[inline(always)]
pub fn backward_row(kept: &[f32], h: &[f32], dx: &mut [f32], dg: &mut [f32], dh: &mut [f32]) {
    let c = h.len();
    let [r, z, n, g] = [0, 1, 2, 3].map(|i| &kept[i * c..(i + 1) * c]);
    let [dx_r, dx_z, dx_n] = thirds_mut(dx);
    let [dg_r, dg_z, dg_n] = thirds_mut(dg);
    for (((dx, d), z), n) in dx_n.iter_mut().zip(&*dh).zip(z).zip(n) {
        *dx = d * (1.0 - z) * (1.0 - n * n);
    }
    for ((((dx, d), z), n), h) in dx_z.iter_mut().zip(&*dh).zip(z).zip(n).zip(h) {
        *dx = d * (h - n) * z * (1.0 - z);
    }
    for (((dx, d), g), r) in dx_r.iter_mut().zip(&*dx_n).zip(g).zip(r) {
        *dx = d * g * r * (1.0 - r);
    }
    for ((dg, d), r) in dg_n.iter_mut().zip(&*dx_n).zip(r) {
        *dg = d * r;
    }
    dg_r.copy_from_slice(dx_r);
    dg_z.copy_from_slice(dx_z);
    for (dh, z) in dh.iter_mut().zip(z) {
        *dh *= z;
    }
}
