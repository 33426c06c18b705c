//! Cross-entropy over token logits.
//!
//! What lives here: the masked, optionally smoothed loss, of logits and of what a matrix makes
//! into logits. What does not: which positions count and how much, which training decides through
//! the weights.

use std::ops::Range;
use std::sync::OnceLock;

use candle_core::{
    CpuStorage, CustomOp1, CustomOp2, D, DType, Device, Layout, Result, Shape, Tensor, bail,
};

use super::{Host, elements, fusible, gradient, linear, output};
use gump_kernels::Operands;
use gump_kernels::gemm::{Mat, MatMut, Right, Store, Threads, gemm};
use gump_kernels::rows::{exp, for_pieces, for_pieces2, max, rows_per_task, sum_exp_shifted};
use gump_kernels::smoothing::OrdinalSmoothing;
use gump_kernels::wide;

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
    if !fusible(&[logits, weights]) {
        return composed(logits, targets, weights, smoothing);
    }
    let targets = Targets {
        bins: targets.to_device(&Device::Cpu)?.to_vec1::<u32>()?,
        weights: weights.to_vec1::<f32>()?,
        smoothing,
        exact: Vec::new(),
    };
    targets.check(n, v)?;
    let op = CrossEntropy {
        scale: targets.scale(),
        targets,
        log_sums: OnceLock::new(),
    };
    logits.contiguous()?.apply_op1(op)
}

/// Target classes of rows of logits.
#[derive(Clone, Debug)]
pub struct Targets {
    /// The class of each row.
    pub bins: Vec<u32>,
    /// Weight of each row; one of weight 0 has no effect, whatever its class.
    pub weights: Vec<f32>,
    /// Distribution of each class over its neighbours; `None` for hard targets.
    pub smoothing: Option<OrdinalSmoothing>,
    /// Rows whose target is the class alone despite `smoothing`; none if it is empty.
    pub exact: Vec<bool>,
}

impl Targets {
    /// Error: unless there are `n` rows of classes below `v`, and a deviation above 0.
    fn check(&self, n: usize, v: usize) -> Result<()> {
        if self.bins.len() != n || self.weights.len() != n {
            let (bins, weights) = (self.bins.len(), self.weights.len());
            bail!("cross entropy of {n} rows: {bins} targets, {weights} weights");
        }
        if !self.exact.is_empty() && self.exact.len() != n {
            bail!(
                "cross entropy of {n} rows: {} marks of exact ones",
                self.exact.len()
            );
        }
        let is_wrong = |s: OrdinalSmoothing| !(s.sigma_bins > 0.0 && s.sigma_bins.is_finite());
        if self.smoothing.is_some_and(is_wrong) {
            bail!("cross entropy: {:?}", self.smoothing);
        }
        for (i, (&t, &w)) in self.bins.iter().zip(&self.weights).enumerate() {
            if w != 0.0 && t as usize >= v {
                bail!("cross entropy: target {t} of row {i} is not below {v}");
            }
        }
        Ok(())
    }

    /// One over the sum of the weights.
    fn scale(&self) -> f64 {
        let total = self.weights.iter().map(|&w| f64::from(w)).sum::<f64>();
        1.0 / total.max(1e-9)
    }

    fn is_exact(&self, row: usize) -> bool {
        self.exact.get(row).copied().unwrap_or(false)
    }

    fn spread(&self, row: usize, v: usize, bins: &mut Vec<(usize, f32)>) {
        let target = self.bins[row] as usize;
        match self.smoothing.filter(|_| !self.is_exact(row)) {
            Some(s) => s.spread(target, v, bins),
            None => {
                bins.clear();
                bins.push((target, 1.0));
            }
        }
    }

    /// The weighted loss of a row and the logarithm of its softmax sum; `bins` is scratch.
    #[inline(always)]
    fn loss(&self, row: usize, logits: &[f32], bins: &mut Vec<(usize, f32)>) -> (f32, f32) {
        let log_sum = wide(
            #[inline(always)]
            || {
                let peak = max(logits);
                peak + sum_exp_shifted(logits, peak).ln()
            },
        );
        self.spread(row, logits.len(), bins);
        let terms = bins.iter().map(|&(bin, p)| p * (log_sum - logits[bin]));
        (self.weights[row] * terms.sum::<f32>(), log_sum)
    }

    /// Takes the logits of a row, in `d`, to their gradient, `factor` times the weighted loss's.
    #[inline(always)]
    fn slope(
        &self,
        row: usize,
        d: &mut [f32],
        log_sum: f32,
        factor: f32,
        bins: &mut Vec<(usize, f32)>,
    ) {
        let factor = self.weights[row] * factor;
        wide(
            #[inline(always)]
            || {
                for d in d.iter_mut() {
                    *d = factor * exp(*d - log_sum);
                }
            },
        );
        self.spread(row, d.len(), bins);
        for &(bin, p) in &*bins {
            d[bin] -= factor * p;
        }
    }
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
    targets: Targets,
    /// One over the sum of the weights.
    scale: f64,
    /// Logarithm of the softmax sum of each row, kept for the gradient.
    log_sums: OnceLock<Vec<f32>>,
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
                    if self.targets.weights[row] != 0.0 {
                        let logits = &logits[row * v..(row + 1) * v];
                        (*loss, *log_sum) = self.targets.loss(row, logits, &mut bins);
                    }
                }
            },
        );
        let total = losses.iter().map(|&l| f64::from(l)).sum::<f64>() * self.scale;
        let _ = self.log_sums.set(log_sums);
        Ok(output(vec![total as f32], ()))
    }

    fn bwd(&self, logits: &Tensor, _loss: &Tensor, grad: &Tensor) -> Result<Option<Tensor>> {
        let factor = grad.to_scalar::<f32>()? * self.scale as f32;
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
                if self.targets.weights[row] != 0.0 {
                    d.copy_from_slice(&all[row * v..(row + 1) * v]);
                    self.targets.slope(row, d, log_sums[row], factor, &mut bins);
                }
            }
        });
        Ok(Some(gradient(d, logits)?))
    }
}

/// [`masked_cross_entropy`] of several steps at once, each over its own rows of one matrix: step `s`
/// has the logits `x[s] weight[rows]^T`. Logits are never held for all steps twice, and rows that
/// several steps share are not copied.
///
/// Shape: `x` `[S, N, C]`; `weight` `[R, C]`; `targets` holds per step its rows of the matrix and
/// the targets of the `N` rows; the result `[S]`, a mean per step.
///
/// Error: when the shapes do not fit, or as [`masked_cross_entropy`].
pub fn linear_cross_entropy(
    x: &Tensor,
    weight: &Tensor,
    targets: Vec<(Range<usize>, Targets)>,
) -> Result<Tensor> {
    let (steps, n, c) = x.dims3()?;
    let (n_rows, width) = weight.dims2()?;
    let is_inside = |rows: &Range<usize>| !rows.is_empty() && rows.end <= n_rows;
    if targets.len() != steps || width != c || !targets.iter().all(|(rows, _)| is_inside(rows)) {
        let rows: Vec<_> = targets.iter().map(|(rows, _)| rows).collect();
        let (x, weight) = (x.shape(), weight.shape());
        bail!("linear_cross_entropy: x {x:?}, weight {weight:?}, rows {rows:?}");
    }
    for (rows, targets) in &targets {
        targets.check(n, rows.len())?;
    }
    if !fusible(&[x, weight]) {
        return composed_steps(x, weight, &targets);
    }
    let op = LinearCrossEntropy {
        targets,
        learns: x.track_op() || weight.track_op(),
        operands: Operands::current(),
        slopes: OnceLock::new(),
    };
    x.contiguous()?.apply_op2(&weight.contiguous()?, op)
}

fn composed_steps(
    x: &Tensor,
    weight: &Tensor,
    targets: &[(Range<usize>, Targets)],
) -> Result<Tensor> {
    let step = |(step, (rows, targets)): (usize, &(Range<usize>, Targets))| {
        let rows = weight.narrow(0, rows.start, rows.len())?;
        let logits = linear(&x.get(step)?, &rows, None)?;
        let bins = Tensor::from_slice(&targets.bins, targets.bins.len(), x.device())?;
        // The mean over all rows from those of the exact ones and of the others.
        let part = |exact: bool, smoothing| {
            let of_part = |row: usize| targets.is_exact(row) == exact;
            let kept = targets.weights.iter().enumerate();
            let weights: Vec<f32> = kept
                .map(|(i, w)| if of_part(i) { *w } else { 0.0 })
                .collect();
            let sum: f64 = weights.iter().map(|w| f64::from(*w)).sum();
            let weights = Tensor::new(weights, x.device())?;
            masked_cross_entropy(&logits, &bins, &weights, smoothing)? * (sum * targets.scale())
        };
        part(false, targets.smoothing)? + part(true, None)?
    };
    let losses = targets.iter().enumerate().map(step);
    Tensor::stack(&losses.collect::<Result<Vec<_>>>()?, 0)
}

/// The right matrix of some rows, which several steps share; `mat` if none had them yet.
fn packed_once<'a, 'b>(
    packed: &'b mut Vec<(Range<usize>, Right<'a>)>,
    rows: &Range<usize>,
    mat: Mat<'a>,
    operands: Operands,
) -> &'b Right<'a> {
    let known = packed.iter().position(|(known, _)| known == rows);
    let at = known.unwrap_or(packed.len());
    if known.is_none() {
        packed.push((rows.clone(), Right::new(mat, operands)));
    }
    &packed[at].1
}

struct LinearCrossEntropy {
    targets: Vec<(Range<usize>, Targets)>,
    /// Whether gradients are needed.
    learns: bool,
    operands: Operands,
    /// Gradients of the logits per step, `[N, V]`, as they are for a gradient of 1 of the loss.
    slopes: OnceLock<Vec<Vec<f32>>>,
}

impl CustomOp2 for LinearCrossEntropy {
    fn name(&self) -> &'static str {
        "linear-cross-entropy"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        weight: &CpuStorage,
        weight_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (x, weight) = (elements(x, x_layout)?, elements(weight, weight_layout)?);
        let (_, n, c) = x_layout.shape().dims3()?;
        let mut means = Vec::new();
        let mut slopes = Vec::new();
        let mut packed = Vec::new();
        for (step, (rows, targets)) in self.targets.iter().enumerate() {
            let v = rows.len();
            let mut logits = vec![0.0; n * v];
            let turned = Mat::new(&weight[rows.start * c..rows.end * c], v, c).t();
            packed_once(&mut packed, rows, turned, self.operands).product(
                MatMut::new(&mut logits, n, v),
                Store::Replace,
                1.0,
                Mat::new(&x[step * n * c..(step + 1) * n * c], n, c),
                Threads::Pool,
            );
            let scale = targets.scale();
            let mut losses = vec![0.0; n];
            let piece = rows_per_task(v);
            for_pieces2(
                (&mut logits, piece * v),
                (&mut losses, piece),
                |i, logits, losses| {
                    let mut bins = Vec::new();
                    let rows = logits.chunks_exact_mut(v).zip(losses);
                    for (j, (logits, loss)) in rows.enumerate() {
                        let row = i * piece + j;
                        if targets.weights[row] == 0.0 {
                            logits.fill(0.0);
                            continue;
                        }
                        let log_sum;
                        (*loss, log_sum) = targets.loss(row, logits, &mut bins);
                        if self.learns {
                            targets.slope(row, logits, log_sum, scale as f32, &mut bins);
                        }
                    }
                },
            );
            let sum = losses.iter().map(|&l| f64::from(l)).sum::<f64>();
            means.push((sum * scale) as f32);
            slopes.push(logits);
        }
        if self.learns {
            let _ = self.slopes.set(slopes);
        }
        let steps = means.len();
        Ok(output(means, steps))
    }

    fn bwd(
        &self,
        x: &Tensor,
        weight: &Tensor,
        _means: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let grad = grad.to_vec1::<f32>()?;
        let (_, n, c) = x.dims3()?;
        let hosts = [Host::new(x)?, Host::new(weight)?];
        let (x_all, w) = (hosts[0].slice::<f32>()?, hosts[1].slice::<f32>()?);
        let slopes = self.slopes.get().expect("forward ran before backward");
        let mut dx = vec![0.0; x_all.len()];
        let mut dw = vec![0.0; w.len()];
        let mut packed = Vec::new();
        for (step, ((rows, _), slope)) in self.targets.iter().zip(slopes).enumerate() {
            let v = rows.len();
            let (at, of_rows) = (step * n * c, rows.start * c..rows.end * c);
            let slope = Mat::new(slope, n, v);
            let straight = Mat::new(&w[of_rows.clone()], v, c);
            packed_once(&mut packed, rows, straight, self.operands).product(
                MatMut::new(&mut dx[at..at + n * c], n, c),
                Store::Replace,
                grad[step],
                slope,
                Threads::Pool,
            );
            gemm(
                MatMut::new(&mut dw[of_rows], v, c),
                Store::Add,
                grad[step],
                slope.t(),
                Mat::new(&x_all[at..at + n * c], n, c),
                Threads::Pool,
                self.operands,
            );
        }
        Ok((Some(gradient(dx, x)?), Some(gradient(dw, weight)?)))
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
    fn steps_over_one_matrix_agree_with_the_composition() {
        let (x, weight) = (var(&[3, 33, 12], 5), var(&[40, 12], 6));
        let target = |of: Range<usize>, smoothing| {
            let (bins, weights) = rows(33, of.len());
            let targets = Targets {
                bins: bins.to_vec1().unwrap(),
                weights: weights.to_vec1().unwrap(),
                smoothing,
                // Every third is exact.
                exact: (0..33).map(|row| row % 3 == 0).collect(),
            };
            (of, targets)
        };
        let targets = vec![
            target(0..13, Some(SPEED)),
            target(13..40, Some(HEADING)),
            target(0..13, None),
        ];
        let sharp = || x.affine(8.0, -3.0);
        check(
            &[&x, &weight],
            || linear_cross_entropy(&sharp()?, &weight, targets.clone()),
            || composed_steps(&sharp()?, &weight, &targets),
        );
        let short = targets[..2].to_vec();
        assert!(linear_cross_entropy(&x, &weight, short).is_err());
        let mut outside = targets;
        outside[1].0 = 20..41;
        assert!(linear_cross_entropy(&x, &weight, outside).is_err());
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
