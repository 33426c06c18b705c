//! A histogram with fixed bins, which can be added to and compared with another of the same bins.

/// Counts in bins of equal width; values outside count in the first or the last bin.
#[derive(Clone, Debug, PartialEq)]
pub struct Distribution {
    low: f64,
    high: f64,
    counts: Vec<u64>,
    sum: f64,
    squares: f64,
}

impl Distribution {
    /// An empty distribution of `bins` bins from `low` to `high`.
    pub fn new(low: f64, high: f64, bins: usize) -> Self {
        Self {
            low,
            high,
            counts: vec![0; bins.max(1)],
            sum: 0.0,
            squares: 0.0,
        }
    }

    /// A distribution from stored values: its mean, its standard deviation and its counts.
    pub fn from_parts(low: f64, high: f64, counts: Vec<u64>, mean: f64, deviation: f64) -> Self {
        let n = counts.iter().sum::<u64>() as f64;
        Self {
            low,
            high,
            counts,
            sum: mean * n,
            squares: (deviation * deviation + mean * mean) * n,
        }
    }

    /// Adds an observation, moved to the nearest value of the range.
    pub fn add(&mut self, value: f64) {
        let value = value.clamp(self.low, self.high);
        let last = self.counts.len() - 1;
        // The epsilon keeps values on the border of two bins, such as 0.1, in the upper one.
        let bin = ((value - self.low) / self.step() + 1e-9) as usize;
        self.counts[bin.min(last)] += 1;
        self.sum += value;
        self.squares += value * value;
    }

    /// Adds another distribution of the same bins.
    pub fn merge(&mut self, other: &Self) {
        for (own, theirs) in self.counts.iter_mut().zip(&other.counts) {
            *own += theirs;
        }
        self.sum += other.sum;
        self.squares += other.squares;
    }

    /// Observations.
    pub fn n(&self) -> u64 {
        self.counts.iter().sum()
    }

    /// Observations in each bin.
    pub fn counts(&self) -> &[u64] {
        &self.counts
    }

    /// Mean of the observations, each within the range; 0 of none.
    pub fn mean(&self) -> f64 {
        self.sum / (self.n() as f64).max(1.0)
    }

    /// Standard deviation of the observations, each within the range.
    pub fn deviation(&self) -> f64 {
        let n = (self.n() as f64).max(1.0);
        let mean = self.sum / n;
        (self.squares / n - mean * mean).max(0.0).sqrt()
    }

    /// The value that a share `q` of the observations does not exceed, to a bin; `None` of none.
    pub fn quantile(&self, q: f64) -> Option<f64> {
        let wanted = q * self.n() as f64;
        let mut below = 0.0;
        for (bin, &count) in self.counts.iter().enumerate() {
            let count = count as f64;
            if count > 0.0 && below + count >= wanted {
                let part = ((wanted - below) / count).clamp(0.0, 1.0);
                return Some(self.low + (bin as f64 + part) * self.step());
            }
            below += count;
        }
        None
    }

    /// 1-Wasserstein distance, in standard deviations of `reference` (at least a tenth of a bin).
    pub fn wasserstein(&self, reference: &Self) -> f64 {
        let (own, theirs) = (self.shares(), reference.shares());
        let (mut below, mut sum) = (0.0, 0.0);
        // The last bin ends both at 1.
        for (p, q) in own.iter().zip(&theirs).take(own.len() - 1) {
            below += p - q;
            sum += f64::abs(below);
        }
        sum * self.step() / reference.deviation().max(0.1 * self.step())
    }

    /// Jensen-Shannon divergence over the bins, in bits.
    pub fn jensen_shannon(&self, reference: &Self) -> f64 {
        let term = |p: f64, middle: f64| {
            if p > 0.0 {
                p * (p / middle).log2()
            } else {
                0.0
            }
        };
        let (own, theirs) = (self.shares(), reference.shares());
        let pairs = own.iter().zip(&theirs);
        let sum: f64 = pairs
            .map(|(&p, &q)| {
                let middle = f64::midpoint(p, q);
                f64::midpoint(term(p, middle), term(q, middle))
            })
            .sum();
        sum.max(0.0)
    }

    fn shares(&self) -> Vec<f64> {
        let n = (self.n() as f64).max(1.0);
        self.counts.iter().map(|&count| count as f64 / n).collect()
    }

    fn step(&self) -> f64 {
        (self.high - self.low) / self.counts.len() as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(values: &[f64]) -> Distribution {
        let mut distribution = Distribution::new(0.0, 10.0, 100);
        values.iter().for_each(|value| distribution.add(*value));
        distribution
    }

    #[test]
    fn moments_and_quantiles() {
        let d = of(&[1.0, 2.0, 3.0, 99.0]);
        assert_eq!((d.n(), d.mean()), (4, 4.0));
        let square = |x: f64| (x - 4.0) * (x - 4.0);
        let deviation = ((square(1.0) + square(2.0) + square(3.0) + square(10.0)) / 4.0).sqrt();
        assert!((d.deviation() - deviation).abs() < 1e-12);
        assert!((d.quantile(0.5).unwrap() - 2.1).abs() < 1e-9);
        assert_eq!(of(&[]).quantile(0.5), None);
    }

    #[test]
    fn a_shift_is_as_far_as_it_is() {
        let (a, b) = (of(&[1.0, 2.0, 3.0]), of(&[3.0, 4.0, 5.0]));
        let expected = 2.0 / b.deviation();
        assert!((a.wasserstein(&b) - expected).abs() < 1e-9);
        assert!(a.wasserstein(&a) == 0.0 && a.jensen_shannon(&a) == 0.0);
        let far = of(&[9.0]);
        assert!((a.jensen_shannon(&far) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn shares_of_what_holds_differ_by_their_difference() {
        let [mut a, mut b] = [(); 2].map(|()| Distribution::new(-0.5, 1.5, 2));
        (0..10).for_each(|i| a.add(f64::from(u8::from(i < 5))));
        (0..10).for_each(|i| b.add(f64::from(u8::from(i < 2))));
        assert!((a.wasserstein(&b) - 0.3 / 0.4).abs() < 1e-12);
    }

    #[test]
    fn parts_give_the_same_distances() {
        let (a, b) = (of(&[1.0, 2.0, 7.5]), of(&[2.0, 4.0]));
        let again =
            Distribution::from_parts(0.0, 10.0, b.counts().to_vec(), b.mean(), b.deviation());
        assert!((a.wasserstein(&b) - a.wasserstein(&again)).abs() < 1e-9);
    }
}
