//! A gated recurrent unit over a whole sequence.
//!
//! What lives here: the chain of hidden states, with its products, as one operation. What does not:
//! the product over the inputs of all steps, which is one `linear`, and the stacking of layers,
//! which is the network's.

use std::sync::OnceLock;

use candle_core::{CpuStorage, CustomOp3, D, Layout, Result, Shape, Tensor, bail};

use super::{Host, elements, fusible, gradient, output};
use gump_kernels::Operands;
use gump_kernels::gemm::{Mat, MatMut, Right, Store, Threads, gemm};
use gump_kernels::gru::{backward_row, gates, kept_row};
use gump_kernels::rows::{column_sums, for_pieces2, for_pieces3, rows_per_task};
use gump_kernels::wide;

/// All hidden states of a gated recurrent unit, as in PyTorch; at each step, with
/// `g = weight h + bias`: `r = sigmoid(x_r + g_r)`, `z = sigmoid(x_z + g_z)`,
/// `n = tanh(x_n + r * g_n)`, `h' = (1 - z) * n + z * h`.
///
/// Shape: `x_gates` `[S, N, 3C]` are the inputs' products plus their bias, with columns reset,
/// update, candidate; `h` `[N, C]` is the state before the first step; `weight` `[3C, C]`, `bias`
/// `[3C]`; the result `[S, N, C]`, the states after each step.
///
/// Error: when the shapes do not fit.
pub fn gru(x_gates: &Tensor, h: &Tensor, weight: &Tensor, bias: &Tensor) -> Result<Tensor> {
    let (n, c) = h.dims2()?;
    let fits = x_gates
        .dims3()
        .is_ok_and(|(_, rows, cols)| (rows, cols) == (n, 3 * c))
        && weight.dims() == [3 * c, c]
        && bias.dims() == [3 * c];
    if !fits {
        bail!(
            "gru: x_gates {:?}, h {:?}, weight {:?}, bias {:?}",
            x_gates.shape(),
            h.shape(),
            weight.shape(),
            bias.shape()
        );
    }
    if !fusible(&[x_gates, h, weight, bias]) {
        return composed(x_gates, h, weight, bias);
    }
    // An operation takes three tensors: the bias is the last column of the matrix.
    let affine = Tensor::cat(&[weight, &bias.unsqueeze(1)?], 1)?; // [3C, C + 1]
    x_gates
        .contiguous()?
        .apply_op3(&h.contiguous()?, &affine, Gru::now())
}

fn composed(x_gates: &Tensor, h: &Tensor, weight: &Tensor, bias: &Tensor) -> Result<Tensor> {
    let sigmoid = |x: Tensor| (x.neg()?.exp()? + 1.0)?.recip();
    let mut h = h.clone();
    let mut states = Vec::new();
    for step in 0..x_gates.dim(0)? {
        let x = x_gates.get(step)?.chunk(3, D::Minus1)?;
        let g = h.matmul(&weight.t()?)?.broadcast_add(bias)?;
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
    operands: Operands,
    /// Per step and row what [`kept_row`] keeps, for the gradient.
    kept: OnceLock<Vec<f32>>,
}

impl Gru {
    fn now() -> Self {
        Self {
            operands: Operands::current(),
            kept: OnceLock::new(),
        }
    }
}

/// Sizes of a sequence: steps, rows, channels.
type Sizes = (usize, usize, usize);

/// The matrix and the bias of `[3C, C + 1]`.
fn halves(affine: &[f32], c: usize) -> (Mat<'_>, Vec<f32>) {
    let bias = affine.chunks_exact(c + 1).map(|row| row[c]).collect();
    (Mat::strided(affine, 3 * c, c, c + 1), bias)
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

impl CustomOp3 for Gru {
    fn name(&self) -> &'static str {
        "gru"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        h: &CpuStorage,
        h_layout: &Layout,
        affine: &CpuStorage,
        affine_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (x, first) = (elements(x, x_layout)?, elements(h, h_layout)?);
        let (n, c) = h_layout.shape().dims2()?;
        let steps = x_layout.dims()[0];
        let (weight, bias) = halves(elements(affine, affine_layout)?, c);
        let turned = Right::new(weight.t(), self.operands);
        let mut states = vec![0.0; steps * n * c];
        let mut g = vec![0.0; n * 3 * c];
        let mut kept = vec![0.0; steps * n * 4 * c];
        let piece = rows_per_task(4 * c);
        for step in 0..steps {
            let (before, states) = states.split_at_mut(step * n * c);
            let h = if step == 0 {
                first
            } else {
                &before[(step - 1) * n * c..]
            };
            hidden_gates(&mut g, h, (&turned, &bias), c);
            let (x, g) = (&x[step * n * 3 * c..], &g);
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
        Ok(output(states, (steps, n, c)))
    }

    fn bwd(
        &self,
        x: &Tensor,
        h: &Tensor,
        affine: &Tensor,
        states: &Tensor,
        d_states: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let d_states = d_states.contiguous()?;
        let sizes = states.dims3()?;
        let hosts = [
            Host::new(h)?,
            Host::new(affine)?,
            Host::new(states)?,
            Host::new(&d_states)?,
        ];
        let [first, weights, states, d_states] = &hosts;
        let (dx, dh, d_affine) = backward(
            (sizes, self.operands),
            self.kept.get().expect("forward ran before backward"),
            first.slice()?,
            weights.slice()?,
            states.slice()?,
            d_states.slice()?,
        );
        Ok((
            Some(gradient(dx, x)?),
            Some(gradient(dh, h)?),
            Some(gradient(d_affine, affine)?),
        ))
    }
}

/// Gradients of the gates, of the first state and of the matrix with its bias.
fn backward(
    ((steps, n, c), operands): (Sizes, Operands),
    kept: &[f32],
    first: &[f32],
    affine: &[f32],
    states: &[f32],
    d_states: &[f32],
) -> (Vec<f32>, Vec<f32>, Vec<f32>) {
    let (weight, _) = halves(affine, c);
    let straight = Right::new(weight, operands);
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
                            for (dh, d) in dh.iter_mut().zip(&d_states[row * c..(row + 1) * c]) {
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
    let mut d_affine = vec![0.0; 3 * c * (c + 1)];
    let sums = column_sums(&dg, 3 * c);
    for (row, sum) in d_affine.chunks_exact_mut(c + 1).zip(sums) {
        row[c] = sum;
    }
    let (dg_first, dg_rest) = dg.split_at((n * 3 * c).min(dg.len()));
    for (dg, before) in [(dg_first, first), (dg_rest, states)] {
        let rows = dg.len() / (3 * c);
        let dst = MatMut::strided(&mut d_affine, 3 * c, c, c + 1);
        let (dg, before) = (Mat::new(dg, rows, 3 * c), Mat::new(before, rows, c));
        gemm(
            dst,
            Store::Add,
            1.0,
            dg.t(),
            before,
            Threads::Pool,
            operands,
        );
    }
    (dx, dh, d_affine)
}

#[cfg(test)]
mod tests {
    use super::super::testing::{check, var};
    use super::*;

    #[test]
    fn agrees_with_the_composition() {
        for (steps, n, c) in [(1, 1, 1), (3, 3, 17), (16, 150, 24), (2, 700, 40)] {
            let (x, h) = (var(&[steps, n, 3 * c], 1), var(&[n, c], 2));
            let (weight, bias) = (var(&[3 * c, c], 3), var(&[3 * c], 4));
            let strong = || x.affine(4.0, 0.0);
            check(
                &[&x, &h, &weight, &bias],
                || gru(&strong()?, &h, &weight, &bias),
                || composed(&strong()?, &h, &weight, &bias),
            );
        }
    }

    #[test]
    fn shapes_that_do_not_fit_are_errors() {
        let (x, h) = (var(&[1, 2, 9], 1), var(&[2, 4], 2));
        let (weight, bias) = (var(&[12, 4], 3), var(&[12], 4));
        assert!(gru(&x, &h, &weight, &bias).is_err());
        let x = var(&[1, 2, 12], 1);
        assert!(gru(&x, &h, &weight, &bias).is_ok());
        assert!(gru(&x, &h, &bias, &weight).is_err());
    }
}
