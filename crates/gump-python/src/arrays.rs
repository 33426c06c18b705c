//! NumPy arrays in and out.

use numpy::ndarray::{Array, Dimension};
use numpy::{Element, IntoPyArray, PyArray, PyArrayDyn, PyArrayMethods, PyReadonlyArrayDyn};
use numpy::{PyUntypedArrayMethods, ndarray};
use pyo3::prelude::*;

use crate::errors;

/// The numbers of an array whose shape has been checked.
pub(crate) struct Numbers<'py, T: Element> {
    name: &'static str,
    array: PyReadonlyArrayDyn<'py, T>,
}

impl<'py, T: Element> Numbers<'py, T> {
    /// Borrows an array; `axes` says what its axes are, for the sentence that refuses another
    /// number of them.
    pub(crate) fn new(
        name: &'static str,
        array: &Bound<'py, PyArrayDyn<T>>,
        axes: &[&str],
    ) -> PyResult<Self> {
        if array.ndim() != axes.len() {
            let (axes, found) = (axes.join(", "), array.shape());
            return Err(errors::value(format!(
                "{name}: expected an array of shape [{axes}], found one of shape {found:?}"
            )));
        }
        let array = array.try_readonly().map_err(|_| {
            errors::value(format!(
                "{name}: expected an array that nobody is writing to"
            ))
        })?;
        Ok(Self { name, array })
    }

    /// Lengths of its axes.
    pub(crate) fn shape(&self) -> &[usize] {
        self.array.shape()
    }

    /// Refuses an axis of another length than `expected`, which is what `why` says.
    pub(crate) fn expect(&self, axis: usize, expected: usize, why: &str) -> PyResult<()> {
        let found = self.shape()[axis];
        if found == expected {
            return Ok(());
        }
        let name = self.name;
        Err(errors::value(format!(
            "{name}: expected {expected} along axis {axis} ({why}), found {found}"
        )))
    }

    /// All numbers, the last axis fastest.
    pub(crate) fn slice(&self) -> PyResult<&[T]> {
        self.array.as_slice().map_err(|_| {
            let name = self.name;
            errors::value(format!("{name}: expected a C-contiguous array"))
        })
    }
}

/// An array of Rust's as one of NumPy's.
pub(crate) fn array<T: Element, D: Dimension>(
    py: Python<'_>,
    shape: impl ndarray::ShapeBuilder<Dim = D>,
    numbers: Vec<T>,
) -> PyResult<Bound<'_, PyArray<T, D>>> {
    let array = Array::from_shape_vec(shape, numbers).map_err(errors::runtime)?;
    Ok(array.into_pyarray(py))
}
