//! Four statistics of a series, and the devkit's rounding between its steps.

/// Largest, smallest, average and 90th percentile of a series.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Statistics {
    /// The largest value.
    pub max: f64,
    /// The smallest value.
    pub min: f64,
    /// The average.
    pub mean: f64,
    /// The 90th percentile: the observation closest to it; of two equally close ones, the one with
    /// the odd rank.
    pub p90: f64,
}

impl Statistics {
    /// The statistics of `values`; `None` if there are none.
    pub fn of(values: &[f64]) -> Option<Self> {
        let mut sorted = values.to_vec();
        sorted.sort_by(f64::total_cmp);
        Some(Self {
            max: *sorted.last()?,
            min: *sorted.first()?,
            mean: values.iter().sum::<f64>() / values.len() as f64,
            p90: closest_observation(&sorted, 0.9),
        })
    }
}

/// The observation closest to a quantile, as numpy's method of that name finds it.
fn closest_observation(sorted: &[f64], quantile: f64) -> f64 {
    let position = sorted.len() as f64 * quantile - 1.5;
    let below = position.floor();
    let take_below = position == below && below.rem_euclid(2.0) == 0.0;
    let rank = if take_below { below } else { below + 1.0 };
    sorted[(rank.max(0.0) as usize).min(sorted.len() - 1)]
}

/// Rounds to 8 decimals, halves to even.
pub(crate) fn round8(value: f64) -> f64 {
    (value * 1e8).round_ties_even() / 1e8
}

/// Mean step of a clock, seconds; 0 for fewer than two times.
pub(crate) fn mean_step(times_us: &[i64]) -> f64 {
    match times_us {
        [first, .., last] => (last - first) as f64 / 1e6 / (times_us.len() - 1) as f64,
        _ => 0.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_percentile_is_an_observation() {
        let check = |n: i32, expected: f64| {
            let values: Vec<f64> = (0..n).rev().map(f64::from).collect();
            assert_eq!(Statistics::of(&values).unwrap().p90, expected, "{n}");
        };
        check(1, 0.0);
        check(5, 4.0);
        check(12, 10.0);
        check(15, 12.0);
        assert_eq!(Statistics::of(&[]), None);
    }

    #[test]
    fn a_jittering_clock_has_a_mean_step() {
        assert_eq!(mean_step(&[0, 90_000, 200_000]), 0.1);
        assert_eq!(mean_step(&[7]), 0.0);
    }
}
