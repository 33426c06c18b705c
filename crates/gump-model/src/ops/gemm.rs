//! The only place of the crate with `unsafe`: matrix products over checked slices, and the
//! switch to the widest vector instructions the processor has.
//!
//! What lives here: [`Mat`], [`MatMut`], [`gemm`] and [`wide`], whose public faces are safe.
//! What does not: any layer; those call these functions and stay free of `unsafe`.
#![allow(
    unsafe_code,
    reason = "`gemm::gemm` takes raw pointers, and code compiled for optional processor features may only be called after checking for them; both are checked here, once"
)]

use gemm::Parallelism;

/// A read-only matrix over a slice with any two strides.
#[derive(Clone, Copy, Debug)]
pub(super) struct Mat<'a> {
    data: &'a [f32],
    rows: usize,
    cols: usize,
    row_stride: usize,
    col_stride: usize,
}

impl<'a> Mat<'a> {
    /// A row-major matrix whose rows start `row_stride` elements apart.
    ///
    /// Panics when the slice is too short for the shape.
    pub(super) fn strided(data: &'a [f32], rows: usize, cols: usize, row_stride: usize) -> Self {
        check_extent(data.len(), rows, cols, row_stride);
        Self {
            data,
            rows,
            cols,
            row_stride,
            col_stride: 1,
        }
    }

    /// A row-major matrix without gaps.
    pub(super) fn new(data: &'a [f32], rows: usize, cols: usize) -> Self {
        Self::strided(data, rows, cols, cols)
    }

    /// The transposed view; no element moves.
    pub(super) fn t(self) -> Self {
        Self {
            data: self.data,
            rows: self.cols,
            cols: self.rows,
            row_stride: self.col_stride,
            col_stride: self.row_stride,
        }
    }
}

/// A writable row-major matrix.
#[derive(Debug)]
pub(super) struct MatMut<'a> {
    data: &'a mut [f32],
    rows: usize,
    cols: usize,
    row_stride: usize,
}

impl<'a> MatMut<'a> {
    /// A row-major matrix whose rows start `row_stride` elements apart.
    ///
    /// Panics when the slice is too short for the shape, or when rows would overlap.
    pub(super) fn strided(
        data: &'a mut [f32],
        rows: usize,
        cols: usize,
        row_stride: usize,
    ) -> Self {
        check_extent(data.len(), rows, cols, row_stride);
        Self {
            data,
            rows,
            cols,
            row_stride,
        }
    }

    /// A row-major matrix without gaps.
    pub(super) fn new(data: &'a mut [f32], rows: usize, cols: usize) -> Self {
        Self::strided(data, rows, cols, cols)
    }
}

fn check_extent(len: usize, rows: usize, cols: usize, row_stride: usize) {
    assert!(rows <= 1 || cols <= row_stride, "matrix rows overlap");
    let needed = if rows == 0 || cols == 0 {
        0
    } else {
        (rows - 1) * row_stride + cols
    };
    assert!(needed <= len, "matrix of {needed} elements over {len}");
}

/// What a product does with the values already in its destination.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Store {
    /// `dst = scale * lhs rhs`
    Replace,
    /// `dst += scale * lhs rhs`
    Add,
}

/// Who computes a product.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Threads {
    /// The calling thread.
    One,
    /// The current rayon pool; the bits do not depend on its size, because only rows and columns
    /// are shared out, never the inner sum.
    Pool,
}

/// Multiplies `lhs` `[m, k]` by `rhs` `[k, n]` into `dst` `[m, n]`.
///
/// Panics when the shapes do not fit.
pub(super) fn gemm(
    dst: MatMut<'_>,
    store: Store,
    scale: f32,
    lhs: Mat<'_>,
    rhs: Mat<'_>,
    threads: Threads,
) {
    let MatMut {
        data,
        rows,
        cols,
        row_stride,
    } = dst;
    assert_eq!(rows, lhs.rows, "rows of the product");
    assert_eq!(cols, rhs.cols, "columns of the product");
    assert_eq!(lhs.cols, rhs.rows, "inner size of the product");
    let stride = |s: usize| isize::try_from(s).expect("a stride is within a slice");
    // SAFETY: the three constructors checked that every (row, column) lies in its slice and that
    // the rows of `dst` are disjoint; `dst` is a unique borrow, so it overlaps neither operand.
    unsafe {
        gemm::gemm(
            rows,
            cols,
            lhs.cols,
            data.as_mut_ptr(),
            1,
            stride(row_stride),
            store == Store::Add,
            lhs.data.as_ptr(),
            stride(lhs.col_stride),
            stride(lhs.row_stride),
            rhs.data.as_ptr(),
            stride(rhs.col_stride),
            stride(rhs.row_stride),
            1.0,
            scale,
            false,
            false,
            false,
            match threads {
                Threads::One => Parallelism::None,
                Threads::Pool => Parallelism::Rayon(0),
            },
        );
    }
}

/// The product of two `[n, n]` matrices by the matrix library on all threads: what the speed of
/// everything else is held against.
///
/// Panics when a slice is shorter than `n * n`.
pub fn square_product(a: &[f32], b: &[f32], n: usize) -> Vec<f32> {
    let mut product = vec![0.0; n * n];
    let dst = MatMut::new(&mut product, n, n);
    let (a, b) = (Mat::new(a, n, n), Mat::new(b, n, n));
    gemm(dst, Store::Replace, 1.0, a, b, Threads::Pool);
    product
}

/// Runs `f` compiled for the widest vectors of this processor.
///
/// Mark the closure and every helper it calls `#[inline(always)]`: only inlined code is compiled
/// wide. The instructions change, the arithmetic does not (a multiply-add is fused only where it is
/// written so, and sums keep their written order), so the bits are those of the plain build.
#[inline(always)]
pub(crate) fn wide<R>(f: impl FnOnce() -> R) -> R {
    #[cfg(target_arch = "x86_64")]
    {
        #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
        fn v4<R>(f: impl FnOnce() -> R) -> R {
            f()
        }
        #[target_feature(enable = "avx2,fma")]
        fn v3<R>(f: impl FnOnce() -> R) -> R {
            f()
        }
        if is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx512bw")
            && is_x86_feature_detected!("avx512dq")
            && is_x86_feature_detected!("avx512vl")
        {
            // SAFETY: the four features were just detected.
            return unsafe { v4(f) };
        }
        if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
            // SAFETY: the two features were just detected.
            return unsafe { v3(f) };
        }
    }
    f()
}

/// Columns of a panel, as in `panels`.
const PANEL: usize = super::panels::PANEL;

/// `sums[r][j] = Σ rows[r][i] * b[i][j]`, where `b` is the blocks, each `[.., PANEL]`, one below
/// another; every sum is one chain of fused multiply-adds, on every processor.
///
/// Panics when a row is shorter than the blocks are deep together.
pub(crate) fn tile<'a, const N: usize>(
    rows: [&[f32]; N],
    blocks: impl Iterator<Item = &'a [f32]>,
) -> [[f32; PANEL]; N] {
    #[cfg(target_arch = "x86_64")]
    {
        if is_x86_feature_detected!("avx512f") {
            // SAFETY: the feature was just detected.
            return unsafe { tile_v4(rows, blocks) };
        }
    }
    tile_plain(rows, blocks)
}

fn tile_plain<'a, const N: usize>(
    rows: [&[f32]; N],
    blocks: impl Iterator<Item = &'a [f32]>,
) -> [[f32; PANEL]; N] {
    let mut sums = [[0f32; PANEL]; N];
    let mut at = 0;
    for block in blocks {
        let block = block.as_chunks::<PANEL>().0;
        // Row by row: sums of one row fit the registers of any processor.
        for (sums, row) in sums.iter_mut().zip(rows) {
            let row = &row[at..at + block.len()];
            wide(
                #[inline(always)]
                || {
                    for (a, b) in row.iter().zip(block) {
                        for (sum, b) in sums.iter_mut().zip(b) {
                            *sum = a.mul_add(*b, *sum);
                        }
                    }
                },
            );
        }
        at += block.len();
    }
    sums
}

// Vectors are made from arrays by value: loads through pointers are checked in builds with
// assertions, at every step of the innermost loop.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
fn tile_v4<'a, const N: usize>(
    rows: [&[f32]; N],
    blocks: impl Iterator<Item = &'a [f32]>,
) -> [[f32; PANEL]; N] {
    use std::arch::x86_64::{__m512, _mm512_fmadd_ps, _mm512_set1_ps, _mm512_setzero_ps};
    let mut sums = [[_mm512_setzero_ps(); 2]; N];
    let mut at = 0;
    for block in blocks {
        let block = block.as_chunks::<PANEL>().0;
        let mut cut = rows;
        for row in &mut cut {
            *row = &row[at..at + block.len()];
        }
        for (i, b) in block.iter().enumerate() {
            // SAFETY: 32 numbers are two vectors of 16, and any bits are numbers.
            let [low, high] = unsafe { std::mem::transmute::<[f32; PANEL], [__m512; 2]>(*b) };
            for (sums, row) in sums.iter_mut().zip(cut) {
                let a = _mm512_set1_ps(row[i]);
                sums[0] = _mm512_fmadd_ps(a, low, sums[0]);
                sums[1] = _mm512_fmadd_ps(a, high, sums[1]);
            }
        }
        at += block.len();
    }
    let mut out = [[0f32; PANEL]; N];
    for (out, sums) in out.iter_mut().zip(sums) {
        // SAFETY: as above.
        *out = unsafe { std::mem::transmute::<[__m512; 2], [f32; PANEL]>(sums) };
    }
    out
}

/// Products of `N` rows of unsigned bytes with a panel of signed ones, summed exactly.
///
/// `panel` is `[k / 4, PANEL, 4]`: four consecutive inner indices of a column lie side by side.
///
/// Panics when a row is not as long as the panel is deep.
pub(super) fn byte_tile<const N: usize>(rows: [&[u8]; N], panel: &[i8]) -> [[i32; PANEL]; N] {
    let depth = panel.len() / PANEL;
    assert!(depth.is_multiple_of(4), "a panel of bytes has depth 4 i");
    assert!(rows.iter().all(|row| row.len() == depth), "rows of {depth}");
    #[cfg(target_arch = "x86_64")]
    {
        if is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512vnni") {
            // SAFETY: the two features were just detected.
            return unsafe { byte_tile_vnni(rows, panel) };
        }
    }
    byte_tile_plain(rows, panel)
}

fn byte_tile_plain<const N: usize>(rows: [&[u8]; N], panel: &[i8]) -> [[i32; PANEL]; N] {
    let mut sums = [[0i32; PANEL]; N];
    wide(
        #[inline(always)]
        || {
            for (i, group) in panel.as_chunks::<{ 4 * PANEL }>().0.iter().enumerate() {
                for (sums, row) in sums.iter_mut().zip(rows) {
                    let x = [0, 1, 2, 3].map(|t| i32::from(row[4 * i + t]));
                    for (sum, w) in sums.iter_mut().zip(group.as_chunks::<4>().0) {
                        let w = w.map(i32::from);
                        *sum += x[0] * w[0] + x[1] * w[1] + x[2] * w[2] + x[3] * w[3];
                    }
                }
            }
        },
    );
    sums
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512vnni")]
fn byte_tile_vnni<const N: usize>(rows: [&[u8]; N], panel: &[i8]) -> [[i32; PANEL]; N] {
    use std::arch::x86_64::{
        __m512i, _mm512_dpbusd_epi32, _mm512_set1_epi32, _mm512_setzero_si512,
    };
    let (groups, _) = panel.as_chunks::<{ 4 * PANEL }>();
    let mut cut = [&[][..]; N];
    for (cut, row) in cut.iter_mut().zip(rows) {
        *cut = &row.as_chunks::<4>().0[..groups.len()];
    }
    let mut sums = [[_mm512_setzero_si512(); 2]; N];
    for (i, group) in groups.iter().enumerate() {
        // SAFETY: 128 bytes are two vectors of 64, and any bits are bytes.
        let [low, high] = unsafe { std::mem::transmute::<[i8; 4 * PANEL], [__m512i; 2]>(*group) };
        for (sums, row) in sums.iter_mut().zip(cut) {
            let x = _mm512_set1_epi32(i32::from_ne_bytes(row[i]));
            sums[0] = _mm512_dpbusd_epi32(sums[0], x, low);
            sums[1] = _mm512_dpbusd_epi32(sums[1], x, high);
        }
    }
    let mut out = [[0i32; PANEL]; N];
    for (out, sums) in out.iter_mut().zip(sums) {
        // SAFETY: two vectors are 32 integers.
        *out = unsafe { std::mem::transmute::<[__m512i; 2], [i32; PANEL]>(sums) };
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_are_summed_exactly() {
        let depth = 44;
        let panel: Vec<i8> = (0..depth * PANEL).map(|i| (i * 37 % 255) as i8).collect();
        let rows: Vec<u8> = (0..4 * depth).map(|i| (i * 91 % 256) as u8).collect();
        let rows: [&[u8]; 4] = std::array::from_fn(|r| &rows[r * depth..][..depth]);
        let sums = byte_tile(rows, &panel);
        assert_eq!(sums, byte_tile_plain(rows, &panel));
        let at = |k: usize, j: usize| i32::from(panel[(k / 4 * PANEL + j) * 4 + k % 4]);
        let slow = (0..depth).map(|k| i32::from(rows[3][k]) * at(k, 7));
        assert_eq!(sums[3][7], slow.sum::<i32>());
    }

    #[test]
    fn tiles_have_the_same_bits_on_every_processor() {
        let number = |i: usize| (i * 7919 % 1013) as f32 / 500.0 - 1.0;
        let rows: Vec<f32> = (0..4 * 50).map(number).collect();
        let rows: [&[f32]; 4] = std::array::from_fn(|r| &rows[r * 50..][..50]);
        let b: Vec<f32> = (0..50 * PANEL).map(number).collect();
        let blocks = || [&b[..20 * PANEL], &b[20 * PANEL..]].into_iter();
        let sums = tile(rows, blocks());
        assert_eq!(sums, tile_plain(rows, blocks()));
        let slow = (0..50).fold(0f32, |sum, i| rows[2][i].mul_add(b[i * PANEL + 9], sum));
        assert_eq!(sums[2][9], slow);
    }

    #[test]
    fn products_of_strided_and_transposed_views() {
        // lhs is columns 1..3 of a [2, 4] matrix, rhs a [3, 2] matrix read transposed.
        let a = [0., 1., 2., 0., 0., 3., 4., 0.];
        let b = [1., 10., 2., 20., 3., 30.];
        let mut c = vec![1.0; 6];
        let lhs = Mat::strided(&a[1..], 2, 2, 4);
        let rhs = Mat::new(&b, 3, 2).t();
        for threads in [Threads::One, Threads::Pool] {
            let dst = MatMut::new(&mut c, 2, 3);
            gemm(dst, Store::Replace, 1.0, lhs, rhs, threads);
            assert_eq!(c, [21., 42., 63., 43., 86., 129.]);
        }
        let dst = MatMut::new(&mut c, 2, 3);
        gemm(dst, Store::Add, -1.0, lhs, rhs, Threads::One);
        assert_eq!(c, [0.0; 6]);
    }

    #[test]
    #[should_panic(expected = "matrix of 7 elements over 6")]
    fn a_short_slice_is_refused() {
        Mat::strided(&[0.0; 6], 2, 2, 5);
    }
}
