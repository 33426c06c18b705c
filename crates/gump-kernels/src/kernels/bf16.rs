//! Products of matrices in f32 whose numbers are rounded to bfloat16 on the way in and summed in
//! f32: the part that all processors share.
//!
//! What lives here: cutting a product into blocks, and the schedule of packing. What does not:
//! packing and multiplying themselves, which a [`Unit`] does; one file per processor.
//!
//! Two neighbours along the inner dimension make a *pair*, 32 bits, the earlier one in the lower
//! half. The left matrix is packed as blocks of a few rows, the right one as panels of [`PANEL`]
//! columns, both with their pairs one after another. An element of the result is one chain of sums
//! along the inner dimension, cut every [`DEPTH`], whatever block it falls into: its bits depend on
//! neither threads nor neighbours.

use std::cell::RefCell;

use rayon::prelude::*;

use crate::fresh::fresh_pieces;
use crate::gemm::{Mat, MatMut, Store, Threads};
use crate::panels::PANEL;
use crate::rows::{exp_shifted_sum, max};

use super::{Pairs, wide};

/// Inner indices packed at a time: a panel of 32 KB stays in the first-level cache.
const DEPTH: usize = 512;

/// Rows packed at a time, a multiple of every unit's block; also the share of a thread at a time.
/// At full depth 128 KB, a part of a second-level cache. Not tuned.
const ROWS_AT_ONCE: usize = 128;

/// Multiplications below which sharing out costs more than it saves: some microseconds. Not tuned.
const SHARED_PRODUCTS: usize = 1 << 20;

/// Rows or columns ("lanes") with their inner index, over a slice with any strides.
#[derive(Clone, Copy, Debug)]
pub(super) struct Lanes<'a> {
    pub(super) data: &'a [f32],
    pub(super) lanes: usize,
    pub(super) depth: usize,
    pub(super) lane_stride: usize,
    pub(super) depth_stride: usize,
}

impl<'a> Lanes<'a> {
    /// The rows of a left matrix.
    fn of_rows(mat: Mat<'a>) -> Self {
        let (data, [rows, cols], [row_stride, col_stride]) = mat.parts();
        Self {
            data,
            lanes: rows,
            depth: cols,
            lane_stride: row_stride,
            depth_stride: col_stride,
        }
    }

    /// Some of the lanes, some of their depth.
    fn part(self, (lane, lanes): (usize, usize), (from, depth): (usize, usize)) -> Self {
        let start = lane * self.lane_stride + from * self.depth_stride;
        Self {
            data: &self.data[start..],
            lanes,
            depth,
            ..self
        }
    }
}

/// A processor's way to multiply pairs. A value exists only where the processor has it.
pub(super) trait Unit: Copy + Send + Sync {
    /// Rows of a block of the left matrix; divides [`ROWS_AT_ONCE`].
    const ROWS: usize;

    /// Pairs that a depth is padded to.
    fn pairs(depth: usize) -> usize;

    /// Writes blocks `[lanes / ROWS, pairs * ROWS]`, missing lanes and depth as zeros.
    fn pack_left(self, from: Lanes<'_>, blocks: &mut [u32]);

    /// Writes panels `[lanes / PANEL, pairs, PANEL]`, missing lanes and depth as zeros.
    fn pack_right(self, from: Lanes<'_>, panels: &mut [u32]);

    /// Runs work that multiplies, on the calling thread.
    fn during<R>(self, work: impl FnOnce() -> R) -> R {
        work()
    }

    /// Takes `scale` times the product of a block with a panel into `to`; only within
    /// [`Unit::during`].
    fn multiply(self, block: &[u32], panel: &[u32], to: &mut Target<'_>);

    /// The same with panels of one depth that lie below each other.
    fn multiply_stack<'a>(
        self,
        block: &[u32],
        panels: impl Iterator<Item = &'a [u32]>,
        to: &mut Target<'_>,
    ) {
        let mut rest = block;
        for panel in panels {
            let (own, after) = rest.split_at(panel.len() / PANEL * Self::ROWS);
            self.multiply(own, panel, to);
            (rest, to.store) = (after, Store::Add);
        }
    }

    /// Packs `e^(score - the row's largest)` of the first `visible[row]` scores of every row as a
    /// block of the left matrix, zeros for the others; `sums` are the sums of the rows before they
    /// are rounded. `scores` are `[ROWS, depth]`, the depth a multiple of 32; they are overwritten.
    fn pack_exponentials(
        self,
        scores: &mut [f32],
        visible: &[usize],
        block: &mut [u32],
        sums: &mut [f32],
    ) {
        let depth = scores.len() / Self::ROWS;
        let rows = scores.chunks_exact_mut(depth).zip(visible);
        for ((scores, &visible), sum) in rows.zip(sums) {
            let (seen, hidden) = scores.split_at_mut(visible);
            hidden.fill(0.0);
            *sum = wide(
                #[inline(always)]
                || {
                    let peak = max(seen);
                    exp_shifted_sum(seen, peak)
                },
            );
        }
        let weights = Lanes {
            data: scores,
            lanes: visible.len(),
            depth,
            lane_stride: depth,
            depth_stride: 1,
        };
        self.pack_left(weights, block);
    }
}

/// Destination of the product of a block with a panel.
#[derive(Debug)]
pub(super) struct Target<'a> {
    /// From the first element on, rows `stride` apart.
    pub(super) data: &'a mut [f32],
    pub(super) stride: usize,
    /// At most a block's.
    pub(super) rows: usize,
    /// At most [`PANEL`].
    pub(super) columns: usize,
    pub(super) store: Store,
    pub(super) scale: f32,
}

impl Target<'_> {
    /// Takes in row `r` of a product, of which only the columns that are there count.
    pub(super) fn take_in(&mut self, r: usize, product: &[f32; PANEL]) {
        let row = &mut self.data[r * self.stride..][..self.columns];
        for (to, product) in row.iter_mut().zip(product) {
            *to = match self.store {
                Store::Replace => product * self.scale,
                Store::Add => product.mul_add(self.scale, *to),
            };
        }
    }
}

thread_local! {
    /// Buffers for packed operands, kept from product to product. A running product takes them out:
    /// while a thread waits for others, it may begin another product.
    static LEFT: RefCell<Pairs> = const { RefCell::new(Pairs::none()) };
    static RIGHT: RefCell<Pairs> = const { RefCell::new(Pairs::none()) };
}

/// A right matrix, packed once for many products.
#[derive(Debug)]
pub(crate) struct Right {
    /// Per piece of the depth, its panels.
    pieces: Vec<Pairs>,
    depth: usize,
    columns: usize,
}

impl Right {
    pub(super) fn new<U: Unit>(unit: U, rhs: Mat<'_>) -> Self {
        let lanes = Lanes::of_rows(rhs.t());
        let pieces = depths(lanes.depth).map(|piece| {
            let mut pairs = Pairs::default();
            let room = pairs.room(U::pairs(piece.1) * lanes.lanes.next_multiple_of(PANEL));
            unit.pack_right(lanes.part((0, lanes.lanes), piece), room);
            pairs
        });
        Self {
            pieces: pieces.collect(),
            depth: lanes.depth,
            columns: lanes.lanes,
        }
    }

    pub(super) fn bytes(&self) -> usize {
        self.pieces.iter().map(Pairs::bytes).sum()
    }

    /// As [`super::Packed::fresh_product`].
    pub(super) fn fresh_product<U: Unit>(
        &self,
        unit: U,
        lhs: Mat<'_>,
        row: Option<&[f32]>,
        threads: Threads,
    ) -> Vec<f32> {
        let (lhs, columns) = (Lanes::of_rows(lhs), self.columns);
        assert_eq!(lhs.depth, self.depth, "inner size of the product");
        let threads = shared(threads, lhs.lanes, columns, lhs.depth);
        let (len, at_once) = (lhs.lanes * columns, (ROWS_AT_ONCE * columns).max(1));
        fresh_pieces(len, at_once, row, threads, |chunk, data| {
            let first = chunk * ROWS_AT_ONCE;
            let mut to = Target {
                data,
                stride: columns,
                rows: ROWS_AT_ONCE.min(lhs.lanes - first),
                columns,
                store: row.map_or(Store::Replace, |_| Store::Add),
                scale: 1.0,
            };
            for (piece, panels) in depths(self.depth).zip(&self.pieces) {
                let panels = (panels.all(), U::pairs(piece.1));
                rows_product(unit, lhs.part((first, to.rows), piece), panels, &mut to);
                to.store = Store::Add;
            }
        })
    }

    /// As [`super::Packed::product`].
    pub(super) fn product<U: Unit>(
        &self,
        unit: U,
        dst: MatMut<'_>,
        store: Store,
        scale: f32,
        lhs: Mat<'_>,
        threads: Threads,
    ) {
        let mut work = Work::new(dst, store, scale, Lanes::of_rows(lhs), threads);
        assert!(work.lhs.depth <= self.depth, "inner size of the product");
        assert!(work.columns <= self.columns, "columns of the product");
        for (whole, (piece, panels)) in
            depths(self.depth).zip(depths(work.lhs.depth).zip(&self.pieces))
        {
            work.add(unit, piece, panels.all(), U::pairs(whole.1));
        }
    }
}

/// The depth in pieces, as (first, count).
fn depths(depth: usize) -> impl Iterator<Item = (usize, usize)> + Clone {
    (0..depth)
        .step_by(DEPTH)
        .map(move |from| (from, DEPTH.min(depth - from)))
}

/// `dst (+)= scale * lhs rhs`.
pub(super) fn product<U: Unit>(
    unit: U,
    dst: MatMut<'_>,
    store: Store,
    scale: f32,
    (lhs, rhs): (Mat<'_>, Mat<'_>),
    threads: Threads,
) {
    let rhs = Lanes::of_rows(rhs.t());
    let mut work = Work::new(dst, store, scale, Lanes::of_rows(lhs), threads);
    let mut right = RIGHT.take();
    for piece in depths(rhs.depth) {
        let pairs = U::pairs(piece.1);
        let panels = right.room(pairs * rhs.lanes.next_multiple_of(PANEL));
        unit.pack_right(rhs.part((0, rhs.lanes), piece), panels);
        work.add(unit, piece, panels, pairs);
    }
    RIGHT.set(right);
}

/// The threads for a product of this size.
fn shared(threads: Threads, rows: usize, columns: usize, depth: usize) -> Threads {
    let is_worth_it = rows > ROWS_AT_ONCE && rows * columns * depth >= SHARED_PRODUCTS;
    if is_worth_it { threads } else { Threads::One }
}

/// A product on its way, piece by piece of the depth.
struct Work<'a> {
    data: &'a mut [f32],
    stride: usize,
    columns: usize,
    store: Store,
    scale: f32,
    lhs: Lanes<'a>,
    is_shared: bool,
}

impl<'a> Work<'a> {
    fn new(dst: MatMut<'a>, store: Store, scale: f32, lhs: Lanes<'a>, threads: Threads) -> Self {
        let (data, [rows, columns], stride) = dst.into_parts();
        // Rows after the last may be part of the slice, but not of the matrix.
        let end = (rows * stride).min(data.len());
        let data = &mut data[..end];
        if lhs.depth == 0 && store == Store::Replace {
            for row in data.chunks_mut(stride.max(1)) {
                row[..columns].fill(0.0);
            }
        }
        Self {
            data: if columns == 0 { &mut [] } else { data },
            stride,
            columns,
            store,
            scale,
            lhs,
            is_shared: shared(threads, rows, columns, lhs.depth) == Threads::Pool,
        }
    }

    /// Adds what a piece of the depth gives; a panel is `pairs` deep, of which the first count.
    fn add<U: Unit>(&mut self, unit: U, piece: (usize, usize), panels: &[u32], pairs: usize) {
        let Self {
            stride,
            columns,
            scale,
            lhs,
            ..
        } = *self;
        let store = if piece.0 == 0 { self.store } else { Store::Add };
        let rows = |(chunk, data): (usize, &mut [f32])| {
            let first = chunk * ROWS_AT_ONCE;
            let mut to = Target {
                data,
                stride,
                rows: ROWS_AT_ONCE.min(lhs.lanes - first),
                columns,
                store,
                scale,
            };
            rows_product(
                unit,
                lhs.part((first, to.rows), piece),
                (panels, pairs),
                &mut to,
            );
        };
        let at_once = (ROWS_AT_ONCE * stride).max(1);
        if self.is_shared {
            let chunks = self.data.par_chunks_mut(at_once);
            chunks.enumerate().for_each(rows);
        } else {
            self.data.chunks_mut(at_once).enumerate().for_each(rows);
        }
    }
}

/// The product of a few rows with all panels, each `deep` pairs; `to` is as wide as its columns.
fn rows_product<U: Unit>(
    unit: U,
    lhs: Lanes<'_>,
    (panels, deep): (&[u32], usize),
    to: &mut Target<'_>,
) {
    let pairs = U::pairs(lhs.depth);
    let mut left = LEFT.take();
    let blocks = left.room(pairs * lhs.lanes.next_multiple_of(U::ROWS));
    unit.pack_left(lhs, blocks);
    let needed = to.columns.div_ceil(PANEL);
    unit.during(|| {
        for (p, panel) in panels.chunks_exact(deep * PANEL).take(needed).enumerate() {
            let panel = &panel[..pairs * PANEL];
            for (b, block) in blocks.chunks_exact(pairs * U::ROWS).enumerate() {
                let (row, column) = (b * U::ROWS, p * PANEL);
                let mut to = Target {
                    data: &mut to.data[row * to.stride + column..],
                    rows: U::ROWS.min(to.rows - row),
                    columns: PANEL.min(to.columns - column),
                    ..*to
                };
                unit.multiply(block, panel, &mut to);
            }
        }
    });
    LEFT.set(left);
}
