//! Normalization of observations to one scale.

/// Maximum absolute value of a normalized number.
///
/// Source: the default of Stable-Baselines3's observation normalisation.
const LIMIT: f32 = 10.0;

/// Subtracts a mean and divides by a standard deviation, both fixed at construction.
#[derive(Clone, Debug, PartialEq)]
pub struct Normalizer {
    /// Mean, per number.
    pub shift: Vec<f32>,
    /// Reciprocal standard deviation, per number, > 0.
    pub scale: Vec<f32>,
}

impl Normalizer {
    /// The identity, except that numbers are clipped to ±10.
    pub fn identity(len: usize) -> Self {
        Self {
            shift: vec![0.0; len],
            scale: vec![1.0; len],
        }
    }

    /// Whether this is the identity, which nothing has been fitted to.
    pub fn is_identity(&self) -> bool {
        *self == Self::identity(self.shift.len())
    }

    /// Scales the content of the `pieces` to mean 0 and variance 1; constant numbers become 0.
    ///
    /// Shape: `[rows, len]` each.
    pub fn fitted(len: usize, pieces: &[&[f32]]) -> Self {
        let rows = || pieces.iter().flat_map(|piece| piece.chunks_exact(len));
        let n = rows().count().max(1) as f64;
        let mut mean = vec![0.0; len];
        for row in rows() {
            for (sum, &x) in mean.iter_mut().zip(row) {
                *sum += f64::from(x) / n;
            }
        }
        let mut variance = vec![0.0; len];
        for row in rows() {
            for ((sum, mean), &x) in variance.iter_mut().zip(&mean).zip(row) {
                *sum += (f64::from(x) - mean).powi(2) / n;
            }
        }
        // What does not vary is not blown up.
        let scale = |v: f64| if v > 1e-8 { 1.0 / v.sqrt() } else { 1.0 } as f32;
        Self {
            shift: mean.into_iter().map(|m| m as f32).collect(),
            scale: variance.into_iter().map(scale).collect(),
        }
    }

    /// Normalises rows in place. Shape: `[rows, len]`.
    pub fn apply(&self, observations: &mut [f32]) {
        for row in observations.chunks_exact_mut(self.shift.len()) {
            for ((x, shift), scale) in row.iter_mut().zip(&self.shift).zip(&self.scale) {
                *x = ((*x - shift) * scale).clamp(-LIMIT, LIMIT);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fitted_rows_have_mean_0_and_variance_1() {
        let (a, b) = ([1.0, 5.0, 3.0, 5.0], [8.0, 5.0]);
        let normalizer = Normalizer::fitted(2, &[&a, &b]);
        let mut rows = [a.to_vec(), b.to_vec()].concat();
        normalizer.apply(&mut rows);
        let first: Vec<f32> = rows.iter().copied().step_by(2).collect();
        let mean = first.iter().sum::<f32>() / 3.0;
        let variance = first.iter().map(|x| x * x).sum::<f32>() / 3.0;
        assert!(mean.abs() < 1e-6 && (variance - 1.0).abs() < 1e-6);
        assert_eq!([rows[1], rows[3], rows[5]], [0.0; 3]);
    }

    #[test]
    fn what_is_far_out_is_cut_off() {
        let mut row = [-20.0, 3.0, f32::MAX];
        Normalizer::identity(3).apply(&mut row);
        assert_eq!(row, [-10.0, 3.0, 10.0]);
    }
}
