//! Normalisation of channels over a batch of images.
//!
//! What lives here: the training pass, by the statistics of the batch itself. What does not: the
//! running statistics and the pass that uses them, which are the network's.

use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor, bail};

use super::{Host, elements, fusible, gradient, output};
use gump_kernels::rows::{dot_from, for_pieces, sum, sum_squares_from};
use gump_kernels::wide;

/// Added to variances, as PyTorch does.
const EPS: f32 = 1e-5;

/// `(x - mean) / sqrt(variance + 1e-5) * weight + bias` with the mean and variance of each channel
/// over the batch, and these two, which no gradient reaches.
///
/// Shape: `x` `[S, C, H, W]`; `weight` and `bias` `[C]`; the result like `x`, mean and variance
/// `[C]`; the variance is that of the batch (divided by `S H W`).
///
/// Error: when the shapes do not fit.
pub fn batch_norm(x: &Tensor, weight: &Tensor, bias: &Tensor) -> Result<(Tensor, [Tensor; 2])> {
    let (_, channels, _, _) = x.dims4()?;
    if weight.dims() != [channels] || bias.dims() != [channels] {
        let (x, weight, bias) = (x.shape(), weight.shape(), bias.shape());
        bail!("batch_norm: x {x:?}, weight {weight:?}, bias {bias:?}");
    }
    if !fusible(&[x, weight, bias]) {
        return composed(x, weight, bias);
    }
    let x = x.contiguous()?;
    let (mean, variance) = statistics(&x)?;
    let tensors = [&mean, &variance].map(|of| Tensor::from_slice(of, channels, x.device()));
    let [mean_tensor, variance_tensor] = tensors;
    let deviation = |v: &f32| 1.0 / (v + EPS).sqrt();
    let op = BatchNorm {
        inverse: variance.iter().map(deviation).collect(),
        mean,
    };
    let y = x.apply_op3(&weight.contiguous()?, &bias.contiguous()?, op)?;
    Ok((y, [mean_tensor?, variance_tensor?]))
}

fn composed(x: &Tensor, weight: &Tensor, bias: &Tensor) -> Result<(Tensor, [Tensor; 2])> {
    let channels = x.dim(1)?;
    let spread = |t: &Tensor| t.reshape((1, channels, 1, 1));
    let mean = x.mean_keepdim((0, 2, 3))?; // [1, C, 1, 1]
    let variance = x.broadcast_sub(&mean)?.sqr()?.mean_keepdim((0, 2, 3))?;
    let deviation = (&variance + f64::from(EPS))?.sqrt()?;
    let y = x.broadcast_sub(&mean)?.broadcast_div(&deviation)?;
    let y = y
        .broadcast_mul(&spread(weight)?)?
        .broadcast_add(&spread(bias)?)?;
    let flat = |t: &Tensor| t.detach().flatten_all();
    Ok((y, [flat(&mean)?, flat(&variance)?]))
}

/// Mean and variance per channel.
fn statistics(x: &Tensor) -> Result<(Vec<f32>, Vec<f32>)> {
    let (s, channels, h, w) = x.dims4()?;
    let host = Host::new(x)?;
    let all = host.slice::<f32>()?;
    let (pixels, n) = (h * w, (s * h * w).max(1) as f64);
    let mean = per_channel(s, channels, &|_, plane| sum(at(all, plane, pixels)));
    let mean: Vec<f32> = mean.into_iter().map(|sum| (sum / n) as f32).collect();
    let squares = per_channel(s, channels, &|channel, plane| {
        sum_squares_from(at(all, plane, pixels), mean[channel])
    });
    let variance = squares.into_iter().map(|sum| (sum / n) as f32).collect();
    Ok((mean, variance))
}

/// The pixels of image and channel `plane`.
#[inline(always)]
fn at(all: &[f32], plane: usize, pixels: usize) -> &[f32] {
    &all[plane * pixels..(plane + 1) * pixels]
}

/// Sums `f` of channel and plane over the images, by channel.
fn per_channel(s: usize, channels: usize, f: &(impl Fn(usize, usize) -> f32 + Sync)) -> Vec<f64> {
    let mut parts = vec![0.0; s * channels];
    for_pieces(&mut parts, 1, |plane, part| {
        part[0] = wide(
            #[inline(always)]
            || f(plane % channels, plane),
        );
    });
    let of_channel = |channel| parts.iter().skip(channel).step_by(channels);
    (0..channels)
        .map(|channel| of_channel(channel).map(|&part| f64::from(part)).sum())
        .collect()
}

struct BatchNorm {
    mean: Vec<f32>,
    /// One over the standard deviation.
    inverse: Vec<f32>,
}

impl CustomOp3 for BatchNorm {
    fn name(&self) -> &'static str {
        "batch-norm"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        weight: &CpuStorage,
        weight_layout: &Layout,
        bias: &CpuStorage,
        bias_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let x = elements(x, x_layout)?;
        let (weight, bias) = (
            elements(weight, weight_layout)?,
            elements(bias, bias_layout)?,
        );
        let (_, channels, h, w) = x_layout.shape().dims4()?;
        let pixels = (h * w).max(1);
        let mut y = vec![0.0; x.len()];
        for_pieces(&mut y, pixels, |plane, y| {
            let channel = plane % channels;
            let factor = self.inverse[channel] * weight[channel];
            let (mean, bias) = (self.mean[channel], bias[channel]);
            let x = at(x, plane, pixels);
            wide(
                #[inline(always)]
                || {
                    for (y, x) in y.iter_mut().zip(x) {
                        *y = (x - mean) * factor + bias;
                    }
                },
            );
        });
        Ok(output(y, x_layout.shape()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        weight: &Tensor,
        bias: &Tensor,
        _y: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let dy = dy.contiguous()?;
        let (s, channels, h, w) = x.dims4()?;
        let hosts = [Host::new(x)?, Host::new(weight)?, Host::new(&dy)?];
        let (x_all, w_all) = (hosts[0].slice::<f32>()?, hosts[1].slice::<f32>()?);
        let dy_all = hosts[2].slice::<f32>()?;
        let pixels = (h * w).max(1);
        let n = (s * h * w).max(1) as f64;
        let d_bias = per_channel(s, channels, &|_, plane| sum(at(dy_all, plane, pixels)));
        let d_weight = per_channel(s, channels, &|channel, plane| {
            let (x, dy) = (at(x_all, plane, pixels), at(dy_all, plane, pixels));
            self.inverse[channel] * dot_from(x, self.mean[channel], dy)
        });
        let mut dx = vec![0.0; x_all.len()];
        for_pieces(&mut dx, pixels, |plane, dx| {
            let channel = plane % channels;
            let (mean, inverse) = (self.mean[channel], self.inverse[channel]);
            let factor = inverse * w_all[channel];
            let level = (d_bias[channel] / n) as f32;
            let slope = inverse * (d_weight[channel] / n) as f32;
            let (x, dy) = (at(x_all, plane, pixels), at(dy_all, plane, pixels));
            wide(
                #[inline(always)]
                || {
                    for ((dx, x), dy) in dx.iter_mut().zip(x).zip(dy) {
                        *dx = factor * (dy - level - (x - mean) * slope);
                    }
                },
            );
        });
        let narrowed = |of: Vec<f64>| of.into_iter().map(|v| v as f32).collect();
        Ok((
            Some(gradient(dx, x)?),
            Some(gradient(narrowed(d_weight), weight)?),
            Some(gradient(narrowed(d_bias), bias)?),
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{assert_close, check, var};
    use super::*;

    #[test]
    fn agrees_with_the_composition() {
        for shape in [[1, 1, 1, 2], [3, 5, 7, 9], [2, 17, 40, 31]] {
            let (x, weight, bias) = (var(&shape, 1), var(&[shape[1]], 2), var(&[shape[1]], 3));
            let shifted = || x.affine(3.0, 1.5);
            check(
                &[&x, &weight, &bias],
                || Ok(batch_norm(&shifted()?, &weight, &bias)?.0),
                || Ok(composed(&shifted()?, &weight, &bias)?.0),
            );
            let fused = batch_norm(&shifted().unwrap(), &weight, &bias).unwrap().1;
            let oracle = composed(&shifted().unwrap(), &weight, &bias).unwrap().1;
            for (fused, oracle) in fused.iter().zip(&oracle) {
                assert_close("statistics", fused, oracle, 1e-5);
            }
        }
    }

    #[test]
    fn shapes_that_do_not_fit_are_errors() {
        let (x, weight) = (var(&[1, 3, 2, 2], 1), var(&[2], 2));
        assert!(batch_norm(&x, &weight, &weight).is_err());
    }
}
