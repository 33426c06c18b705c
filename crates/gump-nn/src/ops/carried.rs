//! Operations of more tensors than the tensor library's take.
//!
//! A custom operation of candle has three inputs at most. One of these reads a tensor and any
//! number of others, whose gradients it leaves behind. The others also enter *carriers*, operations
//! with a single zero as their result, which the operation has as its second input: so the backward
//! pass comes to the carriers after the operation, and each hands over the gradients left for its
//! tensors.
//!
//! What lives here: that detour. What does not: the operations, which `half_block` has.

use std::sync::{Arc, Mutex, PoisonError};

use candle_core::{CpuStorage, CustomOp2, CustomOp3, DType, Layout, Result, Shape, Tensor};

use super::{elements, output};

/// An operation whose result has the shape of its first tensor; it holds the others itself.
pub(super) trait Operation: Send + Sync {
    fn name(&self) -> &'static str;

    fn forward(&self, x: &[f32]) -> Result<Vec<f32>>;

    /// Gradients of `x` and of the other tensors, in the order in which [`apply`] got them; `None`
    /// for one that has no gradient or has it noted elsewhere. `y` is the result.
    fn backward(
        &self,
        x: &Tensor,
        y: &Tensor,
        dy: &Tensor,
    ) -> Result<(Tensor, Vec<Option<Tensor>>)>;
}

/// The result of `operation` on `x`; `others` are contiguous.
///
/// Error: the operation's, or a tensor error.
pub(super) fn apply(
    x: &Tensor,
    others: &[&Tensor],
    operation: impl Operation + 'static,
) -> Result<Tensor> {
    let left = Left::default();
    let mut carried = Tensor::zeros(1, DType::F32, x.device())?;
    for (i, pair) in others.chunks(2).enumerate() {
        let carrier = Carrier {
            left: left.clone(),
            first: 2 * i,
        };
        carried = match pair {
            [one, two] => carried.apply_op3(one, two, carrier)?,
            _ => carried.apply_op2(pair[0], carrier)?,
        };
    }
    let leaving = Leaving { operation, left };
    x.contiguous()?.apply_op2(&carried, leaving)
}

/// Gradients that an operation has left for the carriers.
#[derive(Clone, Default)]
struct Left(Arc<Mutex<Vec<Option<Tensor>>>>);

impl Left {
    fn set(&self, gradients: Vec<Option<Tensor>>) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = gradients;
    }

    fn take(&self, i: usize) -> Option<Tensor> {
        let mut all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        all.get_mut(i).and_then(Option::take)
    }
}

/// Hands over the gradients of one or two tensors, `first` and the one after it.
struct Carrier {
    left: Left,
    first: usize,
}

impl CustomOp2 for Carrier {
    fn name(&self) -> &'static str {
        "carrier"
    }

    fn cpu_fwd(
        &self,
        _: &CpuStorage,
        _: &Layout,
        _: &CpuStorage,
        _: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        Ok(output(vec![0.0], 1))
    }

    fn bwd(
        &self,
        _before: &Tensor,
        _: &Tensor,
        _: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        Ok((Some(grad.clone()), self.left.take(self.first)))
    }
}

impl CustomOp3 for Carrier {
    fn name(&self) -> &'static str {
        "carrier"
    }

    fn cpu_fwd(
        &self,
        _: &CpuStorage,
        _: &Layout,
        _: &CpuStorage,
        _: &Layout,
        _: &CpuStorage,
        _: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        Ok(output(vec![0.0], 1))
    }

    fn bwd(
        &self,
        _before: &Tensor,
        _: &Tensor,
        _: &Tensor,
        _: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let [one, two] = [self.first, self.first + 1].map(|i| self.left.take(i));
        Ok((Some(grad.clone()), one, two))
    }
}

/// The operation itself.
struct Leaving<O> {
    operation: O,
    left: Left,
}

impl<O: Operation> CustomOp2 for Leaving<O> {
    fn name(&self) -> &'static str {
        self.operation.name()
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        layout: &Layout,
        _: &CpuStorage,
        _: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let y = self.operation.forward(elements(x, layout)?)?;
        Ok(output(y, layout.shape()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        carried: &Tensor,
        y: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let (dx, others) = self.operation.backward(x, y, &dy.contiguous()?)?;
        self.left.set(others);
        Ok((Some(dx), Some(carried.zeros_like()?)))
    }
}
