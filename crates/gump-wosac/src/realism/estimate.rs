//! Likelihoods of logged values under distributions estimated from simulated ones.

use super::config::{Estimator, FeatureConfig};

/// Extent of feature arrays, agent-major; indicators have one step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FeatureShape {
    /// Agents.
    pub agents: usize,
    /// Steps.
    pub steps: usize,
}

impl FeatureShape {
    /// The distribution that each value belongs to, in order, and the number of distributions.
    fn groups(self, config: &FeatureConfig) -> (Vec<usize>, usize) {
        let n_steps = if config.independent_timesteps {
            1
        } else {
            self.steps
        };
        let n_agents = if config.aggregate_agents {
            1
        } else {
            self.agents
        };
        let group = |i: usize| {
            let (agent, step) = (i / self.steps, i % self.steps);
            (agent % n_agents) * n_steps + step % n_steps
        };
        let groups = (0..self.agents * self.steps).map(group).collect();
        (groups, n_agents * n_steps)
    }
}

/// Log-likelihood of every logged value, `[agent, step]`; of a bin's mass, not of a density.
///
/// `simulated` has one array like `log` per rollout, each of which stands for `copies` equal ones.
/// Validity is ignored; NaN counts as a value of the last bin, as in the reference.
///
/// # Panics
/// If an array is not of the `shape`.
pub fn log_likelihoods(
    config: &FeatureConfig,
    log: &[f32],
    simulated: &[&[f32]],
    copies: usize,
    shape: FeatureShape,
) -> Vec<f32> {
    let (groups, n_groups) = shape.groups(config);
    assert_eq!(
        log.len(),
        groups.len(),
        "one logged value per agent and step"
    );
    match config.estimator {
        Estimator::Histogram {
            min,
            max,
            bins,
            pseudocount,
        } => Histogram::new(min, max, bins, pseudocount)
            .log_likelihoods(log, simulated, copies, &groups, n_groups),
        Estimator::Bernoulli { pseudocount } => Histogram::new(-0.5, 1.5, 2, pseudocount)
            .log_likelihoods(log, simulated, copies, &groups, n_groups),
        Estimator::KernelDensity { bandwidth } => {
            kernel_density(log, simulated, f64::from(bandwidth), &groups, n_groups)
        }
    }
}

/// As [`log_likelihoods`] without one rollout each, by rollout; at least two must be counted.
pub(crate) fn leave_one_out(
    config: &FeatureConfig,
    log: &[f32],
    simulated: &[&[f32]],
    copies: usize,
    shape: FeatureShape,
) -> Vec<Vec<f32>> {
    let histogram = match config.estimator {
        Estimator::Histogram {
            min,
            max,
            bins,
            pseudocount,
        } => Histogram::new(min, max, bins, pseudocount),
        Estimator::Bernoulli { pseudocount } => Histogram::new(-0.5, 1.5, 2, pseudocount),
        Estimator::KernelDensity { .. } => {
            let others = |i: usize| -> Vec<&[f32]> {
                let each = simulated.iter().enumerate();
                let kept = each.flat_map(|(k, rollout)| {
                    std::iter::repeat_n(*rollout, copies - usize::from(k == i))
                });
                kept.collect()
            };
            let without = |i| log_likelihoods(config, log, &others(i), 1, shape);
            return (0..simulated.len()).map(without).collect();
        }
    };
    let (groups, n_groups) = shape.groups(config);
    let n_bins = histogram.edges.len() - 1;
    let count = |rollout: &[f32], one: usize, counts: &mut [usize]| {
        for (&value, &group) in rollout.iter().zip(&groups) {
            counts[group * n_bins + histogram.bin(value)] += one;
        }
    };
    let mut all = vec![0; n_groups * n_bins];
    for rollout in simulated {
        count(rollout, copies, &mut all);
    }
    let mut n_of_group = vec![0; n_groups];
    for &group in &groups {
        n_of_group[group] += 1;
    }
    let wanted: Vec<usize> = log
        .iter()
        .zip(&groups)
        .map(|(&value, &group)| group * n_bins + histogram.bin(value))
        .collect();
    let without = |rollout: &&[f32]| {
        let mut own = vec![0; n_groups * n_bins];
        count(rollout, 1, &mut own);
        let left = (simulated.len() * copies - 1) as f32;
        let likelihood = |&at: &usize| {
            let values = left * n_of_group[at / n_bins] as f32;
            histogram.log_likelihood(all[at] - own[at], values)
        };
        wanted.iter().map(likelihood).collect()
    };
    simulated.iter().map(without).collect()
}

/// Equal bins over a range.
pub(crate) struct Histogram {
    pub(crate) edges: Vec<f32>,
    pseudocount: f32,
}

impl Histogram {
    pub(crate) fn new(min: f32, max: f32, bins: usize, pseudocount: f32) -> Self {
        let step = (max - min) / bins as f32;
        let edge = |j| {
            if j == bins {
                max
            } else {
                min + step * j as f32
            }
        };
        Self {
            edges: (0..=bins).map(edge).collect(),
            pseudocount,
        }
    }

    fn bin(&self, value: f32) -> usize {
        let last = self.edges.len() - 2;
        if value.is_nan() {
            return last;
        }
        let inner = &self.edges[1..=last];
        inner.iter().take_while(|&&edge| edge <= value).count()
    }

    /// Of a bin with `n` of a group's `all` values.
    fn log_likelihood(&self, n: usize, all: f32) -> f32 {
        let n_bins = (self.edges.len() - 1) as f32;
        ((n as f32 + self.pseudocount) / (all + n_bins * self.pseudocount)).ln()
    }

    fn log_likelihoods(
        &self,
        log: &[f32],
        simulated: &[&[f32]],
        copies: usize,
        groups: &[usize],
        n_groups: usize,
    ) -> Vec<f32> {
        let n_bins = self.edges.len() - 1;
        let mut counts = vec![0usize; n_groups * n_bins];
        for rollout in simulated {
            assert_eq!(rollout.len(), groups.len(), "one value per agent and step");
            for (&value, &group) in rollout.iter().zip(groups) {
                counts[group * n_bins + self.bin(value)] += copies;
            }
        }
        let likelihoods: Vec<f32> = counts
            .chunks(n_bins)
            .flat_map(|counts| {
                let all = counts.iter().sum::<usize>() as f32;
                counts.iter().map(move |&n| self.log_likelihood(n, all))
            })
            .collect();
        let pairs = log.iter().zip(groups);
        pairs
            .map(|(&value, &group)| likelihoods[group * n_bins + self.bin(value)])
            .collect()
    }
}

/// Logarithm of the mean of Gaussians around the samples of a value's group, each 1 at its centre.
fn kernel_density(
    log: &[f32],
    simulated: &[&[f32]],
    bandwidth: f64,
    groups: &[usize],
    n_groups: usize,
) -> Vec<f32> {
    let mut samples: Vec<Vec<f64>> = vec![Vec::new(); n_groups];
    for rollout in simulated {
        for (&value, &group) in rollout.iter().zip(groups) {
            samples[group].push(value.into());
        }
    }
    let pairs = log.iter().zip(groups);
    pairs
        .map(|(&value, &group)| {
            let exponents = samples[group].iter().map(|sample| {
                let off = (f64::from(value) - sample) / bandwidth;
                -off * off / 2.0
            });
            let exponents: Vec<f64> = exponents.collect();
            // Far samples must not underflow to the logarithm of nothing.
            let largest = exponents.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            let sum: f64 = exponents.iter().map(|e| (e - largest).exp()).sum();
            (largest + (sum / exponents.len() as f64).ln()) as f32
        })
        .collect()
}
