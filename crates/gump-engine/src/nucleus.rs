//! Nucleus sampling (top-p), and stateless random numbers.

use gump_scene::Seed;

/// A number in [0, 1) that is a function of the seed only.
pub fn uniform(seed: Seed) -> f64 {
    (seed.fork(0).0 >> 11) as f64 / (1u64 << 53) as f64
}

/// Keeps the largest weights that together have a share `top_p` of the total; reorders them.
pub(crate) fn least_kept(weights: &mut [f32], top_p: f64) -> f32 {
    let total: f64 = weights.iter().map(|w| f64::from(*w)).sum();
    // All that are smaller than an even share of the tail add up to less than the tail: they are in
    // it, and need no order. These are most of them.
    let even = (1.0 - top_p) * total / weights.len() as f64;
    let mut n = 0;
    for i in 0..weights.len() {
        if f64::from(weights[i]) >= even {
            weights.swap(i, n);
            n += 1;
        }
    }
    let large = &mut weights[..n];
    large.sort_unstable_by(|a, b| b.total_cmp(a));
    let mut left = top_p * total;
    for weight in &*large {
        left -= f64::from(*weight);
        if left <= 0.0 {
            return *weight;
        }
    }
    large.last().copied().unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_least_kept_is_that_of_all_weights_in_order() {
        for case in 0..200 {
            let draw = |i: u64| uniform(Seed(case).fork(i));
            let mut weights: Vec<f32> = (0..97).map(|i| draw(i).powi(12) as f32).collect();
            let top_p = 0.5 + 0.5 * draw(1000);
            let mut sorted = weights.clone();
            sorted.sort_by(|a, b| b.total_cmp(a));
            let total: f64 = sorted.iter().map(|w| f64::from(*w)).sum();
            let kept = |n: usize| sorted[..n].iter().map(|w| f64::from(*w)).sum::<f64>();
            let n = (1..97).find(|&n| kept(n) >= top_p * total).unwrap_or(97);
            assert_eq!(
                least_kept(&mut weights, top_p),
                sorted[n - 1],
                "case {case}"
            );
        }
        assert_eq!(least_kept(&mut [0.25; 4], 1.0), 0.25);
        assert_eq!(least_kept(&mut [], 0.9), 0.0);
    }
}
