//! The mean absolute difference.

use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, Tensor, bail};

use super::{Host, elements, fusible, gradient, output};
use gump_kernels::rows::{for_pieces, sum};
use gump_kernels::wide;

/// Elements a task takes, as in `gump_kernels::rows`; fixes the order of sums.
const PIECE: usize = 16 * 1024;

/// The mean over all elements of `|x - target|`; the gradient reaches `x` only, and is 0 where both
/// are equal.
///
/// Shape: both the same, not empty; the result is a scalar.
///
/// Error: when the shapes differ.
pub fn mean_absolute_difference(x: &Tensor, target: &Tensor) -> Result<Tensor> {
    if x.dims() != target.dims() {
        let (x, target) = (x.shape(), target.shape());
        bail!("mean_absolute_difference: x {x:?}, target {target:?}");
    }
    let target = target.detach();
    if !fusible(&[x, &target]) {
        return composed(x, &target);
    }
    x.contiguous()?.apply_op2(&target.contiguous()?, Difference)
}

fn composed(x: &Tensor, target: &Tensor) -> Result<Tensor> {
    (x - target)?.abs()?.mean_all()
}

struct Difference;

impl CustomOp2 for Difference {
    fn name(&self) -> &'static str {
        "mean-absolute-difference"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        target: &CpuStorage,
        target_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (x, target) = (elements(x, x_layout)?, elements(target, target_layout)?);
        let mut sums = vec![0.0; x.len().div_ceil(PIECE)];
        for_pieces(&mut sums, 1, |i, sums| {
            let end = ((i + 1) * PIECE).min(x.len());
            let pairs = x[i * PIECE..end]
                .chunks(LANES)
                .zip(target[i * PIECE..end].chunks(LANES));
            wide(
                #[inline(always)]
                || {
                    let mut lanes = [0.0; LANES];
                    for (x, target) in pairs {
                        for ((lane, x), target) in lanes.iter_mut().zip(x).zip(target) {
                            *lane += (x - target).abs();
                        }
                    }
                    sums[0] = sum(&lanes);
                },
            );
        });
        let total: f64 = sums.iter().map(|&sum| f64::from(sum)).sum();
        Ok(output(vec![(total / x.len() as f64) as f32], ()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        target: &Tensor,
        _mean: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let slope = grad.to_scalar::<f32>()? / x.elem_count() as f32;
        let (x_host, target) = (Host::new(x)?, Host::new(target)?);
        let (x_all, target) = (x_host.slice::<f32>()?, target.slice::<f32>()?);
        let mut dx = vec![0.0; x_all.len()];
        for_pieces(&mut dx, PIECE, |i, dx| {
            let at = i * PIECE..i * PIECE + dx.len();
            let (x, target) = (&x_all[at.clone()], &target[at]);
            wide(
                #[inline(always)]
                || {
                    for ((dx, x), target) in dx.iter_mut().zip(x).zip(target) {
                        let above = if x > target { slope } else { 0.0 };
                        *dx = if x < target { -slope } else { above };
                    }
                },
            );
        });
        Ok((Some(gradient(dx, x)?), None))
    }
}

/// Independent sums: two vectors of 512 bits, as in `gump_kernels::rows`.
const LANES: usize = 32;

#[cfg(test)]
mod tests {
    use super::super::testing::{check, var};
    use super::*;

    #[test]
    fn agrees_with_the_composition() {
        for shape in [&[1usize][..], &[3, 37], &[2, 150, 192]] {
            let (x, target) = (var(shape, 1), var(shape, 2));
            check(
                &[&x],
                || mean_absolute_difference(&x, &target),
                || composed(&x, &target.detach()),
            );
        }
    }

    #[test]
    fn equal_numbers_have_no_slope() {
        let x = var(&[4], 1);
        let mean = mean_absolute_difference(&x, &x.copy().unwrap()).unwrap();
        let grads = mean.backward().unwrap();
        let slopes = grads.get(&x).unwrap().to_vec1::<f32>().unwrap();
        assert_eq!(
            (mean.to_scalar::<f32>().unwrap(), slopes),
            (0.0, vec![0.0; 4])
        );
        assert!(mean_absolute_difference(&x, &var(&[5], 1)).is_err());
    }
}
