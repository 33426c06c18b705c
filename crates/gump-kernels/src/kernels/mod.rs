//! The matrix multiplication kernels and the choice among them.
//!
//! What lives here: the choice among the kernels, once per process, and the products that depend on
//! it. One file per kernel; `bf16` is what those for bfloat16 share, `rounded` what processors
//! without such a unit do instead.
#![allow(
    unsafe_code,
    reason = "cache lines of pairs are pairs one after another; the cast is here, once"
)]

#[cfg(target_arch = "x86_64")]
mod amx;
#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
#[cfg(target_arch = "x86_64")]
mod avx512_bf16;
#[cfg(target_arch = "x86_64")]
mod bf16;
mod choice;
#[cfg(target_arch = "x86_64")]
mod half_attention;
mod portable;
mod rounded;
#[cfg(test)]
mod tests;

use crate::gemm::{Mat, MatMut, Store, Threads};
use crate::half_pages::{HalfHeads, HalfPage, Room};
use crate::panels::PANEL;
#[cfg(target_arch = "x86_64")]
use amx::Amx;
#[cfg(target_arch = "x86_64")]
use avx2::Avx2;
#[cfg(target_arch = "x86_64")]
use avx512::Avx512;
#[cfg(target_arch = "x86_64")]
use avx512_bf16::Avx512Bf16;
pub use choice::{Choice, Kernel};

/// Below this in any direction the packing costs more than the products.
const LEAST: usize = 4;

/// Whether a product of this size is worth packing for.
pub(crate) fn is_worthwhile(m: usize, k: usize, n: usize) -> bool {
    m >= LEAST && k >= LEAST && n >= LEAST
}

/// `dst (+)= scale * lhs rhs` of operands rounded to bfloat16; the shapes fit.
pub(crate) fn bf16_product(
    dst: MatMut<'_>,
    store: Store,
    scale: f32,
    lhs: Mat<'_>,
    rhs: Mat<'_>,
    threads: Threads,
) {
    match unit() {
        #[cfg(target_arch = "x86_64")]
        Some(AnyUnit::Amx(unit)) => bf16::product(unit, dst, store, scale, (lhs, rhs), threads),
        #[cfg(target_arch = "x86_64")]
        Some(AnyUnit::Avx512Bf16(unit)) => {
            bf16::product(unit, dst, store, scale, (lhs, rhs), threads);
        }
        None => rounded::product(dst, store, scale, lhs, rhs, threads),
    }
}

/// A unit for bfloat16.
#[derive(Clone, Copy, Debug)]
enum AnyUnit {
    #[cfg(target_arch = "x86_64")]
    Amx(Amx),
    #[cfg(target_arch = "x86_64")]
    Avx512Bf16(Avx512Bf16),
}

/// The chosen kernel's unit for bfloat16, if it has one.
fn unit() -> Option<AnyUnit> {
    #[cfg(target_arch = "x86_64")]
    match Choice::current().kernel {
        Kernel::Amx => Amx::detect().map(AnyUnit::Amx),
        Kernel::Avx512Bf16 => Avx512Bf16::detect().map(AnyUnit::Avx512Bf16),
        _ => None,
    }
    #[cfg(not(target_arch = "x86_64"))]
    None
}

/// Whether the chosen kernel multiplies bfloat16 faster than f32.
pub(crate) fn has_unit() -> bool {
    unit().is_some()
}

/// As [`crate::half_pages::attend`], whose shapes fit.
#[cfg(target_arch = "x86_64")]
pub(crate) fn attend_half(
    heads: HalfHeads,
    pages: &[&HalfPage],
    q: &[f32],
    visible: &[usize],
    out: &mut [f32],
    room: &mut Room,
) {
    match unit().expect("who has such pages has a unit") {
        AnyUnit::Amx(unit) => half_attention::attend(unit, heads, pages, q, visible, out, room),
        AnyUnit::Avx512Bf16(unit) => {
            half_attention::attend(unit, heads, pages, q, visible, out, room);
        }
    }
}

/// No other processor has a unit, nor such pages.
#[cfg(not(target_arch = "x86_64"))]
pub(crate) fn attend_half(
    _: HalfHeads,
    _: &[&HalfPage],
    _: &[f32],
    _: &[usize],
    _: &mut [f32],
    _: &mut Room,
) {
    unreachable!("who has such pages has a unit")
}

/// A right matrix, rounded to bfloat16 and packed once for many products.
#[derive(Debug)]
pub(crate) enum Packed {
    /// For this processor's unit.
    #[cfg(target_arch = "x86_64")]
    Pairs(bf16::Right),
    /// For a product in f32.
    Rounded(rounded::Right),
}

impl Packed {
    pub(crate) fn new(rhs: Mat<'_>) -> Self {
        match unit() {
            #[cfg(target_arch = "x86_64")]
            Some(AnyUnit::Amx(unit)) => Self::Pairs(bf16::Right::new(unit, rhs)),
            #[cfg(target_arch = "x86_64")]
            Some(AnyUnit::Avx512Bf16(unit)) => Self::Pairs(bf16::Right::new(unit, rhs)),
            None => Self::Rounded(rounded::Right::new(rhs)),
        }
    }

    /// Bytes it takes.
    pub(crate) fn bytes(&self) -> usize {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Pairs(right) => right.bytes(),
            Self::Rounded(right) => right.bytes(),
        }
    }

    /// `lhs rhs` in new memory, plus `row` in every row if there is one.
    ///
    /// Panics when the shapes do not fit.
    pub(crate) fn fresh_product(
        &self,
        lhs: Mat<'_>,
        row: Option<&[f32]>,
        threads: Threads,
    ) -> Vec<f32> {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Pairs(right) => match unit().expect("who packed pairs multiplies them") {
                AnyUnit::Amx(unit) => right.fresh_product(unit, lhs, row, threads),
                AnyUnit::Avx512Bf16(unit) => right.fresh_product(unit, lhs, row, threads),
            },
            Self::Rounded(right) => right.fresh_product(lhs, row, threads),
        }
    }

    /// `dst (+)= scale * lhs rhs`, where `dst` has the first columns of the matrix, and `lhs` its
    /// first inner indices.
    ///
    /// Panics when the shapes do not fit.
    pub(crate) fn product(
        &self,
        dst: MatMut<'_>,
        store: Store,
        scale: f32,
        lhs: Mat<'_>,
        threads: Threads,
    ) {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Pairs(right) => match unit().expect("who packed pairs multiplies them") {
                AnyUnit::Amx(unit) => right.product(unit, dst, store, scale, lhs, threads),
                AnyUnit::Avx512Bf16(unit) => right.product(unit, dst, store, scale, lhs, threads),
            },
            Self::Rounded(right) => right.product(dst, store, scale, lhs, threads),
        }
    }
}

/// Vectors of the chosen kernel.
#[cfg(target_arch = "x86_64")]
#[derive(Clone, Copy, Debug)]
enum Vectors {
    Avx512(Avx512),
    Avx2(Avx2),
    Portable,
}

#[cfg(target_arch = "x86_64")]
impl Vectors {
    #[inline(always)]
    fn chosen() -> Self {
        let kernel = Choice::current().kernel;
        if kernel >= Kernel::Avx512
            && let Some(vectors) = Avx512::detect()
        {
            Self::Avx512(vectors)
        } else if kernel >= Kernel::Avx2
            && let Some(vectors) = Avx2::detect()
        {
            Self::Avx2(vectors)
        } else {
            Self::Portable
        }
    }
}

/// Runs `f` compiled for the chosen kernel's vectors.
///
/// Mark the closure and every helper it calls `#[inline(always)]`: only inlined code is compiled
/// wide. The instructions change, the arithmetic does not (a multiply-add is fused only where it is
/// written so, and sums keep their written order), so the bits are those of the plain build.
#[inline(always)]
pub fn wide<R>(f: impl FnOnce() -> R) -> R {
    #[cfg(target_arch = "x86_64")]
    match Vectors::chosen() {
        Vectors::Avx512(vectors) => vectors.run(f),
        Vectors::Avx2(vectors) => vectors.run(f),
        Vectors::Portable => f(),
    }
    #[cfg(not(target_arch = "x86_64"))]
    f()
}

/// `sums[r][j] = Σ rows[r][i] * b[i][j]`, where `b` is the blocks, each `[.., PANEL]`, one below
/// another; every sum is one chain of fused multiply-adds, on every processor.
///
/// Panics when a row is shorter than the blocks are deep together.
pub fn tile<'a, const N: usize>(
    rows: [&[f32]; N],
    blocks: impl Iterator<Item = &'a [f32]>,
) -> [[f32; PANEL]; N] {
    #[cfg(target_arch = "x86_64")]
    match Vectors::chosen() {
        Vectors::Avx512(vectors) => return vectors.tile(rows, blocks),
        Vectors::Avx2(vectors) => return vectors.tile(rows, blocks),
        Vectors::Portable => {}
    }
    portable::tile(rows, blocks)
}

/// Products of `N` rows of unsigned bytes with a panel of signed ones, summed exactly.
///
/// `panel` is `[k / 4, PANEL, 4]`: four consecutive inner indices of a column lie side by side.
///
/// Panics when a row is not as long as the panel is deep.
pub(crate) fn byte_tile<const N: usize>(rows: [&[u8]; N], panel: &[i8]) -> [[i32; PANEL]; N] {
    let depth = panel.len() / PANEL;
    assert!(depth.is_multiple_of(4), "a panel of bytes has depth 4 i");
    assert!(rows.iter().all(|row| row.len() == depth), "rows of {depth}");
    #[cfg(target_arch = "x86_64")]
    match Vectors::chosen() {
        Vectors::Avx512(vectors) => return vectors.byte_tile(rows, panel),
        Vectors::Avx2(vectors) => return vectors.byte_tile(rows, panel),
        Vectors::Portable => {}
    }
    portable::byte_tile(rows, panel)
}

/// Rows that [`ByteTiles`] multiply together, or twice as many: those of a tile of AMX.
pub(crate) const BYTE_ROWS: usize = 16;

/// Tiles of bytes, which the calling thread holds until they are dropped.
pub(crate) struct ByteTiles {
    #[cfg(target_arch = "x86_64")]
    tiles: amx::Tiles,
    #[cfg(not(target_arch = "x86_64"))]
    never: std::convert::Infallible,
}

impl ByteTiles {
    /// Some where the chosen kernel has them.
    pub(crate) fn cut() -> Option<Self> {
        #[cfg(target_arch = "x86_64")]
        if Choice::current().kernel == Kernel::Amx {
            return Amx::detect().map(Self::of);
        }
        None
    }

    #[cfg(target_arch = "x86_64")]
    fn of(unit: Amx) -> Self {
        Self {
            tiles: amx::Tiles::cut(unit),
        }
    }

    /// [`byte_tile`] of [`BYTE_ROWS`] rows one after another, or of twice as many: whole tiles by
    /// tiles, the rest by vectors.
    #[cfg(target_arch = "x86_64")]
    pub(crate) fn multiply(&self, rows: &[u8], panel: &[i8], sums: &mut [[i32; PANEL]]) {
        let depth = panel.len() / PANEL;
        let done = self.tiles.multiply_bytes(rows, panel, sums);
        if done < depth {
            let tiles = rows.chunks_exact(BYTE_ROWS * depth);
            for (rows, sums) in tiles.zip(sums.chunks_exact_mut(BYTE_ROWS)) {
                let rest = std::array::from_fn(|r| &rows[r * depth + done..(r + 1) * depth]);
                let rest = byte_tile::<BYTE_ROWS>(rest, &panel[done * PANEL..]);
                for (sums, rest) in sums.iter_mut().zip(&rest) {
                    for (sum, rest) in sums.iter_mut().zip(rest) {
                        *sum += rest;
                    }
                }
            }
        }
    }

    #[cfg(not(target_arch = "x86_64"))]
    pub(crate) fn multiply(&self, _: &[u8], _: &[i8], _: &mut [[i32; PANEL]]) {
        match self.never {}
    }
}

/// A cache line of pairs.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
struct Line([u32; 16]);

/// Pairs that begin at a cache line.
#[derive(Clone, Debug, Default)]
pub(crate) struct Pairs(Vec<Line>);

impl Pairs {
    /// None yet.
    #[cfg(target_arch = "x86_64")]
    const fn none() -> Self {
        Self(Vec::new())
    }

    /// Returns room for `n` pairs, with unspecified contents. It never shrinks: room given up for a
    /// small product would be zeroed again for the next large one.
    pub(crate) fn room(&mut self, n: usize) -> &mut [u32] {
        let lines = n.div_ceil(16).max(self.0.len());
        self.0.resize(lines, Line([0; 16]));
        &mut self.all_mut()[..n]
    }

    pub(crate) fn all(&self) -> &[u32] {
        // SAFETY: a line is 16 pairs and nothing else, and the slice is as long as its lines.
        unsafe { std::slice::from_raw_parts(self.0.as_ptr().cast(), 16 * self.0.len()) }
    }

    pub(crate) fn all_mut(&mut self) -> &mut [u32] {
        // SAFETY: as above; any bits are pairs, and the borrow is unique.
        unsafe { std::slice::from_raw_parts_mut(self.0.as_mut_ptr().cast(), 16 * self.0.len()) }
    }

    /// Bytes they take.
    pub(crate) fn bytes(&self) -> usize {
        size_of_val(&self.0[..])
    }
}
