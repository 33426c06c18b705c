//! Layer normalisation.
//!
//! What lives here: the fused operation and its composed oracle. What does not: the parameters,
//! which the network holds.

use std::sync::OnceLock;

use candle_core::{CpuStorage, CustomOp3, D, Layout, Result, Shape, Tensor};

use super::{Host, elements, fusible, gradient, output};
use gump_kernels::norm::normalize_row;
use gump_kernels::rows::{
    add_partials, dot, for_pieces2, for_pieces3, rows_per_partial, rows_per_task, sum,
};
use gump_kernels::wide;

/// Normalises the last axis to mean 0 and variance 1, then scales and shifts it.
///
/// Shape: `x` `[.., C]`, `weight` and `bias` `[C]`; the result is shaped like `x`.
/// `eps` is added to the variance (which divides by `C`, as in PyTorch).
///
/// Error: when `weight` or `bias` is not `[C]`.
pub fn layer_norm(x: &Tensor, weight: &Tensor, bias: &Tensor, eps: f32) -> Result<Tensor> {
    let c = x.dim(D::Minus1)?;
    if weight.dims() != [c] || bias.dims() != [c] {
        candle_core::bail!(
            "layer_norm: x {:?}, weight {:?}, bias {:?}",
            x.shape(),
            weight.shape(),
            bias.shape()
        );
    }
    if !fusible(&[x, weight, bias]) {
        return composed(x, weight, bias, f64::from(eps));
    }
    let op = LayerNorm {
        eps,
        moments: OnceLock::new(),
    };
    x.contiguous()?
        .apply_op3(&weight.contiguous()?, &bias.contiguous()?, op)
}

fn composed(x: &Tensor, weight: &Tensor, bias: &Tensor, eps: f64) -> Result<Tensor> {
    let mean = x.mean_keepdim(D::Minus1)?;
    let centred = x.broadcast_sub(&mean)?;
    let variance = centred.sqr()?.mean_keepdim(D::Minus1)?;
    centred
        .broadcast_div(&(variance + eps)?.sqrt()?)?
        .broadcast_mul(weight)?
        .broadcast_add(bias)
}

struct LayerNorm {
    eps: f32,
    /// Mean and reciprocal deviation of each row, interleaved, kept for the gradient.
    moments: OnceLock<Vec<f32>>,
}

impl CustomOp3 for LayerNorm {
    fn name(&self) -> &'static str {
        "layer-norm"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        weight: &CpuStorage,
        weight_layout: &Layout,
        bias: &CpuStorage,
        bias_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let shape = x_layout.shape();
        let x = elements(x, x_layout)?;
        let weight = elements(weight, weight_layout)?;
        let bias = elements(bias, bias_layout)?;
        let (y, moments) = normalized(x, weight, bias, self.eps);
        // A second run of one operation object would store the same moments.
        let _ = self.moments.set(moments);
        Ok(output(y, shape))
    }

    fn bwd(
        &self,
        x: &Tensor,
        weight: &Tensor,
        bias: &Tensor,
        _y: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let dy = dy.contiguous()?;
        let (x_host, weight_host, dy) = (Host::new(x)?, Host::new(weight)?, Host::new(&dy)?);
        let (x_all, w, dy) = (
            x_host.slice::<f32>()?,
            weight_host.slice::<f32>()?,
            dy.slice::<f32>()?,
        );
        let moments = self.moments.get().expect("forward ran before backward");
        let [dx, dw, db] = gradients(x_all, w, moments, dy);
        Ok((
            Some(gradient(dx, x)?),
            Some(gradient(dw, weight)?),
            Some(gradient(db, bias)?),
        ))
    }
}

/// The normalised rows, and mean and reciprocal deviation of each, interleaved.
pub(super) fn normalized(
    x: &[f32],
    weight: &[f32],
    bias: &[f32],
    eps: f32,
) -> (Vec<f32>, Vec<f32>) {
    let c = weight.len();
    let rows = x.len() / c.max(1);
    let step = rows_per_task(c);
    let mut y = vec![0.0; x.len()];
    let mut moments = vec![0.0; rows * 2];
    for_pieces2((&mut y, step * c), (&mut moments, step * 2), |i, y, m| {
        let x = &x[i * step * c..];
        wide(
            #[inline(always)]
            || forward_rows(x, weight, bias, eps, y, m),
        );
    });
    (y, moments)
}

/// Gradients of the rows, the scale and the shift.
pub(super) fn gradients(x: &[f32], weight: &[f32], moments: &[f32], dy: &[f32]) -> [Vec<f32>; 3] {
    let c = weight.len();
    let rows = moments.len() / 2;
    let step = rows_per_partial(rows, c);
    let pieces = rows.div_ceil(step);
    let mut dx = vec![0.0; x.len()];
    let mut dws = vec![0.0; pieces * c];
    let mut dbs = vec![0.0; pieces * c];
    for_pieces3(
        (&mut dx, step * c),
        (&mut dws, c),
        (&mut dbs, c),
        |i, dx, dw, db| {
            let at = i * step;
            let (x, dy, moments) = (&x[at * c..], &dy[at * c..], &moments[at * 2..]);
            wide(
                #[inline(always)]
                || backward_rows(x, weight, dy, moments, dx, dw, db),
            );
        },
    );
    let (mut dw, mut db) = (vec![0.0; c], vec![0.0; c]);
    add_partials(&mut dw, &dws);
    add_partials(&mut db, &dbs);
    [dx, dw, db]
}

#[inline(always)]
fn forward_rows(
    x: &[f32],
    weight: &[f32],
    bias: &[f32],
    eps: f32,
    y: &mut [f32],
    moments: &mut [f32],
) {
    let c = weight.len();
    for ((x, y), m) in x
        .chunks_exact(c)
        .zip(y.chunks_exact_mut(c))
        .zip(moments.chunks_exact_mut(2))
    {
        m.copy_from_slice(&normalize_row(x, weight, bias, eps, y));
    }
}

#[inline(always)]
fn backward_rows(
    x: &[f32],
    weight: &[f32],
    dy: &[f32],
    moments: &[f32],
    dx: &mut [f32],
    dw: &mut [f32],
    db: &mut [f32],
) {
    let c = weight.len();
    // The normalised row; `dx` first holds the gradient that reaches it.
    let mut unit = vec![0.0; c];
    for (((x, dy), dx), m) in x
        .chunks_exact(c)
        .zip(dy.chunks_exact(c))
        .zip(dx.chunks_exact_mut(c))
        .zip(moments.chunks_exact(2))
    {
        let (mean, reciprocal) = (m[0], m[1]);
        for (u, x) in unit.iter_mut().zip(x) {
            *u = (x - mean) * reciprocal;
        }
        for ((dw, dy), u) in dw.iter_mut().zip(dy).zip(&unit) {
            *dw += dy * u;
        }
        for (db, dy) in db.iter_mut().zip(dy) {
            *db += dy;
        }
        for ((dx, dy), w) in dx.iter_mut().zip(dy).zip(weight) {
            *dx = dy * w;
        }
        let level = sum(dx) / c as f32;
        let along = dot(dx, &unit) / c as f32;
        for (dx, u) in dx.iter_mut().zip(&unit) {
            *dx = reciprocal * (*dx - level - u * along);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{check, var};
    use super::*;

    #[test]
    fn agrees_with_the_composition() {
        for shape in [&[1usize, 1][..], &[3, 37], &[2, 150, 192], &[4, 5, 2, 65]] {
            let c = shape[shape.len() - 1];
            let (x, w, b) = (var(shape, 1), var(&[c], 2), var(&[c], 3));
            check(
                &[&x, &w, &b],
                || layer_norm(&x, &w, &b, 1e-5),
                || composed(&x, &w, &b, 1e-5),
            );
        }
    }

    #[test]
    fn a_strided_input() {
        let (x, w, b) = (var(&[6, 4], 1), var(&[6], 2), var(&[6], 3));
        check(
            &[&x, &w, &b],
            || layer_norm(&x.t()?, &w, &b, 1e-5),
            || composed(&x.t()?, &w, &b, 1e-5),
        );
    }
}
