//! The exact (error function) GELU of a row.
//!
//! The error function follows Abramowitz and Stegun 7.1.26 (absolute error 1.5e-7), whose exponential
//! is the normal density that the gradient needs.

use crate::rows::exp;
use crate::wide;

/// `x[i]` times the standard normal probability of being below `x[i]`, in place.
pub fn gelu_row(x: &mut [f32]) {
    wide(
        #[inline(always)]
        || {
            for x in x {
                *x *= normal(*x).0;
            }
        },
    );
}

/// The standard normal distribution at `x`: probability of being below, and density.
#[inline(always)]
pub fn normal(x: f32) -> (f32, f32) {
    const RECIPROCAL_SQRT_TAU: f32 = 0.398_942_3;
    let bell = exp(-0.5 * x * x);
    let z = x.abs() * std::f32::consts::FRAC_1_SQRT_2;
    let t = 1.0 / (1.0 + 0.327_591_1 * z);
    let mut p = 1.061_405_4;
    p = p * t - 1.453_152;
    p = p * t + 1.421_413_8;
    p = p * t - 0.284_496_74;
    p = p * t + 0.254_829_6;
    let tail = 0.5 * p * t * bell;
    let below = if x > 0.0 { 1.0 - tail } else { tail };
    (below, RECIPROCAL_SQRT_TAU * bell)
}
