//! Weight matrices in the form in which they are multiplied, packed once per training step.
//!
//! Every sample of a step multiplies by the same matrices, forward and backward, and packing one
//! costs as much as some hundred rows multiplied by it.
//!
//! What lives here: the collection of a step. What does not: packing, which `gump-kernels` does, and
//! the end of a step, which training knows: parameters must not change during [`PackedWeights::during`]
//! and the backward passes of what was built in it.

use std::cell::RefCell;
use std::collections::HashMap;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use candle_core::TensorId;
use gump_kernels::gemm::Right;

use super::scope;

/// How a matrix `[out, in]` is multiplied.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) enum Side {
    /// `x w^T`, forward.
    Turned,
    /// `dy w`, backward.
    Straight,
}

/// A packed matrix, or the place for it.
pub(super) type Place = Arc<OnceLock<Right<'static>>>;

/// The packed parameters of one training step; operations built within [`Self::during`] share them.
///
/// Bytes: twice those of the matrices in bfloat16. Matrices in f32 are not packed.
#[derive(Clone, Debug, Default)]
pub struct PackedWeights(Arc<Mutex<HashMap<(TensorId, Side), Place>>>);

thread_local! {
    static CURRENT: RefCell<Option<PackedWeights>> = const { RefCell::new(None) };
}

impl PackedWeights {
    /// Those of the step that the calling thread works for, if any.
    pub(super) fn current() -> Option<Self> {
        CURRENT.with_borrow(Clone::clone)
    }

    /// Runs `f`, whose operations take parameters from here, also in their gradients.
    pub fn during<R>(&self, f: impl FnOnce() -> R) -> R {
        scope::within(&CURRENT, self.clone(), f)
    }

    /// The place of a parameter.
    pub(super) fn of(&self, name: TensorId, side: Side) -> Place {
        let mut places = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        places.entry((name, side)).or_default().clone()
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{flat, var};
    use super::super::{in_bfloat16, linear};
    use super::*;
    use candle_core::{Tensor, Var};

    /// The bits of values and gradients of two samples in one step.
    fn step(w: &Var, b: &Var, packed: Option<&PackedWeights>) -> Vec<u32> {
        let mut bits = Vec::new();
        for salt in [3, 4] {
            let x = var(&[130, 70], salt);
            let build = || in_bfloat16(|| linear(&x, w, Some(b)).unwrap());
            let y = match packed {
                Some(packed) => packed.during(build),
                None => build(),
            };
            let grads = y.sqr().unwrap().sum_all().unwrap().backward().unwrap();
            let of = |of: &Tensor| flat(grads.get(of).unwrap());
            for found in [flat(&y), of(&x), of(w), of(b)] {
                bits.extend(found.into_iter().map(f32::to_bits));
            }
        }
        bits
    }

    #[test]
    fn a_step_with_packed_weights_has_the_same_bits() {
        let (w, b) = (var(&[90, 70], 1), var(&[90], 2));
        let packed = PackedWeights::default();
        assert_eq!(step(&w, &b, Some(&packed)), step(&w, &b, None));
        let places = packed.0.lock().unwrap();
        let filled = places.values().filter(|place| place.get().is_some());
        assert_eq!(filled.count(), 2, "one for each direction");
    }

    #[test]
    fn the_next_step_sees_changed_weights() {
        let (w, b) = (var(&[90, 70], 1), var(&[90], 2));
        let before = step(&w, &b, Some(&PackedWeights::default()));
        w.set(&(w.as_tensor() * 2.0).unwrap()).unwrap();
        let after = step(&w, &b, Some(&PackedWeights::default()));
        assert_ne!(before, after);
        assert_eq!(after, step(&w, &b, None));
    }

    #[test]
    fn what_is_computed_from_parameters_is_packed_anew() {
        let (w, x) = (var(&[8, 8], 1), var(&[8, 8], 2));
        let packed = PackedWeights::default();
        for by in [1.0, 2.0] {
            let doubled = (w.as_tensor() * by).unwrap();
            let build = || in_bfloat16(|| linear(&x, &doubled, None).unwrap());
            assert_eq!(flat(&packed.during(build)), flat(&build()));
        }
        assert!(packed.0.lock().unwrap().is_empty());
    }
}
