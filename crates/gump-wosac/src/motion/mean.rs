//! A mean that does not depend on the order of summation.

/// Sum and count of measurements; merging in any order gives the same bits.
///
/// Numbers are summed as multiples of 2⁻⁴⁰ (1e-12), far below the accuracy of any measurement here;
/// in return a benchmark that is split over machines gives exactly the totals of one run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Mean {
    sum: i128,
    n: u64,
}

/// Quanta per unit: see [`Mean`].
const QUANTA: f64 = (1_u64 << 40) as f64;

impl Mean {
    /// Adds a measurement; it must be finite and below 1e25, as any distance on Earth is.
    pub fn add(&mut self, value: f64) {
        debug_assert!(value.is_finite(), "a measurement is a number");
        self.sum += (value * QUANTA).round() as i128;
        self.n += 1;
    }

    /// Adds the measurements of another.
    pub fn merge(&mut self, other: &Self) {
        self.sum += other.sum;
        self.n += other.n;
    }

    /// The mean, `None` without measurements.
    pub fn value(&self) -> Option<f64> {
        (self.n > 0).then(|| self.sum as f64 / QUANTA / self.n as f64)
    }

    /// Number of measurements.
    pub fn count(&self) -> u64 {
        self.n
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn order_does_not_matter() {
        let numbers = [1e8, 1e-9, -0.1, 0.3, 7.7, 1e3 / 3.0];
        let mean = |numbers: &mut dyn Iterator<Item = &f64>| {
            let mut mean = Mean::default();
            numbers.for_each(|&x| mean.add(x));
            mean
        };
        let forward = mean(&mut numbers.iter());
        assert_eq!(forward, mean(&mut numbers.iter().rev()));
        let mut merged = mean(&mut numbers[2..].iter());
        merged.merge(&mean(&mut numbers[..2].iter()));
        assert_eq!(merged, forward);
        let expected = numbers.iter().sum::<f64>() / 6.0;
        assert!((forward.value().unwrap() - expected).abs() < 1e-8);
        assert_eq!((Mean::default().value(), forward.count()), (None, 6));
    }
}
