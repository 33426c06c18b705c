//! The Savitzky–Golay filter: smoothing and derivatives by polynomials fitted to a sliding window.

/// Parameters of the fit and of its evaluation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SavitzkyGolay {
    /// Samples per window; more than `polynomial`. May be even, see [`SavitzkyGolay::filter`].
    pub window: usize,
    /// Degree of the polynomial.
    pub polynomial: usize,
    /// Order of the derivative; 0 smooths.
    pub derivative: usize,
    /// Distance between samples, in the unit that the derivative is taken by.
    pub delta: f64,
}

impl SavitzkyGolay {
    /// The filtered samples, as many as given; `None` if there are fewer than a window or the
    /// window is too short for the polynomial.
    ///
    /// A window of odd length is centred on its sample. One of even length `w` reaches from
    /// `w/2 - 1` samples before to `w/2` after, and the polynomial is read off in *its* middle, half
    /// a sample later. The first and last `w/2` samples (rounded down) are read off the
    /// polynomials of the first and last window.
    ///
    /// Source: Savitzky and Golay 1964; even windows and edges as in scipy (`mode="interp"`).
    pub fn filter(&self, samples: &[f64]) -> Option<Vec<f64>> {
        let (n, w) = (samples.len(), self.window);
        if w <= self.polynomial || n < w {
            return None;
        }
        let edge = w / 2;
        let before = (w - 1) / 2;
        let inner = self.weights((w - 1) as f64 / 2.0);
        let read_off = |i: usize| {
            if i < edge {
                dot(&self.weights(i as f64), &samples[..w])
            } else if i >= n - edge {
                dot(&self.weights((w + i - n) as f64), &samples[n - w..])
            } else {
                dot(&inner, &samples[i - before..i - before + w])
            }
        };
        Some((0..n).map(read_off).collect())
    }

    /// The weight of each sample of a window in the derivative at position `at`, counted in samples
    /// from the window's first.
    pub fn weights(&self, at: f64) -> Vec<f64> {
        let middle = (self.window - 1) as f64 / 2.0;
        // Positions scaled to [-1, 1] keep the normal equations well conditioned.
        let scale = middle.max(1.0);
        let scaled = |position: f64| (position - middle) / scale;
        let positions: Vec<f64> = (0..self.window).map(|i| scaled(i as f64)).collect();
        let n = self.polynomial + 1;
        let mut moments = vec![vec![0.0; n]; n];
        for (row, moments) in moments.iter_mut().enumerate() {
            for (column, moment) in moments.iter_mut().enumerate() {
                *moment = positions
                    .iter()
                    .map(|u| u.powi((row + column) as i32))
                    .sum();
            }
        }
        let coefficients = solve(moments, self.monomial_derivatives(scaled(at)));
        let unit = (scale * self.delta).powi(self.derivative as i32);
        positions
            .iter()
            .map(|u| coefficients.iter().rev().fold(0.0, |sum, c| sum * u + c) / unit)
            .collect()
    }

    /// The derivative of 1, u, u², ... at `u`.
    fn monomial_derivatives(&self, u: f64) -> Vec<f64> {
        let d = self.derivative;
        (0..=self.polynomial)
            .map(|k| {
                if k < d {
                    return 0.0;
                }
                let factor: f64 = (k - d + 1..=k).map(|j| j as f64).product();
                factor * u.powi((k - d) as i32)
            })
            .collect()
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Solves a symmetric positive definite system by elimination.
fn solve(mut matrix: Vec<Vec<f64>>, mut right: Vec<f64>) -> Vec<f64> {
    let n = right.len();
    for pivot in 0..n {
        let (upper, lower) = matrix.split_at_mut(pivot + 1);
        let top = &upper[pivot];
        for (offset, row) in lower.iter_mut().enumerate() {
            let factor = row[pivot] / top[pivot];
            for column in pivot..n {
                row[column] -= factor * top[column];
            }
            right[pivot + 1 + offset] -= factor * right[pivot];
        }
    }
    for row in (0..n).rev() {
        let known: f64 = (row + 1..n).map(|c| matrix[row][c] * right[c]).sum();
        right[row] = (right[row] - known) / matrix[row][row];
    }
    right
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;

    #[test]
    fn a_polynomial_comes_back_with_its_derivatives() {
        let delta = 0.1;
        let samples: Vec<f64> = (0..20)
            .map(|i| {
                let t = f64::from(i) * delta;
                1.0 - 2.0 * t + 3.0 * t * t
            })
            .collect();
        for (window, derivative) in [(5, 0), (7, 1), (15, 2), (8, 2)] {
            let filter = SavitzkyGolay {
                window,
                polynomial: 2,
                derivative,
                delta,
            };
            let filtered = filter.filter(&samples).unwrap();
            for (i, value) in filtered.into_iter().enumerate() {
                let t = i as f64 * delta;
                let expected = match derivative {
                    0 => samples[i],
                    1 => -2.0 + 6.0 * t,
                    _ => 6.0,
                };
                assert_abs_diff_eq!(value, expected, epsilon = 1e-9);
            }
        }
    }

    #[test]
    fn too_few_samples_are_no_result() {
        let filter = SavitzkyGolay {
            window: 4,
            polynomial: 3,
            derivative: 0,
            delta: 1.0,
        };
        assert!(filter.filter(&[1.0; 3]).is_none());
        assert!(filter.filter(&[1.0; 4]).is_some());
        let narrow = SavitzkyGolay {
            window: 3,
            ..filter
        };
        assert!(narrow.filter(&[1.0; 9]).is_none());
    }
}
