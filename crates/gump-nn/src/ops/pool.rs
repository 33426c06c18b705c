//! Pooling by the largest of overlapping windows.
//!
//! What lives here: the fused operation and its composition, one dimension after the other. What
//! does not: other windows, which no network here has.

use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor, bail};

use gump_kernels::rows::for_pieces;
use gump_kernels::wide;

use super::{Host, elements, fusible, gradient, output};

/// The largest number of windows of 3 x 3 pixels around every second pixel of both dimensions,
/// first of three rows, then of three columns; equal numbers share the gradient.
///
/// Shape: `x` `[S, C, H, W]`, not negative, so that zeros beyond the border are never the largest
/// alone, with even `H` and `W`; the result `[S, C, H / 2, W / 2]`.
///
/// Error: when the shape does not fit.
pub fn largest_of_nine(x: &Tensor) -> Result<Tensor> {
    let (_, _, h, w) = x.dims4()?;
    if h % 2 != 0 || w % 2 != 0 {
        bail!("largest_of_nine: x {:?}", x.shape());
    }
    if !fusible(&[x]) {
        return composed(&composed(x, 2)?, 3);
    }
    x.contiguous()?.apply_op1(Pool)
}

/// The maximum of three neighbours along a dimension, around every second. The tensor library does
/// not differentiate overlapping pooling.
fn composed(x: &Tensor, dim: usize) -> Result<Tensor> {
    let n = x.dim(dim)? / 2;
    let padded = x.pad_with_zeros(dim, 1, 1)?;
    let mut dims = padded.dims().to_vec();
    dims[dim] = n + 1;
    dims.insert(dim + 1, 2);
    let pairs = padded.reshape(dims)?;
    let every_second = |i| pairs.narrow(dim + 1, i, 1)?.squeeze(dim + 1);
    let (even, odd) = (every_second(0)?, every_second(1)?);
    let (left, middle, right) = (
        even.narrow(dim, 0, n)?,
        odd.narrow(dim, 0, n)?,
        even.narrow(dim, 1, n)?,
    );
    left.maximum(&middle)?.maximum(&right)
}

struct Pool;

impl CustomOp1 for Pool {
    fn name(&self) -> &'static str {
        "largest-of-nine"
    }

    fn cpu_fwd(&self, x: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let (s, c, h, w) = layout.shape().dims4()?;
        let x = elements(x, layout)?;
        let mut y = vec![0.0; x.len() / 4];
        for_pieces(&mut y, (h * w / 4).max(1), |plane, y| {
            let x = &x[plane * h * w..][..h * w];
            wide(
                #[inline(always)]
                || {
                    let (border, mut line) = (vec![0.0; w], vec![0.0; w]);
                    for (i, y) in y.chunks_exact_mut(w / 2).enumerate() {
                        largest_of_rows(three_rows(x, w, i, &border), &mut line);
                        largest_of_columns(&line, y);
                    }
                },
            );
        });
        Ok(output(y, (s, c, h / 2, w / 2)))
    }

    fn bwd(&self, x: &Tensor, _y: &Tensor, dy: &Tensor) -> Result<Option<Tensor>> {
        let (_, _, h, w) = x.dims4()?;
        let dy = dy.contiguous()?;
        let (x_host, dy) = (Host::new(x)?, Host::new(&dy)?);
        let (x_all, dy) = (x_host.slice::<f32>()?, dy.slice::<f32>()?);
        let mut dx = vec![0.0; x_all.len()];
        for_pieces(&mut dx, (h * w).max(1), |plane, dx| {
            let x = &x_all[plane * h * w..][..h * w];
            let dy = &dy[plane * h * w / 4..][..h * w / 4];
            wide(
                #[inline(always)]
                || backward_plane(x, dy, dx, w),
            );
        });
        Ok(Some(gradient(dx, x)?))
    }
}

/// The rows above, at and below every second row of a plane, with `border` above the first.
#[inline(always)]
fn three_rows<'a>(x: &'a [f32], w: usize, i: usize, border: &'a [f32]) -> [&'a [f32]; 3] {
    let row = |row: usize| &x[row * w..(row + 1) * w];
    let above = if i > 0 { row(2 * i - 1) } else { border };
    [above, row(2 * i), row(2 * i + 1)]
}

/// The largest of three rows, number by number.
#[inline(always)]
fn largest_of_rows([above, middle, below]: [&[f32]; 3], line: &mut [f32]) {
    for (((line, above), middle), below) in line.iter_mut().zip(above).zip(middle).zip(below) {
        *line = largest([*above, *middle, *below]);
    }
}

/// The largest of three neighbours around every second number.
#[inline(always)]
fn largest_of_columns(line: &[f32], y: &mut [f32]) {
    let (pairs, _) = line.as_chunks::<2>();
    let mut left = 0.0;
    for (y, [middle, right]) in y.iter_mut().zip(pairs) {
        *y = largest([left, *middle, *right]);
        left = *right;
    }
}

#[inline(always)]
fn largest([first, second, third]: [f32; 3]) -> f32 {
    first.max(second).max(third)
}

/// The gradients of three numbers from that of their maximum.
#[inline(always)]
fn shared([first, second, third]: [f32; 3], slope: f32) -> [f32; 3] {
    let (of_two, of_third) = halves(first.max(second), third, slope);
    let (of_first, of_second) = halves(first, second, of_two);
    [of_first, of_second, of_third]
}

/// The gradients of two numbers from that of their maximum.
#[inline(always)]
fn halves(a: f32, b: f32, slope: f32) -> (f32, f32) {
    let part = if a == b { 0.5 * slope } else { slope };
    let of = |is_largest: bool| if is_largest { part } else { 0.0 };
    (of(a >= b), of(b >= a))
}

/// Adds the gradient of a plane `[H, w]` to `dx`.
#[inline(always)]
fn backward_plane(x: &[f32], dy: &[f32], dx: &mut [f32], w: usize) {
    let border = vec![0.0; w];
    let (mut beyond, mut line, mut slopes) = (vec![0.0; w], vec![0.0; w], vec![0.0; w]);
    for (i, dy) in dy.chunks_exact(w / 2).enumerate() {
        let rows = three_rows(x, w, i, &border);
        largest_of_rows(rows, &mut line);
        let pairs = line.as_chunks::<2>().0.iter().zip(dy);
        // The number to the left and its gradient so far; nothing reads that of the border.
        let (mut left, mut of_border) = (0.0, 0.0);
        let mut of_before = &mut of_border;
        for (slopes, ([middle, right], dy)) in slopes.as_chunks_mut::<2>().0.iter_mut().zip(pairs) {
            let [of_left, of_middle, of_right] = shared([left, *middle, *right], *dy);
            *of_before += of_left;
            *slopes = [of_middle, of_right];
            (left, of_before) = (*right, &mut slopes[1]);
        }
        let (done, rest) = dx.split_at_mut(2 * i * w);
        let above = if i > 0 {
            &mut done[(2 * i - 1) * w..]
        } else {
            &mut beyond[..]
        };
        let (middle, below) = rest.split_at_mut(w);
        let outputs = above.iter_mut().zip(middle).zip(below);
        let inputs = rows[0].iter().zip(rows[1]).zip(rows[2]).zip(&slopes);
        for (((d_above, d_middle), d_below), (((above, middle), below), slope)) in
            outputs.zip(inputs)
        {
            let [first, second, third] = shared([*above, *middle, *below], *slope);
            *d_above += first;
            (*d_middle, *d_below) = (second, third);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{check, flat, values, var};
    use super::*;
    use candle_core::{Device, Var};

    #[test]
    fn two_halves_of_pooling_are_pooling() {
        let numbers = values(2 * 3 * 8 * 6, 1).into_iter().map(f32::abs).collect();
        let x = Tensor::from_vec(numbers, (2, 3, 8, 6), &Device::Cpu).unwrap();
        let padded = x.pad_with_zeros(2, 1, 1).unwrap().pad_with_zeros(3, 1, 1);
        let pooled = padded.unwrap().max_pool2d_with_stride(3, 2).unwrap();
        let ours = largest_of_nine(&x).unwrap();
        assert_eq!(ours.dims(), [2, 3, 4, 3]);
        assert_eq!(flat(&ours), flat(&pooled));
        assert!(largest_of_nine(&x.narrow(3, 0, 5).unwrap()).is_err());
    }

    #[test]
    fn agrees_with_the_composition() {
        for shape in [[1, 1, 2, 2], [2, 3, 8, 6], [1, 2, 34, 50]] {
            let x = var(&shape, 1);
            // Rectified, most windows have equal numbers; rounded, also positive ones.
            let rounded = x.affine(3.0, 0.5).unwrap().round().unwrap();
            for x in [x.relu().unwrap(), rounded.relu().unwrap()] {
                let x = Var::from_tensor(&x).unwrap();
                check(
                    &[&x],
                    || largest_of_nine(&x),
                    || composed(&composed(&x, 2)?, 3),
                );
            }
        }
    }
}
