//! Keys and values of tokens in pages that futures share until they diverge; and attention over
//! them.
//!
//! [`Pages`] belong to one attention layer, [`KvCache`] to all layers of one sequence, with the
//! slots they were computed from, which are in shared pages as well ([`SlotPages`]); [`attend`]
//! computes attention. With weights in fewer bits, keys and values are bfloat16 where the processor
//! has a unit for it. Start with [`KvCache::reuse`], which keeps the cache exact: an entry is kept
//! only as long as its token and all tokens before it are unchanged.

use std::sync::Arc;

use gump_kernels::half_pages::{self, HalfHeads, HalfPage};
use gump_kernels::panels::{PANEL, Precision};
use gump_kernels::rows::{exp_shifted_sum, max};
use gump_kernels::{tile, wide};
use gump_model::placed_slot::PlacedSlot;

/// Tokens of a page: as many as a panel has columns, so that a page's keys are one panel.
const PAGE: usize = half_pages::PAGE;

/// The division of channels into heads.
#[derive(Clone, Copy, Debug)]
pub(super) struct Heads {
    n: usize,
    /// Channels of a head.
    d: usize,
    /// The same if keys and values are bfloat16.
    half: Option<HalfHeads>,
}

impl Heads {
    /// `n` heads of `d` channels.
    pub(super) fn new(n: usize, d: usize, precision: Precision) -> Self {
        let half = match precision {
            Precision::F32 => None,
            Precision::Bf16 | Precision::Int8 => HalfHeads::new(n, d),
        };
        Self { n, d, half }
    }

    /// Channels of a head.
    pub(super) fn channels(self) -> usize {
        self.d
    }

    /// Channels of all heads.
    pub(super) fn width(self) -> usize {
        self.n * self.d
    }

    /// Panels that the values of a head fill.
    fn value_panels(self) -> usize {
        self.d.div_ceil(PANEL)
    }

    /// Numbers of a page in f32: keys `[H, d, PAGE]`, then values `[H, panels, PAGE, PANEL]`.
    fn page_len(self) -> usize {
        self.n * PAGE * (self.d + self.value_panels() * PANEL)
    }

    fn keys(self, page: &[f32], head: usize) -> &[f32] {
        &page[head * self.d * PAGE..][..self.d * PAGE]
    }

    fn values(self, page: &[f32], head: usize, panel: usize) -> &[f32] {
        let first = self.n * self.d * PAGE + (head * self.value_panels() + panel) * PAGE * PANEL;
        &page[first..][..PAGE * PANEL]
    }
}

/// Keys and values of a page of tokens in one attention layer.
#[derive(Clone, Debug)]
enum Page {
    F32(Vec<f32>),
    Half(HalfPage),
}

impl Page {
    fn new(heads: Heads) -> Self {
        match heads.half {
            Some(half) => Self::Half(HalfPage::new(half)),
            None => Self::F32(vec![0.0; heads.page_len()]),
        }
    }

    fn bytes(&self) -> usize {
        match self {
            Self::F32(page) => size_of_val(&page[..]),
            Self::Half(page) => page.bytes(),
        }
    }

    /// Writes the keys and values of token `at`, `[C]` each.
    fn write(&mut self, heads: Heads, at: usize, keys: &[f32], values: &[f32]) {
        let page = match (self, heads.half) {
            (Self::Half(page), Some(half)) => return page.write(half, at, keys, values),
            (Self::F32(page), None) => page,
            _ => unreachable!("an engine's pages are of one kind"),
        };
        for (k, key) in keys.iter().enumerate() {
            page[k * PAGE + at] = *key;
        }
        let panels = heads.value_panels();
        for (h, head) in values.chunks_exact(heads.d).enumerate() {
            for (p, part) in head.chunks(PANEL).enumerate() {
                let first = heads.width() * PAGE + ((h * panels + p) * PAGE + at) * PANEL;
                page[first..first + part.len()].copy_from_slice(part);
            }
        }
    }
}

/// Keys and values of one attention layer, page by page; clones share their pages until one of
/// them writes.
#[derive(Clone, Debug, Default)]
pub(super) struct Pages(Vec<Arc<Page>>);

impl Pages {
    /// Writes the keys and values of tokens `first..`, one row `[2C]` each.
    pub(super) fn write(&mut self, heads: Heads, first: usize, rows: &[f32]) {
        let c = heads.width();
        let n = rows.len() / (2 * c);
        while self.0.len() * PAGE < first + n {
            self.0.push(Arc::new(Page::new(heads)));
        }
        for (i, row) in rows.chunks_exact(2 * c).enumerate() {
            let page = Arc::make_mut(&mut self.0[(first + i) / PAGE]);
            let (keys, values) = row.split_at(c);
            page.write(heads, (first + i) % PAGE, keys, values);
        }
    }
}

/// The slots of cached tokens, page by page; clones share their pages until one of them writes.
#[derive(Clone, Debug, Default)]
pub(super) struct SlotPages {
    /// All are full except the last, which may hold slots beyond `len`.
    pages: Vec<Arc<Vec<PlacedSlot>>>,
    len: usize,
}

impl SlotPages {
    /// Number of slots.
    #[cfg(test)]
    pub(super) fn len(&self) -> usize {
        self.len
    }

    /// The slots in order.
    pub(super) fn iter(&self) -> impl Iterator<Item = &PlacedSlot> {
        let all = self.pages.iter().flat_map(|page| page.iter());
        all.take(self.len)
    }

    /// Keeps the first `len` slots.
    pub(super) fn truncate(&mut self, len: usize) {
        self.len = self.len.min(len);
        self.pages.truncate(self.len.div_ceil(PAGE));
    }

    /// Adds slots at the end.
    pub(super) fn extend(&mut self, slots: &[PlacedSlot]) {
        let room = self.len.next_multiple_of(PAGE) - self.len;
        let (first, rest) = slots.split_at(room.min(slots.len()));
        if let Some(page) = self.pages.last_mut().filter(|_| !first.is_empty()) {
            let page = Arc::make_mut(page);
            page.truncate(self.len % PAGE);
            page.extend_from_slice(first);
        }
        let pages = rest.chunks(PAGE).map(|page| Arc::new(page.to_vec()));
        self.pages.extend(pages);
        self.len += slots.len();
    }
}

/// The cached keys and values of one sequence, in every layer.
#[derive(Clone, Debug, Default)]
pub struct KvCache {
    /// The slots whose keys and values are held.
    pub(super) slots: SlotPages,
    pub(super) layers: Vec<Pages>,
}

impl KvCache {
    /// Clears the cache but keeps the memory of its keys and values.
    pub(crate) fn clear(&mut self) {
        self.slots.truncate(0);
    }

    /// Returns the number of leading tokens of `slots` that are cached, compared token by token.
    pub(crate) fn common(&self, slots: &[PlacedSlot]) -> usize {
        let pairs = self.slots.iter().zip(slots);
        pairs.take_while(|(held, wanted)| held == wanted).count()
    }

    /// Keeps the cached part of the first `limit` tokens of `slots`; returns its number of tokens.
    pub(super) fn reuse(&mut self, slots: &[PlacedSlot], limit: usize) -> usize {
        let n = self.common(&slots[..limit]);
        self.slots.truncate(n);
        n
    }

    /// Bytes held; a shared page is divided among its owners.
    pub(crate) fn bytes(&self) -> usize {
        let pages = self.layers.iter().flat_map(|pages| &pages.0);
        let part = |page: &Arc<Page>| page.bytes() / Arc::strong_count(page);
        pages.map(part).sum()
    }
}

/// Memory that attention works in.
#[derive(Debug, Default)]
pub(super) struct AttentionRoom {
    scores: Vec<f32>,
    visible: Vec<usize>,
    half: half_pages::Room,
}

/// Attention of `q` `[rows, C]`, scaled already, over the first `visible[row]` tokens of `pages`;
/// `out` is shaped like `q`.
pub(super) fn attend(
    heads: Heads,
    pages: &Pages,
    q: &[f32],
    visible: impl Fn(usize) -> usize,
    out: &mut [f32],
    room: &mut AttentionRoom,
) {
    let rows = q.len() / heads.width();
    if let Some(half) = heads.half {
        let pages: Vec<&HalfPage> = pages.0.iter().map(|page| as_half(page)).collect();
        room.visible.clear();
        room.visible.extend((0..rows).map(visible));
        half_pages::attend(half, &pages, q, &room.visible, out, &mut room.half);
        return;
    }
    let pages: Vec<&[f32]> = pages.0.iter().map(|page| as_f32(page)).collect();
    let scores = &mut room.scores;
    match rows {
        1 => attend_together::<1>(heads, &pages, q, visible, out, scores),
        2..=4 => attend_together::<4>(heads, &pages, q, visible, out, scores),
        _ => attend_together::<8>(heads, &pages, q, visible, out, scores),
    }
}

fn as_half(page: &Page) -> &HalfPage {
    match page {
        Page::Half(page) => page,
        Page::F32(_) => unreachable!("an engine's pages are of one kind"),
    }
}

fn as_f32(page: &Page) -> &[f32] {
    match page {
        Page::F32(page) => page,
        Page::Half(_) => unreachable!("an engine's pages are of one kind"),
    }
}

/// The same in f32, `N` rows together.
fn attend_together<const N: usize>(
    heads: Heads,
    pages: &[&[f32]],
    q: &[f32],
    visible: impl Fn(usize) -> usize,
    out: &mut [f32],
    scores: &mut Vec<f32>,
) {
    let c = heads.width();
    let rows = q.len() / c;
    for head in 0..heads.n {
        for first in (0..rows).step_by(N) {
            // Rows beyond the last repeat it: they cost nothing else.
            let row = |r: usize| (first + r).min(rows - 1);
            let longest = (0..N).map(|r| visible(row(r))).fold(0, usize::max);
            let pages = &pages[..longest.div_ceil(PAGE)];
            let n = pages.len() * PAGE;
            scores.resize(N * n, 0.0);
            let queries: [&[f32]; N] =
                std::array::from_fn(|r| &q[row(r) * c + head * heads.d..][..heads.d]);
            for (p, page) in pages.iter().enumerate() {
                let sums = tile::<N>(queries, std::iter::once(heads.keys(page, head)));
                for (scores, sums) in scores.chunks_exact_mut(n).zip(sums) {
                    scores[p * PAGE..(p + 1) * PAGE].copy_from_slice(&sums);
                }
            }
            let mut reciprocals = [0.0; N];
            for (r, scores) in scores.chunks_exact_mut(n).enumerate() {
                let (seen, hidden) = scores.split_at_mut(visible(row(r)));
                hidden.fill(0.0);
                reciprocals[r] = 1.0 / softmax(seen);
            }
            let weights: [&[f32]; N] = std::array::from_fn(|r| &scores[r * n..][..n]);
            for panel in 0..heads.value_panels() {
                let blocks = pages.iter().map(|page| heads.values(page, head, panel));
                let sums = tile::<N>(weights, blocks);
                let width = PANEL.min(heads.d - panel * PANEL);
                for r in 0..N.min(rows - first) {
                    let at = (first + r) * c + head * heads.d + panel * PANEL;
                    for (out, sum) in out[at..at + width].iter_mut().zip(sums[r]) {
                        *out = sum * reciprocals[r];
                    }
                }
            }
        }
    }
}

/// `x[i] = e^(x[i] - max)`; returns the sum.
fn softmax(x: &mut [f32]) -> f32 {
    wide(
        #[inline(always)]
        || {
            let peak = max(x);
            exp_shifted_sum(x, peak)
        },
    )
}
