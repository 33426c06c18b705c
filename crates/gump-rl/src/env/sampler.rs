//! Selection of scenarios for episodes.

use gump_scene::Seed;
use rand::Rng as _;
use serde::{Deserialize, Serialize};

/// Rule by which episodes choose their scenarios.
#[derive(Clone, Copy, Debug, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case", deny_unknown_fields)]
#[non_exhaustive]
pub enum Sampling {
    /// Uniformly at random.
    #[default]
    Uniform,
    /// In order, each once before any is repeated: row `i` of `n` drives the scenarios `i`,
    /// `i + n`, `i + 2 n`, ... For evaluation.
    InOrder,
    /// Scenarios with recent failures more often: the weight is `floor` plus the share of failures,
    /// of which each episode forgets the share `forget`. Draws of one row then depend on the
    /// outcomes of the others.
    Prioritized {
        /// Weight of a scenario that is never failed, > 0.
        floor: f64,
        /// In (0, 1].
        forget: f64,
    },
}

impl Sampling {
    /// A scenario without failures is drawn a tenth as often as one that always fails; half of the
    /// weight of past outcomes is gone after seven episodes.
    pub fn prioritized() -> Self {
        Self::Prioritized {
            floor: 0.1,
            forget: 0.1,
        }
    }

    /// The name of the first parameter that is out of range, with its value and what is expected.
    pub(super) fn check(&self) -> Option<(&'static str, f64, &'static str)> {
        let Self::Prioritized { floor, forget } = *self else {
            return None;
        };
        if !(floor > 0.0 && floor.is_finite()) {
            Some(("floor", floor, "a positive number"))
        } else if !(forget > 0.0 && forget <= 1.0) {
            Some(("forget", forget, "above 0 and at most 1"))
        } else {
            None
        }
    }
}

/// Draws scenarios and keeps their outcomes.
#[derive(Debug)]
pub(super) struct Sampler {
    sampling: Sampling,
    n_rows: usize,
    /// Recent share of failures per scenario.
    failures: Vec<f64>,
}

impl Sampler {
    pub(super) fn new(sampling: Sampling, n_rows: usize, n_scenarios: usize) -> Self {
        Self {
            sampling,
            n_rows,
            // Nothing is known yet, so all are as likely, and as likely as hard ones.
            failures: vec![1.0; n_scenarios],
        }
    }

    /// The scenario of an episode.
    pub(super) fn draw(&self, row: usize, episode: u64, seed: Seed) -> usize {
        let n = self.failures.len();
        match self.sampling {
            Sampling::Uniform => seed.rng().random_range(0..n),
            Sampling::InOrder => {
                let index = row as u64 + episode * self.n_rows as u64;
                (index % n as u64) as usize
            }
            Sampling::Prioritized { floor, .. } => {
                let total: f64 = self.failures.iter().map(|f| floor + f).sum();
                let mut left = seed.rng().random_range(0.0..total);
                let passes = |share: &f64| {
                    left -= floor + share;
                    left < 0.0
                };
                self.failures.iter().position(passes).unwrap_or(n - 1)
            }
        }
    }

    /// Records the outcome of an episode.
    pub(super) fn note(&mut self, scenario: usize, failed: bool) {
        if let Sampling::Prioritized { forget, .. } = self.sampling {
            let known = &mut self.failures[scenario];
            *known += forget * (f64::from(u8::from(failed)) - *known);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn counts(sampler: &Sampler, n: u64) -> Vec<u64> {
        let mut counts = vec![0; sampler.failures.len()];
        for episode in 0..n {
            counts[sampler.draw(0, episode, Seed(7).fork(episode))] += 1;
        }
        counts
    }

    #[test]
    fn uniform_draws_are_uniform() {
        let counts = counts(&Sampler::new(Sampling::Uniform, 4, 10), 5000);
        // Chi-square with 9 degrees of freedom: 27.9 is exceeded once in a thousand.
        let chi_square: f64 = counts
            .iter()
            .map(|n| (*n as f64 - 500.0).powi(2) / 500.0)
            .sum();
        assert!(chi_square < 27.9, "{chi_square}");
    }

    #[test]
    fn in_order_the_rows_share_the_scenarios() {
        let sampler = Sampler::new(Sampling::InOrder, 2, 5);
        let drawn = |row| [0, 1, 2].map(|episode| sampler.draw(row, episode, Seed(0)));
        assert_eq!((drawn(0), drawn(1)), ([0, 2, 4], [1, 3, 0]));
    }

    #[test]
    fn what_is_failed_comes_again() {
        let mut sampler = Sampler::new(Sampling::prioritized(), 1, 3);
        let even = counts(&sampler, 3000);
        assert!(even.iter().all(|n| (850..1150).contains(n)), "{even:?}");
        for _ in 0..100 {
            sampler.note(0, false);
            sampler.note(1, true);
            sampler.note(2, false);
        }
        // Weights of 0.1, 1.1 and 0.1.
        let counts = counts(&sampler, 3000);
        assert!((2450..2630).contains(&counts[1]), "{counts:?}");
        assert!(counts[0] > 170 && counts[2] > 170, "{counts:?}");
    }
}
