//! Two-dimensional convolution as matrix products.
//!
//! What lives here: the fused operation. A band of output rows at a time, or several small images at
//! a time, the patches under it are laid out as columns (`[Cin * kh * kw, positions]`) and multiplied
//! by the weights. A 1 x 1 convolution reads its input in place. What does not: normalisation and
//! pooling, which the encoder composes.

use candle_core::{CpuStorage, CustomOp2, CustomOp3, Layout, Result, Shape, Tensor, bail};

use super::{Host, elements, fusible, gradient, output};
use gump_kernels::Operands;
use gump_kernels::gemm::{Mat, MatMut, Store, Threads, gemm};
use gump_kernels::rows::{add_partials, add_to, for_pieces, for_pieces2, sum};
use gump_kernels::wide;

/// Column elements of a band: 512 KB, a part of a second-level cache. Not tuned.
const BAND: usize = 128 * 1024;

/// Positions of a band, at least, where there are as many: the weights are packed, and the sum of
/// their gradients is read and written, once per band, which for a few positions of a deep layer
/// costs more than the products. The depth that the kernels of bfloat16 pack at a time.
const FEW_POSITIONS: usize = 512;

/// Pieces of the batch whose weight gradients are summed apart, each as large as the weights:
/// bounds the memory and the threads that share the work. Fixed, so that sums do not depend on
/// their number.
const MAX_PARTIALS: usize = 8;

/// Cross-correlates `x` with `weight` and adds `bias`, with zeros around the border.
///
/// Shape: `x` `[B, Cin, H, W]`, `weight` `[Cout, Cin, kh, kw]`, `bias` `[Cout]`; the result
/// `[B, Cout, (H + 2 padding - kh) / stride + 1, (W + 2 padding - kw) / stride + 1]`.
///
/// Error: when the shapes do not fit, `stride` is 0, or the kernel exceeds the padded image.
pub fn conv2d(
    x: &Tensor,
    weight: &Tensor,
    bias: Option<&Tensor>,
    stride: usize,
    padding: usize,
) -> Result<Tensor> {
    let conv = Conv::new(x, weight, bias, stride, padding)?;
    match bias {
        Some(bias) if fusible(&[x, weight, bias]) => {
            x.contiguous()?
                .apply_op3(&weight.contiguous()?, &bias.contiguous()?, conv)
        }
        None if fusible(&[x, weight]) => x.contiguous()?.apply_op2(&weight.contiguous()?, conv),
        _ => composed(x, weight, bias, stride, padding),
    }
}

fn composed(
    x: &Tensor,
    weight: &Tensor,
    bias: Option<&Tensor>,
    stride: usize,
    padding: usize,
) -> Result<Tensor> {
    let y = x.conv2d(weight, padding, stride, 1, 1)?;
    match bias {
        Some(bias) => y.broadcast_add(&bias.reshape((1, (), 1, 1))?),
        None => Ok(y),
    }
}

/// The sizes of a convolution.
struct Conv {
    b: usize,
    c_in: usize,
    h: usize,
    w: usize,
    c_out: usize,
    kh: usize,
    kw: usize,
    stride: usize,
    padding: usize,
    out_h: usize,
    out_w: usize,
    operands: Operands,
}

impl Conv {
    fn new(
        x: &Tensor,
        weight: &Tensor,
        bias: Option<&Tensor>,
        stride: usize,
        padding: usize,
    ) -> Result<Self> {
        let (b, c_in, h, w) = x.dims4()?;
        let (c_out, c_kernel, kh, kw) = weight.dims4()?;
        let fits = c_kernel == c_in
            && stride > 0
            && kh > 0
            && kw > 0
            && kh <= h + 2 * padding
            && kw <= w + 2 * padding
            && bias.is_none_or(|b| b.dims() == [c_out]);
        if !fits {
            bail!(
                "conv2d: x {:?}, weight {:?}, bias {:?}, stride {stride}, padding {padding}",
                x.shape(),
                weight.shape(),
                bias.map(Tensor::shape)
            );
        }
        Ok(Self {
            b,
            c_in,
            h,
            w,
            c_out,
            kh,
            kw,
            stride,
            padding,
            out_h: (h + 2 * padding - kh) / stride + 1,
            out_w: (w + 2 * padding - kw) / stride + 1,
            operands: Operands::current(),
        })
    }

    /// Elements of a patch: rows of the column matrix.
    fn patch(&self) -> usize {
        self.c_in * self.kh * self.kw
    }

    /// Output positions of an image.
    fn positions(&self) -> usize {
        self.out_h * self.out_w
    }

    /// Elements of an input image.
    fn image(&self) -> usize {
        self.c_in * self.h * self.w
    }

    /// Whether the columns are the input itself.
    fn is_pointwise(&self) -> bool {
        (self.kh, self.kw, self.stride, self.padding) == (1, 1, 1, 0)
    }

    /// Images of a group, whose patches stand side by side in one band: several if they are small.
    fn group(&self) -> usize {
        let enough = FEW_POSITIONS.div_ceil(self.positions().max(1));
        enough.clamp(1, self.b.max(1))
    }

    /// Threads that work on one group: one per group, or all of them on a lone group.
    fn threads(&self) -> Threads {
        if self.b <= self.group() {
            Threads::Pool
        } else {
            Threads::One
        }
    }

    /// Output rows per band. Images of a lone group are one band, so that all threads share it.
    fn band(&self) -> usize {
        if self.group() > 1 || self.threads() == Threads::Pool {
            return self.out_h;
        }
        let positions = (BAND / self.patch()).max(FEW_POSITIONS);
        let rows = (positions / self.out_w).clamp(1, self.out_h);
        self.out_h.div_ceil(self.out_h.div_ceil(rows))
    }

    /// Output rows of every band, as (first, count).
    fn bands(&self) -> impl Iterator<Item = (usize, usize)> {
        let (band, out_h) = (self.band(), self.out_h);
        (0..out_h)
            .step_by(band)
            .map(move |y| (y, band.min(out_h - y)))
    }

    /// The output columns whose tap `kx` lies inside the image.
    fn inside(&self, kx: usize) -> std::ops::Range<usize> {
        let start = self.padding.saturating_sub(kx).div_ceil(self.stride);
        // The last column with ox * stride + kx - padding < w.
        let end = (self.w + self.padding).saturating_sub(kx);
        let end = end.div_ceil(self.stride).min(self.out_w);
        start.min(end)..end
    }

    /// The input row under output row `oy` and tap `ky`, unless it is border.
    fn input_row(&self, oy: usize, ky: usize) -> Option<usize> {
        (oy * self.stride + ky)
            .checked_sub(self.padding)
            .filter(|&y| y < self.h)
    }

    /// The image of a group and the output row that line `j` of a band stands for.
    fn line(&self, (first, count): (usize, usize), j: usize) -> (usize, usize) {
        (j / count, first + j % count)
    }

    /// Lays out the patches of `images` under output rows `first..first + count` as columns.
    fn gather(&self, x: &[f32], images: usize, band: (usize, usize), cols: &mut [f32]) {
        let n = images * band.1 * self.out_w;
        if (self.kw, self.stride, self.padding) == (4, 4, 0) {
            return self.gather_fours(x, n, band, cols);
        }
        let rows_per_piece = match self.threads() {
            // Elements per task, as in `gump_kernels::rows`.
            Threads::Pool => (16 * 1024usize).div_ceil(n),
            Threads::One => self.patch(),
        };
        for_pieces(cols, rows_per_piece * n, |piece, cols| {
            for (i, row) in cols.chunks_exact_mut(n).enumerate() {
                let tap = piece * rows_per_piece + i;
                let (ci, ky, kx) = self.tap(tap);
                let inside = self.inside(kx);
                for (j, out) in row.chunks_exact_mut(self.out_w).enumerate() {
                    let (image, oy) = self.line(band, j);
                    let Some(y) = self.input_row(oy, ky) else {
                        out.fill(0.0);
                        continue;
                    };
                    out[..inside.start].fill(0.0);
                    out[inside.end..].fill(0.0);
                    if inside.is_empty() {
                        continue;
                    }
                    let line = &x[image * self.image() + (ci * self.h + y) * self.w..][..self.w];
                    let line = &line[inside.start * self.stride + kx - self.padding..];
                    let out = &mut out[inside.clone()];
                    if self.stride == 1 {
                        out.copy_from_slice(&line[..out.len()]);
                    } else {
                        for (o, v) in out.iter_mut().zip(line.iter().step_by(self.stride)) {
                            *o = *v;
                        }
                    }
                }
            }
        });
    }

    /// [`Self::gather`] of patches that stand side by side and are four wide: a line of pixels is
    /// dealt out to four rows at once.
    fn gather_fours(&self, x: &[f32], n: usize, band: (usize, usize), cols: &mut [f32]) {
        let piece = match self.threads() {
            Threads::Pool => 4 * n,
            Threads::One => cols.len(),
        };
        for_pieces(cols, piece, |at, cols| {
            for (i, rows) in cols.chunks_exact_mut(4 * n).enumerate() {
                self.deal_fours(x, at * piece / (4 * n) + i, band, rows);
            }
        });
    }

    /// The four rows of one channel and kernel row.
    fn deal_fours(&self, x: &[f32], i: usize, band: (usize, usize), rows: &mut [f32]) {
        let n = rows.len() / 4;
        let (ci, ky) = (i / self.kh, i % self.kh);
        let (low, high) = rows.split_at_mut(2 * n);
        let ((a, b), (c, d)) = (low.split_at_mut(n), high.split_at_mut(n));
        for j in 0..n / self.out_w {
            let (image, oy) = self.line(band, j);
            let y = oy * self.stride + ky;
            let line = &x[image * self.image() + (ci * self.h + y) * self.w..][..4 * self.out_w];
            let out = j * self.out_w..(j + 1) * self.out_w;
            let (a, b) = (&mut a[out.clone()], &mut b[out.clone()]);
            let (c, d) = (&mut c[out.clone()], &mut d[out]);
            wide(
                #[inline(always)]
                || {
                    let outs = a.iter_mut().zip(b).zip(c.iter_mut().zip(d));
                    for (((a, b), (c, d)), four) in outs.zip(line.as_chunks::<4>().0) {
                        [*a, *b, *c, *d] = *four;
                    }
                },
            );
        }
    }

    /// Adds columns back to the pixels they came from: the gradient of [`Self::gather`].
    fn scatter(&self, cols: &[f32], images: usize, band: (usize, usize), dx: &mut [f32]) {
        let n = images * band.1 * self.out_w;
        for (tap, row) in cols.chunks_exact(n).enumerate() {
            let (ci, ky, kx) = self.tap(tap);
            let inside = self.inside(kx);
            if inside.is_empty() {
                continue;
            }
            for (j, row) in row.chunks_exact(self.out_w).enumerate() {
                let (image, oy) = self.line(band, j);
                let Some(y) = self.input_row(oy, ky) else {
                    continue;
                };
                let start = image * self.image() + (ci * self.h + y) * self.w;
                let line = &mut dx[start..][..self.w];
                let line = &mut line[inside.start * self.stride + kx - self.padding..];
                let row = &row[inside.clone()];
                if self.stride == 1 {
                    add_to(line, row);
                } else {
                    for (d, v) in line.iter_mut().step_by(self.stride).zip(row) {
                        *d += v;
                    }
                }
            }
        }
    }

    /// Input channel, kernel row and kernel column of a row of the column matrix.
    fn tap(&self, tap: usize) -> (usize, usize, usize) {
        let (rest, kx) = (tap / self.kw, tap % self.kw);
        (rest / self.kh, rest % self.kh, kx)
    }

    /// The columns of a band of `images`: gathered into `cols`, or the input itself.
    fn columns<'a>(
        &self,
        x: &'a [f32],
        images: usize,
        band: (usize, usize),
        cols: &'a mut Vec<f32>,
    ) -> Mat<'a> {
        let n = images * band.1 * self.out_w;
        if self.is_pointwise() && images == 1 {
            Mat::strided(&x[band.0 * self.out_w..], self.c_in, n, self.positions())
        } else {
            cols.resize(self.patch() * n, 0.0);
            self.gather(x, images, band, cols);
            Mat::new(cols, self.patch(), n)
        }
    }

    fn forward(&self, x: &[f32], weight: &[f32], bias: Option<&[f32]>) -> (CpuStorage, Shape) {
        let positions = self.positions();
        let (per_image, group) = (self.c_out * positions, self.group());
        let mut out = vec![0.0; self.b * per_image];
        for_pieces(&mut out, group * per_image, |piece, out| {
            let x = &x[piece * group * self.image()..];
            let images = out.len() / per_image;
            if let Some(bias) = bias {
                for out in out.chunks_exact_mut(per_image) {
                    for (out, bias) in out.chunks_exact_mut(positions).zip(bias) {
                        out.fill(*bias);
                    }
                }
            }
            let store = if bias.is_some() {
                Store::Add
            } else {
                Store::Replace
            };
            let (mut cols, mut joined) = (Vec::new(), Vec::new());
            let weight = Mat::new(weight, self.c_out, self.patch());
            let (threads, operands) = (self.threads(), self.operands);
            for band in self.bands() {
                let n = images * band.1 * self.out_w;
                let cols = self.columns(x, images, band, &mut cols);
                if images == 1 {
                    let out = &mut out[band.0 * self.out_w..];
                    let out = MatMut::strided(out, self.c_out, n, positions);
                    gemm(out, store, 1.0, weight, cols, threads, operands);
                } else {
                    self.join(out, &mut joined);
                    let y = MatMut::new(&mut joined, self.c_out, n);
                    gemm(y, store, 1.0, weight, cols, threads, operands);
                    self.part(&joined, out);
                }
            }
        });
        output(out, (self.b, self.c_out, self.out_h, self.out_w))
    }

    /// Lays the outputs of several images `[images, Cout, positions]` side by side,
    /// `[Cout, images * positions]`.
    fn join(&self, images: &[f32], joined: &mut Vec<f32>) {
        let positions = self.positions();
        joined.clear();
        for channel in 0..self.c_out {
            for image in images.chunks_exact(self.c_out * positions) {
                joined.extend_from_slice(&image[channel * positions..][..positions]);
            }
        }
    }

    /// The inverse of [`Self::join`].
    fn part(&self, joined: &[f32], images: &mut [f32]) {
        let positions = self.positions();
        let width = joined.len() / self.c_out;
        for (i, image) in images.chunks_exact_mut(self.c_out * positions).enumerate() {
            let rows = joined.chunks_exact(width);
            for (to, row) in image.chunks_exact_mut(positions).zip(rows) {
                to.copy_from_slice(&row[i * positions..][..positions]);
            }
        }
    }

    /// Gradients of the input and the weights.
    fn backward(
        &self,
        x: &Tensor,
        weight: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let hosts = [Host::new(x)?, Host::new(weight)?, Host::new(dy)?];
        let x_all = hosts[0].slice::<f32>()?;
        let w = hosts[1].slice::<f32>()?;
        let dy = hosts[2].slice::<f32>()?;
        let group = self.group();
        let step = self.b.div_ceil(MAX_PARTIALS).max(1);
        let step = step.next_multiple_of(group);
        let mut dws = vec![0.0; self.b.div_ceil(step) * w.len()];
        // Without a gradient to the image, one element a piece keeps the two outputs in step.
        let wants_dx = x.track_op();
        let per_image = if wants_dx { self.image() } else { 1 };
        let mut dx = vec![0.0; self.b * per_image];
        for_pieces2(
            (&mut dws, w.len()),
            (&mut dx, step * per_image),
            |piece, dw, dx| {
                let (mut cols, mut joined) = (Vec::new(), Vec::new());
                for (i, dx) in dx.chunks_mut(group * per_image).enumerate() {
                    let (first, images) = (piece * step + i * group, dx.len() / per_image);
                    let x = &x_all[first * self.image()..];
                    let of_image = self.c_out * self.positions();
                    let dy = &dy[first * of_image..][..images * of_image];
                    if images > 1 {
                        self.join(dy, &mut joined);
                    }
                    for band in self.bands() {
                        let n = images * band.1 * self.out_w;
                        let dy = if images == 1 {
                            let dy = &dy[band.0 * self.out_w..];
                            Mat::strided(dy, self.c_out, n, self.positions())
                        } else {
                            Mat::new(&joined, self.c_out, n)
                        };
                        gemm(
                            MatMut::new(dw, self.c_out, self.patch()),
                            Store::Add,
                            1.0,
                            dy,
                            self.columns(x, images, band, &mut cols).t(),
                            self.threads(),
                            self.operands,
                        );
                        if wants_dx {
                            self.backward_images(w, dy, images, band, &mut cols, dx);
                        }
                    }
                }
            },
        );
        let mut dw = vec![0.0; w.len()];
        add_partials(&mut dw, &dws);
        let dx = if wants_dx {
            Some(gradient(dx, x)?)
        } else {
            None
        };
        Ok((dx, Some(gradient(dw, weight)?)))
    }

    /// Adds the gradient of one band to that of its images.
    fn backward_images(
        &self,
        weight: &[f32],
        dy: Mat<'_>,
        images: usize,
        band: (usize, usize),
        cols: &mut Vec<f32>,
        dx: &mut [f32],
    ) {
        let n = images * band.1 * self.out_w;
        let weight = Mat::new(weight, self.c_out, self.patch()).t();
        let (threads, operands) = (self.threads(), self.operands);
        if self.is_pointwise() && images == 1 {
            let dx = &mut dx[band.0 * self.out_w..];
            let dst = MatMut::strided(dx, self.c_in, n, self.positions());
            gemm(dst, Store::Replace, 1.0, weight, dy, threads, operands);
        } else {
            cols.resize(self.patch() * n, 0.0);
            let dst = MatMut::new(cols, self.patch(), n);
            gemm(dst, Store::Replace, 1.0, weight, dy, threads, operands);
            self.scatter(cols, images, band, dx);
        }
    }

    fn bias_gradient(&self, bias: &Tensor, dy: &Tensor) -> Result<Tensor> {
        let host = Host::new(dy)?;
        let dy = host.slice::<f32>()?;
        let positions = self.positions();
        let mut sums = vec![0.0; self.b * self.c_out]; // [B, Cout]
        for_pieces(&mut sums, self.c_out, |b, sums| {
            let dy = &dy[b * self.c_out * positions..];
            wide(
                #[inline(always)]
                || {
                    for (s, dy) in sums.iter_mut().zip(dy.chunks_exact(positions)) {
                        *s = sum(dy);
                    }
                },
            );
        });
        let mut db = vec![0.0; self.c_out];
        add_partials(&mut db, &sums);
        gradient(db, bias)
    }
}

impl CustomOp2 for Conv {
    fn name(&self) -> &'static str {
        "conv2d"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        weight: &CpuStorage,
        weight_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (x, weight) = (elements(x, x_layout)?, elements(weight, weight_layout)?);
        Ok(self.forward(x, weight, None))
    }

    fn bwd(
        &self,
        x: &Tensor,
        weight: &Tensor,
        _y: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        self.backward(x, weight, &dy.contiguous()?)
    }
}

impl CustomOp3 for Conv {
    fn name(&self) -> &'static str {
        "conv2d"
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
        let (x, weight) = (elements(x, x_layout)?, elements(weight, weight_layout)?);
        Ok(self.forward(x, weight, Some(elements(bias, bias_layout)?)))
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
        let (dx, dw) = self.backward(x, weight, &dy)?;
        Ok((dx, dw, Some(self.bias_gradient(bias, &dy)?)))
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{check, var};
    use super::*;

    #[test]
    fn agrees_with_candle() {
        // [B, Cin, H, W, Cout, kh, kw, stride, padding]
        for [b, c_in, h, w, c_out, kh, kw, stride, padding] in [
            [1, 1, 1, 1, 1, 1, 1, 1, 0],
            [1, 3, 9, 7, 5, 3, 3, 1, 1],
            [3, 4, 8, 8, 6, 1, 1, 1, 0],
            [2, 3, 11, 11, 4, 3, 3, 2, 1],
            [2, 2, 15, 15, 3, 7, 7, 2, 3],
            [10, 2, 6, 6, 3, 3, 3, 1, 1],
            [2, 5, 16, 16, 7, 4, 4, 4, 0],
            [2, 32, 60, 60, 8, 3, 3, 1, 1],
            [2, 1, 2, 3, 1, 3, 5, 1, 2],
            // Several images in a band, the last with fewer; and several bands, the last shorter.
            [5, 3, 17, 13, 6, 3, 3, 1, 1],
            [3, 6, 18, 18, 5, 1, 1, 2, 0],
            [2, 3, 40, 64, 4, 4, 4, 4, 0],
            [2, 40, 37, 36, 5, 3, 3, 1, 1],
        ] {
            let x = var(&[b, c_in, h, w], 1);
            let (k, bias) = (var(&[c_out, c_in, kh, kw], 2), var(&[c_out], 3));
            check(
                &[&x, &k, &bias],
                || conv2d(&x, &k, Some(&bias), stride, padding),
                || composed(&x, &k, Some(&bias), stride, padding),
            );
            check(
                &[&k],
                || conv2d(&x.detach(), &k, None, stride, padding),
                || composed(&x.detach(), &k, None, stride, padding),
            );
        }
    }

    #[test]
    fn a_kernel_larger_than_the_image_is_an_error() {
        let (x, k) = (var(&[1, 1, 2, 2], 1), var(&[1, 1, 5, 5], 2));
        assert!(conv2d(&x, &k, None, 1, 1).is_err());
        assert!(conv2d(&x, &k, None, 0, 2).is_err());
    }
}
