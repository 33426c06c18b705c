//! Normalisation of channels over a batch of images.
//!
//! What lives here: the training pass, by the statistics of the batch itself, with what a residual
//! block does to its result in the same pass over memory. What does not: the running statistics and
//! the pass that uses them, which are the network's.

use candle_core::{CpuStorage, CustomOp2, CustomOp3, Layout, Result, Shape, Tensor, bail};

use super::{Host, elements, fusible, gradient, output};
use gump_kernels::rows::{dot_from, for_pieces, sum, sum_squares_from};
use gump_kernels::wide;

/// Added to variances, as PyTorch does.
const EPS: f32 = 1e-5;

/// What follows a normalisation.
#[derive(Clone, Copy, Debug)]
pub enum Then<'a> {
    /// Nothing.
    Nothing,
    /// Negative numbers become 0.
    Rectify,
    /// A tensor of the same shape is added, then negative numbers become 0.
    AddAndRectify(&'a Tensor),
}

impl Then<'_> {
    /// Applies it to a normalised tensor.
    ///
    /// Error: when a tensor to be added has another shape.
    pub fn apply(self, y: Tensor) -> Result<Tensor> {
        match self {
            Self::Nothing => Ok(y),
            Self::Rectify => y.relu(),
            Self::AddAndRectify(other) => (y + other)?.relu(),
        }
    }
}

/// `(x - mean) / sqrt(variance + 1e-5) * weight + bias` with the mean and variance of each channel
/// over the batch, then what `then` says; and these two, which no gradient reaches.
///
/// Shape: `x` `[S, C, H, W]`; `weight` and `bias` `[C]`; the result like `x`, mean and variance
/// `[C]`; the variance is that of the batch (divided by `S H W`).
///
/// Error: when the shapes do not fit.
pub fn batch_norm(
    x: &Tensor,
    weight: &Tensor,
    bias: &Tensor,
    then: Then<'_>,
) -> Result<(Tensor, [Tensor; 2])> {
    let (_, channels, _, _) = x.dims4()?;
    let other = match then {
        Then::AddAndRectify(other) => Some(other),
        _ => None,
    };
    let fits = weight.dims() == [channels]
        && bias.dims() == [channels]
        && other.is_none_or(|other| other.dims() == x.dims());
    if !fits {
        let (x, weight, bias) = (x.shape(), weight.shape(), bias.shape());
        let other = other.map(Tensor::shape);
        bail!("batch_norm: x {x:?}, weight {weight:?}, bias {bias:?}, added {other:?}");
    }
    if !fusible(&[x, weight, bias, other.unwrap_or(x)]) {
        return composed(x, weight, bias, then);
    }
    let x = x.contiguous()?;
    let (mean, variance) = statistics(&x)?;
    let tensors = [&mean, &variance].map(|of| Tensor::from_slice(of, channels, x.device()));
    let [mean_tensor, variance_tensor] = tensors;
    let deviation = |v: &f32| 1.0 / (v + EPS).sqrt();
    let op = BatchNorm {
        inverse: variance.iter().map(deviation).collect(),
        mean,
        rectifies: !matches!(then, Then::Nothing),
    };
    // An operation takes three tensors.
    let affine = Tensor::stack(&[weight, bias], 0)?; // [2, C]
    let y = match other {
        Some(other) => x.apply_op3(&affine, &other.contiguous()?, op)?,
        None => x.apply_op2(&affine, op)?,
    };
    Ok((y, [mean_tensor?, variance_tensor?]))
}

fn composed(
    x: &Tensor,
    weight: &Tensor,
    bias: &Tensor,
    then: Then<'_>,
) -> Result<(Tensor, [Tensor; 2])> {
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
    Ok((then.apply(y)?, [flat(&mean)?, flat(&variance)?]))
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
    rectifies: bool,
}

impl CustomOp2 for BatchNorm {
    fn name(&self) -> &'static str {
        "batch-norm"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        affine: &CpuStorage,
        affine_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let affine = elements(affine, affine_layout)?;
        self.forward(elements(x, x_layout)?, x_layout, affine, None)
    }

    fn bwd(
        &self,
        x: &Tensor,
        affine: &Tensor,
        _y: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let (dx, d_affine, _) = self.backward(x, affine, None, dy)?;
        Ok((Some(dx), Some(d_affine)))
    }
}

/// With a tensor to add.
impl CustomOp3 for BatchNorm {
    fn name(&self) -> &'static str {
        "batch-norm-add"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        affine: &CpuStorage,
        affine_layout: &Layout,
        other: &CpuStorage,
        other_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let affine = elements(affine, affine_layout)?;
        let other = elements(other, other_layout)?;
        self.forward(elements(x, x_layout)?, x_layout, affine, Some(other))
    }

    fn bwd(
        &self,
        x: &Tensor,
        affine: &Tensor,
        other: &Tensor,
        _y: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let (dx, d_affine, d_sum) = self.backward(x, affine, Some(other), dy)?;
        Ok((Some(dx), Some(d_affine), Some(d_sum)))
    }
}

/// The normalised number plus the other one, if there is one: what is rectified.
#[inline(always)]
fn sum_of(x: f32, (mean, factor, bias): (f32, f32, f32), other: f32) -> f32 {
    ((x - mean) * factor + bias) + other
}

impl BatchNorm {
    /// Mean, factor and bias of a channel.
    fn terms(&self, channel: usize, affine: &[f32]) -> (f32, f32, f32) {
        let (weight, bias) = affine.split_at(affine.len() / 2);
        let factor = self.inverse[channel] * weight[channel];
        (self.mean[channel], factor, bias[channel])
    }

    fn forward(
        &self,
        x: &[f32],
        layout: &Layout,
        affine: &[f32],
        other: Option<&[f32]>,
    ) -> Result<(CpuStorage, Shape)> {
        let (_, channels, h, w) = layout.shape().dims4()?;
        let pixels = (h * w).max(1);
        let mut y = vec![0.0; x.len()];
        for_pieces(&mut y, pixels, |plane, y| {
            let terms = self.terms(plane % channels, affine);
            let x = at(x, plane, pixels);
            wide(
                #[inline(always)]
                || match other {
                    Some(other) => {
                        for ((y, x), other) in y.iter_mut().zip(x).zip(at(other, plane, pixels)) {
                            *y = sum_of(*x, terms, *other);
                        }
                    }
                    None => {
                        for (y, x) in y.iter_mut().zip(x) {
                            *y = (x - terms.0) * terms.1 + terms.2;
                        }
                    }
                },
            );
            if self.rectifies {
                wide(
                    #[inline(always)]
                    || y.iter_mut().for_each(|y| *y = y.max(0.0)),
                );
            }
        });
        Ok(output(y, layout.shape()))
    }

    /// Gradients of `x`, of weight and bias, and of what is rectified, if anything is.
    fn backward(
        &self,
        x: &Tensor,
        affine: &Tensor,
        other: Option<&Tensor>,
        dy: &Tensor,
    ) -> Result<(Tensor, Tensor, Tensor)> {
        let (s, channels, h, w) = x.dims4()?;
        let (x_host, affine_host) = (Host::new(x)?, Host::new(affine)?);
        let (x_all, affine_all) = (x_host.slice::<f32>()?, affine_host.slice::<f32>()?);
        let pixels = (h * w).max(1);
        let dy = dy.contiguous()?;
        let dy = if self.rectifies {
            let other = other.map(Host::new).transpose()?;
            let other = other
                .as_ref()
                .map(|other| other.slice::<f32>())
                .transpose()?;
            let host = Host::new(&dy)?;
            let all = host.slice::<f32>()?;
            let mut reaches = vec![0.0; x_all.len()];
            for_pieces(&mut reaches, pixels, |plane, reaches| {
                let terms = self.terms(plane % channels, affine_all);
                let (x, dy) = (at(x_all, plane, pixels), at(all, plane, pixels));
                // As the tensor library has it, the slope at 0 is 1.
                let slope = |sum: f32, dy: f32| if sum >= 0.0 { dy } else { 0.0 };
                wide(
                    #[inline(always)]
                    || {
                        let pairs = reaches.iter_mut().zip(x).zip(dy);
                        match other {
                            Some(other) => {
                                for (((d, x), dy), other) in pairs.zip(at(other, plane, pixels)) {
                                    *d = slope(sum_of(*x, terms, *other), *dy);
                                }
                            }
                            None => {
                                for ((d, x), dy) in pairs {
                                    *d = slope((x - terms.0) * terms.1 + terms.2, *dy);
                                }
                            }
                        }
                    },
                );
            });
            gradient(reaches, x)?
        } else {
            dy
        };
        let dy_host = Host::new(&dy)?;
        let dy_all = dy_host.slice::<f32>()?;
        let n = (s * h * w).max(1) as f64;
        let d_bias = per_channel(s, channels, &|_, plane| sum(at(dy_all, plane, pixels)));
        let d_weight = per_channel(s, channels, &|channel, plane| {
            let (x, dy) = (at(x_all, plane, pixels), at(dy_all, plane, pixels));
            self.inverse[channel] * dot_from(x, self.mean[channel], dy)
        });
        let mut dx = vec![0.0; x_all.len()];
        for_pieces(&mut dx, pixels, |plane, dx| {
            let channel = plane % channels;
            let (mean, factor, _) = self.terms(channel, affine_all);
            let level = (d_bias[channel] / n) as f32;
            let slope = self.inverse[channel] * (d_weight[channel] / n) as f32;
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
        let both = d_weight.into_iter().chain(d_bias).map(|v| v as f32);
        let d_affine = gradient(both.collect(), affine)?;
        drop(dy_host);
        Ok((gradient(dx, x)?, d_affine, dy))
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
            let other = var(&shape, 4);
            let shifted = || x.affine(3.0, 1.5);
            let all = [&x, &weight, &bias, &other];
            for (vars, then) in [
                (&all[..3], Then::Nothing),
                (&all[..3], Then::Rectify),
                (&all, Then::AddAndRectify(&other)),
            ] {
                check(
                    vars,
                    || Ok(batch_norm(&shifted()?, &weight, &bias, then)?.0),
                    || Ok(composed(&shifted()?, &weight, &bias, then)?.0),
                );
            }
            let (x, then) = (shifted().unwrap(), Then::Rectify);
            let fused = batch_norm(&x, &weight, &bias, then).unwrap().1;
            let oracle = composed(&x, &weight, &bias, then).unwrap().1;
            for (fused, oracle) in fused.iter().zip(&oracle) {
                assert_close("statistics", fused, oracle, 1e-5);
            }
        }
    }

    #[test]
    fn shapes_that_do_not_fit_are_errors() {
        let (x, weight) = (var(&[1, 3, 2, 2], 1), var(&[2], 2));
        assert!(batch_norm(&x, &weight, &weight, Then::Nothing).is_err());
        let (weight, other) = (var(&[3], 2), var(&[1, 3, 2, 1], 3));
        assert!(batch_norm(&x, &weight, &weight, Then::AddAndRectify(&other)).is_err());
    }
}
