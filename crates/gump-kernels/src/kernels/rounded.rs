//! Products of bfloat16 on processors without a unit for them: operands are rounded and multiplied
//! in f32. As exact as a unit, and no faster than f32.

use crate::gemm::{Mat, MatMut, Store, Threads, f32_fresh_product, f32_product};

/// `dst (+)= scale * lhs rhs` of rounded operands.
pub(super) fn product(
    dst: MatMut<'_>,
    store: Store,
    scale: f32,
    lhs: Mat<'_>,
    rhs: Mat<'_>,
    threads: Threads,
) {
    Right::new(rhs).product(dst, store, scale, lhs, threads);
}

/// The nearest bfloat16, ties to even; what is too small for a normal one is 0, as units have it.
pub(super) fn round(x: f32) -> f32 {
    if x.abs() < f32::MIN_POSITIVE {
        return 0.0f32.copysign(x);
    }
    half::bf16::from_f32(x).to_f32()
}

/// The numbers of a matrix, rounded, row by row.
fn rounded(mat: Mat<'_>) -> Vec<f32> {
    let (data, [rows, cols], [row_stride, col_stride]) = mat.parts();
    let at = |i: usize| data[i / cols * row_stride + i % cols * col_stride];
    (0..rows * cols).map(|i| round(at(i))).collect()
}

/// A right matrix `[depth, columns]`, rounded.
#[derive(Debug)]
pub(crate) struct Right {
    numbers: Vec<f32>,
    columns: usize,
}

impl Right {
    pub(super) fn new(rhs: Mat<'_>) -> Self {
        let (_, [_, columns], _) = rhs.parts();
        Self {
            numbers: rounded(rhs),
            columns,
        }
    }

    pub(super) fn bytes(&self) -> usize {
        size_of_val(&self.numbers[..])
    }

    /// As [`super::Packed::fresh_product`].
    pub(super) fn fresh_product(
        &self,
        lhs: Mat<'_>,
        row: Option<&[f32]>,
        threads: Threads,
    ) -> Vec<f32> {
        let (_, [rows, depth], _) = lhs.parts();
        let lhs = rounded(lhs);
        let lhs = Mat::new(&lhs, rows, depth);
        let rhs = Mat::new(&self.numbers, depth, self.columns);
        f32_fresh_product(lhs, rhs, row, threads)
    }

    /// As [`super::Packed::product`].
    pub(super) fn product(
        &self,
        dst: MatMut<'_>,
        store: Store,
        scale: f32,
        lhs: Mat<'_>,
        threads: Threads,
    ) {
        let (_, [rows, depth], _) = lhs.parts();
        let columns = dst.columns();
        let lhs = rounded(lhs);
        let lhs = Mat::new(&lhs, rows, depth);
        let rhs = Mat::strided(&self.numbers, depth, columns, self.columns);
        f32_product(dst, store, scale, lhs, rhs, threads);
    }
}
