//! One step of a gated recurrent unit.
//!
//! What lives here: the gates, fused. What does not: the two products before them, which are
//! `linear`, and the stacking of layers, which is the network's.

use candle_core::{CpuStorage, CustomOp3, D, Layout, Result, Shape, Tensor, bail};

use super::gemm::wide;
use super::rows::{exp, for_pieces, for_pieces3, rows_per_task};
use super::{Host, elements, fusible, gradient, output};

/// The next hidden state of a gated recurrent unit, as in PyTorch:
/// `r = sigmoid(x_r + h_r)`, `z = sigmoid(x_z + h_z)`, `n = tanh(x_n + r * h_n)`,
/// `h' = (1 - z) * n + z * h`.
///
/// Shape: `x_gates` `[N, 3C]` is the input's product plus its bias, `h_gates` `[N, 3C]` the hidden
/// state's, both with columns reset, update, candidate; `h` and the result `[N, C]`.
///
/// Error: when the shapes do not fit.
pub fn gru_cell(x_gates: &Tensor, h_gates: &Tensor, h: &Tensor) -> Result<Tensor> {
    let (n, c) = h.dims2()?;
    if x_gates.dims() != [n, 3 * c] || h_gates.dims() != [n, 3 * c] {
        bail!(
            "gru_cell: x_gates {:?}, h_gates {:?}, h {:?}",
            x_gates.shape(),
            h_gates.shape(),
            h.shape()
        );
    }
    if !fusible(&[x_gates, h_gates, h]) {
        return composed(x_gates, h_gates, h);
    }
    x_gates
        .contiguous()?
        .apply_op3(&h_gates.contiguous()?, &h.contiguous()?, GruCell)
}

fn composed(x_gates: &Tensor, h_gates: &Tensor, h: &Tensor) -> Result<Tensor> {
    let sigmoid = |x: Tensor| (x.neg()?.exp()? + 1.0)?.recip();
    let x = x_gates.chunk(3, D::Minus1)?;
    let g = h_gates.chunk(3, D::Minus1)?;
    let r = sigmoid((&x[0] + &g[0])?)?;
    let z = sigmoid((&x[1] + &g[1])?)?;
    let n = (&x[2] + (r * &g[2])?)?.tanh()?;
    (&n - (&z * &n)?)? + (&z * h)?
}

struct GruCell;

impl CustomOp3 for GruCell {
    fn name(&self) -> &'static str {
        "gru-cell"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        g: &CpuStorage,
        g_layout: &Layout,
        h: &CpuStorage,
        h_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (x, g) = (elements(x, x_layout)?, elements(g, g_layout)?);
        let h = elements(h, h_layout)?;
        let (_, c) = h_layout.shape().dims2()?;
        let step = rows_per_task(4 * c);
        let mut out = vec![0.0; h.len()];
        for_pieces(&mut out, step * c, |piece, out| {
            wide(
                #[inline(always)]
                || {
                    for (i, out) in out.chunks_exact_mut(c).enumerate() {
                        let row = piece * step + i;
                        let (x, g) = (gates(x, row, c), gates(g, row, c));
                        let h = &h[row * c..(row + 1) * c];
                        for j in 0..c {
                            let [_, z, n] = cell(x, g, j);
                            out[j] = (1.0 - z) * n + z * h[j];
                        }
                    }
                },
            );
        });
        Ok(output(out, h_layout.shape()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        g: &Tensor,
        h: &Tensor,
        _out: &Tensor,
        d_out: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let d_out = d_out.contiguous()?;
        let hosts = [
            Host::new(x)?,
            Host::new(g)?,
            Host::new(h)?,
            Host::new(&d_out)?,
        ];
        let x_all = hosts[0].slice::<f32>()?;
        let g_all = hosts[1].slice::<f32>()?;
        let h_all = hosts[2].slice::<f32>()?;
        let d_all = hosts[3].slice::<f32>()?;
        let (n, c) = h.dims2()?;
        let step = rows_per_task(8 * c);
        let mut dx = vec![0.0; n * 3 * c];
        let mut dg = vec![0.0; n * 3 * c];
        let mut dh = vec![0.0; n * c];
        for_pieces3(
            (&mut dx, step * 3 * c),
            (&mut dg, step * 3 * c),
            (&mut dh, step * c),
            |piece, dx, dg, dh| {
                wide(
                    #[inline(always)]
                    || {
                        let rows = dx
                            .chunks_exact_mut(3 * c)
                            .zip(dg.chunks_exact_mut(3 * c))
                            .zip(dh.chunks_exact_mut(c));
                        for (i, ((dx, dg), dh)) in rows.enumerate() {
                            let row = piece * step + i;
                            let at = row * c..(row + 1) * c;
                            backward_row(
                                gates(x_all, row, c),
                                gates(g_all, row, c),
                                &h_all[at.clone()],
                                &d_all[at],
                                dx,
                                dg,
                                dh,
                            );
                        }
                    },
                );
            },
        );
        Ok((
            Some(gradient(dx, x)?),
            Some(gradient(dg, g)?),
            Some(gradient(dh, h)?),
        ))
    }
}

/// One step of one row in place: `h` becomes the next state; gates `[3C]` as in [`gru_cell`].
#[inline(always)]
pub(crate) fn gru_row(x_gates: &[f32], h_gates: &[f32], h: &mut [f32]) {
    let c = h.len();
    let (x, g) = (gates(x_gates, 0, c), gates(h_gates, 0, c));
    for (j, h) in h.iter_mut().enumerate() {
        let [_, z, n] = cell(x, g, j);
        *h = (1.0 - z) * n + z * *h;
    }
}

/// The three gate rows of row `row`.
#[inline(always)]
fn gates(all: &[f32], row: usize, c: usize) -> [&[f32]; 3] {
    let row = &all[row * 3 * c..(row + 1) * 3 * c];
    [&row[..c], &row[c..2 * c], &row[2 * c..]]
}

/// Reset, update and candidate at channel `j`.
#[inline(always)]
fn cell(x: [&[f32]; 3], g: [&[f32]; 3], j: usize) -> [f32; 3] {
    let r = sigmoid(x[0][j] + g[0][j]);
    let z = sigmoid(x[1][j] + g[1][j]);
    let n = 2.0 * sigmoid(2.0 * (x[2][j] + r * g[2][j])) - 1.0;
    [r, z, n]
}

#[inline(always)]
fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

#[inline(always)]
fn backward_row(
    x: [&[f32]; 3],
    g: [&[f32]; 3],
    h: &[f32],
    d_out: &[f32],
    dx: &mut [f32],
    dg: &mut [f32],
    dh: &mut [f32],
) {
    let c = h.len();
    let (dx_r, dx) = dx.split_at_mut(c);
    let (dx_z, dx_n) = dx.split_at_mut(c);
    let (dg_r, dg) = dg.split_at_mut(c);
    let (dg_z, dg_n) = dg.split_at_mut(c);
    let (d_out, dx_n) = (&d_out[..c], &mut dx_n[..c]);
    let (dg_n, dh) = (&mut dg_n[..c], &mut dh[..c]);
    for j in 0..c {
        let [r, z, n] = cell(x, g, j);
        let d = d_out[j];
        let d_candidate = d * (1.0 - z) * (1.0 - n * n);
        let d_update = d * (h[j] - n) * z * (1.0 - z);
        let d_reset = d_candidate * g[2][j] * r * (1.0 - r);
        dx_r[j] = d_reset;
        dx_z[j] = d_update;
        dx_n[j] = d_candidate;
        dg_r[j] = d_reset;
        dg_z[j] = d_update;
        dg_n[j] = d_candidate * r;
        dh[j] = d * z;
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{check, var};
    use super::*;

    #[test]
    fn agrees_with_the_composition() {
        for (n, c) in [(1, 1), (3, 17), (700, 40)] {
            let (x, g) = (var(&[n, 3 * c], 1), var(&[n, 3 * c], 2));
            let h = var(&[n, c], 3);
            check(
                &[&x, &g, &h],
                || gru_cell(&x.affine(4.0, 0.0)?, &g, &h),
                || composed(&x.affine(4.0, 0.0)?, &g, &h),
            );
        }
    }

    #[test]
    fn shapes_that_do_not_fit_are_errors() {
        let (x, h) = (var(&[2, 9], 1), var(&[2, 4], 2));
        assert!(gru_cell(&x, &x, &h).is_err());
    }
}
