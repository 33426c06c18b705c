//! Adam (Kingma and Ba 2015) over a slice of parameters.

/// Source of all three: the paper's defaults.
const BETA1: f64 = 0.9;
const BETA2: f64 = 0.999;
const EPSILON: f64 = 1e-8;

/// The moments of every parameter's gradient.
#[derive(Clone, Debug, PartialEq)]
pub struct Adam {
    /// First moments.
    pub mean: Vec<f32>,
    /// Second moments.
    pub square: Vec<f32>,
    /// Steps taken.
    pub steps: u64,
}

impl Adam {
    /// Moments of 0 for `n` parameters.
    pub fn new(n: usize) -> Self {
        Self {
            mean: vec![0.0; n],
            square: vec![0.0; n],
            steps: 0,
        }
    }

    /// One step against the gradient.
    ///
    /// # Panics
    /// If there are not as many parameters and gradients as moments.
    pub fn step(&mut self, parameters: &mut [f32], gradient: &[f32], learning_rate: f64) {
        assert_eq!(parameters.len(), self.mean.len(), "parameters");
        assert_eq!(gradient.len(), self.mean.len(), "gradients");
        self.steps += 1;
        let steps = self.steps as f64;
        let rate = (learning_rate / (1.0 - BETA1.powf(steps))) as f32;
        let correction = (1.0 / (1.0 - BETA2.powf(steps))) as f32;
        let (beta1, beta2, epsilon) = (BETA1 as f32, BETA2 as f32, EPSILON as f32);
        let moments = self.mean.iter_mut().zip(&mut self.square);
        for ((p, &g), (m, v)) in parameters.iter_mut().zip(gradient).zip(moments) {
            *m = beta1 * *m + (1.0 - beta1) * g;
            *v = beta2 * *v + (1.0 - beta2) * g * g;
            *p -= rate * *m / ((*v * correction).sqrt() + epsilon);
        }
    }
}

/// The Euclidean norm of a gradient.
pub fn norm(gradient: &[f32]) -> f64 {
    let squares: f64 = gradient.iter().map(|&g| f64::from(g) * f64::from(g)).sum();
    squares.sqrt()
}

/// Scales a gradient down to the norm `limit` if it is longer; its norm before.
pub fn clip(gradient: &mut [f32], limit: Option<f64>) -> f64 {
    let norm = norm(gradient);
    if let Some(limit) = limit.filter(|&limit| norm > limit) {
        let scale = (limit / norm) as f32;
        for g in gradient {
            *g *= scale;
        }
    }
    norm
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_steps_by_hand() {
        let mut adam = Adam::new(2);
        let mut parameters = [1.0, -1.0];
        // The first step is the learning rate against the sign, whatever the size.
        adam.step(&mut parameters, &[0.5, -20.0], 0.1);
        assert!((parameters[0] - 0.9).abs() < 1e-6 && (parameters[1] + 0.9).abs() < 1e-6);
        adam.step(&mut parameters, &[-0.5, -20.0], 0.1);
        // m = 0.9 * 0.05 - 0.05 = -0.005 over 0.19, v = 0.25 after correction.
        let expected = 0.9 + 0.1 * (0.005 / 0.19) / 0.5;
        assert!((parameters[0] - expected).abs() < 1e-6, "{}", parameters[0]);
        assert!((parameters[1] + 0.8).abs() < 1e-5, "{}", parameters[1]);
    }

    #[test]
    fn long_gradients_are_cut() {
        let mut gradient = [3.0, -4.0];
        assert_eq!(clip(&mut gradient, Some(6.0)), 5.0);
        assert_eq!(gradient, [3.0, -4.0]);
        assert_eq!(clip(&mut gradient, Some(2.5)), 5.0);
        assert_eq!(gradient, [1.5, -2.0]);
    }
}
