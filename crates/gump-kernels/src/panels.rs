//! Matrices packed once for the many products of inference.
//!
//! What lives here: [`Panels`], a weight matrix cut into panels of [`PANEL`] columns that a product
//! reads from front to back, in one of three precisions, under the
//! kernels of `gemm`. What does not: products with a gradient, which are `gump-nn`'s.
//!
//! Every element of a product is one chain of fused multiply-adds in the order of the inner index,
//! whatever the neighbouring rows: a row's bits depend neither on the batch nor on the threads.

use std::fmt;
use std::str::FromStr;

use rayon::prelude::*;
use serde::de::IntoDeserializer as _;
use serde::de::value::Error as NameError;
use serde::{Deserialize, Serialize};

use crate::gemm::{Mat, MatMut, Store, Threads};
use crate::kernels::{BYTE_ROWS, ByteTiles, Packed, byte_tile, has_unit, tile, wide};

/// Columns of a panel: two vectors of 512 bits.
pub const PANEL: usize = 32;

/// Rows multiplied together: 16 sums in flight hide how long a multiply-add takes.
const ROWS: usize = 8;

/// Rows that are multiplied together where fewer are left: half of them, so that little is computed
/// in vain.
const FEW_ROWS: usize = 4;

/// Number format in which the weights of linear layers are stored and multiplied.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Precision {
    /// 32 bits, as trained.
    #[default]
    F32,
    /// Weights rounded to bfloat16, 16 bits; sums in f32. Where the processor has a unit for
    /// bfloat16, the inputs of a product are rounded too, row by row as they come.
    Bf16,
    /// Weights in 8 bits with a scale per output; the inputs of a product are quantised to 8 bits
    /// row by row as they come; sums are exact integers.
    Int8,
}

impl fmt::Display for Precision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

impl FromStr for Precision {
    type Err = NameError;

    /// Finds a value by the name that it is stored and displayed under.
    ///
    /// # Errors
    /// A sentence with the unknown name and the known ones.
    fn from_str(name: &str) -> Result<Self, NameError> {
        Self::deserialize(name.into_deserializer())
    }
}

impl Precision {
    /// All of them, in the order of declaration.
    pub const ALL: [Self; 3] = [Self::F32, Self::Bf16, Self::Int8];

    /// Bits a weight takes.
    pub fn bits(self) -> u32 {
        match self {
            Self::F32 => 32,
            Self::Bf16 => 16,
            Self::Int8 => 8,
        }
    }
}

/// A weight matrix `[out, in]` and its bias, packed.
#[derive(Debug)]
pub struct Panels {
    n_in: usize,
    n_out: usize,
    weights: Weights,
    /// One per column of the panels; 0 without a bias.
    bias: Vec<f32>,
}

/// Panels one after another.
#[derive(Debug)]
enum Weights {
    /// `[in, PANEL]` each.
    F32(Vec<f32>),
    /// `[in, PANEL]` each, the upper halves of f32.
    Bf16(Vec<u16>),
    /// As this processor's unit for bfloat16 takes them.
    Pairs(Packed),
    /// `[in / 4, PANEL, 4]` each, `in` rounded up.
    Int8 {
        weights: Vec<i8>,
        /// Per column.
        scales: Vec<f32>,
        /// Per column, the sum of its weights times the zero point of the inputs.
        offsets: Vec<i32>,
    },
}

/// Scratch memory of products, kept from call to call so that it is allocated only once.
#[derive(Debug, Default)]
pub struct Scratch {
    panel: Vec<f32>,
    bytes: Vec<u8>,
    scales: Vec<f32>,
}

/// Quantised value of an input of 0: the middle of an unsigned byte.
const ZERO_POINT: i32 = 128;

impl Panels {
    /// Packs a row-major matrix `[out, in]`.
    pub fn new(weight: &[f32], n_in: usize, bias: Option<&[f32]>, precision: Precision) -> Self {
        let n_out = weight.len() / n_in;
        let columns = n_out.next_multiple_of(PANEL);
        let mut padded = bias.map_or(Vec::new(), <[f32]>::to_vec);
        padded.resize(columns, 0.0);
        let weights = match precision {
            Precision::F32 => Weights::F32(interleave(weight, n_in, |w| w)),
            Precision::Bf16 if has_unit() => {
                Weights::Pairs(Packed::new(Mat::new(weight, n_out, n_in).t()))
            }
            Precision::Bf16 => Weights::Bf16(interleave(weight, n_in, round_bf16)),
            Precision::Int8 => bytes(weight, n_in),
        };
        Self {
            n_in,
            n_out,
            weights,
            bias: padded,
        }
    }

    /// Columns of the matrix that it is multiplied with.
    pub fn n_in(&self) -> usize {
        self.n_in
    }

    /// Columns of the result.
    pub fn n_out(&self) -> usize {
        self.n_out
    }

    /// Bytes the weights take.
    pub fn bytes(&self) -> usize {
        match &self.weights {
            Weights::F32(w) => 4 * w.len(),
            Weights::Bf16(w) => 2 * w.len(),
            Weights::Pairs(packed) => packed.bytes(),
            Weights::Int8 {
                weights, scales, ..
            } => weights.len() + 8 * scales.len(),
        }
    }

    /// Multiplications of a product with that many rows.
    pub fn products(&self, rows: usize) -> u64 {
        (rows * self.n_in * self.n_out) as u64
    }

    /// `y = x weight^T + bias`; `x` is `[rows, in]`, `y` `[rows, out]`.
    pub fn apply(&self, x: &[f32], y: &mut [f32], scratch: &mut Scratch) {
        debug_assert_eq!(x.len() / self.n_in, y.len() / self.n_out, "rows");
        match &self.weights {
            Weights::F32(weights) => {
                let panels = weights.chunks_exact(self.n_in * PANEL).enumerate();
                for (p, panel) in panels {
                    self.panel_product(x, p, panel, y);
                }
            }
            Weights::Bf16(weights) => {
                scratch.panel.resize(self.n_in * PANEL, 0.0);
                for (p, panel) in weights.chunks_exact(self.n_in * PANEL).enumerate() {
                    wide(
                        #[inline(always)]
                        || {
                            for (wide, half) in scratch.panel.iter_mut().zip(panel) {
                                *wide = f32::from_bits(u32::from(*half) << 16);
                            }
                        },
                    );
                    self.panel_product(x, p, &scratch.panel, y);
                }
            }
            Weights::Pairs(packed) => {
                let (rows, bias) = (x.len() / self.n_in, &self.bias[..self.n_out]);
                for row in y.chunks_exact_mut(self.n_out) {
                    row.copy_from_slice(bias);
                }
                let (x, y) = (
                    Mat::new(x, rows, self.n_in),
                    MatMut::new(y, rows, self.n_out),
                );
                packed.product(y, Store::Add, 1.0, x, Threads::One);
            }
            Weights::Int8 {
                weights,
                scales,
                offsets,
            } => self.byte_product(x, weights, scales, offsets, y, scratch),
        }
    }

    /// As [`Panels::apply`] for very few rows, whose cost is reading the weights: the columns are
    /// shared out over the threads.
    pub fn apply_to_few(&self, x: &[f32], y: &mut [f32], scratch: &mut Scratch) {
        let rows = x.len() / self.n_in;
        let Weights::F32(weights) = &self.weights else {
            return self.apply(x, y, scratch);
        };
        if rows > FEW_ROWS || weights.len() < FEW_WEIGHTS || rayon::current_num_threads() == 1 {
            return self.apply(x, y, scratch);
        }
        let depth = self.n_in * PANEL;
        let sums: Vec<[[f32; PANEL]; FEW_ROWS]> = weights
            .par_chunks_exact(depth)
            .with_min_len(FEW_WEIGHTS / (4 * depth))
            .map(|panel| {
                let row = |r: usize| &x[r.min(rows - 1) * self.n_in..][..self.n_in];
                tile::<FEW_ROWS>(std::array::from_fn(row), std::iter::once(panel))
            })
            .collect();
        for (p, sums) in sums.iter().enumerate() {
            for (r, sums) in sums.iter().take(rows).enumerate() {
                self.store(sums, p, &mut y[r * self.n_out..][..self.n_out]);
            }
        }
    }

    #[inline(always)]
    fn store(&self, sums: &[f32; PANEL], p: usize, row: &mut [f32]) {
        let bias = &self.bias[p * PANEL..][..PANEL];
        let row = &mut row[p * PANEL..];
        for ((y, sum), bias) in row.iter_mut().zip(sums).zip(bias) {
            *y = sum + bias;
        }
    }

    /// The columns of one panel.
    fn panel_product(&self, x: &[f32], p: usize, panel: &[f32], y: &mut [f32]) {
        let (k, n) = (self.n_in, self.n_out);
        let row = |r: usize| &x[r * k..][..k];
        let panel = || std::iter::once(panel);
        let mut store = |r: usize, sums: &[f32; PANEL]| self.store(sums, p, &mut y[r * n..][..n]);
        in_groups(x.len() / k, |group| match group {
            Group::Many(rows) => {
                let sums = tile::<ROWS>(rows.map(row), panel());
                rows.into_iter()
                    .zip(&sums)
                    .for_each(|(r, sums)| store(r, sums));
            }
            Group::Few(rows) => {
                let sums = tile::<FEW_ROWS>(rows.map(row), panel());
                rows.into_iter()
                    .zip(&sums)
                    .for_each(|(r, sums)| store(r, sums));
            }
            Group::One(r) => store(r, &tile::<1>([row(r)], panel())[0]),
        });
    }

    fn byte_product(
        &self,
        x: &[f32],
        weights: &[i8],
        scales: &[f32],
        offsets: &[i32],
        y: &mut [f32],
        scratch: &mut Scratch,
    ) {
        let (k, n) = (self.n_in, self.n_out);
        let depth = k.next_multiple_of(4);
        let rows = x.len() / k;
        let is_tiled = rows >= FEWEST_TILED;
        let tiles = is_tiled.then(ByteTiles::cut).flatten();
        let tiled = match &tiles {
            Some(_) if rows % BYTE_ROWS >= FEWEST_TILED => rows.next_multiple_of(BYTE_ROWS),
            Some(_) => rows - rows % BYTE_ROWS,
            None => 0,
        };
        scratch
            .bytes
            .resize(rows.max(tiled) * depth, ZERO_POINT as u8);
        scratch.scales.resize(rows, 0.0);
        let quantised = scratch
            .bytes
            .chunks_exact_mut(depth)
            .zip(&mut scratch.scales);
        for (x, (bytes, scale)) in x.chunks_exact(k).zip(quantised) {
            bytes[k..].fill(ZERO_POINT as u8);
            *scale = quantize_row(x, &mut bytes[..k]);
        }
        let row = |r: usize| &scratch.bytes[r * depth..][..depth];
        let mut sums = [[0; PANEL]; 2 * BYTE_ROWS];
        let all_scales = scales.as_chunks::<PANEL>().0;
        let all_offsets = offsets.as_chunks::<PANEL>().0;
        let all_bias = self.bias.as_chunks::<PANEL>().0;
        for (p, panel) in weights.chunks_exact(depth * PANEL).enumerate() {
            let (scales, offsets, bias) = (&all_scales[p], &all_offsets[p], &all_bias[p]);
            let mut store = |first: usize, sums: &[[i32; PANEL]]| {
                let y = y[first * n..].chunks_mut(n);
                let rows = y.zip(&scratch.scales[first..]).zip(sums);
                wide(
                    #[inline(always)]
                    || {
                        for ((y, input), sums) in rows {
                            let column = |j: usize| {
                                let sum = sums[j].wrapping_sub(offsets[j]) as f32;
                                sum * (input * scales[j]) + bias[j]
                            };
                            let y = &mut y[p * PANEL..];
                            match y.first_chunk_mut::<PANEL>() {
                                Some(y) => *y = std::array::from_fn(column),
                                None => y.iter_mut().enumerate().for_each(|(j, y)| *y = column(j)),
                            }
                        }
                    },
                );
            };
            if let Some(tiles) = &tiles {
                let blocks = scratch.bytes[..tiled * depth].chunks(2 * BYTE_ROWS * depth);
                for (first, block) in (0..rows).step_by(2 * BYTE_ROWS).zip(blocks) {
                    let sums = &mut sums[..block.len() / depth];
                    tiles.multiply(block, panel, sums);
                    store(first, sums);
                }
            }
            let done = tiled.min(rows);
            let row = |r: usize| row(done + r);
            let mut store =
                |r: usize, sums: &[i32; PANEL]| store(done + r, std::slice::from_ref(sums));
            in_groups(rows - done, |group| match group {
                Group::Many(rows) => {
                    let sums = byte_tile::<ROWS>(rows.map(row), panel);
                    rows.into_iter()
                        .zip(&sums)
                        .for_each(|(r, sums)| store(r, sums));
                }
                Group::Few(rows) => {
                    let sums = byte_tile::<FEW_ROWS>(rows.map(row), panel);
                    rows.into_iter()
                        .zip(&sums)
                        .for_each(|(r, sums)| store(r, sums));
                }
                Group::One(r) => store(r, &byte_tile::<1>([row(r)], panel)[0]),
            });
        }
    }
}

/// Rows from which 16 go through tiles, even if some of them are none: fewer are faster by vectors.
const FEWEST_TILED: usize = 3;

/// Rows that go through a kernel together; the last of them may stand there several times.
enum Group {
    Many([usize; ROWS]),
    Few([usize; FEW_ROWS]),
    One(usize),
}

/// All rows in as few groups as their number allows.
#[inline(always)]
fn in_groups(rows: usize, mut work: impl FnMut(Group)) {
    let mut first = 0;
    while first < rows {
        let row = |r: usize| (first + r).min(rows - 1);
        let (group, n) = match rows - first {
            1 => (Group::One(first), 1),
            2..=FEW_ROWS => (Group::Few(std::array::from_fn(row)), FEW_ROWS),
            _ => (Group::Many(std::array::from_fn(row)), ROWS),
        };
        work(group);
        first += n;
    }
}

/// Weights below which sharing out the columns of a product with few rows costs more than it saves:
/// some microseconds. Not tuned.
const FEW_WEIGHTS: usize = 64 * 1024;

/// `[out, in]` as panels of `[in, PANEL]`, padded with zeros.
fn interleave<T: Copy + Default>(weight: &[f32], n_in: usize, cast: impl Fn(f32) -> T) -> Vec<T> {
    let n_out = weight.len() / n_in;
    let mut panels = vec![T::default(); n_out.next_multiple_of(PANEL) * n_in];
    for (o, row) in weight.chunks_exact(n_in).enumerate() {
        let panel = &mut panels[o / PANEL * PANEL * n_in..];
        for (i, w) in row.iter().enumerate() {
            panel[i * PANEL + o % PANEL] = cast(*w);
        }
    }
    panels
}

/// The nearest bfloat16, ties to even.
fn round_bf16(x: f32) -> u16 {
    half::bf16::from_f32(x).to_bits()
}

fn bytes(weight: &[f32], n_in: usize) -> Weights {
    let (n_out, depth) = (weight.len() / n_in, n_in.next_multiple_of(4));
    let columns = n_out.next_multiple_of(PANEL);
    let (mut scales, mut offsets) = (vec![0.0; columns], vec![0; columns]);
    let mut weights = vec![0i8; columns * depth];
    for (o, row) in weight.chunks_exact(n_in).enumerate() {
        let largest = row.iter().fold(0f32, |m, w| m.max(w.abs()));
        let reciprocal = if largest > 0.0 { 127.0 / largest } else { 0.0 };
        scales[o] = largest / 127.0;
        let panel = &mut weights[o / PANEL * PANEL * depth..];
        for (i, w) in row.iter().enumerate() {
            let byte = (w * reciprocal).round_ties_even() as i8;
            panel[(i / 4 * PANEL + o % PANEL) * 4 + i % 4] = byte;
            offsets[o] += ZERO_POINT * i32::from(byte);
        }
    }
    Weights::Int8 {
        weights,
        scales,
        offsets,
    }
}

/// Quantises a row to bytes around [`ZERO_POINT`]; returns the scale.
fn quantize_row(x: &[f32], bytes: &mut [u8]) -> f32 {
    wide(
        #[inline(always)]
        || {
            let mut lanes = [0f32; PANEL];
            let (chunks, tail) = x.as_chunks::<PANEL>();
            for chunk in chunks {
                for (lane, x) in lanes.iter_mut().zip(chunk) {
                    *lane = if x.abs() > *lane { x.abs() } else { *lane };
                }
            }
            let largest = lanes
                .iter()
                .chain(tail)
                .fold(0f32, |m, x| if x.abs() > m { x.abs() } else { m });
            let reciprocal = if largest > 0.0 { 127.0 / largest } else { 0.0 };
            // Adding 1.5 * 2^23 rounds to an integer, which then sits in the low bits.
            const ROUND: f32 = 12_582_912.0 + ZERO_POINT as f32;
            for (byte, x) in bytes.iter_mut().zip(x) {
                *byte = (x * reciprocal + ROUND).to_bits() as u8;
            }
            largest / 127.0
        },
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::values;

    fn check(rows: usize, n_in: usize, n_out: usize, precision: Precision, tolerance: f32) {
        let (x, w) = (values(rows * n_in, 1), values(n_out * n_in, 2));
        let b = values(n_out, 3);
        let panels = Panels::new(&w, n_in, Some(&b), precision);
        let (mut y, mut few) = (vec![0.0; rows * n_out], vec![0.0; rows * n_out]);
        let mut scratch = Scratch::default();
        panels.apply(&x, &mut y, &mut scratch);
        for r in 0..rows {
            for o in 0..n_out {
                let products = (0..n_in).map(|i| x[r * n_in + i] * w[o * n_in + i]);
                let exact = products.sum::<f32>() + b[o];
                let found = y[r * n_out + o];
                assert!((found - exact).abs() < tolerance, "{found} {exact}");
            }
        }
        // A row alone has the bits it has among others.
        for r in 0..rows {
            let mut alone = vec![0.0; n_out];
            panels.apply(&x[r * n_in..][..n_in], &mut alone, &mut scratch);
            assert_eq!(alone, y[r * n_out..][..n_out], "{precision:?} row {r}");
        }
        panels.apply_to_few(&x, &mut few, &mut scratch);
        assert_eq!(few, y, "{precision:?} columns shared out");
    }

    #[test]
    fn products_agree_with_the_definition() {
        for (rows, n_in, n_out) in [(1, 1, 1), (7, 37, 33), (4, 128, 14), (3, 300, 1000)] {
            check(rows, n_in, n_out, Precision::F32, 1e-4);
            check(rows, n_in, n_out, Precision::Bf16, 4e-3 * n_in as f32);
            check(rows, n_in, n_out, Precision::Int8, 1e-2 * n_in as f32);
        }
    }

    #[test]
    fn a_row_of_zeros_stays_zero_in_bytes() {
        let panels = Panels::new(&values(64, 2), 8, None, Precision::Int8);
        let mut y = [1.0; 8];
        panels.apply(&[0.0; 8], &mut y, &mut Scratch::default());
        assert_eq!(y, [0.0; 8]);
    }
}
