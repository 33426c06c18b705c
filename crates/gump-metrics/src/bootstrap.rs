//! How sure an average over scenarios is.

use gump_scene::Seed;
use rand::Rng as _;

/// Where a mean lies with 95 % confidence.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Interval {
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

/// Resamples; the ends of an interval then stray by about 2 % of its width.
const N_RESAMPLES: usize = 2000;

/// The 95 % interval of the mean of `values`, one per scenario, by resampling scenarios; `None`
/// for fewer than two.
///
/// Equal seeds and numbers of scenarios draw equal scenarios, so intervals of several metrics are
/// of the same resamples.
///
/// Source: percentile bootstrap, Efron 1979.
pub fn interval(values: &[f64], seed: Seed) -> Option<Interval> {
    let n = values.len();
    if n < 2 {
        return None;
    }
    let mut rng = seed.rng();
    let mut means: Vec<f64> = (0..N_RESAMPLES)
        .map(|_| (0..n).map(|_| values[rng.random_range(0..n)]).sum::<f64>() / n as f64)
        .collect();
    means.sort_by(f64::total_cmp);
    let at = |share: f64| means[(share * (N_RESAMPLES - 1) as f64).round() as usize];
    Some(Interval {
        low: at(0.025),
        high: at(0.975),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn intervals_are_as_wide_as_the_normal_law_says() {
        // Uniform on [0, 1): the mean of 400 has a standard deviation of 1 / sqrt(12 * 400).
        let mut rng = Seed(1).rng();
        let values: Vec<f64> = (0..400).map(|_| rng.random()).collect();
        let mean = values.iter().sum::<f64>() / 400.0;
        let expected = 1.96 / (12.0f64 * 400.0).sqrt();
        let Interval { low, high } = interval(&values, Seed(0)).unwrap();
        assert!((mean - low - expected).abs() < 0.15 * expected, "{low}");
        assert!((high - mean - expected).abs() < 0.15 * expected, "{high}");
        assert_eq!(interval(&values, Seed(0)), interval(&values, Seed(0)));
    }

    #[test]
    fn one_scenario_says_nothing() {
        assert_eq!(interval(&[0.5], Seed(0)), None);
        let same = interval(&[0.5, 0.5], Seed(0)).unwrap();
        assert_eq!((same.low, same.high), (0.5, 0.5));
    }
}
