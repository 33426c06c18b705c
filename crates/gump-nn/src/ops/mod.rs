//! Fused tensor operations with hand-written gradients.
//!
//! What lives here: the operations of the network that candle composes from many passes over
//! memory, each rewritten as one pass forward and one backward for f32 tensors on a CPU, parallel
//! over rayon. On other devices and for other types every function falls back to candle's own
//! operations with the same result. What does not: layers with parameters, the network itself.
//!
//! One file per family; start with `norm` (the simplest), then `attention`. The arithmetic on rows and
//! matrices is `gump-kernels`'s.
//!
//! Results on a CPU are bit-identical for any number of threads: work is cut by shape, and sums
//! are added in a fixed order. Gradients cannot be differentiated again.

mod absolute;
mod attention;
mod batch_norm;
mod carried;
mod conv;
mod deferred;
mod divergence;
mod edge_attention;
mod gelu;
mod gru;
mod half_block;
mod linear;
mod loss;
mod norm;
mod packed;
mod pool;
mod scope;
mod table;

pub use absolute::mean_absolute_difference;
pub use attention::{
    causal_attention, causal_self_attention, cross_attention, cross_attention_padded,
};
pub use batch_norm::{Then, batch_norm};
pub use conv::conv2d;
pub use divergence::{weighted_divergence, weighted_entropy};
pub use edge_attention::edge_attention;
pub use gelu::gelu;
pub use gru::{gru, gru_of_gates};
pub use half_block::{Affine, Join, Scaling, Seen, attention_half, feed_forward};
pub use linear::{linear, reduced_linear};
pub use loss::{Targets, linear_cross_entropy, masked_cross_entropy};
pub use norm::layer_norm;
pub use pool::largest_of_nine;
pub use table::{embedding_sum, table_rows};

pub use deferred::Deferred;
pub use packed::PackedWeights;

use candle_core::{
    CpuStorage, DType, Layout, Result, Shape, Storage, StorageRef, Tensor, WithDType, bail,
};

/// Runs `f`; what it builds of these operations multiplies numbers rounded to bfloat16, forward and
/// backward, on a CPU. Sums stay f32.
pub fn in_bfloat16<R>(f: impl FnOnce() -> R) -> R {
    gump_kernels::Operands::Bf16.during(f)
}

/// Whether the fused path takes these tensors: f32 on a CPU, all of them.
fn fusible(tensors: &[&Tensor]) -> bool {
    tensors
        .iter()
        .all(|t| t.device().is_cpu() && t.dtype() == DType::F32)
}

/// The elements of a contiguous tensor inside a custom operation.
fn elements<'a>(storage: &'a CpuStorage, layout: &Layout) -> Result<&'a [f32]> {
    match layout.contiguous_offsets() {
        Some((start, end)) => Ok(&storage.as_slice::<f32>()?[start..end]),
        None => bail!("fused operations take contiguous tensors"),
    }
}

/// The elements of a contiguous CPU tensor, borrowed.
struct Host<'a> {
    storage: StorageRef<'a>,
    range: std::ops::Range<usize>,
}

impl<'a> Host<'a> {
    fn new(tensor: &'a Tensor) -> Result<Self> {
        let (storage, layout) = tensor.storage_and_layout();
        match layout.contiguous_offsets() {
            Some((start, end)) => Ok(Self {
                storage,
                range: start..end,
            }),
            None => bail!("fused operations take contiguous tensors"),
        }
    }

    fn slice<T: WithDType>(&self) -> Result<&[T]> {
        match &*self.storage {
            Storage::Cpu(storage) => Ok(&storage.as_slice::<T>()?[self.range.clone()]),
            _ => bail!("fused operations take CPU tensors"),
        }
    }
}

/// The sum of the squares of a tensor's elements.
pub fn sum_of_squares(tensor: &Tensor) -> Result<f64> {
    let tensor = tensor.contiguous()?;
    if fusible(&[&tensor]) {
        return Ok(gump_kernels::rows::squares(Host::new(&tensor)?.slice()?));
    }
    let sum = tensor.sqr()?.sum_all()?.to_dtype(DType::F32)?;
    Ok(f64::from(sum.to_scalar::<f32>()?))
}

/// Wraps computed elements as the output of a custom operation.
fn output(elements: Vec<f32>, shape: impl Into<Shape>) -> (CpuStorage, Shape) {
    (CpuStorage::F32(elements), shape.into())
}

/// Wraps computed elements as a gradient shaped like `like`.
fn gradient(elements: Vec<f32>, like: &Tensor) -> Result<Tensor> {
    Tensor::from_vec(elements, like.shape(), like.device())
}

#[cfg(test)]
mod testing {
    //! Helpers shared by the tests of the operations.

    use candle_core::{Device, Result, Tensor, Var};

    /// Values in about -1..1 that look random and are the same everywhere.
    pub(super) fn values(n: usize, salt: u32) -> Vec<f32> {
        let mut state = salt.wrapping_mul(2_654_435_761).wrapping_add(12345);
        (0..n)
            .map(|_| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 8) as f32 / (1 << 23) as f32 - 1.0
            })
            .collect()
    }

    pub(super) fn var(shape: &[usize], salt: u32) -> Var {
        let n = shape.iter().product();
        Var::from_vec(values(n, salt), shape, &Device::Cpu).unwrap()
    }

    pub(super) fn flat(t: &Tensor) -> Vec<f32> {
        t.flatten_all().unwrap().to_vec1::<f32>().unwrap()
    }

    pub(super) fn assert_close(what: &str, a: &Tensor, b: &Tensor, tolerance: f32) {
        assert_eq!(a.dims(), b.dims(), "{what}: shape");
        let (a, b) = (flat(a), flat(b));
        let scale = b.iter().fold(1e-2f32, |m, v| m.max(v.abs()));
        for (i, (x, y)) in a.iter().zip(&b).enumerate() {
            assert!(
                (x - y).abs() <= tolerance * scale,
                "{what}[{i}]: {x} against {y}, scale {scale}"
            );
        }
    }

    /// A scalar whose gradient reaches every element of `y` with a different weight.
    fn probe(y: &Tensor) -> Tensor {
        let w = Tensor::from_vec(values(y.elem_count(), 99), y.shape(), &Device::Cpu).unwrap();
        (y * w).unwrap().sum_all().unwrap()
    }

    /// Compares a fused operation with its oracle: value and all gradients, then the fused bits
    /// under one and two threads.
    pub(super) fn check(
        vars: &[&Var],
        fused: impl Fn() -> Result<Tensor> + Sync,
        oracle: impl Fn() -> Result<Tensor>,
    ) {
        let run = |f: &dyn Fn() -> Result<Tensor>| {
            let y = f().unwrap();
            let grads = probe(&y).backward().unwrap();
            let grads: Vec<Tensor> = vars
                .iter()
                .map(|v| grads.get(v.as_tensor()).unwrap().clone())
                .collect();
            (y, grads)
        };
        let (y, grads) = run(&fused);
        let (y_oracle, grads_oracle) = run(&oracle);
        assert_close("value", &y, &y_oracle, 1e-5);
        for (i, (g, o)) in grads.iter().zip(&grads_oracle).enumerate() {
            assert_close(&format!("gradient {i}"), g, o, 1e-4);
        }
        for threads in [1, 2] {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap();
            let bits = |t: &Tensor| flat(t).iter().map(|v| v.to_bits()).collect::<Vec<_>>();
            pool.install(|| {
                let y2 = fused().unwrap();
                let grads2 = probe(&y2).backward().unwrap();
                assert_eq!(bits(&y), bits(&y2), "value with {threads} threads");
                for (v, g) in vars.iter().zip(&grads) {
                    let g2 = grads2.get(v.as_tensor()).unwrap();
                    assert_eq!(bits(g), bits(g2), "gradient with {threads} threads");
                }
            });
        }
    }
}
