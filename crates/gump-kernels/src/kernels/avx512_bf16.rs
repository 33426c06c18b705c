//! Pairs of bfloat16 multiplied by `VDPBF16PS`: AMD since Zen 4, Intel since Cooper Lake.
//!
//! A block is 8 rows of the left matrix, `[pairs, 8]`; 16 sums in flight hide how long an
//! instruction takes, and both units that have it stay busy. Rounding is to the nearest, ties to
//! even; numbers too small for a normal bfloat16 are 0, as the instructions have it.
//!
//! Vectors are made from arrays by value: loads through pointers are checked in builds with
//! assertions, at every step of the innermost loop.
#![allow(
    unsafe_code,
    reason = "code compiled for optional processor features may only be called after checking for them, which `detect` does, once; arrays and vectors of one size are the same bits"
)]

use std::arch::x86_64::{
    __m512, __m512bh, __m512i, _mm512_cvtne2ps_pbh, _mm512_dpbf16_ps, _mm512_fmadd_ps,
    _mm512_mul_ps, _mm512_permutexvar_epi16, _mm512_set1_epi32, _mm512_set1_ps, _mm512_setzero_ps,
    _mm512_setzero_si512, _mm512_shuffle_i32x4, _mm512_unpackhi_epi32, _mm512_unpackhi_epi64,
    _mm512_unpacklo_epi32, _mm512_unpacklo_epi64,
};
use std::mem::transmute;

use super::bf16::{Lanes, Target, Unit};
use crate::gemm::Store;
use crate::panels::PANEL;
use crate::rows::{max, sum};

/// Rows of a block.
const BLOCK: usize = 8;

/// Lanes turned at a time: a vector of 512 bits.
const GROUP: usize = 16;

/// Proof that the processor has the instructions.
#[derive(Clone, Copy, Debug)]
pub(super) struct Avx512Bf16(());

impl Avx512Bf16 {
    pub(super) fn detect() -> Option<Self> {
        let is_there = is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx512bw")
            && is_x86_feature_detected!("avx512bf16");
        is_there.then_some(Self(()))
    }

    /// Packs panels of so many pairs, at least those of the depth.
    pub(super) fn pack_panels(self, from: Lanes<'_>, pairs: usize, panels: &mut [u32]) {
        // SAFETY: the value proves the features.
        unsafe { pack::<PANEL>(from, pairs, panels.as_chunks_mut().0) }
    }

    /// Packs lanes as `[lanes / 32, pairs / 16, 2, 16, 16]`: 16 lanes, each of 16 pairs, are a tile.
    pub(super) fn pack_tiles(self, from: Lanes<'_>, pairs: usize, tiles: &mut [u32]) {
        let (tiles, _) = tiles.as_chunks_mut::<{ GROUP * GROUP }>();
        let steps = pairs / GROUP;
        let groups = tiles.len() / steps.max(1);
        for i in 0..tiles.len() {
            // All lanes of a step before the next step: numbers are read side by side where the
            // lanes lie side by side.
            let (step, lane) = (i / groups, i % groups);
            // SAFETY: the value proves the features.
            let lanes = unsafe { rows_of_pairs(from, lane * GROUP, step * GROUP) };
            let tile = (lane / 2 * steps + step) * 2 + lane % 2;
            // SAFETY: 16 vectors are 256 pairs.
            tiles[tile] = unsafe { transmute::<[__m512i; GROUP], [u32; GROUP * GROUP]>(lanes) };
        }
    }
}

impl Avx512Bf16 {
    /// Packs `e^(score - the largest)` of a row as a row of tiles, `first` being where it begins in
    /// those of [`Self::pack_tiles`]; zeros after the last. Returns the sum before rounding.
    pub(super) fn pack_exponentials(self, scores: &[f32], first: usize, tiles: &mut [u32]) -> f32 {
        // SAFETY: the value proves the features.
        unsafe { exponentials_of_row(scores, first, tiles) }
    }
}

impl Unit for Avx512Bf16 {
    const ROWS: usize = BLOCK;

    fn pairs(depth: usize) -> usize {
        depth.div_ceil(2)
    }

    fn pack_left(self, from: Lanes<'_>, blocks: &mut [u32]) {
        // SAFETY: the value proves the features.
        unsafe { pack::<BLOCK>(from, Self::pairs(from.depth), blocks.as_chunks_mut().0) }
    }

    fn pack_right(self, from: Lanes<'_>, panels: &mut [u32]) {
        self.pack_panels(from, Self::pairs(from.depth), panels);
    }

    fn multiply(self, block: &[u32], panel: &[u32], to: &mut Target<'_>) {
        let (block, panel) = (block.as_chunks().0, panel.as_chunks().0);
        // SAFETY: as above.
        unsafe {
            match to.rows {
                1 => tile::<1>(block, panel, to),
                2 => tile::<2>(block, panel, to),
                3 => tile::<3>(block, panel, to),
                4 => tile::<4>(block, panel, to),
                5 => tile::<5>(block, panel, to),
                6 => tile::<6>(block, panel, to),
                7 => tile::<7>(block, panel, to),
                _ => tile::<8>(block, panel, to),
            }
        }
    }
}

/// The first `N` rows of a block times a panel.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
fn tile<const N: usize>(block: &[[u32; BLOCK]], panel: &[[u32; PANEL]], to: &mut Target<'_>) {
    let mut sums = [[_mm512_setzero_ps(); 2]; N];
    for (left, right) in block.iter().zip(panel) {
        // SAFETY: 32 pairs are two vectors of 16, and any bits are numbers.
        let [low, high] = unsafe { transmute::<[u32; PANEL], [__m512bh; 2]>(*right) };
        for (sums, left) in sums.iter_mut().zip(left) {
            let left = _mm512_set1_epi32(left.cast_signed());
            // SAFETY: both are 512 bits.
            let left = unsafe { transmute::<__m512i, __m512bh>(left) };
            sums[0] = _mm512_dpbf16_ps(sums[0], left, low);
            sums[1] = _mm512_dpbf16_ps(sums[1], left, high);
        }
    }
    for (r, sums) in sums.into_iter().enumerate() {
        store_row(to, r, sums);
    }
}

/// Takes the rows of a product that the target has into it.
#[target_feature(enable = "avx512f")]
pub(super) fn store_rows(to: &mut Target<'_>, sums: &[[f32; PANEL]]) {
    for (r, sums) in sums.iter().enumerate().take(to.rows) {
        // SAFETY: 32 numbers are two vectors.
        store_row(to, r, unsafe {
            transmute::<[f32; PANEL], [__m512; 2]>(*sums)
        });
    }
}

/// Takes row `r` of a product into its target.
#[target_feature(enable = "avx512f")]
#[inline]
fn store_row(to: &mut Target<'_>, r: usize, sums: [__m512; 2]) {
    if to.columns < PANEL {
        // SAFETY: two vectors are 32 numbers.
        return to.take_in(r, &unsafe { transmute::<[__m512; 2], [f32; PANEL]>(sums) });
    }
    let row = to.data[r * to.stride..].first_chunk_mut::<PANEL>();
    let row = row.expect("a row of the target is as wide as its columns");
    let scale = _mm512_set1_ps(to.scale);
    let scaled = match to.store {
        Store::Replace => [_mm512_mul_ps(sums[0], scale), _mm512_mul_ps(sums[1], scale)],
        Store::Add => {
            // SAFETY: as above.
            let [low, high] = unsafe { transmute::<[f32; PANEL], [__m512; 2]>(*row) };
            [
                _mm512_fmadd_ps(sums[0], scale, low),
                _mm512_fmadd_ps(sums[1], scale, high),
            ]
        }
    };
    // SAFETY: as above.
    *row = unsafe { transmute::<[__m512; 2], [f32; PANEL]>(scaled) };
}

/// Packs lanes as `[lanes / W, pairs, W]`.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
fn pack<const W: usize>(from: Lanes<'_>, pairs: usize, out: &mut [[u32; W]]) {
    // A last group of 16 may leave panels of 32 half written.
    if W > GROUP && !from.lanes.is_multiple_of(W) && from.lanes % W <= GROUP {
        let last = out.len() - pairs;
        out[last..].fill([0; W]);
    }
    if from.lane_stride == 1 {
        pack_across(from, pairs, out);
    } else {
        pack_along(from, pairs, out);
    }
}

/// Pairs of a group of lanes, as far as there are such lanes, at one inner index of `out`.
#[inline(always)]
fn put<const W: usize>(
    out: &mut [[u32; W]],
    pairs: usize,
    lane: usize,
    p: usize,
    group: &[u32; GROUP],
) {
    if W >= GROUP {
        out[lane / W * pairs + p][lane % W..][..GROUP].copy_from_slice(group);
    } else {
        for (i, part) in group.as_chunks::<W>().0.iter().enumerate() {
            if let Some(out) = out.get_mut((lane / W + i) * pairs + p) {
                *out = *part;
            }
        }
    }
}

/// Lanes side by side: two rows make the pairs of all their lanes.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
fn pack_across<const W: usize>(from: Lanes<'_>, pairs: usize, out: &mut [[u32; W]]) {
    /// Pairs written one after another, before the next lanes: whole cache lines.
    const RUN: usize = 8;
    let groups = from.lanes / GROUP;
    for run in (0..pairs).step_by(RUN) {
        let here = RUN.min(pairs - run);
        if 2 * (run + RUN) > from.depth {
            for (lane, p) in (0..from.lanes)
                .step_by(GROUP)
                .flat_map(|l| (0..here).map(move |p| (l, p)))
            {
                put(
                    out,
                    pairs,
                    lane,
                    run + p,
                    &pairs_across(from, lane, run + p),
                );
            }
            continue;
        }
        let rows: [&[[f32; GROUP]]; 2 * RUN] = std::array::from_fn(|i| {
            let row = &from.data[(2 * run + i) * from.depth_stride..];
            &row.as_chunks().0[..groups]
        });
        for group in 0..groups {
            for (p, row) in rows.as_chunks::<2>().0.iter().enumerate() {
                let both = interleave(&row[0][group], &row[1][group]);
                put(out, pairs, group * GROUP, run + p, &both);
            }
        }
        if groups * GROUP < from.lanes {
            for p in run..run + RUN {
                let lane = groups * GROUP;
                put(out, pairs, lane, p, &pairs_across(from, lane, p));
            }
        }
    }
}

/// A pair of each of 16 lanes that lie side by side; zeros beyond their number and depth.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
fn pairs_across(from: Lanes<'_>, lane: usize, p: usize) -> [u32; GROUP] {
    let lanes = GROUP.min(from.lanes.saturating_sub(lane));
    let row = |i: usize| {
        let is_there = i < from.depth && lanes > 0;
        let start = i * from.depth_stride + lane;
        if is_there {
            &from.data[start..][..lanes]
        } else {
            &[]
        }
    };
    let (even, odd) = (row(2 * p), row(2 * p + 1));
    match (even.first_chunk(), odd.first_chunk()) {
        (Some(even), Some(odd)) => interleave(even, odd),
        _ => interleave(&padded(even), &padded(odd)),
    }
}

#[inline(always)]
fn padded<const N: usize>(numbers: &[f32]) -> [f32; N] {
    let mut padded = [0.0; N];
    padded[..numbers.len()].copy_from_slice(numbers);
    padded
}

/// Rounds two rows and lays them together, number by number.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
#[inline]
fn interleave(even: &[f32; GROUP], odd: &[f32; GROUP]) -> [u32; GROUP] {
    // 0, 16, 1, 17, ...: the even row's numbers come first.
    const ORDER: [u16; 32] = {
        let mut order = [0; 32];
        let mut i = 0;
        while i < 16 {
            order[2 * i] = i as u16;
            order[2 * i + 1] = 16 + i as u16;
            i += 1;
        }
        order
    };
    // SAFETY: all of these are 512 bits.
    unsafe {
        let both = _mm512_cvtne2ps_pbh(
            transmute::<[f32; 16], __m512>(*odd),
            transmute::<[f32; 16], __m512>(*even),
        );
        let order = transmute::<[u16; 32], __m512i>(ORDER);
        let pairs = _mm512_permutexvar_epi16(order, transmute::<__m512bh, __m512i>(both));
        transmute::<__m512i, [u32; GROUP]>(pairs)
    }
}

/// Inner index side by side, or any strides: 16 lanes are turned at a time.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
fn pack_along<const W: usize>(from: Lanes<'_>, pairs: usize, out: &mut [[u32; W]]) {
    for lane in (0..from.lanes).step_by(GROUP) {
        for p in (0..pairs).step_by(GROUP) {
            let turned = turn(rows_along(from, lane, p));
            // SAFETY: a vector is 16 pairs.
            let turned = unsafe { transmute::<[__m512i; GROUP], [[u32; GROUP]; GROUP]>(turned) };
            for (i, group) in turned.iter().take(pairs - p).enumerate() {
                put(out, pairs, lane, p + i, group);
            }
        }
    }
}

/// 16 pairs of each of 16 lanes, lane by lane; zeros beyond their number and depth.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
fn rows_of_pairs(from: Lanes<'_>, lane: usize, p: usize) -> [__m512i; GROUP] {
    if from.lane_stride != 1 {
        return rows_along(from, lane, p);
    }
    let mut columns = [_mm512_setzero_si512(); GROUP];
    if lane + GROUP <= from.lanes && 2 * (p + GROUP) <= from.depth {
        let block = &from.data[2 * p * from.depth_stride + lane..];
        let mut rows = block.chunks(from.depth_stride);
        let mut row = || rows.next().and_then(<[f32]>::first_chunk);
        for column in &mut columns {
            let (even, odd) = (row(), row());
            let (even, odd) = even.zip(odd).expect("the depth is there");
            // SAFETY: 16 pairs are a vector.
            *column = unsafe { transmute::<[u32; GROUP], __m512i>(interleave(even, odd)) };
        }
        return turn(columns);
    }
    for (i, column) in columns.iter_mut().enumerate() {
        // SAFETY: 16 pairs are a vector.
        *column = unsafe { transmute::<[u32; GROUP], __m512i>(pairs_across(from, lane, p + i)) };
    }
    turn(columns)
}

/// [`rows_of_pairs`] of lanes whose inner index lies side by side, or in any strides.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
#[inline]
fn rows_along(from: Lanes<'_>, lane: usize, p: usize) -> [__m512i; GROUP] {
    let lanes = GROUP.min(from.lanes.saturating_sub(lane));
    let depth = (2 * GROUP).min(from.depth.saturating_sub(2 * p));
    let mut rows = [_mm512_setzero_si512(); GROUP];
    if depth == 0 {
        return rows;
    }
    if lanes == GROUP && depth == 2 * GROUP && from.depth_stride == 1 {
        let block = &from.data[lane * from.lane_stride + 2 * p..];
        for (row, numbers) in rows.iter_mut().zip(block.chunks(from.lane_stride)) {
            let numbers = numbers.first_chunk().expect("the depth is there");
            *row = rounded(numbers);
        }
        return rows;
    }
    for (r, row) in rows.iter_mut().enumerate().take(lanes) {
        let start = (lane + r) * from.lane_stride + 2 * p * from.depth_stride;
        let numbers: [f32; 2 * GROUP] = if from.depth_stride != 1 {
            let mut numbers = [0.0; 2 * GROUP];
            let source = from.data[start..].iter().step_by(from.depth_stride);
            for (number, source) in numbers.iter_mut().zip(source.take(depth)) {
                *number = *source;
            }
            numbers
        } else if depth == 2 * GROUP {
            let numbers = from.data[start..].first_chunk();
            *numbers.expect("the depth is there")
        } else {
            padded(&from.data[start..][..depth])
        };
        *row = rounded(&numbers);
    }
    rows
}

/// Numbers side by side as pairs.
#[target_feature(enable = "avx512f,avx512bf16")]
#[inline]
fn rounded(numbers: &[f32; 2 * GROUP]) -> __m512i {
    // SAFETY: 32 numbers are two vectors, 32 bfloat16 are one.
    unsafe {
        let [low, high] = transmute::<[f32; 2 * GROUP], [__m512; 2]>(*numbers);
        transmute::<__m512bh, __m512i>(_mm512_cvtne2ps_pbh(high, low))
    }
}

/// As [`Avx512Bf16::pack_exponentials`].
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
fn exponentials_of_row(scores: &[f32], first: usize, tiles: &mut [u32]) -> f32 {
    /// Pairs from a row in a step to the same row in the next.
    const STEP: usize = 2 * GROUP * GROUP;
    let peak = max(scores);
    let mut lanes = [0.0; 2 * GROUP];
    let mut pack = |scores: &[f32; 2 * GROUP]| {
        let mut weights = *scores;
        for (weight, lane) in weights.iter_mut().zip(&mut lanes) {
            *weight = exp(*weight - peak);
            *lane += *weight;
        }
        // SAFETY: 16 pairs are a vector.
        unsafe { transmute::<__m512i, [u32; GROUP]>(rounded(&weights)) }
    };
    let (whole, rest) = scores.as_chunks();
    let mut rows = tiles[first..].chunks_mut(STEP);
    let mut next = || rows.next().and_then(<[u32]>::first_chunk_mut);
    for scores in whole {
        *next().expect("as many steps as scores") = pack(scores);
    }
    if !rest.is_empty() {
        // What is not there has the weight 0.
        let mut last = [f32::NEG_INFINITY; 2 * GROUP];
        last[..rest.len()].copy_from_slice(rest);
        *next().expect("as many steps as scores") = pack(&last);
    }
    while let Some(row) = next() {
        *row = [0; GROUP];
    }
    sum(&lanes)
}

/// `e^x` of 0 and less, to a fiftieth of the last place of a bfloat16; 0 below -87.
#[inline(always)]
fn exp(x: f32) -> f32 {
    // As in `rows::exp`, with fewer terms and with multiply-adds.
    const ROUND: f32 = 12_582_912.0;
    let shifted = x.max(-127.0).mul_add(std::f32::consts::LOG2_E, ROUND);
    let n = shifted - ROUND;
    let r = n.mul_add(-std::f32::consts::LN_2, x);
    let mut p = 1.0f32 / 24.0;
    p = p.mul_add(r, 1.0 / 6.0);
    p = p.mul_add(r, 0.5);
    p = p.mul_add(r, 1.0);
    p = p.mul_add(r, 1.0);
    let exponent = shifted.to_bits().wrapping_sub(ROUND.to_bits()) << 23;
    let power = f32::from_bits(p.to_bits().wrapping_add(exponent));
    if x > -87.0 { power } else { 0.0 }
}

/// The transpose of 16 by 16 pairs.
#[target_feature(enable = "avx512f")]
#[inline]
fn turn(rows: [__m512i; 16]) -> [__m512i; 16] {
    // Two rows, then four, within each quarter of a vector.
    let mut twos = rows;
    for i in (0..16).step_by(2) {
        twos[i] = _mm512_unpacklo_epi32(rows[i], rows[i + 1]);
        twos[i + 1] = _mm512_unpackhi_epi32(rows[i], rows[i + 1]);
    }
    let mut fours = twos;
    for i in (0..16).step_by(4) {
        fours[i] = _mm512_unpacklo_epi64(twos[i], twos[i + 2]);
        fours[i + 1] = _mm512_unpackhi_epi64(twos[i], twos[i + 2]);
        fours[i + 2] = _mm512_unpacklo_epi64(twos[i + 1], twos[i + 3]);
        fours[i + 3] = _mm512_unpackhi_epi64(twos[i + 1], twos[i + 3]);
    }
    // Now quarter l of `fours[4 g + j]` is column 4 l + j of rows 4 g to 4 g + 3: quarters move.
    const EVEN: i32 = 0b10_00_10_00;
    const ODD: i32 = 0b11_01_11_01;
    let mut columns = fours;
    for j in 0..4 {
        let [a, b, c, d] = [fours[j], fours[4 + j], fours[8 + j], fours[12 + j]];
        let [ab, cd] = [
            _mm512_shuffle_i32x4::<EVEN>(a, b),
            _mm512_shuffle_i32x4::<EVEN>(c, d),
        ];
        columns[j] = _mm512_shuffle_i32x4::<EVEN>(ab, cd);
        columns[8 + j] = _mm512_shuffle_i32x4::<ODD>(ab, cd);
        let [ab, cd] = [
            _mm512_shuffle_i32x4::<ODD>(a, b),
            _mm512_shuffle_i32x4::<ODD>(c, d),
        ];
        columns[4 + j] = _mm512_shuffle_i32x4::<EVEN>(ab, cd);
        columns[12 + j] = _mm512_shuffle_i32x4::<ODD>(ab, cd);
    }
    columns
}
