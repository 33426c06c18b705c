//! Keys and values of attention in bfloat16, in pages that a processor's unit for it multiplies as
//! they are.
//!
//! What lives here: a page of one attention layer ([`HalfPage`]) and attention over pages
//! ([`attend`]). What does not: whose pages they are and how long they are kept. Only where
//! [`HalfHeads::new`] returns some does the processor have such a unit.

use crate::kernels::{Pairs, attend_half, has_unit, wide};
use crate::panels::PANEL;

/// Tokens of a page: as many as a panel has columns, so that a page's keys are one panel.
pub const PAGE: usize = PANEL;

/// Pairs that the keys' channels are padded to a multiple of: those of a step of every unit.
const STEP: usize = 16;

/// The division of channels into heads.
#[derive(Clone, Copy, Debug)]
pub struct HalfHeads {
    pub(crate) n: usize,
    /// Channels of a head.
    pub(crate) d: usize,
}

impl HalfHeads {
    /// `n` heads of `d` channels each; none where the chosen kernel has no unit for bfloat16.
    pub fn new(n: usize, d: usize) -> Option<Self> {
        has_unit().then_some(Self { n, d })
    }

    /// Panels that the values of a head fill.
    pub(crate) fn value_panels(self) -> usize {
        self.d.div_ceil(PANEL)
    }

    /// Pairs of channels in a page, padded.
    fn key_pairs(self) -> usize {
        self.d.div_ceil(2).next_multiple_of(STEP)
    }

    /// Pairs of all keys of a page: `[H, key pairs, PAGE]`.
    fn keys_len(self) -> usize {
        self.n * self.key_pairs() * PAGE
    }

    /// Pairs of all values of a page: `[H, panels, PAGE / 2, PANEL]`, two tokens making a pair.
    fn values_len(self) -> usize {
        self.n * self.value_panels() * PAGE / 2 * PANEL
    }
}

/// Keys and values of [`PAGE`] tokens in one attention layer; zeros at first.
#[derive(Clone, Debug)]
pub struct HalfPage(Pairs);

impl HalfPage {
    /// An empty page.
    pub fn new(heads: HalfHeads) -> Self {
        let mut pairs = Pairs::default();
        pairs.room(heads.keys_len() + heads.values_len()).fill(0);
        Self(pairs)
    }

    /// Bytes it takes.
    pub fn bytes(&self) -> usize {
        self.0.bytes()
    }

    /// Writes the keys and values of token `at`, `[C]` each, rounded to bfloat16.
    ///
    /// Panics when they are not as long as the heads are together, or the page has no such token.
    pub fn write(&mut self, heads: HalfHeads, at: usize, keys: &[f32], values: &[f32]) {
        assert!(at < PAGE, "a page has {PAGE} tokens");
        let all = self.0.all_mut();
        let (all_keys, all_values) = all.split_at_mut(heads.keys_len());
        wide(
            #[inline(always)]
            || {
                write_keys(heads, at, keys, all_keys);
                write_values(heads, at, values, all_values);
            },
        );
    }

    /// Keys of a head, the first so many pairs of channels.
    pub(crate) fn keys(&self, heads: HalfHeads, head: usize, pairs: usize) -> &[u32] {
        &self.0.all()[head * heads.key_pairs() * PAGE..][..pairs * PAGE]
    }

    /// A panel of values of a head.
    pub(crate) fn values(&self, heads: HalfHeads, head: usize, panel: usize) -> &[u32] {
        let of_panel = PAGE / 2 * PANEL;
        let first = heads.keys_len() + (head * heads.value_panels() + panel) * of_panel;
        &self.0.all()[first..][..of_panel]
    }
}

#[inline(always)]
fn write_keys(heads: HalfHeads, at: usize, keys: &[f32], all: &mut [u32]) {
    let of_head = all.chunks_exact_mut(heads.key_pairs() * PAGE);
    for (own, keys) in of_head.zip(keys.chunks_exact(heads.d)) {
        let rows = own.as_chunks_mut::<PAGE>().0;
        let (pairs, odd) = keys.as_chunks::<2>();
        for (row, [low, high]) in rows.iter_mut().zip(pairs) {
            row[at] = rounded(*low) | rounded(*high) << 16;
        }
        if let [low] = odd {
            rows[pairs.len()][at] = rounded(*low);
        }
    }
}

#[inline(always)]
fn write_values(heads: HalfHeads, at: usize, values: &[f32], all: &mut [u32]) {
    let shift = 16 * (at % 2) as u32;
    let of_head = all.chunks_exact_mut(heads.value_panels() * PAGE / 2 * PANEL);
    for (own, values) in of_head.zip(values.chunks_exact(heads.d)) {
        for (panel, values) in values.chunks(PANEL).enumerate() {
            let row = &mut own[(panel * PAGE / 2 + at / 2) * PANEL..][..values.len()];
            for (pair, value) in row.iter_mut().zip(values) {
                *pair = *pair & !(0xffff << shift) | rounded(*value) << shift;
            }
        }
    }
}

/// The nearest bfloat16, ties to even, in the lower half.
#[inline(always)]
fn rounded(x: f32) -> u32 {
    let bits = x.to_bits();
    (bits + 0x7fff + (bits >> 16 & 1)) >> 16
}

/// Memory that attention works in, kept from call to call.
#[derive(Debug, Default)]
pub struct Room {
    pub(crate) scores: Vec<f32>,
    pub(crate) sums: Vec<f32>,
    pub(crate) left: Pairs,
}

/// Attention of `q` `[rows, C]`, scaled already, over the first `visible[row]` tokens of `pages`, at
/// least one; `out` is shaped like `q`. Queries and weights are rounded to bfloat16, sums are f32.
///
/// Panics when the shapes do not fit, or the pages were made with another kernel.
pub fn attend(
    heads: HalfHeads,
    pages: &[&HalfPage],
    q: &[f32],
    visible: &[usize],
    out: &mut [f32],
    room: &mut Room,
) {
    assert_eq!(
        q.len(),
        visible.len() * heads.n * heads.d,
        "rows of queries"
    );
    assert_eq!(q.len(), out.len(), "queries and results");
    attend_half(heads, pages, q, visible, out, room);
}
