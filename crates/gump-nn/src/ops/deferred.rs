//! Gradients of matrices, deferred until all samples of a step are differentiated.
//!
//! The gradient of a weight matrix is a product of two tensors that the backward pass has in
//! memory; that of a table of embeddings, a few of its rows. Computed immediately, it is a matrix
//! per sample: zeroed, added to, kept, and added to those of the other samples, which for millions
//! of parameters and a few hundred tokens costs as much as the products. So an operation that is
//! built within [`Deferred::during`] only notes the tensors, and [`Deferred::take_in`] adds all
//! parts of a matrix's gradient up in one place.
//!
//! What lives here: the notes and their sum. What does not: who notes (`linear`, `table`), and when
//! the sums are due, which training knows.

use std::cell::RefCell;
use std::sync::{Arc, Mutex, PoisonError};

use candle_core::{Result, Tensor, TensorId};

use super::{Host, scope};
use gump_kernels::Operands;
use gump_kernels::gemm::{Mat, MatMut, Store, Threads, gemm};
use gump_kernels::rows::add_to;
use gump_kernels::wide;

/// A part of the gradient of a matrix `[R, C]`.
#[derive(Clone, Debug)]
pub(super) enum Part {
    /// `dy^T x`, of `x` `[.., C]` and `dy` `[.., R]`.
    Product {
        x: Tensor,
        dy: Tensor,
        operands: Operands,
    },
    /// The rows from `first` on, `[.., C]`.
    Rows { first: usize, slopes: Tensor },
    /// To each of the rows `[N, K]`, `u32::MAX` for none, a row of `[N, C]` is added.
    Scattered { rows: Tensor, slopes: Tensor },
}

/// The parts of gradients that one backward pass has deferred, in its order.
#[derive(Clone, Debug, Default)]
pub struct Deferred(Arc<Mutex<Vec<(TensorId, Part)>>>);

thread_local! {
    static CURRENT: RefCell<Option<Deferred>> = const { RefCell::new(None) };
}

impl Deferred {
    /// The collector of gradients deferred by operations that the calling thread builds now, if
    /// any.
    pub(super) fn current() -> Option<Self> {
        CURRENT.with_borrow(Clone::clone)
    }

    /// Runs `f`, whose operations note gradients here.
    pub fn during<R>(&self, f: impl FnOnce() -> R) -> R {
        scope::within(&CURRENT, self.clone(), f)
    }

    /// Notes a part of the gradient of `matrix`.
    pub(super) fn note(&self, matrix: &Tensor, part: Part) {
        let mut parts = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        parts.push((matrix.id(), part));
    }

    /// Returns the parts noted for `matrix`; the lock is released before they are used.
    fn parts_of(&self, matrix: &Tensor) -> Vec<Part> {
        let parts = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let own = parts.iter().filter(|(of, _)| *of == matrix.id());
        own.map(|(_, part)| part.clone()).collect()
    }

    /// Adds the parts noted for `matrix`, in the order of `all`, to its gradient so far; `None` if
    /// there is neither.
    ///
    /// Error: a tensor error.
    pub fn take_in<'a>(
        all: impl Iterator<Item = &'a Self>,
        matrix: &Tensor,
        mut sum: Option<Tensor>,
    ) -> Result<Option<Tensor>> {
        let mut gradient: Option<Vec<f32>> = None;
        for deferred in all {
            for part in deferred.parts_of(matrix) {
                let mut is_zero = false;
                let numbers = match &mut gradient {
                    Some(numbers) => numbers,
                    None => gradient.insert(match sum.take() {
                        Some(sum) => sum.flatten_all()?.to_vec1::<f32>()?,
                        None => {
                            is_zero = true;
                            vec![0.0; matrix.elem_count()]
                        }
                    }),
                };
                part.add_to(numbers, is_zero, matrix.dims2()?)?;
            }
        }
        match gradient {
            Some(numbers) => Tensor::from_vec(numbers, matrix.shape(), matrix.device()).map(Some),
            None => Ok(sum),
        }
    }
}

impl Part {
    /// Adds the part to `numbers` `[R, C]`, which may be known to be zeros.
    fn add_to(
        &self,
        numbers: &mut [f32],
        is_zero: bool,
        (n_rows, width): (usize, usize),
    ) -> Result<()> {
        match self {
            Self::Product { x, dy, operands } => {
                let (x, dy) = (Host::new(x)?, Host::new(dy)?);
                let (x, dy) = (x.slice::<f32>()?, dy.slice::<f32>()?);
                let n = x.len() / width.max(1);
                let store = if is_zero { Store::Replace } else { Store::Add };
                gemm(
                    MatMut::new(numbers, n_rows, width),
                    store,
                    1.0,
                    Mat::new(dy, n, n_rows).t(),
                    Mat::new(x, n, width),
                    Threads::One,
                    *operands,
                );
            }
            Self::Rows { first, slopes } => {
                let slopes = Host::new(slopes)?;
                let slopes = slopes.slice::<f32>()?;
                let numbers = &mut numbers[first * width..][..slopes.len()];
                wide(
                    #[inline(always)]
                    || add_to(numbers, slopes),
                );
            }
            Self::Scattered { rows, slopes } => {
                let n_each = rows.dim(1)?;
                let (rows, slopes) = (Host::new(rows)?, Host::new(slopes)?);
                let (rows, slopes) = (rows.slice::<u32>()?, slopes.slice::<f32>()?);
                super::table::scatter(numbers, rows.chunks_exact(n_each), slopes, width);
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::super::linear;
    use super::super::testing::{assert_close, var};
    use super::*;

    #[test]
    fn gradients_put_off_are_the_gradients() {
        let (w, b) = (var(&[9, 7], 1), var(&[9], 2));
        let xs = [var(&[5, 7], 3), var(&[2, 4, 7], 4)];
        let loss = |x: &Tensor| {
            // The matrix is used twice.
            let twice = linear(x, &w, Some(&b)).unwrap();
            let again = linear(&(x * 0.5).unwrap(), &w, None).unwrap();
            (twice * again).unwrap().sum_all().unwrap()
        };
        let mut expected: Option<Tensor> = None;
        let mut found = None;
        for x in &xs {
            let grads = loss(x).backward().unwrap();
            let grad = grads.get(&w).unwrap();
            expected = Some(match expected {
                Some(sum) => (sum + grad).unwrap(),
                None => grad.clone(),
            });
            let deferred = Deferred::default();
            let grads_put_off = deferred.during(|| loss(x)).backward().unwrap();
            assert!(grads_put_off.get(&w).is_none());
            for v in [x, &b] {
                assert_close(
                    "others",
                    grads_put_off.get(v).unwrap(),
                    grads.get(v).unwrap(),
                    1e-6,
                );
            }
            found = Deferred::take_in([&deferred].into_iter(), &w, found).unwrap();
        }
        assert_close("sum", &found.unwrap(), &expected.unwrap(), 1e-5);
        let none = Deferred::default();
        assert!(
            Deferred::take_in([&none].into_iter(), &w, None)
                .unwrap()
                .is_none()
        );
    }

    #[test]
    fn what_is_computed_from_parameters_is_not_put_off() {
        let (w, x) = (var(&[3, 4], 1), var(&[2, 4], 2));
        let deferred = Deferred::default();
        let y = deferred.during(|| linear(&x, &(&*w * 2.0).unwrap(), None).unwrap());
        let grads = y.sum_all().unwrap().backward().unwrap();
        assert!(grads.get(&w).is_some());
        assert!(
            Deferred::take_in([&deferred].into_iter(), &w, None)
                .unwrap()
                .is_none()
        );
    }
}
