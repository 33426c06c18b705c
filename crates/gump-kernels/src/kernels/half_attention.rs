//! Attention over keys and values in bfloat16, by the processor's unit.
//!
//! A head's keys of a page are a right matrix of as many columns as the page has tokens, its values
//! one of as many rows: both are multiplied where they lie. Softmax is in f32. A row's sums are taken
//! page by page in their order, whatever rows it is multiplied with.

use super::bf16::{Lanes, Target, Unit};
use crate::gemm::Store;
use crate::half_pages::{HalfHeads, HalfPage, PAGE, Room};
use crate::panels::PANEL;
use crate::rows::{exp_shifted_sum, max};

/// As [`crate::half_pages::attend`], by one unit.
pub(super) fn attend<U: Unit>(
    unit: U,
    heads: HalfHeads,
    pages: &[&HalfPage],
    q: &[f32],
    visible: &[usize],
    out: &mut [f32],
    room: &mut Room,
) {
    let c = heads.n * heads.d;
    let blocks = q.chunks(U::ROWS * c).zip(visible.chunks(U::ROWS));
    let blocks = blocks.zip(out.chunks_mut(U::ROWS * c));
    unit.during(|| {
        for ((q, visible), out) in blocks {
            let longest = visible.iter().fold(0, |most, n| most.max(*n));
            let pages = &pages[..longest.div_ceil(PAGE)];
            for head in 0..heads.n {
                let part = head * heads.d..(head + 1) * heads.d;
                let q = Lanes {
                    data: &q[part.start..],
                    lanes: visible.len(),
                    depth: heads.d,
                    lane_stride: c,
                    depth_stride: 1,
                };
                let out = &mut out[part.start..];
                attend_with_head(unit, (heads, head), pages, q, visible, out, room);
            }
        }
    });
}

/// The rows of one block with one head; `out` starts with the first channel of the head in the first
/// row, its rows are as far apart as those of `q`.
fn attend_with_head<U: Unit>(
    unit: U,
    (heads, head): (HalfHeads, usize),
    pages: &[&HalfPage],
    q: Lanes<'_>,
    visible: &[usize],
    out: &mut [f32],
    room: &mut Room,
) {
    let (rows, n) = (visible.len(), pages.len() * PAGE);
    let Room { scores, left } = room;
    scores.resize(rows * n, 0.0);
    let block = left.room(U::pairs(q.depth) * U::ROWS);
    unit.pack_left(q, block);
    for (p, page) in pages.iter().enumerate() {
        let mut to = Target {
            data: &mut scores[p * PAGE..],
            stride: n,
            rows,
            columns: PAGE,
            store: Store::Replace,
            scale: 1.0,
        };
        unit.multiply(block, page.keys(heads, head, U::pairs(q.depth)), &mut to);
    }
    for (scores, &visible) in scores.chunks_exact_mut(n).zip(visible) {
        let (seen, hidden) = scores.split_at_mut(visible);
        hidden.fill(0.0);
        super::wide(
            #[inline(always)]
            || {
                let peak = max(seen);
                let reciprocal = 1.0 / exp_shifted_sum(seen, peak);
                seen.iter_mut().for_each(|weight| *weight *= reciprocal);
            },
        );
    }
    let weights = Lanes {
        data: scores,
        lanes: rows,
        depth: n,
        lane_stride: n,
        depth_stride: 1,
    };
    let block = left.room(U::pairs(n) * U::ROWS);
    unit.pack_left(weights, block);
    for panel in 0..heads.value_panels() {
        let first = panel * PANEL;
        // A page is as deep as a whole number of steps of every unit.
        let parts = block.chunks_exact(PAGE / 2 * U::ROWS);
        for (p, (page, block)) in pages.iter().zip(parts).enumerate() {
            let mut to = Target {
                data: &mut out[first..],
                stride: q.lane_stride,
                rows,
                columns: PANEL.min(heads.d - first),
                store: if p == 0 { Store::Replace } else { Store::Add },
                scale: 1.0,
            };
            unit.multiply(block, page.values(heads, head, panel), &mut to);
        }
    }
}
