//! A multi-layer perceptron with hand-written gradients.

use gump_scene::Rng;
use rand::Rng as _;

use super::product::{Mat, add_product};

/// Dense layers with ReLU between them.
///
/// All parameters lie in one slice, layer after layer: weights `[out, in]`, then biases `[out]`.
#[derive(Clone, Debug, PartialEq)]
pub struct Mlp {
    sizes: Vec<usize>,
    parameters: Vec<f32>,
}

/// Values of a forward pass that the backward pass needs; reused from batch to batch.
#[derive(Clone, Debug, Default)]
pub struct Pass {
    rows: usize,
    /// The input, then the output of every layer.
    layers: Vec<Vec<f32>>,
    delta: Vec<f32>,
    delta_before: Vec<f32>,
}

impl Pass {
    /// The output of the network. Shape: `[rows, outputs]`.
    pub fn output(&self) -> &[f32] {
        self.layers.last().map_or(&[], Vec::as_slice)
    }

    /// Rows of the batch.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// The gradient of the input after [`Mlp::backward_to_input`] or [`Mlp::backward_through`].
    /// Shape: `[rows, inputs]`.
    pub fn input_gradient(&self) -> &[f32] {
        &self.delta
    }
}

impl Mlp {
    /// A network of these layer sizes, input first, with random parameters.
    ///
    /// Uniform in ±√(1 / inputs) as PyTorch's linear layers; the weights of the last layer times
    /// `output_gain`, its biases 0.
    ///
    /// # Panics
    /// For fewer than two sizes.
    pub fn new(sizes: &[usize], output_gain: f32, rng: &mut Rng) -> Self {
        assert!(sizes.len() > 1, "a network has an input and an output");
        let n_layers = sizes.len() - 1;
        let mut parameters = Vec::with_capacity(n_parameters(sizes));
        for (layer, pair) in sizes.windows(2).enumerate() {
            let [inputs, outputs] = [pair[0], pair[1]];
            let bound = (1.0 / inputs as f32).sqrt();
            let is_last = layer + 1 == n_layers;
            let (gain, bias) = if is_last {
                (output_gain, 0.0)
            } else {
                (1.0, 1.0)
            };
            let mut draw = |scale: f32| scale * bound * rng.random_range(-1.0f32..1.0);
            parameters.extend((0..inputs * outputs).map(|_| draw(gain)));
            parameters.extend((0..outputs).map(|_| draw(bias)));
        }
        Self {
            sizes: sizes.to_vec(),
            parameters,
        }
    }

    /// The network with these parameters; `None` if their number does not match the sizes.
    pub fn from_parameters(sizes: &[usize], parameters: Vec<f32>) -> Option<Self> {
        let fits = sizes.len() > 1 && parameters.len() == n_parameters(sizes);
        fits.then(|| Self {
            sizes: sizes.to_vec(),
            parameters,
        })
    }

    /// Layer sizes, input first.
    pub fn sizes(&self) -> &[usize] {
        &self.sizes
    }

    /// All parameters.
    pub fn parameters(&self) -> &[f32] {
        &self.parameters
    }

    /// All parameters, mutably.
    pub fn parameters_mut(&mut self) -> &mut [f32] {
        &mut self.parameters
    }

    /// Moves every parameter towards that of `online` by the share `tau` of the difference.
    ///
    /// # Panics
    /// If the networks differ in size.
    pub fn follow(&mut self, online: &Self, tau: f32) {
        assert_eq!(self.sizes, online.sizes, "a target is a copy");
        for (target, online) in self.parameters.iter_mut().zip(&online.parameters) {
            *target += tau * (online - *target);
        }
    }

    /// Runs a batch through the network; the output is in `pass`.
    ///
    /// Shape: `input` `[rows, inputs]`, row-major.
    ///
    /// # Panics
    /// If `input` is no whole number of rows.
    pub fn forward(&self, input: &[f32], pass: &mut Pass) {
        let rows = input.len() / self.sizes[0];
        assert_eq!(rows * self.sizes[0], input.len(), "rows of the input");
        pass.rows = rows;
        pass.layers.resize(self.sizes.len(), Vec::new());
        pass.layers[0].clear();
        pass.layers[0].extend_from_slice(input);
        let n_layers = self.sizes.len() - 1;
        for layer in 0..n_layers {
            let (weights, biases) = self.layer(layer);
            let (inputs, outputs) = (self.sizes[layer], self.sizes[layer + 1]);
            let (before, after) = pass.layers.split_at_mut(layer + 1);
            let output = &mut after[0];
            output.clear();
            for _ in 0..rows {
                output.extend_from_slice(biases);
            }
            // [rows, in] [in, out] -> [rows, out]
            let input = Mat::new(&before[layer], rows, inputs);
            add_product(output, input, Mat::new(weights, outputs, inputs).t());
            if layer + 1 < n_layers {
                for x in output.iter_mut() {
                    *x = x.max(0.0);
                }
            }
        }
    }

    /// Adds the gradient of the parameters to `gradient`, given that of the output.
    ///
    /// # Panics
    /// If the sizes do not fit the last [`Mlp::forward`] into `pass`.
    pub fn backward(&self, output_gradient: &[f32], pass: &mut Pass, gradient: &mut [f32]) {
        self.back(output_gradient, pass, Some(gradient), false);
    }

    /// [`Mlp::backward`] and [`Mlp::backward_to_input`] in one pass.
    ///
    /// # Panics
    /// If the sizes do not fit the last [`Mlp::forward`] into `pass`.
    pub fn backward_through(&self, output_gradient: &[f32], pass: &mut Pass, gradient: &mut [f32]) {
        self.back(output_gradient, pass, Some(gradient), true);
    }

    /// Computes the gradient of the input, given that of the output, and leaves it in `pass`.
    ///
    /// # Panics
    /// If the sizes do not fit the last [`Mlp::forward`] into `pass`.
    pub fn backward_to_input(&self, output_gradient: &[f32], pass: &mut Pass) {
        self.back(output_gradient, pass, None, true);
    }

    fn back(
        &self,
        output_gradient: &[f32],
        pass: &mut Pass,
        mut gradient: Option<&mut [f32]>,
        to_input: bool,
    ) {
        let Pass {
            rows,
            layers,
            delta,
            delta_before,
        } = pass;
        let rows = *rows;
        delta.clear();
        delta.extend_from_slice(output_gradient);
        let mut end = self.parameters.len();
        for layer in (0..self.sizes.len() - 1).rev() {
            let (inputs, outputs) = (self.sizes[layer], self.sizes[layer + 1]);
            let begin = end - (inputs + 1) * outputs;
            // [rows, out]
            let above = Mat::new(delta, rows, outputs);
            if let Some(gradient) = &mut gradient {
                let (weights, biases) = gradient[begin..end].split_at_mut(inputs * outputs);
                add_product(weights, above.t(), Mat::new(&layers[layer], rows, inputs));
                for row in delta.chunks_exact(outputs) {
                    for (sum, x) in biases.iter_mut().zip(row) {
                        *sum += x;
                    }
                }
            }
            if layer == 0 && !to_input {
                return;
            }
            delta_before.clear();
            delta_before.resize(rows * inputs, 0.0);
            let weights = Mat::new(self.layer(layer).0, outputs, inputs);
            add_product(delta_before, above, weights);
            if layer > 0 {
                for (x, &activation) in delta_before.iter_mut().zip(&layers[layer]) {
                    *x = if activation > 0.0 { *x } else { 0.0 };
                }
            }
            std::mem::swap(delta, delta_before);
            end = begin;
        }
    }

    /// Weights `[out, in]` and biases `[out]` of a layer.
    fn layer(&self, layer: usize) -> (&[f32], &[f32]) {
        let begin = n_parameters(&self.sizes[..=layer]);
        let end = n_parameters(&self.sizes[..layer + 2]);
        let weights = self.sizes[layer] * self.sizes[layer + 1];
        self.parameters[begin..end].split_at(weights)
    }
}

fn n_parameters(sizes: &[usize]) -> usize {
    sizes.windows(2).map(|pair| (pair[0] + 1) * pair[1]).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_scene::Seed;

    fn network() -> Mlp {
        Mlp::new(&[3, 8, 5, 2], 1.0, &mut Seed(4).rng())
    }

    const INPUT: [f32; 12] = [
        0.3, -1.0, 0.7, 1.5, 0.2, -0.4, -0.9, 0.8, 0.1, 0.6, -0.3, -1.2,
    ];

    /// A weighted sum of the outputs, and these weights.
    fn loss(network: &Mlp, input: &[f32]) -> (f64, Vec<f32>) {
        let mut pass = Pass::default();
        network.forward(input, &mut pass);
        let weights: Vec<f32> = (0..pass.output().len())
            .map(|i| 0.5 - 0.2 * i as f32)
            .collect();
        let sum = pass.output().iter().zip(&weights);
        (sum.map(|(y, w)| f64::from(y * w)).sum(), weights)
    }

    /// Central differences; where a step crosses a kink of ReLU the two sides disagree, so few are
    /// allowed to.
    fn check(analytic: &[f32], numeric: impl Fn(usize, f32) -> f64) {
        let h = 1e-2;
        for (i, &found) in analytic.iter().enumerate() {
            let expected = (numeric(i, h) - numeric(i, -h)) / (2.0 * f64::from(h));
            let error = (f64::from(found) - expected).abs();
            assert!(
                error < 2e-3 * (1.0 + expected.abs()),
                "{i}: {found}, {expected}"
            );
        }
    }

    #[test]
    fn gradients_are_finite_differences() {
        let network = network();
        let (_, weights) = loss(&network, &INPUT);
        let mut pass = Pass::default();
        network.forward(&INPUT, &mut pass);
        let mut gradient = vec![0.0; network.parameters().len()];
        network.backward(&weights, &mut pass, &mut gradient);
        check(&gradient, |i, h| {
            let mut moved = network.clone();
            moved.parameters_mut()[i] += h;
            loss(&moved, &INPUT).0
        });
        network.backward_to_input(&weights, &mut pass);
        let of_input = pass.input_gradient().to_vec();
        check(&of_input, |i, h| {
            let mut moved = INPUT;
            moved[i] += h;
            loss(&network, &moved).0
        });
        let mut both = vec![0.0; gradient.len()];
        network.backward_through(&weights, &mut pass, &mut both);
        assert_eq!(both, gradient);
        assert_eq!(pass.input_gradient(), of_input);
    }

    #[test]
    fn gradients_add_up() {
        let network = network();
        let (_, weights) = loss(&network, &INPUT);
        let mut pass = Pass::default();
        network.forward(&INPUT, &mut pass);
        let mut once = vec![0.0; network.parameters().len()];
        network.backward(&weights, &mut pass, &mut once);
        let mut twice = once.clone();
        network.backward(&weights, &mut pass, &mut twice);
        for (a, b) in once.iter().zip(&twice) {
            assert!((2.0 * a - b).abs() < 1e-5);
        }
    }

    #[test]
    fn a_network_by_hand() {
        // h = relu([x, -x] + [1, 0]), y = 2 h0 - 3 h1 + 0.5
        let parameters = vec![1.0, -1.0, 1.0, 0.0, 2.0, -3.0, 0.5];
        let network = Mlp::from_parameters(&[1, 2, 1], parameters).unwrap();
        let mut pass = Pass::default();
        network.forward(&[2.0, -3.0], &mut pass);
        assert_eq!(pass.output(), [6.5, -8.5]);
        assert!(Mlp::from_parameters(&[1, 2, 1], vec![0.0; 6]).is_none());
    }

    #[test]
    fn a_target_follows_geometrically() {
        let online = network();
        let mut target = online.clone();
        target.parameters_mut().fill(0.0);
        for _ in 0..10 {
            target.follow(&online, 0.1);
        }
        let share = 1.0 - 0.9f32.powi(10);
        for (target, online) in target.parameters().iter().zip(online.parameters()) {
            assert!((target - share * online).abs() < 1e-6);
        }
    }
}
