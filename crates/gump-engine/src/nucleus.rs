//! Draws that keep to what is likely.

use gump_scene::Seed;

/// A number in [0, 1) that is a function of the seed alone: no generator, no state.
pub fn uniform(seed: Seed) -> f64 {
    (seed.fork(0).0 >> 11) as f64 / (1u64 << 53) as f64
}

/// The smallest of the largest weights that together have a share `top_p` of all; sorts them.
pub(crate) fn least_kept(weights: &mut [f32], top_p: f64) -> f32 {
    weights.sort_unstable_by(|a, b| b.total_cmp(a));
    let total: f64 = weights.iter().map(|w| f64::from(*w)).sum();
    let mut left = top_p * total;
    for weight in weights.iter() {
        left -= f64::from(*weight);
        if left <= 0.0 {
            return *weight;
        }
    }
    0.0
}
