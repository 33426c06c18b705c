//! A gated recurrent unit over a whole sequence.
//!
//! What lives here: the product over the inputs of all steps and the chain of hidden states with its
//! products, as one operation: the gates of the inputs are three times as large as the states, and the
//! tensor library would keep them, zero a gradient for them and add to it. What does not: the stacking
//! of layers, which is the network's.

use std::sync::OnceLock;

use candle_core::{D, Result, Tensor, bail};

use super::carried::{Operation, apply};
use super::half_block::Affine;
use super::linear::{Linear, bias_gradient, linear};
use super::packed::Side;
use super::{Host, fusible, gradient};
use gump_kernels::gemm::{Mat, MatMut, Right, Store, Threads};
use gump_kernels::gru::{backward_row, gates, kept_row};
use gump_kernels::rows::{for_pieces2, for_pieces3, rows_per_task};
use gump_kernels::wide;

/// All hidden states of a gated recurrent unit, as in PyTorch; at each step, with
/// `x = weight_input input + bias_input` and `g = weight h + bias`: `r = sigmoid(x_r + g_r)`,
/// `z = sigmoid(x_z + g_z)`, `n = tanh(x_n + r * g_n)`, `h' = (1 - z) * n + z * h`.
///
/// Shape: `inputs` `[S, N, C]`; `h` `[N, C]` is the state before the first step; of both affine maps the
/// matrix is `[3C, C]` and the bias `[3C]`, with rows reset, update, candidate; the result `[S, N, C]`,
/// the states after each step.
///
/// Error: when the shapes do not fit or a bias is missing.
pub fn gru(inputs: &Tensor, h: &Tensor, input: Affine<'_>, hidden: Affine<'_>) -> Result<Tensor> {
    let (n, c) = h.dims2()?;
    let [Some(input_bias), Some(hidden_bias)] = [input.bias, hidden.bias] else {
        bail!("gru: both maps have a bias");
    };
    let is_map =
        |map: Affine<'_>, bias: &Tensor| map.weight.dims() == [3 * c, c] && bias.dims() == [3 * c];
    let rows = inputs
        .dims3()
        .is_ok_and(|(_, rows, cols)| (rows, cols) == (n, c));
    if !rows || !is_map(input, input_bias) || !is_map(hidden, hidden_bias) {
        bail!(
            "gru: inputs {:?}, h {:?}, weights {:?} and {:?}, biases {:?} and {:?}",
            inputs.shape(),
            h.shape(),
            input.weight.shape(),
            hidden.weight.shape(),
            input_bias.shape(),
            hidden_bias.shape()
        );
    }
    let h = h.contiguous()?;
    let others = [&h, input.weight, input_bias, hidden.weight, hidden_bias];
    let stored = others.iter().all(|tensor| tensor.is_contiguous());
    if !stored || !fusible(&[inputs]) || !fusible(&others) {
        return composed(inputs, &h, input, hidden);
    }
    let op = Gru {
        first: h.clone(),
        input: [input.weight.clone(), input_bias.clone()],
        hidden: [hidden.weight.clone(), hidden_bias.clone()],
        linear: Linear::now(),
        kept: OnceLock::new(),
    };
    apply(inputs, &others, op)
}

fn composed(inputs: &Tensor, h: &Tensor, input: Affine<'_>, hidden: Affine<'_>) -> Result<Tensor> {
    gru_of_gates(&linear(inputs, input.weight, input.bias)?, h, hidden)
}

/// [`gru()`] of its inputs' products plus their bias, `[S, N, 3C]`, by the tensor library.
///
/// Error: when the shapes do not fit.
pub fn gru_of_gates(x_gates: &Tensor, h: &Tensor, hidden: Affine<'_>) -> Result<Tensor> {
    let sigmoid = |x: Tensor| (x.neg()?.exp()? + 1.0)?.recip();
    let mut h = h.clone();
    let mut states = Vec::new();
    for step in 0..x_gates.dim(0)? {
        let x = x_gates.get(step)?.chunk(3, D::Minus1)?;
        let g = linear(&h, hidden.weight, hidden.bias)?;
        let g = g.chunk(3, D::Minus1)?;
        let r = sigmoid((&x[0] + &g[0])?)?;
        let z = sigmoid((&x[1] + &g[1])?)?;
        let n = (&x[2] + (r * &g[2])?)?.tanh()?;
        h = ((&n - (&z * &n)?)? + (&z * &h)?)?;
        states.push(h.clone());
    }
    Tensor::stack(&states, 0)
}

struct Gru {
    /// The state before the first step.
    first: Tensor,
    /// Matrix and bias.
    input: [Tensor; 2],
    hidden: [Tensor; 2],
    linear: Linear,
    /// Per step and row what [`kept_row`] keeps, for the gradient.
    kept: OnceLock<Vec<f32>>,
}

impl Operation for Gru {
    fn name(&self) -> &'static str {
        "gru"
    }

    fn forward(&self, inputs: &[f32]) -> Result<Vec<f32>> {
        let (n, c) = self.first.dims2()?;
        let [input, input_bias] = [Host::new(&self.input[0])?, Host::new(&self.input[1])?];
        let [weight, bias] = [Host::new(&self.hidden[0])?, Host::new(&self.hidden[1])?];
        let (first, bias) = (Host::new(&self.first)?, bias.slice()?);
        let gates_of_all = self.linear.multiply(
            inputs,
            (input.slice()?, &self.input[0]),
            Some(input_bias.slice()?),
        )?;
        let weight = Mat::new(weight.slice()?, 3 * c, c);
        let turned = self.linear.right(weight.t(), &self.hidden[0], Side::Turned);
        let turned = turned.get();
        let steps = inputs.len() / (n * c).max(1);
        let mut states = vec![0.0; steps * n * c];
        let mut g = vec![0.0; n * 3 * c];
        let mut kept = vec![0.0; steps * n * 4 * c];
        let piece = rows_per_task(4 * c);
        for step in 0..steps {
            let (before, states) = states.split_at_mut(step * n * c);
            let h = match step {
                0 => first.slice()?,
                _ => &before[(step - 1) * n * c..],
            };
            hidden_gates(&mut g, h, (turned, bias), c);
            let (x, g) = (&gates_of_all[step * n * 3 * c..], &g);
            let of_step = step * n * 4 * c..(step + 1) * n * 4 * c;
            for_pieces2(
                (&mut states[..n * c], piece * c),
                (&mut kept[of_step], piece * 4 * c),
                |i, out, kept| {
                    let at = i * piece * c..i * piece * c + out.len();
                    out.copy_from_slice(&h[at]);
                    wide(
                        #[inline(always)]
                        || {
                            let rows = out.chunks_exact_mut(c).zip(kept.chunks_exact_mut(4 * c));
                            for (row, (h, kept)) in rows.enumerate() {
                                let row = i * piece + row;
                                kept_row(gates(x, row, c), gates(g, row, c), h, kept);
                            }
                        },
                    );
                },
            );
        }
        let _ = self.kept.set(kept);
        Ok(states)
    }

    fn backward(
        &self,
        inputs: &Tensor,
        states: &Tensor,
        d_states: &Tensor,
    ) -> Result<(Tensor, Vec<Option<Tensor>>)> {
        let (steps, n, c) = states.dims3()?;
        let (dx, dg, dh) = self.slopes(states, d_states)?;
        let of_all =
            |slopes: Vec<f32>| Tensor::from_vec(slopes, (steps, n, 3 * c), inputs.device());
        let (dx, dg) = (of_all(dx)?, of_all(dg)?);
        let [input, input_bias] = &self.input;
        let [hidden, hidden_bias] = &self.hidden;
        let (d_inputs, d_input) = self
            .linear
            .backward(inputs, input, &dx, inputs.track_op())?;
        // The first step comes after the state before it, the others after those in `states`.
        let mut parts = Vec::new();
        if steps > 0 {
            parts.push((self.first.detach(), dg.narrow(0, 0, 1)?));
        }
        if steps > 1 {
            let before = states.narrow(0, 0, steps - 1)?.detach();
            parts.push((before, dg.narrow(0, 1, steps - 1)?));
        }
        let d_hidden = self.linear.weight_gradient(hidden, &parts)?;
        let others = vec![
            Some(gradient(dh, &self.first)?),
            d_input,
            bias_gradient(input_bias, &dx)?,
            d_hidden,
            bias_gradient(hidden_bias, &dg)?,
        ];
        let d_inputs = match d_inputs {
            Some(d_inputs) => gradient(d_inputs, inputs)?,
            None => inputs.zeros_like()?,
        };
        Ok((d_inputs, others))
    }
}

impl Gru {
    /// Gradients of the inputs' gates and the states' `[S, N, 3C]`, and of the first state.
    fn slopes(&self, states: &Tensor, d_states: &Tensor) -> Result<(Vec<f32>, Vec<f32>, Vec<f32>)> {
        let (steps, n, c) = states.dims3()?;
        let kept = self.kept.get().expect("forward ran before backward");
        let [first, weight] = [Host::new(&self.first)?, Host::new(&self.hidden[0])?];
        let [states, d_states] = [Host::new(states)?, Host::new(d_states)?];
        let (first, weight) = (first.slice::<f32>()?, weight.slice::<f32>()?);
        let (states, d_states) = (states.slice::<f32>()?, d_states.slice::<f32>()?);
        let weight = Mat::new(weight, 3 * c, c);
        let straight = self.linear.right(weight, &self.hidden[0], Side::Straight);
        let straight = straight.get();
        let mut dx = vec![0.0; steps * n * 3 * c];
        let mut dg = vec![0.0; steps * n * 3 * c];
        let mut dh = vec![0.0; n * c];
        let piece = rows_per_task(8 * c);
        for step in (0..steps).rev() {
            let before = if step == 0 {
                first
            } else {
                &states[(step - 1) * n * c..step * n * c]
            };
            let d_states = &d_states[step * n * c..];
            let kept = &kept[step * n * 4 * c..(step + 1) * n * 4 * c];
            let of_step = step * n * 3 * c..(step + 1) * n * 3 * c;
            for_pieces3(
                (&mut dx[of_step.clone()], piece * 3 * c),
                (&mut dg[of_step.clone()], piece * 3 * c),
                (&mut dh, piece * c),
                |i, dx, dg, dh| {
                    wide(
                        #[inline(always)]
                        || {
                            let rows = dx
                                .chunks_exact_mut(3 * c)
                                .zip(dg.chunks_exact_mut(3 * c))
                                .zip(dh.chunks_exact_mut(c));
                            for (row, ((dx, dg), dh)) in rows.enumerate() {
                                let row = i * piece + row;
                                for (dh, d) in dh.iter_mut().zip(&d_states[row * c..(row + 1) * c])
                                {
                                    *dh += d;
                                }
                                let kept = &kept[row * 4 * c..(row + 1) * 4 * c];
                                backward_row(kept, &before[row * c..(row + 1) * c], dx, dg, dh);
                            }
                        },
                    );
                },
            );
            // What reaches the state before through the gates.
            let dg = Mat::new(&dg[of_step], n, 3 * c);
            let dst = MatMut::new(&mut dh, n, c);
            straight.product(dst, Store::Add, 1.0, dg, Threads::Pool);
        }
        Ok((dx, dg, dh))
    }
}

/// `out = h weight^T + bias`, `[N, 3C]`.
fn hidden_gates(out: &mut [f32], h: &[f32], (turned, bias): (&Right<'_>, &[f32]), c: usize) {
    for row in out.chunks_exact_mut(3 * c) {
        row.copy_from_slice(bias);
    }
    let n = h.len() / c;
    let (dst, h) = (MatMut::new(out, n, 3 * c), Mat::new(h, n, c));
    turned.product(dst, Store::Add, 1.0, h, Threads::Pool);
}

#[cfg(test)]
mod tests {
    use super::super::testing::{assert_close, check, var};
    use super::super::{Deferred, PackedWeights, in_bfloat16};
    use super::*;

    #[test]
    fn agrees_with_the_composition() {
        for (steps, n, c) in [(1, 1, 1), (3, 3, 17), (16, 150, 24), (2, 700, 40)] {
            let (x, h) = (var(&[steps, n, c], 1), var(&[n, c], 2));
            let (w_in, b_in) = (var(&[3 * c, c], 3), var(&[3 * c], 4));
            let (w, b) = (var(&[3 * c, c], 5), var(&[3 * c], 6));
            let strong = || x.affine(4.0, 0.0);
            let maps = [(&w_in, &b_in), (&w, &b)].map(|(weight, bias)| Affine {
                weight,
                bias: Some(bias),
            });
            check(
                &[&x, &h, &w_in, &b_in, &w, &b],
                || gru(&strong()?, &h, maps[0], maps[1]),
                || composed(&strong()?, &h, maps[0], maps[1]),
            );
        }
    }

    #[test]
    fn deferred_gradients_with_packed_weights_are_the_gradients() {
        let (steps, n, c) = (5, 40, 24);
        let (x, h) = (var(&[steps, n, c], 1), var(&[n, c], 2));
        let vars = [
            var(&[3 * c, c], 3),
            var(&[3 * c], 4),
            var(&[3 * c, c], 5),
            var(&[3 * c], 6),
        ];
        let map = |weight, bias| Affine {
            weight,
            bias: Some(bias),
        };
        let build = || {
            let maps = [map(&vars[0], &vars[1]), map(&vars[2], &vars[3])];
            in_bfloat16(|| gru(&x, &h, maps[0], maps[1])).unwrap()
        };
        let loss = |y: Tensor| y.sqr().unwrap().sum_all().unwrap();
        let expected = loss(build()).backward().unwrap();
        let (deferred, packed) = (Deferred::default(), PackedWeights::default());
        let grads = loss(packed.during(|| deferred.during(build)));
        let grads = grads.backward().unwrap();
        for var in &vars {
            let all = [&deferred].into_iter();
            let found = Deferred::take_in(all, var, grads.get(var).cloned()).unwrap();
            assert_close(
                "gradient",
                &found.unwrap(),
                expected.get(var).unwrap(),
                1e-5,
            );
        }
        assert!(grads.get(&vars[2]).is_none(), "it was deferred");
    }

    #[test]
    fn shapes_that_do_not_fit_are_errors() {
        let (x, h) = (var(&[1, 2, 4], 1), var(&[2, 4], 2));
        let (weight, bias) = (var(&[12, 4], 3), var(&[12], 4));
        let map = Affine {
            weight: &weight,
            bias: Some(&bias),
        };
        assert!(gru(&x, &h, map, map).is_ok());
        let wide = var(&[1, 2, 12], 1);
        assert!(gru(&wide, &h, map, map).is_err());
        let turned = Affine {
            weight: &bias,
            bias: Some(&weight),
        };
        assert!(gru(&x, &h, map, turned).is_err());
        let without = Affine { bias: None, ..map };
        assert!(gru(&x, &h, without, map).is_err());
    }
}
