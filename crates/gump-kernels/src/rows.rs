//! Arithmetic on rows: sums in a fixed order, a vectorisable exponential, and sharing rows out
//! over threads.
//!
//! What lives here: helpers that several operations need. What does not: anything that knows a
//! layer or a tensor.
//!
//! Two rules make every result independent of the number of threads: work is cut into pieces
//! whose size depends on the shape only, and partial sums are added in the order of the pieces.

use rayon::prelude::*;

use crate::kernels::wide;

/// Independent accumulators of a sum; two 512-bit vectors.
const LANES: usize = 32;

/// Elements a task should touch before it is worth handing to another thread: 64 KB, some
/// microseconds. Not tuned.
const TASK_ELEMENTS: usize = 16 * 1024;

/// Pieces of a sum over rows, at most; bounds the memory of the partial sums and the threads that
/// share the work. Not tuned.
const MAX_PARTIALS: usize = 32;

/// Rows per task for row-wise work on rows of `cols` elements.
pub fn rows_per_task(cols: usize) -> usize {
    (TASK_ELEMENTS / cols.max(1)).max(1)
}

/// Rows per task when every task also produces a partial sum.
pub fn rows_per_partial(rows: usize, cols: usize) -> usize {
    rows_per_task(cols).max(rows.div_ceil(MAX_PARTIALS))
}

/// Calls `f(piece_index, piece)` for consecutive pieces of `out`, in parallel when there are
/// several: waking the pool costs more than a single small piece.
pub fn for_pieces(out: &mut [f32], piece: usize, f: impl Fn(usize, &mut [f32]) + Sync) {
    if out.len() <= piece {
        if !out.is_empty() {
            f(0, out);
        }
    } else {
        out.par_chunks_mut(piece)
            .enumerate()
            .for_each(|(i, chunk)| f(i, chunk));
    }
}

/// As [`for_pieces`] over two outputs cut in step.
pub fn for_pieces2(
    (a, piece_a): (&mut [f32], usize),
    (b, piece_b): (&mut [f32], usize),
    f: impl Fn(usize, &mut [f32], &mut [f32]) + Sync,
) {
    if a.len() <= piece_a {
        if !a.is_empty() {
            f(0, a, b);
        }
    } else {
        a.par_chunks_mut(piece_a)
            .zip(b.par_chunks_mut(piece_b))
            .enumerate()
            .for_each(|(i, (a, b))| f(i, a, b));
    }
}

/// As [`for_pieces`] over three outputs cut in step.
pub fn for_pieces3(
    (a, piece_a): (&mut [f32], usize),
    (b, piece_b): (&mut [f32], usize),
    (c, piece_c): (&mut [f32], usize),
    f: impl Fn(usize, &mut [f32], &mut [f32], &mut [f32]) + Sync,
) {
    if a.len() <= piece_a {
        if !a.is_empty() {
            f(0, a, b, c);
        }
    } else {
        a.par_chunks_mut(piece_a)
            .zip(b.par_chunks_mut(piece_b))
            .zip(c.par_chunks_mut(piece_c))
            .enumerate()
            .for_each(|(i, ((a, b), c))| f(i, a, b, c));
    }
}

/// Adds the pieces of `partials`, each as long as `out`, to `out` in order.
pub fn add_partials(out: &mut [f32], partials: &[f32]) {
    let n = out.len();
    if n == 0 {
        return;
    }
    for_pieces(out, TASK_ELEMENTS, |i, out| {
        let start = i * TASK_ELEMENTS;
        for partial in partials.chunks_exact(n) {
            let partial = &partial[start..start + out.len()];
            wide(
                #[inline(always)]
                || add_to(out, partial),
            );
        }
    });
}

/// Sums a row-major `[rows, cols]` matrix over its rows, giving `[cols]`.
pub fn column_sums(data: &[f32], cols: usize) -> Vec<f32> {
    let mut out = vec![0.0; cols];
    if cols == 0 || data.is_empty() {
        return out;
    }
    let rows = data.len() / cols;
    let step = rows_per_partial(rows, cols);
    let mut partials = vec![0.0; rows.div_ceil(step) * cols];
    for_pieces(&mut partials, cols, |i, sum| {
        let end = ((i + 1) * step).min(rows);
        wide(
            #[inline(always)]
            || {
                for row in data[i * step * cols..end * cols].chunks_exact(cols) {
                    add_to(sum, row);
                }
            },
        );
    });
    add_partials(&mut out, &partials);
    out
}

/// `out += row`
#[inline(always)]
pub fn add_to(out: &mut [f32], row: &[f32]) {
    for (o, r) in out.iter_mut().zip(row) {
        *o += r;
    }
}

#[inline(always)]
fn fold_lanes(lanes: &[f32; LANES]) -> f32 {
    let mut lanes = *lanes;
    let mut width = LANES / 2;
    while width > 0 {
        for i in 0..width {
            lanes[i] += lanes[i + width];
        }
        width /= 2;
    }
    lanes[0]
}

/// Sum of a row.
#[inline(always)]
pub fn sum(x: &[f32]) -> f32 {
    let mut lanes = [0.0; LANES];
    let chunks = x.chunks_exact(LANES);
    let tail = chunks.remainder();
    for chunk in chunks {
        for i in 0..LANES {
            lanes[i] += chunk[i];
        }
    }
    for (lane, v) in lanes.iter_mut().zip(tail) {
        *lane += v;
    }
    fold_lanes(&lanes)
}

/// Sum of squared distances from `centre`.
#[inline(always)]
pub fn sum_squares_from(x: &[f32], centre: f32) -> f32 {
    let mut lanes = [0.0; LANES];
    let chunks = x.chunks_exact(LANES);
    let tail = chunks.remainder();
    for chunk in chunks {
        for i in 0..LANES {
            let d = chunk[i] - centre;
            lanes[i] += d * d;
        }
    }
    for (lane, v) in lanes.iter_mut().zip(tail) {
        let d = v - centre;
        *lane += d * d;
    }
    fold_lanes(&lanes)
}

/// Sum of the squares of many numbers, in f64 over pieces.
pub fn squares(x: &[f32]) -> f64 {
    let piece = |x: &[f32]| {
        let square = wide(
            #[inline(always)]
            || dot(x, x),
        );
        f64::from(square)
    };
    x.chunks(TASK_ELEMENTS).map(piece).sum()
}

/// Inner product of two rows of one length.
#[inline(always)]
pub fn dot(x: &[f32], y: &[f32]) -> f32 {
    dot_from(x, 0.0, y)
}

/// Inner product of the distances from `centre` with another row.
#[inline(always)]
pub fn dot_from(x: &[f32], centre: f32, y: &[f32]) -> f32 {
    let mut lanes = [0.0; LANES];
    let (xs, ys) = (x.chunks_exact(LANES), y.chunks_exact(LANES));
    let (x_tail, y_tail) = (xs.remainder(), ys.remainder());
    for (a, b) in xs.zip(ys) {
        for i in 0..LANES {
            lanes[i] += (a[i] - centre) * b[i];
        }
    }
    for ((lane, a), b) in lanes.iter_mut().zip(x_tail).zip(y_tail) {
        *lane += (a - centre) * b;
    }
    fold_lanes(&lanes)
}

/// Largest element of a row; minus infinity for an empty one.
#[inline(always)]
pub fn max(x: &[f32]) -> f32 {
    let mut lanes = [f32::NEG_INFINITY; LANES];
    let chunks = x.chunks_exact(LANES);
    let tail = chunks.remainder();
    for chunk in chunks {
        for i in 0..LANES {
            lanes[i] = if chunk[i] > lanes[i] {
                chunk[i]
            } else {
                lanes[i]
            };
        }
    }
    for (lane, &v) in lanes.iter_mut().zip(tail) {
        *lane = if v > *lane { v } else { *lane };
    }
    lanes
        .iter()
        .fold(f32::NEG_INFINITY, |a, &b| if b > a { b } else { a })
}

/// Number of elements of a row that are at least `low`.
pub fn count_from(x: &[f32], low: f32) -> usize {
    wide(
        #[inline(always)]
        || {
            let count = |n: u32, x: &f32| n.wrapping_add(u32::from(*x >= low));
            x.iter().fold(0, count) as usize
        },
    )
}

/// `e^x` to about two units in the last place, in operations a compiler can vectorise.
///
/// Below -87.3 the result is about 1e-38 instead of a subnormal; above 88 it is held at 1.6e38.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    // Adding 1.5 * 2^23 rounds to an integer, which then sits in the low bits of the mantissa.
    const ROUND: f32 = 12_582_912.0;
    // ln 2 in two parts (Cody and Waite 1980), the first so short that its multiples are exact.
    const LN2_HIGH: f32 = 0.693_359_4;
    const LN2_LOW: f32 = -2.121_944_4e-4;
    let x = if x > -87.3 { x } else { -87.3 };
    let x = if x < 88.0 { x } else { 88.0 };
    let shifted = x * std::f32::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    let r = x - n * LN2_HIGH - n * LN2_LOW;
    // Taylor to the sixth degree: |r| <= ln(2) / 2, so the remainder is below 2e-7 relative.
    let mut p = 1.0 / 720.0;
    p = p * r + 1.0 / 120.0;
    p = p * r + 1.0 / 24.0;
    p = p * r + 1.0 / 6.0;
    p = p * r + 0.5;
    p = p * r + 1.0;
    p = p * r + 1.0;
    let exponent = shifted.to_bits().wrapping_sub(ROUND.to_bits()) << 23;
    f32::from_bits(p.to_bits().wrapping_add(exponent))
}

/// `x[i] = e^(x[i] - shift)`; returns the sum.
#[inline(always)]
pub fn exp_shifted_sum(x: &mut [f32], shift: f32) -> f32 {
    let mut lanes = [0.0; LANES];
    let mut chunks = x.chunks_exact_mut(LANES);
    for chunk in &mut chunks {
        for i in 0..LANES {
            chunk[i] = exp(chunk[i] - shift);
            lanes[i] += chunk[i];
        }
    }
    for (lane, v) in lanes.iter_mut().zip(chunks.into_remainder()) {
        *v = exp(*v - shift);
        *lane += *v;
    }
    fold_lanes(&lanes)
}

/// Sum of `e^(x[i] - shift)`, storing nothing.
#[inline(always)]
pub fn sum_exp_shifted(x: &[f32], shift: f32) -> f32 {
    let mut lanes = [0.0; LANES];
    let chunks = x.chunks_exact(LANES);
    let tail = chunks.remainder();
    for chunk in chunks {
        for i in 0..LANES {
            lanes[i] += exp(chunk[i] - shift);
        }
    }
    for (lane, v) in lanes.iter_mut().zip(tail) {
        *lane += exp(v - shift);
    }
    fold_lanes(&lanes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp_agrees_with_the_library() {
        let mut worst = 0.0f32;
        for i in -86_000..87_000 {
            let x = i as f32 * 1e-3;
            worst = worst.max((exp(x) / x.exp() - 1.0).abs());
        }
        assert!(worst < 3e-7, "{worst}");
        assert_eq!(exp(0.0), 1.0);
        assert!(exp(-1000.0) < 2e-38 && exp(f32::NEG_INFINITY) < 2e-38);
    }

    #[test]
    fn reductions_of_odd_lengths() {
        for n in [0, 1, 31, 32, 33, 100] {
            let x: Vec<f32> = (0..n).map(|i| i as f32 - 40.0).collect();
            assert_eq!(sum(&x), x.iter().sum::<f32>());
            assert_eq!(dot(&x, &x), x.iter().map(|v| v * v).sum::<f32>());
            assert_eq!(max(&x), x.last().copied().unwrap_or(f32::NEG_INFINITY));
        }
    }

    #[test]
    fn column_sums_of_many_rows() {
        let data: Vec<f32> = (0..5000 * 7).map(|i| (i % 7) as f32).collect();
        let expected: Vec<f32> = (0..7).map(|c| 5000.0 * c as f32).collect();
        assert_eq!(column_sums(&data, 7), expected);
    }
}
