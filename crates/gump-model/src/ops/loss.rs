//! Cross-entropy over token logits.
//!
//! What lives here: the masked, optionally smoothed loss. What does not: which positions count and
//! how much, which training decides through the weights.

use std::sync::OnceLock;

use candle_core::{CpuStorage, CustomOp1, D, DType, Device, Layout, Result, Shape, Tensor, bail};

use super::gemm::wide;
use super::rows::{exp, for_pieces, for_pieces2, max, rows_per_task, sum_exp_shifted};
use super::{Host, elements, fusible, gradient, output};

/// Spreads a target over its neighbours on an ordered scale of bins, as a discrete normal
/// distribution cut at four deviations and scaled to sum 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OrdinalSmoothing {
    /// Standard deviation in bins, above 0.
    pub sigma_bins: f32,
    /// Whether the last bin neighbours the first, as for headings.
    pub circular: bool,
}

impl OrdinalSmoothing {
    /// Farthest bin that gets probability.
    fn radius(&self) -> usize {
        (4.0 * self.sigma_bins).ceil() as usize
    }

    fn weight(&self, distance: usize) -> f32 {
        let z = distance as f32 / self.sigma_bins;
        (-0.5 * z * z).exp()
    }

    /// Bins and probabilities of target `t` among `v` bins.
    fn spread(&self, t: usize, v: usize, bins: &mut Vec<(usize, f32)>) {
        let radius = self.radius();
        bins.clear();
        if self.circular {
            for step in 0..v {
                let distance = step.min(v - step);
                if distance <= radius {
                    bins.push(((t + step) % v, self.weight(distance)));
                }
            }
        } else {
            for bin in t.saturating_sub(radius)..(t + radius + 1).min(v) {
                bins.push((bin, self.weight(bin.abs_diff(t))));
            }
        }
        let total: f32 = bins.iter().map(|b| b.1).sum();
        for b in bins {
            b.1 /= total;
        }
    }
}

/// Weighted mean over rows of the cross-entropy between a target distribution and
/// `softmax(logits)`: `sum_i w_i CE_i / max(sum_i w_i, 1e-9)`.
///
/// The target is one class, or with `smoothing` a distribution around it. A row of weight 0 adds
/// exactly nothing to value and gradient, whatever its logits (even NaN) and target hold. The
/// gradient reaches `logits` only.
///
/// Shape: `logits` `[N, V]`, `targets` `[N]` u32, `weights` `[N]` f32; the result is a scalar, f32.
///
/// Error: when the shapes do not fit, a deviation is not above 0, or (on a CPU) a target of
/// non-zero weight is not below `V`.
pub fn masked_cross_entropy(
    logits: &Tensor,
    targets: &Tensor,
    weights: &Tensor,
    smoothing: Option<OrdinalSmoothing>,
) -> Result<Tensor> {
    let (n, v) = logits.dims2()?;
    if targets.dims() != [n] || weights.dims() != [n] || v == 0 {
        bail!(
            "masked_cross_entropy: logits {:?}, targets {:?}, weights {:?}",
            logits.shape(),
            targets.shape(),
            weights.shape()
        );
    }
    if smoothing.is_some_and(|s| !(s.sigma_bins > 0.0 && s.sigma_bins.is_finite())) {
        bail!("masked_cross_entropy: {smoothing:?}");
    }
    if !fusible(&[logits, weights]) {
        return composed(logits, targets, weights, smoothing);
    }
    let targets = targets.to_device(&Device::Cpu)?.to_vec1::<u32>()?;
    let weights = weights.to_vec1::<f32>()?;
    for (i, (&t, &w)) in targets.iter().zip(&weights).enumerate() {
        if w != 0.0 && t as usize >= v {
            bail!("masked_cross_entropy: target {t} of row {i} is not below {v}");
        }
    }
    let total = weights.iter().map(|&w| f64::from(w)).sum::<f64>();
    let op = CrossEntropy {
        targets,
        scale: 1.0 / total.max(1e-9),
        weights,
        smoothing,
        log_sums: OnceLock::new(),
    };
    logits.contiguous()?.apply_op1(op)
}

fn composed(
    logits: &Tensor,
    targets: &Tensor,
    weights: &Tensor,
    smoothing: Option<OrdinalSmoothing>,
) -> Result<Tensor> {
    let (n, v) = logits.dims2()?;
    let logits = logits.to_dtype(DType::F32)?;
    let weights = weights.to_dtype(DType::F32)?.detach();
    let counted = weights.ne(0.0)?; // [N]
    let targets = counted.where_cond(targets, &targets.zeros_like()?)?;
    let mask = counted.unsqueeze(1)?.broadcast_as((n, v))?.contiguous()?;
    let logits = mask.where_cond(&logits, &logits.zeros_like()?)?;
    let log_p = candle_nn::ops::log_softmax(&logits, D::Minus1)?; // [N, V]
    let log_likelihood = match smoothing {
        None => log_p.gather(&targets.unsqueeze(1)?, 1)?.squeeze(1)?,
        Some(s) => {
            let bins = Tensor::arange(0u32, v as u32, logits.device())?.to_dtype(DType::F32)?;
            let targets = targets.to_dtype(DType::F32)?.unsqueeze(1)?; // [N, 1]
            let mut distance = bins.unsqueeze(0)?.broadcast_sub(&targets)?.abs()?; // [N, V]
            if s.circular {
                distance = distance.minimum(&distance.affine(-1.0, v as f64)?)?;
            }
            let deviation = f64::from(s.sigma_bins);
            let bell = (distance.sqr()? * (-0.5 / (deviation * deviation)))?.exp()?;
            let near = distance.le(s.radius() as f64)?.to_dtype(DType::F32)?;
            let spread = (bell * near)?;
            let spread = spread.broadcast_div(&spread.sum_keepdim(1)?)?;
            (log_p * spread)?.sum(1)?
        }
    };
    let total = weights.sum_all()?.maximum(1e-9)?;
    (log_likelihood * weights)?.sum_all()?.neg()?.div(&total)
}

struct CrossEntropy {
    targets: Vec<u32>,
    weights: Vec<f32>,
    /// One over the sum of the weights.
    scale: f64,
    smoothing: Option<OrdinalSmoothing>,
    /// Logarithm of the softmax sum of each row, kept for the gradient.
    log_sums: OnceLock<Vec<f32>>,
}

impl CrossEntropy {
    fn target_bins(&self, row: usize, v: usize, bins: &mut Vec<(usize, f32)>) {
        let target = self.targets[row] as usize;
        match self.smoothing {
            Some(s) => s.spread(target, v, bins),
            None => {
                bins.clear();
                bins.push((target, 1.0));
            }
        }
    }
}

impl CustomOp1 for CrossEntropy {
    fn name(&self) -> &'static str {
        "masked-cross-entropy"
    }

    fn cpu_fwd(&self, logits: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let logits = elements(logits, layout)?;
        let (n, v) = layout.shape().dims2()?;
        let step = rows_per_task(v);
        let mut losses = vec![0.0; n];
        let mut log_sums = vec![0.0; n];
        for_pieces2(
            (&mut losses, step),
            (&mut log_sums, step),
            |i, losses, log_sums| {
                let mut bins = Vec::new();
                for (j, (loss, log_sum)) in losses.iter_mut().zip(log_sums).enumerate() {
                    let row = i * step + j;
                    if self.weights[row] == 0.0 {
                        continue;
                    }
                    let logits = &logits[row * v..(row + 1) * v];
                    *log_sum = wide(
                        #[inline(always)]
                        || {
                            let peak = max(logits);
                            peak + sum_exp_shifted(logits, peak).ln()
                        },
                    );
                    self.target_bins(row, v, &mut bins);
                    let hit: f32 = bins
                        .iter()
                        .map(|&(bin, p)| p * (*log_sum - logits[bin]))
                        .sum();
                    *loss = self.weights[row] * hit;
                }
            },
        );
        let total = losses.iter().map(|&l| f64::from(l)).sum::<f64>() * self.scale;
        let _ = self.log_sums.set(log_sums);
        Ok(output(vec![total as f32], ()))
    }

    fn bwd(&self, logits: &Tensor, _loss: &Tensor, grad: &Tensor) -> Result<Option<Tensor>> {
        let scale = grad.to_scalar::<f32>()? * self.scale as f32;
        let (_, v) = logits.dims2()?;
        let host = Host::new(logits)?;
        let all = host.slice::<f32>()?;
        let log_sums = self.log_sums.get().expect("forward ran before backward");
        let step = rows_per_task(v);
        let mut d = vec![0.0; all.len()];
        for_pieces(&mut d, step * v, |i, d| {
            let mut bins = Vec::new();
            for (j, d) in d.chunks_exact_mut(v).enumerate() {
                let row = i * step + j;
                if self.weights[row] == 0.0 {
                    continue;
                }
                let factor = self.weights[row] * scale;
                let (logits, log_sum) = (&all[row * v..(row + 1) * v], log_sums[row]);
                wide(
                    #[inline(always)]
                    || {
                        for (d, logit) in d.iter_mut().zip(logits) {
                            *d = factor * exp(logit - log_sum);
                        }
                    },
                );
                self.target_bins(row, v, &mut bins);
                for &(bin, p) in &bins {
                    d[bin] -= factor * p;
                }
            }
        });
        Ok(Some(gradient(d, logits)?))
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{check, flat, var};
    use super::*;
    use candle_core::Var;

    const HEADING: OrdinalSmoothing = OrdinalSmoothing {
        sigma_bins: 0.8,
        circular: true,
    };
    const SPEED: OrdinalSmoothing = OrdinalSmoothing {
        sigma_bins: 1.5,
        circular: false,
    };

    fn rows(n: usize, v: usize) -> (Tensor, Tensor) {
        let targets: Vec<u32> = (0..n).map(|i| (i * 7 % v) as u32).collect();
        let weights: Vec<f32> = (0..n).map(|i| [1.0, 0.0, 0.5][i % 3]).collect();
        (
            Tensor::from_vec(targets, n, &Device::Cpu).unwrap(),
            Tensor::from_vec(weights, n, &Device::Cpu).unwrap(),
        )
    }

    #[test]
    fn agrees_with_the_composition() {
        for (n, v) in [(1, 1), (1, 5), (40, 7), (33, 1501)] {
            let logits = var(&[n, v], 5);
            let (targets, weights) = rows(n, v);
            let sharp = || logits.affine(8.0, -3.0);
            for smoothing in [None, Some(HEADING), Some(SPEED)] {
                check(
                    &[&logits],
                    || masked_cross_entropy(&sharp()?, &targets, &weights, smoothing),
                    || composed(&sharp()?, &targets, &weights, smoothing),
                );
            }
        }
    }

    #[test]
    fn a_row_of_weight_zero_adds_nothing() {
        let values = [1.0, 2.0, f32::NAN, f32::INFINITY, 0.0, 1.0];
        let logits = Var::from_slice(&values, (3, 2), &Device::Cpu).unwrap();
        let targets = Tensor::new(&[0u32, u32::MAX, 1], &Device::Cpu).unwrap();
        let weights = Tensor::new(&[1.0f32, 0.0, 1.0], &Device::Cpu).unwrap();
        for loss in [masked_cross_entropy, composed] {
            let loss = loss(&logits, &targets, &weights, None).unwrap();
            let grads = loss.backward().unwrap();
            let grad = flat(grads.get(logits.as_tensor()).unwrap());
            let expected = (1f32.exp().ln_1p() + (-1f32).exp().ln_1p()) / 2.0;
            assert!((loss.to_scalar::<f32>().unwrap() - expected).abs() < 1e-6);
            assert_eq!(grad[2..4], [0.0, 0.0]);
            assert!(grad.iter().all(|g| g.is_finite()));
        }
    }

    #[test]
    fn no_counted_row_is_zero() {
        let logits = var(&[2, 3], 1);
        let targets = Tensor::new(&[0u32, 1], &Device::Cpu).unwrap();
        let weights = Tensor::new(&[0.0f32, 0.0], &Device::Cpu).unwrap();
        let loss = masked_cross_entropy(&logits, &targets, &weights, None).unwrap();
        assert_eq!(loss.to_scalar::<f32>().unwrap(), 0.0);
        let grads = loss.backward().unwrap();
        assert_eq!(flat(grads.get(logits.as_tensor()).unwrap()), [0.0; 6]);
    }

    #[test]
    fn a_target_out_of_range_is_an_error() {
        let logits = var(&[1, 3], 1);
        let targets = Tensor::new(&[3u32], &Device::Cpu).unwrap();
        let weights = Tensor::new(&[1.0f32], &Device::Cpu).unwrap();
        assert!(masked_cross_entropy(&logits, &targets, &weights, None).is_err());
    }

    #[test]
    fn a_circle_smaller_than_the_spread_counts_each_bin_once() {
        let mut bins = Vec::new();
        OrdinalSmoothing {
            sigma_bins: 3.0,
            circular: true,
        }
        .spread(4, 5, &mut bins);
        let mut seen: Vec<usize> = bins.iter().map(|b| b.0).collect();
        seen.sort_unstable();
        assert_eq!(seen, [0, 1, 2, 3, 4]);
        assert!((bins.iter().map(|b| b.1).sum::<f32>() - 1.0).abs() < 1e-6);
    }
}
