//! Means over scenarios and how far to trust them.

use gump_scene::Seed;
use rand::Rng as _;

/// Resamples of the bootstrap.
const RESAMPLES: usize = 2000;

/// Mean; `None` of nothing.
pub(crate) fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// The interval that holds the mean with 95 % confidence, by the percentile bootstrap; `None` of
/// nothing.
pub(crate) fn interval(values: &[f64], seed: Seed) -> Option<(f64, f64)> {
    mean(values)?;
    let n = values.len();
    let mut rng = seed.rng();
    let mut means: Vec<f64> = (0..RESAMPLES)
        .map(|_| (0..n).map(|_| values[rng.random_range(0..n)]).sum::<f64>() / n as f64)
        .collect();
    means.sort_by(f64::total_cmp);
    let at = |share: f64| means[(share * (RESAMPLES - 1) as f64).round() as usize];
    Some((at(0.025), at(0.975)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_interval_shrinks_with_the_number_of_scenarios() {
        let alternating = |n: usize| (0..n).map(|i| (i % 2) as f64).collect::<Vec<_>>();
        let width = |n: usize| {
            let (low, high) = interval(&alternating(n), Seed(1)).unwrap();
            assert!(low <= 0.5 && 0.5 <= high);
            high - low
        };
        // Twice 1.96 standard errors of 0.5 / sqrt(n).
        assert!((width(100) - 0.196).abs() < 0.03, "{}", width(100));
        assert!(width(400) < 0.6 * width(100));
        assert_eq!(interval(&[], Seed(0)), None);
        assert_eq!(interval(&[0.3], Seed(0)), Some((0.3, 0.3)));
    }
}
