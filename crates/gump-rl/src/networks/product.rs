//! Matrix products over checked slices: the only `unsafe` of the crate.
#![allow(
    unsafe_code,
    reason = "`gemm::gemm` takes raw pointers; what they reach is checked here, once"
)]

/// A row-major matrix without gaps, possibly transposed.
#[derive(Clone, Copy, Debug)]
pub(super) struct Matrix<'a> {
    data: &'a [f32],
    rows: usize,
    cols: usize,
    row_stride: usize,
    col_stride: usize,
}

impl<'a> Matrix<'a> {
    /// Panics if `data` does not have exactly `rows` times `cols` numbers.
    pub(super) fn new(data: &'a [f32], rows: usize, cols: usize) -> Self {
        assert_eq!(data.len(), rows * cols, "a matrix of {rows} x {cols}");
        Self {
            data,
            rows,
            cols,
            row_stride: cols,
            col_stride: 1,
        }
    }

    /// The transposed view; no data is moved.
    pub(super) fn t(self) -> Self {
        Self {
            data: self.data,
            rows: self.cols,
            cols: self.rows,
            row_stride: self.col_stride,
            col_stride: self.row_stride,
        }
    }
}

/// `sum += lhs rhs` for `lhs` `[m, k]`, `rhs` `[k, n]` and a row-major `sum` `[m, n]`.
///
/// Runs on the calling thread, so that equal input gives equal bits.
///
/// Panics if the shapes do not fit.
pub(super) fn add_product(sum: &mut [f32], lhs: Matrix<'_>, rhs: Matrix<'_>) {
    let (m, k, n) = (lhs.rows, lhs.cols, rhs.cols);
    assert_eq!(k, rhs.rows, "inner size of the product");
    assert_eq!(sum.len(), m * n, "size of the product");
    let stride = |s: usize| isize::try_from(s).expect("a stride is within a slice");
    // SAFETY: `Matrix::new` checked that every (row, column) of the operands lies in its slice, the
    // assertion above the same of `sum`, which is borrowed uniquely and so overlaps neither.
    unsafe {
        gemm::gemm(
            m,
            n,
            k,
            sum.as_mut_ptr(),
            1,
            stride(n),
            true,
            lhs.data.as_ptr(),
            stride(lhs.col_stride),
            stride(lhs.row_stride),
            rhs.data.as_ptr(),
            stride(rhs.col_stride),
            stride(rhs.row_stride),
            1.0,
            1.0,
            false,
            false,
            false,
            gemm::Parallelism::None,
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn products_by_hand() {
        let a = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
        let b = [1.0, 0.0, -1.0, 2.0, 1.0, 1.0];
        let check = |lhs: Matrix<'_>, rhs: Matrix<'_>, expected: &[f32]| {
            let mut sum = vec![10.0; expected.len()];
            add_product(&mut sum, lhs, rhs);
            let expected: Vec<f32> = expected.iter().map(|x| x + 10.0).collect();
            assert_eq!(sum, expected);
        };
        let (wide, tall) = (Matrix::new(&a, 2, 3), Matrix::new(&b, 3, 2));
        check(wide, tall, &[2.0, 7.0, 5.0, 16.0]);
        check(
            wide.t(),
            tall.t(),
            &[1.0, 7.0, 5.0, 2.0, 8.0, 7.0, 3.0, 9.0, 9.0],
        );
        check(wide, Matrix::new(&b, 2, 3).t(), &[-2.0, 7.0, -2.0, 19.0]);
    }
}
