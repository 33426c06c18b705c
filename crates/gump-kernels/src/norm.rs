//! Layer normalisation of a row.

use crate::rows::{sum, sum_squares_from};

/// Constant that the networks add to the variance of a row. Source: PyTorch's default.
pub const NORM_EPS: f64 = 1e-5;

/// Normalises one row; returns its mean and reciprocal deviation.
#[inline(always)]
pub fn normalize_row(x: &[f32], weight: &[f32], bias: &[f32], eps: f32, y: &mut [f32]) -> [f32; 2] {
    let c = weight.len() as f32;
    let mean = sum(x) / c;
    let reciprocal = 1.0 / (sum_squares_from(x, mean) / c + eps).sqrt();
    for (((y, x), w), b) in y.iter_mut().zip(x).zip(weight).zip(bias) {
        *y = (x - mean) * reciprocal * w + b;
    }
    [mean, reciprocal]
}
