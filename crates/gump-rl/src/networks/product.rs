//! Matrix products that are added to a sum, on the kernels of `gump-kernels`.

use gump_kernels::gemm::{MatMut, Store, Threads, f32_product};

pub(super) use gump_kernels::gemm::Mat;

/// `sum += lhs rhs` for `lhs` `[m, k]`, `rhs` `[k, n]` and a row-major `sum` `[m, n]`.
///
/// Runs on the calling thread, so that equal input gives equal bits.
///
/// Panics if the shapes do not fit.
pub(super) fn add_product(sum: &mut [f32], lhs: Mat<'_>, rhs: Mat<'_>) {
    let ((_, [m, k], _), (_, [inner, n], _)) = (lhs.parts(), rhs.parts());
    assert_eq!(k, inner, "inner size of the product");
    assert_eq!(sum.len(), m * n, "size of the product");
    let sum = MatMut::new(sum, m, n);
    f32_product(sum, Store::Add, 1.0, lhs, rhs, Threads::One);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn products_by_hand() {
        let a = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
        let b = [1.0, 0.0, -1.0, 2.0, 1.0, 1.0];
        let check = |lhs: Mat<'_>, rhs: Mat<'_>, expected: &[f32]| {
            let mut sum = vec![10.0; expected.len()];
            add_product(&mut sum, lhs, rhs);
            let expected: Vec<f32> = expected.iter().map(|x| x + 10.0).collect();
            assert_eq!(sum, expected);
        };
        let (wide, tall) = (Mat::new(&a, 2, 3), Mat::new(&b, 3, 2));
        check(wide, tall, &[2.0, 7.0, 5.0, 16.0]);
        check(
            wide.t(),
            tall.t(),
            &[1.0, 7.0, 5.0, 2.0, 8.0, 7.0, 3.0, 9.0, 9.0],
        );
        check(wide, Mat::new(&b, 2, 3).t(), &[-2.0, 7.0, -2.0, 19.0]);
    }
}
