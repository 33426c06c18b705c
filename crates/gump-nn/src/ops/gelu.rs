//! The exact (error function) GELU.
//!
//! What lives here: the fused operation. What does not: the error function, which is
//! [`gump_kernels::gelu`]'s.

use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor};

use gump_kernels::gelu::normal;
use gump_kernels::gemm::Threads;
use gump_kernels::rows::for_pieces;
use gump_kernels::{fresh_pieces, wide};

use super::{Host, elements, fusible, gradient, output};

/// Elements per task, as in `gump_kernels::rows`.
const PIECE: usize = 16 * 1024;

/// `x` times the standard normal probability of being below `x`; any shape.
///
/// Error: none beyond candle's own.
pub fn gelu(x: &Tensor) -> Result<Tensor> {
    if !fusible(&[x]) {
        return x.gelu_erf();
    }
    x.contiguous()?.apply_op1(Gelu)
}

struct Gelu;

impl CustomOp1 for Gelu {
    fn name(&self) -> &'static str {
        "gelu"
    }

    fn cpu_fwd(&self, x: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        Ok(output(activated(elements(x, layout)?), layout.shape()))
    }

    fn bwd(&self, x: &Tensor, _y: &Tensor, dy: &Tensor) -> Result<Option<Tensor>> {
        let dy = dy.contiguous()?;
        let (x_host, dy) = (Host::new(x)?, Host::new(&dy)?);
        let mut dx = dy.slice::<f32>()?.to_vec();
        slope(x_host.slice()?, &mut dx);
        Ok(Some(gradient(dx, x)?))
    }
}

/// The activation of every number.
pub(super) fn activated(x: &[f32]) -> Vec<f32> {
    fresh_pieces(x.len(), PIECE, None, Threads::Pool, |i, y| {
        let x = &x[i * PIECE..];
        wide(
            #[inline(always)]
            || {
                for (y, &x) in y.iter_mut().zip(x) {
                    *y = x * normal(x).0;
                }
            },
        );
    })
}

/// Turns the gradient of the activations into that of the numbers `x`.
pub(super) fn slope(x: &[f32], d: &mut [f32]) {
    for_pieces(d, PIECE, |i, d| {
        let x = &x[i * PIECE..];
        wide(
            #[inline(always)]
            || {
                for (d, &x) in d.iter_mut().zip(x) {
                    let (below, density) = normal(x);
                    *d *= below + x * density;
                }
            },
        );
    });
}

#[cfg(test)]
mod tests {
    use super::super::testing::{check, flat, var};
    use super::*;
    use candle_core::Device;

    #[test]
    fn agrees_with_candle() {
        for shape in [&[1usize][..], &[3, 7], &[20_000, 3]] {
            let x = var(shape, 4);
            let wide_x = || x.affine(5.0, 0.3);
            check(&[&x], || gelu(&wide_x()?), || wide_x()?.gelu_erf());
        }
    }

    #[test]
    fn absolute_error_is_small_everywhere() {
        let xs: Vec<f32> = (-12_000..12_000).map(|i| i as f32 * 1e-3).collect();
        let x = Tensor::new(xs.as_slice(), &Device::Cpu).unwrap();
        let exact = x.to_dtype(candle_core::DType::F64).unwrap();
        let exact = exact.gelu_erf().unwrap().to_vec1::<f64>().unwrap();
        for (y, e) in flat(&gelu(&x).unwrap()).iter().zip(exact) {
            assert!((f64::from(*y) - e).abs() < 2e-6, "{y} against {e}");
        }
    }
}
