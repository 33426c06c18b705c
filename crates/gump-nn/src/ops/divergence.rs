//! How far two distributions over tokens are apart, and how wide one is.
//!
//! What lives here: the Kullback-Leibler divergence of logits from other logits, with its gradient,
//! and the entropy, without one. What does not: which positions count and how much, which training
//! decides through the weights.

use std::sync::OnceLock;

use candle_core::{CpuStorage, CustomOp1, D, DType, Layout, Result, Shape, Tensor, bail};

use super::{Host, elements, fusible, gradient, output};
use gump_kernels::rows::{dot, exp, for_pieces, for_pieces2, max, rows_per_task, sum_exp_shifted};
use gump_kernels::wide;

/// Sum over rows of `w_i KL(softmax(logits_i) || softmax(reference_i))`, nats.
///
/// A row of weight 0 adds exactly nothing to value and gradient, whatever it holds; one that equals
/// its reference adds exactly nothing either. The gradient reaches `logits` only.
///
/// Shape: `logits` and `reference` `[N, V]`, a weight per row; the result is a scalar, f32.
///
/// Error: when the shapes do not fit.
pub fn weighted_divergence(logits: &Tensor, reference: &Tensor, weights: &[f32]) -> Result<Tensor> {
    let (n, v) = logits.dims2()?;
    if reference.dims() != [n, v] || weights.len() != n || v == 0 {
        let (shape, other) = (logits.shape(), reference.shape());
        bail!(
            "divergence: logits {shape:?}, reference {other:?}, {} weights",
            weights.len()
        );
    }
    if !fusible(&[logits, reference]) {
        return composed(logits, reference, weights);
    }
    let op = Divergence {
        reference: reference.flatten_all()?.to_vec1::<f32>()?,
        weights: weights.to_vec(),
        slopes: OnceLock::new(),
    };
    logits.contiguous()?.apply_op1(op)
}

/// Sum over rows of `w_i` times the entropy of `softmax(logits_i)`, nats; for reports, nothing is
/// differentiated.
///
/// A row of weight 0 adds nothing, whatever it holds.
///
/// Shape: `logits` `[N, V]`, a weight per row.
///
/// Error: when the shapes do not fit.
pub fn weighted_entropy(logits: &Tensor, weights: &[f32]) -> Result<f64> {
    let (n, v) = logits.dims2()?;
    if weights.len() != n || v == 0 {
        let shape = logits.shape();
        bail!("entropy: logits {shape:?}, {} weights", weights.len());
    }
    let logits = logits.detach();
    if !fusible(&[&logits]) {
        return composed_entropy(&logits, weights);
    }
    let logits = logits.contiguous()?;
    let host = Host::new(&logits)?;
    let all = host.slice::<f32>()?;
    let step = rows_per_task(v);
    let mut sums = vec![0.0; n];
    for_pieces(&mut sums, step, |i, sums| {
        let mut shares = vec![0.0; v];
        for (j, sum) in sums.iter_mut().enumerate() {
            let row = i * step + j;
            if weights[row] != 0.0 {
                *sum = weights[row] * entropy(&all[row * v..(row + 1) * v], &mut shares);
            }
        }
    });
    Ok(sums.iter().map(|&sum| f64::from(sum)).sum())
}

/// Logarithm of the softmax sum of a row.
#[inline(always)]
fn log_sum(logits: &[f32]) -> f32 {
    let peak = max(logits);
    peak + sum_exp_shifted(logits, peak).ln()
}

/// Entropy of a row; `shares` is scratch.
fn entropy(logits: &[f32], shares: &mut [f32]) -> f32 {
    wide(
        #[inline(always)]
        || {
            let log_sum = log_sum(logits);
            for (share, logit) in shares.iter_mut().zip(logits) {
                *share = exp(logit - log_sum);
            }
            log_sum - dot(shares, logits)
        },
    )
}

/// Divergence of a row from its reference; leaves `weight` times its gradient in `slopes`. `gaps` is
/// scratch.
fn divergence(
    logits: &[f32],
    reference: &[f32],
    weight: f32,
    slopes: &mut [f32],
    gaps: &mut [f32],
) -> f32 {
    wide(
        #[inline(always)]
        || {
            let own_sum = log_sum(logits);
            let shift = own_sum - log_sum(reference);
            let pairs = logits.iter().zip(reference);
            for ((slope, gap), (own, other)) in slopes.iter_mut().zip(&mut *gaps).zip(pairs) {
                *slope = exp(own - own_sum);
                *gap = (own - other) - shift;
            }
            let divergence = dot(slopes, gaps);
            for (slope, gap) in slopes.iter_mut().zip(&*gaps) {
                *slope *= weight * (gap - divergence);
            }
            divergence
        },
    )
}

struct Divergence {
    reference: Vec<f32>,
    weights: Vec<f32>,
    /// Gradient of the logits for a gradient of 1 of the sum.
    slopes: OnceLock<Vec<f32>>,
}

impl CustomOp1 for Divergence {
    fn name(&self) -> &'static str {
        "divergence"
    }

    fn cpu_fwd(&self, logits: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let logits = elements(logits, layout)?;
        let (n, v) = layout.shape().dims2()?;
        let step = rows_per_task(v);
        let mut slopes = vec![0.0; n * v];
        let mut sums = vec![0.0; n];
        for_pieces2(
            (&mut slopes, step * v),
            (&mut sums, step),
            |i, slopes, sums| {
                let mut gaps = vec![0.0; v];
                for (j, (slopes, sum)) in slopes.chunks_exact_mut(v).zip(sums).enumerate() {
                    let row = i * step + j;
                    let weight = self.weights[row];
                    if weight != 0.0 {
                        let at = row * v..(row + 1) * v;
                        let (own, other) = (&logits[at.clone()], &self.reference[at]);
                        *sum = weight * divergence(own, other, weight, slopes, &mut gaps);
                    }
                }
            },
        );
        let _ = self.slopes.set(slopes);
        let total: f64 = sums.iter().map(|&sum| f64::from(sum)).sum();
        Ok(output(vec![total as f32], ()))
    }

    fn bwd(&self, logits: &Tensor, _sum: &Tensor, grad: &Tensor) -> Result<Option<Tensor>> {
        let factor = grad.to_scalar::<f32>()?;
        let slopes = self.slopes.get().expect("forward ran before backward");
        let slopes = slopes.iter().map(|slope| factor * slope).collect();
        Ok(Some(gradient(slopes, logits)?))
    }
}

/// The rows that count, and their weights `[M]`; `None` without any.
fn counted(logits: &Tensor, weights: &[f32]) -> Result<Option<(Tensor, Tensor)>> {
    let device = logits.device();
    let rows = weights.iter().enumerate();
    let (rows, weights): (Vec<u32>, Vec<f32>) = rows
        .filter(|(_, weight)| **weight != 0.0)
        .map(|(row, weight)| (row as u32, *weight))
        .unzip();
    if rows.is_empty() {
        return Ok(None);
    }
    Ok(Some((
        Tensor::new(rows, device)?,
        Tensor::new(weights, device)?,
    )))
}

fn log_softmax(logits: &Tensor, rows: &Tensor) -> Result<Tensor> {
    let logits = logits.index_select(rows, 0)?.to_dtype(DType::F32)?;
    let shifted = logits.broadcast_sub(&logits.max_keepdim(D::Minus1)?.detach())?;
    shifted.broadcast_sub(&shifted.exp()?.sum_keepdim(D::Minus1)?.log()?)
}

fn composed(logits: &Tensor, reference: &Tensor, weights: &[f32]) -> Result<Tensor> {
    let Some((rows, weights)) = counted(logits, weights)? else {
        return Tensor::zeros((), DType::F32, logits.device());
    };
    let own = log_softmax(logits, &rows)?;
    let gaps = (&own - log_softmax(&reference.detach(), &rows)?)?;
    ((own.exp()? * gaps)?.sum(1)? * weights)?.sum_all()
}

fn composed_entropy(logits: &Tensor, weights: &[f32]) -> Result<f64> {
    let Some((rows, weights)) = counted(logits, weights)? else {
        return Ok(0.0);
    };
    let own = log_softmax(logits, &rows)?;
    let sum = ((own.exp()? * own)?.sum(1)? * weights)?.sum_all()?;
    Ok(-f64::from(sum.to_scalar::<f32>()?))
}

#[cfg(test)]
mod tests {
    use candle_core::{Device, Var};

    use super::super::testing::{check, flat, var};
    use super::*;

    fn weights(n: usize) -> Vec<f32> {
        (0..n).map(|i| [1.0, 0.0, 0.5][i % 3]).collect()
    }

    #[test]
    fn agrees_with_the_composition() {
        for (n, v) in [(1, 1), (1, 5), (40, 7), (33, 1501)] {
            let (logits, reference) = (var(&[n, v], 5), var(&[n, v], 6));
            let sharp = || logits.affine(8.0, -3.0);
            check(
                &[&logits],
                || weighted_divergence(&sharp()?, &reference, &weights(n)),
                || composed(&sharp()?, &reference, &weights(n)),
            );
            let found = weighted_entropy(&sharp().unwrap(), &weights(n)).unwrap();
            let expected = composed_entropy(&sharp().unwrap(), &weights(n)).unwrap();
            let scale = expected.abs().max(1.0);
            assert!(
                (found - expected).abs() < 1e-5 * scale,
                "{found} {expected}"
            );
        }
    }

    #[test]
    fn two_coins_are_as_far_apart_as_the_formula_says() {
        let logits = |p: f32| Var::new(&[[p.ln(), (1.0 - p).ln()]], &Device::Cpu).unwrap();
        let (own, other) = (logits(0.8), logits(0.5));
        let found = weighted_divergence(&own, &other, &[2.0]).unwrap();
        let expected = 2.0 * (0.8 * 1.6f32.ln() + 0.2 * 0.4f32.ln());
        assert!((found.to_scalar::<f32>().unwrap() - expected).abs() < 1e-6);
        let entropy = weighted_entropy(&other, &[3.0]).unwrap();
        assert!((entropy - 3.0 * 2f64.ln()).abs() < 1e-6, "{entropy}");
    }

    #[test]
    fn equal_rows_and_rows_of_weight_zero_add_nothing() {
        let values = [0.3, 2.0, -7.0, f32::NAN, f32::INFINITY, 0.0];
        let logits = Var::from_slice(&values, (2, 3), &Device::Cpu).unwrap();
        let reference = logits.as_tensor().copy().unwrap().detach();
        for divergence in [weighted_divergence, composed] {
            let sum = divergence(&logits, &reference, &[1.0, 0.0]).unwrap();
            assert_eq!(sum.to_scalar::<f32>().unwrap(), 0.0);
            let grads = sum.backward().unwrap();
            let grad = flat(grads.get(logits.as_tensor()).unwrap());
            assert!(grad.iter().all(|g| g.abs() < 1e-6), "{grad:?}");
        }
        let sum = weighted_divergence(&logits, &reference, &[1.0, 0.0]).unwrap();
        let grads = sum.backward().unwrap();
        assert_eq!(flat(grads.get(logits.as_tensor()).unwrap()), [0.0; 6]);
        assert!(weighted_entropy(&logits, &[1.0, 0.0]).unwrap().is_finite());
        assert!(weighted_divergence(&logits, &reference, &[1.0]).is_err());
        assert!(weighted_entropy(&logits, &[1.0]).is_err());
    }
}
