//! Attention over keys and values in bfloat16, by the processor's unit.
//!
//! A head's keys of a page are a right matrix of as many columns as the page has tokens, its values
//! one of as many rows: both are multiplied where they lie. Softmax is in f32, and a row is divided by
//! its sum after it has been multiplied. A row's sums are taken page by page in their order, whatever
//! rows it is multiplied with.

use super::bf16::{Lanes, Target, Unit};
use crate::gemm::Store;
use crate::half_pages::{HalfHeads, HalfPage, PAGE, Room};
use crate::panels::PANEL;

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
    let Room { scores, sums, left } = room;
    // A whole block, so that products are stored where they belong; rows beyond the last do not count.
    scores.resize(U::ROWS * n, 0.0);
    let block = left.room(U::pairs(q.depth) * U::ROWS);
    unit.pack_left(q, block);
    for (p, page) in pages.iter().enumerate() {
        let mut to = Target {
            data: &mut scores[p * PAGE..],
            stride: n,
            rows: U::ROWS,
            columns: PAGE,
            store: Store::Replace,
            scale: 1.0,
        };
        unit.multiply(block, page.keys(heads, head, U::pairs(q.depth)), &mut to);
    }
    sums.resize(rows, 0.0);
    let block = left.room(U::pairs(n) * U::ROWS);
    unit.pack_exponentials(scores, visible, block, sums);
    for panel in 0..heads.value_panels() {
        let first = panel * PANEL;
        let mut to = Target {
            data: &mut out[first..],
            stride: q.lane_stride,
            rows,
            columns: PANEL.min(heads.d - first),
            store: Store::Replace,
            scale: 1.0,
        };
        // A page is as deep as a whole number of steps of every unit.
        let values = pages.iter().map(|page| page.values(heads, head, panel));
        unit.multiply_stack(block, values, &mut to);
    }
    super::wide(
        #[inline(always)]
        || {
            for (out, sum) in out.chunks_mut(q.lane_stride).zip(&*sums) {
                let reciprocal = 1.0 / sum;
                let own = &mut out[..heads.d];
                own.iter_mut().for_each(|number| *number *= reciprocal);
            }
        },
    );
}
