//! The affine map.
//!
//! What lives here: the fused operation, whose gradients never copy a transposed matrix. What does
//! not: the parameters, which the network holds.

use candle_core::{CpuStorage, CustomOp2, CustomOp3, D, DType, Layout, Result, Shape, Tensor};

use super::deferred::{Deferred, Part};
use super::{Host, elements, fusible, gradient, output};
use gump_kernels::Operands;
use gump_kernels::gemm::{Mat, MatMut, Store, Threads, gemm};
use gump_kernels::rows::column_sums;

/// `x weight^T + bias`.
///
/// Shape: `x` `[.., in]`, `weight` `[out, in]` as in PyTorch, `bias` `[out]`; the result `[.., out]`.
///
/// Error: when the shapes do not fit.
pub fn linear(x: &Tensor, weight: &Tensor, bias: Option<&Tensor>) -> Result<Tensor> {
    let (n_out, n_in) = weight.dims2()?;
    if x.dim(D::Minus1)? != n_in || bias.is_some_and(|b| b.dims() != [n_out]) {
        candle_core::bail!(
            "linear: x {:?}, weight {:?}, bias {:?}",
            x.shape(),
            weight.shape(),
            bias.map(Tensor::shape)
        );
    }
    match bias {
        Some(bias) if fusible(&[x, weight, bias]) => {
            x.contiguous()?
                .apply_op3(&weight.contiguous()?, &bias.contiguous()?, Linear::now())
        }
        None if fusible(&[x, weight]) => x
            .contiguous()?
            .apply_op2(&weight.contiguous()?, Linear::now()),
        _ => composed(x, weight, bias),
    }
}

/// [`linear`] whose product, forward and backward, is computed in a shorter type; the bias is added
/// in that of `x`, which the result has.
///
/// Error: as [`linear`], or a product that the device does not have.
pub fn reduced_linear(
    x: &Tensor,
    weight: &Tensor,
    bias: Option<&Tensor>,
    product: DType,
) -> Result<Tensor> {
    let y = composed(&x.to_dtype(product)?, &weight.to_dtype(product)?, None)?;
    let y = y.to_dtype(x.dtype())?;
    match bias {
        Some(bias) => y.broadcast_add(bias),
        None => Ok(y),
    }
}

fn composed(x: &Tensor, weight: &Tensor, bias: Option<&Tensor>) -> Result<Tensor> {
    let (n_out, n_in) = weight.dims2()?;
    let mut shape = x.dims().to_vec();
    *shape.last_mut().expect("x has a last axis") = n_out;
    let y = x.reshape(((), n_in))?.matmul(&weight.t()?)?;
    let y = match bias {
        Some(bias) => y.broadcast_add(bias)?,
        None => y,
    };
    y.reshape(shape)
}

/// How products are computed and where the gradients of their matrices go.
pub(super) struct Linear {
    operands: Operands,
    deferred: Option<Deferred>,
}

impl Linear {
    /// As the calling thread has it now.
    pub(super) fn now() -> Self {
        Self {
            operands: Operands::current(),
            deferred: Deferred::current(),
        }
    }
}

impl CustomOp2 for Linear {
    fn name(&self) -> &'static str {
        "linear"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        weight: &CpuStorage,
        weight_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let weight = elements(weight, weight_layout)?;
        self.forward(
            elements(x, x_layout)?,
            x_layout,
            weight,
            weight_layout,
            None,
        )
    }

    fn bwd(
        &self,
        x: &Tensor,
        weight: &Tensor,
        _y: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let (dx, dw) = self.backward(x, weight, &dy.contiguous()?, x.track_op())?;
        Ok((dx.map(|dx| gradient(dx, x)).transpose()?, dw))
    }
}

impl CustomOp3 for Linear {
    fn name(&self) -> &'static str {
        "linear"
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
        let (x, weight) = (elements(x, x_layout)?, elements(weight, weight_layout)?);
        let bias = elements(bias, bias_layout)?;
        self.forward(x, x_layout, weight, weight_layout, Some(bias))
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
        let (dx, dw) = self.backward(x, weight, &dy, x.track_op())?;
        let dx = dx.map(|dx| gradient(dx, x)).transpose()?;
        Ok((dx, dw, bias_gradient(bias, &dy)?))
    }
}

/// The gradient of a bias, if it has one, from that of the output.
pub(super) fn bias_gradient(bias: &Tensor, dy: &Tensor) -> Result<Option<Tensor>> {
    if !bias.track_op() {
        return Ok(None);
    }
    let dy = Host::new(dy)?;
    gradient(column_sums(dy.slice()?, bias.dim(0)?), bias).map(Some)
}

impl Linear {
    fn forward(
        &self,
        x: &[f32],
        x_layout: &Layout,
        weight: &[f32],
        weight_layout: &Layout,
        bias: Option<&[f32]>,
    ) -> Result<(CpuStorage, Shape)> {
        let sizes = weight_layout.shape().dims2()?;
        let mut shape = x_layout.dims().to_vec();
        *shape.last_mut().expect("x has a last axis") = sizes.0;
        Ok(output(self.multiply(x, weight, sizes, bias), shape))
    }

    /// `x weight^T + bias`, of a matrix `[out, in]` with these sizes.
    pub(super) fn multiply(
        &self,
        x: &[f32],
        weight: &[f32],
        (n_out, n_in): (usize, usize),
        bias: Option<&[f32]>,
    ) -> Vec<f32> {
        let rows = x.len() / n_in.max(1);
        let (mut y, store) = match bias {
            Some(bias) => {
                let mut y = Vec::with_capacity(rows * n_out);
                (0..rows).for_each(|_| y.extend_from_slice(bias));
                (y, Store::Add)
            }
            None => (vec![0.0; rows * n_out], Store::Replace),
        };
        gemm(
            MatMut::new(&mut y, rows, n_out),
            store,
            1.0,
            Mat::new(x, rows, n_in),
            Mat::new(weight, n_out, n_in).t(),
            Threads::Pool,
            self.operands,
        );
        y
    }

    /// Gradients of the input, if it is wanted, and of the matrix, if it is due now.
    pub(super) fn backward(
        &self,
        x: &Tensor,
        weight: &Tensor,
        dy: &Tensor,
        wants_dx: bool,
    ) -> Result<(Option<Vec<f32>>, Option<Tensor>)> {
        let (n_out, n_in) = weight.dims2()?;
        let dy_tensor = dy;
        let (x_host, weight_host, dy) = (Host::new(x)?, Host::new(weight)?, Host::new(dy)?);
        let (x_all, w) = (x_host.slice::<f32>()?, weight_host.slice::<f32>()?);
        let dy = dy.slice::<f32>()?;
        let rows = x_all.len() / n_in.max(1);
        let dy = Mat::new(dy, rows, n_out);
        let dx = if wants_dx {
            let mut dx = vec![0.0; x_all.len()];
            let w = Mat::new(w, n_out, n_in);
            let dst = MatMut::new(&mut dx, rows, n_in);
            gemm(
                dst,
                Store::Replace,
                1.0,
                dy,
                w,
                Threads::Pool,
                self.operands,
            );
            Some(dx)
        } else {
            None
        };
        let dw = if let Some(deferred) = self.deferred.as_ref().filter(|_| weight.is_variable()) {
            let part = Part::Product {
                x: x.detach(),
                dy: dy_tensor.detach(),
                operands: self.operands,
            };
            deferred.note(weight, part);
            None
        } else if weight.track_op() {
            let mut dw = vec![0.0; w.len()];
            let x_all = Mat::new(x_all, rows, n_in);
            let dst = MatMut::new(&mut dw, n_out, n_in);
            gemm(
                dst,
                Store::Replace,
                1.0,
                dy.t(),
                x_all,
                Threads::Pool,
                self.operands,
            );
            Some(gradient(dw, weight)?)
        } else {
            None
        };
        Ok((dx, dw))
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{assert_close, check, flat, var};
    use super::*;

    #[test]
    fn agrees_with_the_composition() {
        for (shape, n_out) in [
            (&[1usize, 3][..], 1),
            (&[5, 7], 9),
            (&[2, 130, 64], 96),
            (&[1, 1, 33], 200),
            (&[300, 48], 48),
        ] {
            let n_in = shape[shape.len() - 1];
            let (x, w, b) = (var(shape, 1), var(&[n_out, n_in], 2), var(&[n_out], 3));
            check(
                &[&x, &w, &b],
                || linear(&x, &w, Some(&b)),
                || composed(&x, &w, Some(&b)),
            );
            check(
                &[&x, &w],
                || linear(&x, &w, None),
                || composed(&x, &w, None),
            );
        }
    }

    #[test]
    fn rounded_operands_give_nearly_the_same() {
        for (shape, n_out) in [(&[5usize, 7][..], 9), (&[2, 130, 64], 96), (&[300, 48], 50)] {
            let n_in = shape[shape.len() - 1];
            let (x, w, b) = (var(shape, 1), var(&[n_out, n_in], 2), var(&[n_out], 3));
            let found = |operands: Operands| {
                let y = operands.during(|| linear(&x, &w, Some(&b)).unwrap());
                // Outside of the scope: an operation remembers.
                let grads = y.sqr().unwrap().sum_all().unwrap().backward().unwrap();
                let of = |v: &candle_core::Var| grads.get(v).unwrap().clone();
                [y.detach(), of(&x), of(&w), of(&b)]
            };
            let (exact, rounded) = (found(Operands::F32), found(Operands::Bf16));
            for (i, (exact, rounded)) in exact.iter().zip(&rounded).enumerate() {
                assert_close(&format!("{i}"), rounded, exact, 0.02);
                // The bias sees the products only through the output.
                assert_ne!(flat(exact), flat(rounded), "{i}");
            }
        }
    }

    #[test]
    fn shapes_that_do_not_fit_are_errors() {
        let (x, w, b) = (var(&[2, 3], 1), var(&[4, 3], 2), var(&[3], 3));
        assert!(linear(&x, &w, Some(&b)).is_err());
        assert!(linear(&x, &w.t().unwrap(), None).is_err());
    }
}
