//! Group normalization: maps with mean 0 and variance 1, by row and group of channels.
//!
//! Source: Wu and He 2018, "Group Normalization". Unlike in batch normalization, the result of a
//! row does not depend on other rows, so small batches, target copies and single rows need no
//! running statistics.

/// Groups of channels, as many as fit; the paper takes 32 of much wider maps.
const GROUPS: usize = 8;
/// Added to the variance. Source: PyTorch's default.
const EPSILON: f32 = 1e-5;

/// The shape of what is normalized: maps `[channel, row of the batch, pixel]`.
#[derive(Clone, Copy, Debug)]
pub(super) struct GroupNorm {
    /// A multiple of 8.
    pub(super) channels: usize,
    pub(super) rows: usize,
    /// Pixels of a map.
    pub(super) area: usize,
}

impl GroupNorm {
    /// Scales, then shifts, one per channel.
    pub(super) fn n_parameters(channels: usize) -> usize {
        2 * channels
    }

    /// Normalizes `maps` in place, leaving one over each group's deviation, `[row, group]`, in
    /// `inverse_deviations`; the scaled and shifted maps in `output`.
    pub(super) fn forward(
        &self,
        parameters: &[f32],
        maps: &mut [f32],
        inverse_deviations: &mut Vec<f32>,
        output: &mut Vec<f32>,
    ) {
        inverse_deviations.clear();
        for row in 0..self.rows {
            for group in 0..GROUPS {
                let (mut sum, mut squares) = (0.0f64, 0.0f64);
                for channel in self.channels_of(group) {
                    let map = &maps[self.map(channel, row)];
                    sum += f64::from(map.iter().sum::<f32>());
                    squares += f64::from(map.iter().map(|x| x * x).sum::<f32>());
                }
                let n = self.group_len() as f64;
                let mean = sum / n;
                let variance = (squares / n - mean * mean).max(0.0) as f32;
                let inverse = 1.0 / (variance + EPSILON).sqrt();
                inverse_deviations.push(inverse);
                let mean = mean as f32;
                for channel in self.channels_of(group) {
                    for x in &mut maps[self.map(channel, row)] {
                        *x = (*x - mean) * inverse;
                    }
                }
            }
        }
        let (scales, shifts) = parameters.split_at(self.channels);
        output.clear();
        let channels = maps.chunks_exact(self.rows * self.area);
        for ((map, &scale), &shift) in channels.zip(scales).zip(shifts) {
            output.extend(map.iter().map(|x| scale * x + shift));
        }
    }

    /// Adds the gradient of the parameters to `gradient` and turns that of the output, in `delta`,
    /// into that of the input.
    pub(super) fn backward(
        &self,
        (parameters, gradient): (&[f32], &mut [f32]),
        normalized: &[f32],
        inverse_deviations: &[f32],
        delta: &mut [f32],
    ) {
        let (of_scales, of_shifts) = gradient.split_at_mut(self.channels);
        let scales = &parameters[..self.channels];
        let len = self.rows * self.area;
        let channels = delta
            .chunks_exact_mut(len)
            .zip(normalized.chunks_exact(len));
        for (channel, (delta, normalized)) in channels.enumerate() {
            of_scales[channel] += delta
                .iter()
                .zip(normalized)
                .map(|(d, x)| d * x)
                .sum::<f32>();
            of_shifts[channel] += delta.iter().sum::<f32>();
            for d in delta {
                *d *= scales[channel];
            }
        }
        for row in 0..self.rows {
            for group in 0..GROUPS {
                let (mut sum, mut product) = (0.0f32, 0.0f32);
                for channel in self.channels_of(group) {
                    let (delta, x) = (
                        &delta[self.map(channel, row)],
                        &normalized[self.map(channel, row)],
                    );
                    sum += delta.iter().sum::<f32>();
                    product += delta.iter().zip(x).map(|(d, x)| d * x).sum::<f32>();
                }
                let n = self.group_len() as f32;
                let (mean, slope) = (sum / n, product / n);
                let inverse = inverse_deviations[row * GROUPS + group];
                for channel in self.channels_of(group) {
                    let map = self.map(channel, row);
                    for (d, x) in delta[map.clone()].iter_mut().zip(&normalized[map]) {
                        *d = inverse * (*d - mean - slope * x);
                    }
                }
            }
        }
    }

    fn channels_of(&self, group: usize) -> std::ops::Range<usize> {
        let len = self.channels / GROUPS;
        group * len..(group + 1) * len
    }

    fn group_len(&self) -> usize {
        self.channels / GROUPS * self.area
    }

    fn map(&self, channel: usize, row: usize) -> std::ops::Range<usize> {
        let begin = (channel * self.rows + row) * self.area;
        begin..begin + self.area
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_scene::Seed;
    use rand::Rng as _;

    const NORM: GroupNorm = GroupNorm {
        channels: 16,
        rows: 3,
        area: 4,
    };

    fn random(n: usize, seed: u64) -> Vec<f32> {
        let mut rng = Seed(seed).rng();
        (0..n).map(|_| rng.random_range(-2.0..3.0)).collect()
    }

    fn run(parameters: &[f32], maps: &[f32]) -> (Vec<f32>, Vec<f32>, Vec<f32>) {
        let (mut maps, mut inverse, mut output) = (maps.to_vec(), Vec::new(), Vec::new());
        NORM.forward(parameters, &mut maps, &mut inverse, &mut output);
        (maps, inverse, output)
    }

    #[test]
    fn groups_have_mean_0_and_variance_1() {
        let (normalized, ..) = run(&random(32, 1), &random(192, 2));
        for row in 0..3 {
            for group in 0..GROUPS {
                let of = NORM.channels_of(group).map(|c| NORM.map(c, row));
                let values: Vec<f32> = of.flat_map(|map| normalized[map].to_vec()).collect();
                let mean = values.iter().sum::<f32>() / 8.0;
                let variance = values.iter().map(|x| x * x).sum::<f32>() / 8.0;
                assert!(mean.abs() < 1e-5 && (variance - 1.0).abs() < 1e-3);
            }
        }
    }

    #[test]
    fn gradients_are_finite_differences() {
        let (parameters, maps) = (random(32, 1), random(192, 2));
        let above = random(192, 3);
        let loss = |parameters: &[f32], maps: &[f32]| {
            let (.., output) = run(parameters, maps);
            let products = output.iter().zip(&above);
            products.map(|(y, w)| f64::from(y * w)).sum::<f64>()
        };
        let (normalized, inverse, _) = run(&parameters, &maps);
        let (mut gradient, mut delta) = (vec![0.0; 32], above.clone());
        NORM.backward(
            (&parameters, &mut gradient),
            &normalized,
            &inverse,
            &mut delta,
        );
        let h = 1e-2;
        let check = |found: f32, up: f64, down: f64| {
            let expected = (up - down) / (2.0 * f64::from(h));
            let error = (f64::from(found) - expected).abs();
            assert!(error < 5e-3 * (1.0 + expected.abs()), "{found}, {expected}");
        };
        let moved = |values: &[f32], i: usize, h: f32| {
            let mut values = values.to_vec();
            values[i] += h;
            values
        };
        for (i, &found) in gradient.iter().enumerate() {
            let at = |h| loss(&moved(&parameters, i, h), &maps);
            check(found, at(h), at(-h));
        }
        for (i, &found) in delta.iter().enumerate() {
            let at = |h| loss(&parameters, &moved(&maps, i, h));
            check(found, at(h), at(-h));
        }
    }
}
