//! Confidence intervals over scenarios: [`interval`] of a mean, [`intervals`] of other statistics.

use gump_scene::Seed;
use rand::Rng as _;
use rayon::prelude::*;

/// The 95 % confidence interval of a mean.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Interval {
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

/// Number of resamples; the ends of an interval then vary by about 2 % of its width.
const N_RESAMPLES: usize = 2000;

/// The 95 % interval of the mean of `values`, one per scenario, by resampling scenarios; `None`
/// for fewer than two.
///
/// Equal seeds and numbers of scenarios give equal resamples, so intervals of several metrics share
/// them.
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
    middle(&mut means)
}

/// 95 % intervals of the values of `statistic` over `n` scenarios, for statistics that are not
/// means over scenarios; empty for fewer than two scenarios.
///
/// `n_resamples` times, `n` scenarios are drawn with replacement and their indices passed to
/// `statistic`; each interval is the 2.5th to 97.5th percentile of a value. The values must come in
/// the same order every time. Resamples in which a value is `None` do not count for it; a value
/// that is always `None` has no interval. Results do not depend on the number of threads.
///
/// Source: percentile bootstrap, Efron 1979.
pub fn intervals(
    n: usize,
    n_resamples: usize,
    seed: Seed,
    statistic: impl Fn(&[usize]) -> Vec<Option<f64>> + Sync,
) -> Vec<Option<Interval>> {
    if n < 2 {
        return Vec::new();
    }
    intervals_of_groups(&[n], n_resamples, seed, |drawn| statistic(&drawn[0]))
}

/// As [`intervals`] over several groups at once, for instance scenarios and policies: every
/// resample draws from each group as many indices as it has members, independently of the others,
/// and passes them in the order of the groups.
///
/// Source: Owen 2007, "The pigeonhole bootstrap".
///
/// # Panics
/// For an empty group.
pub fn intervals_of_groups(
    sizes: &[usize],
    n_resamples: usize,
    seed: Seed,
    statistic: impl Fn(&[Vec<usize>]) -> Vec<Option<f64>> + Sync,
) -> Vec<Option<Interval>> {
    let resample = |k: usize| {
        let mut rng = seed.fork(k as u64).rng();
        let mut draw = |&n: &usize| (0..n).map(|_| rng.random_range(0..n)).collect();
        statistic(&sizes.iter().map(&mut draw).collect::<Vec<Vec<usize>>>())
    };
    let resamples: Vec<_> = (0..n_resamples).into_par_iter().map(resample).collect();
    let n_numbers = resamples.iter().map(Vec::len).max().unwrap_or(0);
    let interval = |i: usize| {
        let values = resamples.iter().filter_map(|numbers| *numbers.get(i)?);
        middle(&mut values.collect::<Vec<f64>>())
    };
    (0..n_numbers).map(interval).collect()
}

/// The middle 95 % of values, linear between two of them.
fn middle(values: &mut [f64]) -> Option<Interval> {
    values.sort_by(f64::total_cmp);
    let last = values.len().checked_sub(1)?;
    let at = |share: f64| {
        let position = share * last as f64;
        let below = position as usize;
        let above = (below + 1).min(last);
        values[below] + (position - below as f64) * (values[above] - values[below])
    };
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

    #[test]
    fn the_middle_by_hand() {
        let found = middle(&mut [10.0, 1.0, 0.0, 3.0, 2.0]).unwrap();
        assert!((found.low - 0.1).abs() < 1e-12 && (found.high - 9.3).abs() < 1e-12);
        assert_eq!(middle(&mut []), None);
    }

    #[test]
    fn the_interval_of_a_statistic_is_that_of_theory() {
        // Half zeros, half ones: the mean of 400 has a standard error of 0.025.
        let mean = |drawn: &[usize]| {
            let ones = drawn.iter().filter(|&&i| i % 2 == 1).count();
            vec![Some(ones as f64 / drawn.len() as f64), None]
        };
        let found = intervals(400, 2000, Seed(3), mean);
        let Interval { low, high } = found[0].unwrap();
        assert!((low - (0.5 - 1.96 * 0.025)).abs() < 0.006, "{low}");
        assert!((high - (0.5 + 1.96 * 0.025)).abs() < 0.006, "{high}");
        assert_eq!(found[1], None);
        assert_eq!(found, intervals(400, 2000, Seed(3), mean));
        assert_ne!(found, intervals(400, 2000, Seed(4), mean));
        assert!(intervals(1, 10, Seed(0), mean).is_empty());
    }
}
