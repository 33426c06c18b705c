//! The affine map.
//!
//! What lives here: the fused operation, whose gradients never copy a transposed matrix. What does
//! not: the parameters, which the network holds.

use candle_core::{
    CpuStorage, CustomOp2, CustomOp3, D, DType, Layout, Result, Shape, Tensor, TensorId,
};

use super::deferred::{Deferred, Part};
use super::packed::{PackedWeights, Place, Side};
use super::{Host, elements, fusible, gradient, output};
use gump_kernels::Operands;
use gump_kernels::gemm::{Mat, MatMut, Right, Store, Threads, fresh_product, gemm};
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
            let op = Linear::of(weight);
            x.contiguous()?
                .apply_op3(&weight.contiguous()?, &bias.contiguous()?, op)
        }
        None if fusible(&[x, weight]) => x
            .contiguous()?
            .apply_op2(&weight.contiguous()?, Linear::of(weight)),
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
    packed: Option<PackedWeights>,
    /// The matrix of the operation [`linear`], if it is a parameter.
    weight: Option<TensorId>,
}

impl Linear {
    /// As the calling thread has it now.
    pub(super) fn now() -> Self {
        Self {
            operands: Operands::current(),
            deferred: Deferred::current(),
            packed: PackedWeights::current(),
            weight: None,
        }
    }

    /// The same for one matrix.
    fn of(weight: &Tensor) -> Self {
        Self {
            weight: parameter(weight),
            ..Self::now()
        }
    }
}

/// What a matrix is known by, if it is a parameter: other tensors do not outlive a sample.
fn parameter(weight: &Tensor) -> Option<TensorId> {
    weight.is_variable().then(|| weight.id())
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
        let y = self.multiply_by(x, (weight, self.weight), sizes, bias);
        Ok(output(y, shape))
    }

    /// `x weight^T + bias`, given the numbers of a matrix `[out, in]` and itself.
    pub(super) fn multiply(
        &self,
        x: &[f32],
        (numbers, weight): (&[f32], &Tensor),
        bias: Option<&[f32]>,
    ) -> Result<Vec<f32>> {
        let (sizes, name) = (weight.dims2()?, parameter(weight));
        Ok(self.multiply_by(x, (numbers, name), sizes, bias))
    }

    fn multiply_by(
        &self,
        x: &[f32],
        (weight, name): (&[f32], Option<TensorId>),
        (n_out, n_in): (usize, usize),
        bias: Option<&[f32]>,
    ) -> Vec<f32> {
        let x = Mat::new(x, x.len() / n_in.max(1), n_in);
        let turned = Mat::new(weight, n_out, n_in).t();
        self.product(x, (turned, name), Side::Turned, bias)
    }

    /// A matrix, or its transpose, as the right side of several products.
    pub(super) fn right<'a>(&self, rhs: Mat<'a>, weight: &Tensor, side: Side) -> Shared<'a> {
        let packed = self.packed.as_ref().zip(parameter(weight));
        match packed.filter(|_| self.operands == Operands::Bf16) {
            Some((packed, name)) => Shared::Packed(packed.of(name, side), rhs),
            None => Shared::Own(Right::new(rhs, self.operands)),
        }
    }

    /// `lhs rhs` in new memory, plus `bias` in every row; a parameter is packed once a step.
    fn product(
        &self,
        lhs: Mat<'_>,
        (rhs, name): (Mat<'_>, Option<TensorId>),
        side: Side,
        bias: Option<&[f32]>,
    ) -> Vec<f32> {
        let packed = self.packed.as_ref().zip(name);
        let packed = packed.map(|(packed, name)| packed.of(name, side));
        let rhs = (rhs, packed.as_deref());
        fresh_product(lhs, rhs, bias, Threads::Pool, self.operands)
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
        let (weight_host, dy) = (Host::new(weight)?, Host::new(dy)?);
        let w = weight_host.slice::<f32>()?;
        let dy = dy.slice::<f32>()?;
        let dy = Mat::new(dy, dy.len() / n_out.max(1), n_out);
        let dx = if wants_dx {
            let w = (Mat::new(w, n_out, n_in), parameter(weight));
            Some(self.product(dy, w, Side::Straight, None))
        } else {
            None
        };
        let dw = self.weight_gradient(weight, &[(x.detach(), dy_tensor.detach())])?;
        Ok((dx, dw))
    }

    /// The gradient of a matrix `[out, in]`, if it is due now: the sum of `dy^T x` over parts of `x`
    /// `[.., in]` with `dy` `[.., out]`.
    pub(super) fn weight_gradient(
        &self,
        weight: &Tensor,
        parts: &[(Tensor, Tensor)],
    ) -> Result<Option<Tensor>> {
        let operands = self.operands;
        if let Some(deferred) = self.deferred.as_ref().filter(|_| weight.is_variable()) {
            for (x, dy) in parts.iter().cloned() {
                deferred.note(weight, Part::Product { x, dy, operands });
            }
            return Ok(None);
        }
        if !weight.track_op() {
            return Ok(None);
        }
        let (n_out, n_in) = weight.dims2()?;
        let mut dw = vec![0.0; n_out * n_in];
        for (i, (x, dy)) in parts.iter().enumerate() {
            let (x, dy) = (Host::new(x)?, Host::new(dy)?);
            let (x, dy) = (x.slice::<f32>()?, dy.slice::<f32>()?);
            let rows = x.len() / n_in.max(1);
            gemm(
                MatMut::new(&mut dw, n_out, n_in),
                if i == 0 { Store::Replace } else { Store::Add },
                1.0,
                Mat::new(dy, rows, n_out).t(),
                Mat::new(x, rows, n_in),
                Threads::Pool,
                operands,
            );
        }
        Ok(Some(gradient(dw, weight)?))
    }
}

/// A right matrix for several products, packed for the step or for these.
pub(super) enum Shared<'a> {
    Packed(Place, Mat<'a>),
    Own(Right<'a>),
}

impl<'a> Shared<'a> {
    pub(super) fn get(&self) -> &Right<'a> {
        match self {
            Self::Packed(place, rhs) => place.get_or_init(|| Right::packed(*rhs)),
            Self::Own(right) => right,
        }
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
