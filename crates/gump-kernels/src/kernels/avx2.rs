//! Vectors of 256 bits: Intel since Haswell, AMD since Zen.
#![allow(
    unsafe_code,
    reason = "code compiled for optional processor features may only be called after checking for them, which `detect` does; arrays and vectors of one size are the same bits"
)]

use std::arch::x86_64::{
    __m256i, _mm256_add_epi32, _mm256_and_si256, _mm256_madd_epi16, _mm256_set1_epi16,
    _mm256_set1_epi32, _mm256_setzero_si256, _mm256_slli_epi16, _mm256_srai_epi16,
    _mm256_srli_epi16,
};
use std::mem::transmute;

use super::portable;
use crate::panels::PANEL;

/// Proof that the processor has the instructions.
#[derive(Clone, Copy, Debug)]
pub(super) struct Avx2(());

impl Avx2 {
    #[inline(always)]
    pub(super) fn detect() -> Option<Self> {
        let is_there = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
        is_there.then_some(Self(()))
    }

    /// Runs `f` compiled for these vectors.
    #[inline(always)]
    pub(super) fn run<R>(self, f: impl FnOnce() -> R) -> R {
        #[target_feature(enable = "avx2,fma")]
        fn widely<R>(f: impl FnOnce() -> R) -> R {
            f()
        }
        // SAFETY: the value proves the features.
        unsafe { widely(f) }
    }

    /// As [`super::tile`].
    pub(super) fn tile<'a, const N: usize>(
        self,
        rows: [&[f32]; N],
        blocks: impl Iterator<Item = &'a [f32]>,
    ) -> [[f32; PANEL]; N] {
        let mut sums = [[0f32; PANEL]; N];
        let mut at = 0;
        for block in blocks {
            let block = block.as_chunks::<PANEL>().0;
            let cut = rows.map(|row| &row[at..at + block.len()]);
            self.run(
                #[inline(always)]
                || {
                    // Two rows have eight vectors of sums: as many as two units need in flight.
                    let (twos, one) = sums.as_chunks_mut::<2>();
                    let (row_twos, row_one) = cut.as_chunks::<2>();
                    for ([low, high], [a, b]) in twos.iter_mut().zip(row_twos) {
                        let (mut x, mut y) = (*low, *high);
                        for ((a, b), w) in a.iter().zip(*b).zip(block) {
                            for (((x, y), w), _) in x.iter_mut().zip(&mut y).zip(w).zip(0..PANEL) {
                                *x = a.mul_add(*w, *x);
                                *y = b.mul_add(*w, *y);
                            }
                        }
                        (*low, *high) = (x, y);
                    }
                    for (sums, row) in one.iter_mut().zip(row_one) {
                        portable::row_times(row, block, sums);
                    }
                },
            );
            at += block.len();
        }
        sums
    }

    /// As [`super::byte_tile`].
    pub(super) fn byte_tile<const N: usize>(
        self,
        rows: [&[u8]; N],
        panel: &[i8],
    ) -> [[i32; PANEL]; N] {
        // SAFETY: the value proves the features.
        unsafe { byte_tile(rows, panel) }
    }
}

/// The instruction that multiplies bytes saturates sums of two, so bytes become 16 bits first:
/// those in even places, then those in odd ones.
#[target_feature(enable = "avx2")]
fn byte_tile<const N: usize>(rows: [&[u8]; N], panel: &[i8]) -> [[i32; PANEL]; N] {
    const VECTORS: usize = PANEL / 8;
    let (groups, _) = panel.as_chunks::<{ 4 * PANEL }>();
    let low = _mm256_set1_epi16(0xff);
    let mut sums = [[_mm256_setzero_si256(); VECTORS]; N];
    for (i, group) in groups.iter().enumerate() {
        // SAFETY: 128 bytes are four vectors of 32, and any bits are bytes.
        let group = unsafe { transmute::<[i8; 4 * PANEL], [__m256i; VECTORS]>(*group) };
        let mut even = group;
        let mut odd = group;
        for (even, odd) in even.iter_mut().zip(&mut odd) {
            *even = _mm256_srai_epi16::<8>(_mm256_slli_epi16::<8>(*even));
            *odd = _mm256_srai_epi16::<8>(*odd);
        }
        for (sums, row) in sums.iter_mut().zip(rows) {
            let four = row.as_chunks::<4>().0[i];
            let x = _mm256_set1_epi32(i32::from_ne_bytes(four));
            let (x_even, x_odd) = (_mm256_and_si256(x, low), _mm256_srli_epi16::<8>(x));
            for (sum, (even, odd)) in sums.iter_mut().zip(even.iter().zip(&odd)) {
                let both = _mm256_add_epi32(
                    _mm256_madd_epi16(x_even, *even),
                    _mm256_madd_epi16(x_odd, *odd),
                );
                *sum = _mm256_add_epi32(*sum, both);
            }
        }
    }
    let mut out = [[0i32; PANEL]; N];
    for (out, sums) in out.iter_mut().zip(sums) {
        // SAFETY: four vectors are 32 integers.
        *out = unsafe { transmute::<[__m256i; VECTORS], [i32; PANEL]>(sums) };
    }
    out
}
