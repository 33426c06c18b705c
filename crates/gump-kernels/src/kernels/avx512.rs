//! Vectors of 512 bits: Intel since Skylake-X, AMD since Zen 4.
//!
//! Vectors are made from arrays by value: loads through pointers are checked in builds with
//! assertions, at every step of the innermost loop.
#![allow(
    unsafe_code,
    reason = "code compiled for optional processor features may only be called after checking for them, which `detect` does; arrays and vectors of one size are the same bits"
)]

use std::arch::x86_64::{
    __m512, __m512i, _mm512_dpbusd_epi32, _mm512_fmadd_ps, _mm512_set1_epi32, _mm512_set1_ps,
    _mm512_setzero_ps, _mm512_setzero_si512,
};
use std::mem::transmute;

use super::avx2::Avx2;
use crate::panels::PANEL;

/// Proof that the processor has the instructions.
#[derive(Clone, Copy, Debug)]
pub(super) struct Avx512(Avx2);

impl Avx512 {
    #[inline(always)]
    pub(super) fn detect() -> Option<Self> {
        let is_there = is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx512bw")
            && is_x86_feature_detected!("avx512dq")
            && is_x86_feature_detected!("avx512vl");
        if is_there {
            Avx2::detect().map(Self)
        } else {
            None
        }
    }

    /// Runs `f` compiled for these vectors.
    #[inline(always)]
    pub(super) fn run<R>(self, f: impl FnOnce() -> R) -> R {
        #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
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
        // SAFETY: the value proves the feature.
        unsafe { tile(rows, blocks) }
    }

    /// As [`super::byte_tile`].
    pub(super) fn byte_tile<const N: usize>(
        self,
        rows: [&[u8]; N],
        panel: &[i8],
    ) -> [[i32; PANEL]; N] {
        if is_x86_feature_detected!("avx512vnni") {
            // SAFETY: the feature was just detected, the value proves the other.
            return unsafe { byte_tile(rows, panel) };
        }
        self.0.byte_tile(rows, panel)
    }
}

#[target_feature(enable = "avx512f")]
fn tile<'a, const N: usize>(
    rows: [&[f32]; N],
    blocks: impl Iterator<Item = &'a [f32]>,
) -> [[f32; PANEL]; N] {
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
            let [low, high] = unsafe { transmute::<[f32; PANEL], [__m512; 2]>(*b) };
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
        *out = unsafe { transmute::<[__m512; 2], [f32; PANEL]>(sums) };
    }
    out
}

#[target_feature(enable = "avx512f,avx512vnni")]
fn byte_tile<const N: usize>(rows: [&[u8]; N], panel: &[i8]) -> [[i32; PANEL]; N] {
    let (groups, _) = panel.as_chunks::<{ 4 * PANEL }>();
    let mut cut = [&[][..]; N];
    for (cut, row) in cut.iter_mut().zip(rows) {
        *cut = &row.as_chunks::<4>().0[..groups.len()];
    }
    let mut sums = [[_mm512_setzero_si512(); 2]; N];
    for (i, group) in groups.iter().enumerate() {
        // SAFETY: 128 bytes are two vectors of 64, and any bits are bytes.
        let [low, high] = unsafe { transmute::<[i8; 4 * PANEL], [__m512i; 2]>(*group) };
        for (sums, row) in sums.iter_mut().zip(cut) {
            let x = _mm512_set1_epi32(i32::from_ne_bytes(row[i]));
            sums[0] = _mm512_dpbusd_epi32(sums[0], x, low);
            sums[1] = _mm512_dpbusd_epi32(sums[1], x, high);
        }
    }
    let mut out = [[0i32; PANEL]; N];
    for (out, sums) in out.iter_mut().zip(sums) {
        // SAFETY: two vectors are 32 integers.
        *out = unsafe { transmute::<[__m512i; 2], [i32; PANEL]>(sums) };
    }
    out
}
