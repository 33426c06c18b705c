//! Sums of products in portable code; the reference that the other kernels are tested against.

use crate::panels::PANEL;

/// As [`super::tile`].
pub(super) fn tile<'a, const N: usize>(
    rows: [&[f32]; N],
    blocks: impl Iterator<Item = &'a [f32]>,
) -> [[f32; PANEL]; N] {
    let mut sums = [[0f32; PANEL]; N];
    let mut at = 0;
    for block in blocks {
        let block = block.as_chunks::<PANEL>().0;
        for (sums, row) in sums.iter_mut().zip(rows) {
            row_times(&row[at..at + block.len()], block, sums);
        }
        at += block.len();
    }
    sums
}

/// Row by row: sums of one row fit the registers of any processor.
#[inline(always)]
pub(super) fn row_times(row: &[f32], block: &[[f32; PANEL]], sums: &mut [f32; PANEL]) {
    for (a, b) in row.iter().zip(block) {
        for (sum, b) in sums.iter_mut().zip(b) {
            *sum = times_plus(*a, *b, *sum);
        }
    }
}

/// `a * b + c`, rounded once; in WebAssembly, which has no such instruction and would call a function
/// for each, rounded twice.
#[inline(always)]
fn times_plus(a: f32, b: f32, c: f32) -> f32 {
    if cfg!(target_arch = "wasm32") {
        a * b + c
    } else {
        a.mul_add(b, c)
    }
}

/// As [`super::byte_tile`].
pub(super) fn byte_tile<const N: usize>(rows: [&[u8]; N], panel: &[i8]) -> [[i32; PANEL]; N] {
    let mut sums = [[0i32; PANEL]; N];
    for (i, group) in panel.as_chunks::<{ 4 * PANEL }>().0.iter().enumerate() {
        for (sums, row) in sums.iter_mut().zip(rows) {
            let x = [0, 1, 2, 3].map(|t| i32::from(row[4 * i + t]));
            for (sum, w) in sums.iter_mut().zip(group.as_chunks::<4>().0) {
                let w = w.map(i32::from);
                *sum += x[0] * w[0] + x[1] * w[1] + x[2] * w[2] + x[3] * w[3];
            }
        }
    }
    sums
}
