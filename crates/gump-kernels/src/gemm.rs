//! Matrix products over checked slices.
//!
//! What lives here: [`Mat`], [`MatMut`], [`gemm()`] and [`Right`], whose faces are safe. What does
//! not: what a processor multiplies with, which is in `kernels`, and any layer; those call these
//! functions and stay free of `unsafe`.
#![allow(
    unsafe_code,
    reason = "`gemm::gemm` takes raw pointers, which are checked here, once"
)]

use std::sync::OnceLock;

use gemm::Parallelism;

use crate::kernels;
use crate::operands::Operands;

/// A read-only matrix over a slice with any two strides.
#[derive(Clone, Copy, Debug)]
pub struct Mat<'a> {
    data: &'a [f32],
    rows: usize,
    cols: usize,
    row_stride: usize,
    col_stride: usize,
}

impl<'a> Mat<'a> {
    /// A row-major matrix whose rows start `row_stride` elements apart.
    ///
    /// Panics when the slice is too short for the shape.
    pub fn strided(data: &'a [f32], rows: usize, cols: usize, row_stride: usize) -> Self {
        check_extent(data.len(), rows, cols, row_stride);
        Self {
            data,
            rows,
            cols,
            row_stride,
            col_stride: 1,
        }
    }

    /// A row-major matrix without gaps.
    pub fn new(data: &'a [f32], rows: usize, cols: usize) -> Self {
        Self::strided(data, rows, cols, cols)
    }

    /// The transposed view; no element moves.
    pub fn t(self) -> Self {
        Self {
            data: self.data,
            rows: self.cols,
            cols: self.rows,
            row_stride: self.col_stride,
            col_stride: self.row_stride,
        }
    }

    /// The slice, rows and columns, and the strides of both; every element lies in the slice.
    pub fn parts(self) -> (&'a [f32], [usize; 2], [usize; 2]) {
        (
            self.data,
            [self.rows, self.cols],
            [self.row_stride, self.col_stride],
        )
    }
}

/// A writable row-major matrix.
#[derive(Debug)]
pub struct MatMut<'a> {
    data: &'a mut [f32],
    rows: usize,
    cols: usize,
    row_stride: usize,
}

impl<'a> MatMut<'a> {
    /// A row-major matrix whose rows start `row_stride` elements apart.
    ///
    /// Panics when the slice is too short for the shape, or when rows would overlap.
    pub fn strided(data: &'a mut [f32], rows: usize, cols: usize, row_stride: usize) -> Self {
        check_extent(data.len(), rows, cols, row_stride);
        Self {
            data,
            rows,
            cols,
            row_stride,
        }
    }

    /// A row-major matrix without gaps.
    pub fn new(data: &'a mut [f32], rows: usize, cols: usize) -> Self {
        Self::strided(data, rows, cols, cols)
    }

    /// Number of columns.
    pub fn columns(&self) -> usize {
        self.cols
    }

    /// The slice, rows and columns, and the stride of the rows.
    pub fn into_parts(self) -> (&'a mut [f32], [usize; 2], usize) {
        (self.data, [self.rows, self.cols], self.row_stride)
    }
}

fn check_extent(len: usize, rows: usize, cols: usize, row_stride: usize) {
    assert!(rows <= 1 || cols <= row_stride, "matrix rows overlap");
    let needed = if rows == 0 || cols == 0 {
        0
    } else {
        (rows - 1) * row_stride + cols
    };
    assert!(needed <= len, "matrix of {needed} elements over {len}");
}

/// Whether a product replaces its destination or is added to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Store {
    /// `dst = scale * lhs rhs`
    Replace,
    /// `dst += scale * lhs rhs`
    Add,
}

/// Threads that compute a product.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Threads {
    /// The calling thread.
    One,
    /// The current rayon pool; the bits do not depend on its size, because only rows and columns
    /// are shared out, never the inner sum.
    Pool,
}

/// Multiplies `lhs` `[m, k]` by `rhs` `[k, n]` into `dst` `[m, n]`.
///
/// Panics when the shapes do not fit.
pub fn gemm(
    dst: MatMut<'_>,
    store: Store,
    scale: f32,
    lhs: Mat<'_>,
    rhs: Mat<'_>,
    threads: Threads,
    operands: Operands,
) {
    assert_eq!(dst.rows, lhs.rows, "rows of the product");
    assert_eq!(dst.cols, rhs.cols, "columns of the product");
    assert_eq!(lhs.cols, rhs.rows, "inner size of the product");
    match operands {
        Operands::Bf16 if kernels::is_worthwhile(dst.rows, lhs.cols, dst.cols) => {
            kernels::bf16_product(dst, store, scale, lhs, rhs, threads);
        }
        _ => f32_product(dst, store, scale, lhs, rhs, threads),
    }
}

/// A right matrix that several products share: packed once, if it is to be packed.
#[derive(Debug)]
pub struct Right<'a>(Form<'a>);

/// Storage of a right matrix.
#[derive(Debug)]
enum Form<'a> {
    /// Multiplied as it is.
    Plain(Mat<'a>),
    /// Rounded and packed.
    Packed(kernels::Packed),
}

impl Right<'static> {
    /// Rounds the matrix and packs it.
    pub fn packed(rhs: Mat<'_>) -> Self {
        Self(Form::Packed(kernels::Packed::new(rhs)))
    }
}

impl<'a> Right<'a> {
    /// Packs the matrix if its operands are to be rounded.
    pub fn new(rhs: Mat<'a>, operands: Operands) -> Self {
        match operands {
            Operands::F32 => Self(Form::Plain(rhs)),
            Operands::Bf16 => Self(Form::Packed(kernels::Packed::new(rhs))),
        }
    }

    /// [`gemm()`] with this matrix, or with its first columns where `dst` has fewer, and its first
    /// rows where `lhs` has fewer columns.
    pub fn product(
        &self,
        dst: MatMut<'_>,
        store: Store,
        scale: f32,
        lhs: Mat<'_>,
        threads: Threads,
    ) {
        assert_eq!(dst.rows, lhs.rows, "rows of the product");
        match &self.0 {
            Form::Packed(packed) => packed.product(dst, store, scale, lhs, threads),
            Form::Plain(rhs) => {
                let enough = dst.cols <= rhs.cols && lhs.cols <= rhs.rows;
                assert!(enough, "columns and inner size of the product");
                let rhs = Mat {
                    rows: lhs.cols,
                    cols: dst.cols,
                    ..*rhs
                };
                f32_product(dst, store, scale, lhs, rhs, threads);
            }
        }
    }
}

/// `lhs rhs` in new memory, `[m, n]`, plus `row` `[n]` in every row if there is one.
///
/// `packed` keeps the right matrix for the next product with it, if its operands are rounded; the
/// bits are those of [`gemm()`] either way.
///
/// Panics when the shapes do not fit.
pub fn fresh_product(
    lhs: Mat<'_>,
    (rhs, packed): (Mat<'_>, Option<&OnceLock<Right<'static>>>),
    row: Option<&[f32]>,
    threads: Threads,
    operands: Operands,
) -> Vec<f32> {
    assert_eq!(lhs.cols, rhs.rows, "inner size of the product");
    let fits = row.is_none_or(|row| row.len() == rhs.cols);
    assert!(fits, "a row as wide as the product");
    let rounds = operands == Operands::Bf16;
    if !rounds || !kernels::is_worthwhile(lhs.rows, lhs.cols, rhs.cols) {
        return f32_fresh_product(lhs, rhs, row, threads);
    }
    let once = OnceLock::new();
    let right = packed.unwrap_or(&once).get_or_init(|| Right::packed(rhs));
    match &right.0 {
        Form::Packed(packed) => packed.fresh_product(lhs, row, threads),
        Form::Plain(_) => unreachable!("it was packed"),
    }
}

/// [`fresh_product`] of the numbers as they are; the shapes fit.
pub(crate) fn f32_fresh_product(
    lhs: Mat<'_>,
    rhs: Mat<'_>,
    row: Option<&[f32]>,
    threads: Threads,
) -> Vec<f32> {
    let (m, n) = (lhs.rows, rhs.cols);
    let mut product = Vec::with_capacity(m * n);
    match row {
        Some(row) => {
            (0..m).for_each(|_| product.extend_from_slice(row));
            let dst = MatMut::new(&mut product, m, n);
            f32_product(dst, Store::Add, 1.0, lhs, rhs, threads);
        }
        None if lhs.cols == 0 => product.resize(m * n, 0.0),
        None => {
            // SAFETY: there is room for `m` rows of `n` numbers, `product` is not shared, and with
            // `Replace` and at least one inner index all of them are written and none is read.
            unsafe {
                multiply(
                    (product.as_mut_ptr(), n),
                    Store::Replace,
                    1.0,
                    lhs,
                    rhs,
                    threads,
                );
                product.set_len(m * n);
            }
        }
    }
    product
}

/// [`gemm()`] of the numbers as they are.
///
/// Panics when the shapes do not fit.
pub fn f32_product(
    dst: MatMut<'_>,
    store: Store,
    scale: f32,
    lhs: Mat<'_>,
    rhs: Mat<'_>,
    threads: Threads,
) {
    assert_eq!(dst.rows, lhs.rows, "rows of the product");
    assert_eq!(dst.cols, rhs.cols, "columns of the product");
    let MatMut {
        data, row_stride, ..
    } = dst;
    // SAFETY: the constructor checked that every (row, column) lies in the slice of `dst`, which is
    // as large as the product, and that its rows are disjoint; it is a unique borrow, so it overlaps
    // neither operand.
    unsafe {
        let to = (data.as_mut_ptr(), row_stride);
        multiply(to, store, scale, lhs, rhs, threads);
    }
}

/// The product by the matrix library, to rows of the pointer that are so far apart.
///
/// # Safety
/// There is room for the rows of `lhs` with the columns of `rhs`, which overlaps neither and is used
/// by no one else; the numbers there may be read unless they are replaced.
unsafe fn multiply(
    (to, row_stride): (*mut f32, usize),
    store: Store,
    scale: f32,
    lhs: Mat<'_>,
    rhs: Mat<'_>,
    threads: Threads,
) {
    assert_eq!(lhs.cols, rhs.rows, "inner size of the product");
    let stride = |s: usize| isize::try_from(s).expect("a stride is within a slice");
    // SAFETY: as the function's; the constructors of both operands checked that every (row, column)
    // lies in its slice.
    unsafe {
        gemm::gemm(
            lhs.rows,
            rhs.cols,
            lhs.cols,
            to,
            1,
            stride(row_stride),
            store == Store::Add,
            lhs.data.as_ptr(),
            stride(lhs.col_stride),
            stride(lhs.row_stride),
            rhs.data.as_ptr(),
            stride(rhs.col_stride),
            stride(rhs.row_stride),
            1.0,
            scale,
            false,
            false,
            false,
            match threads {
                Threads::One => Parallelism::None,
                Threads::Pool => Parallelism::Rayon(0),
            },
        );
    }
}

/// The product of two `[n, n]` matrices by the matrix library on all threads: what the speed of
/// everything else is held against.
///
/// Panics when a slice is shorter than `n * n`.
pub fn square_product(a: &[f32], b: &[f32], n: usize) -> Vec<f32> {
    let mut product = vec![0.0; n * n];
    let dst = MatMut::new(&mut product, n, n);
    let (a, b) = (Mat::new(a, n, n), Mat::new(b, n, n));
    f32_product(dst, Store::Replace, 1.0, a, b, Threads::Pool);
    product
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn products_of_strided_and_transposed_views() {
        // lhs is columns 1..3 of a [2, 4] matrix, rhs a [3, 2] matrix read transposed.
        let a = [0., 1., 2., 0., 0., 3., 4., 0.];
        let b = [1., 10., 2., 20., 3., 30.];
        let mut c = vec![1.0; 6];
        let lhs = Mat::strided(&a[1..], 2, 2, 4);
        let rhs = Mat::new(&b, 3, 2).t();
        for threads in [Threads::One, Threads::Pool] {
            let dst = MatMut::new(&mut c, 2, 3);
            f32_product(dst, Store::Replace, 1.0, lhs, rhs, threads);
            assert_eq!(c, [21., 42., 63., 43., 86., 129.]);
        }
        let dst = MatMut::new(&mut c, 2, 3);
        f32_product(dst, Store::Add, -1.0, lhs, rhs, Threads::One);
        assert_eq!(c, [0.0; 6]);
    }

    #[test]
    #[should_panic(expected = "rows of the product")]
    fn a_product_larger_than_its_destination_is_refused() {
        let (mut to, a) = ([0.0; 2], [0.0; 4]);
        let (dst, a) = (MatMut::new(&mut to, 1, 2), Mat::new(&a, 2, 2));
        f32_product(dst, Store::Replace, 1.0, a, a, Threads::One);
    }

    #[test]
    #[should_panic(expected = "matrix of 7 elements over 6")]
    fn a_short_slice_is_refused() {
        Mat::strided(&[0.0; 6], 2, 2, 5);
    }
}
