//! Attention of nodes along the edges of a graph, with relative features on every edge.
//!
//! Node `i` attends to the sources of its edges `i`. The score of edge `e` to source `s` in head `h`
//! is `q[i, h] · k[s, h] / √d + u[i, h] · features[e]`; the result holds, head by head, the averages
//! of `v[s, h]`, then those of `features[e]`.
//!
//! What lives here: the arithmetic on slices and its gradient. What does not: tensors, projections,
//! and which edges there are.

use std::sync::Arc;

use crate::rows::{exp_shifted_sum, max};
use crate::wide;

/// The sources that each node attends to.
///
/// The edges of node `i` are `offsets[i]..offsets[i + 1]`; `sources` holds a row of the keys and
/// values per edge.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Edges {
    /// One more than there are nodes, ascending from 0.
    pub offsets: Vec<u32>,
    /// One per edge.
    pub sources: Vec<u32>,
}

impl Edges {
    /// Number of nodes that attend.
    pub fn n_nodes(&self) -> usize {
        self.offsets.len().saturating_sub(1)
    }

    /// The edges of a node.
    #[inline(always)]
    pub fn of(&self, node: usize) -> std::ops::Range<usize> {
        self.offsets[node] as usize..self.offsets[node + 1] as usize
    }

    /// Checks that the offsets ascend to the number of sources and that every source is below
    /// `n_sources`.
    ///
    /// # Errors
    /// The first mismatch.
    pub fn check(&self, n_nodes: usize, n_sources: usize) -> Result<(), EdgesError> {
        let ascend = self.offsets.first() == Some(&0) && self.offsets.is_sorted();
        let ends = self.offsets.last().map_or(0, |&end| end as usize);
        if self.n_nodes() != n_nodes || !ascend || ends != self.sources.len() {
            return Err(EdgesError::Offsets {
                n_offsets: self.offsets.len(),
                ends,
                n_nodes,
                n_edges: self.sources.len(),
            });
        }
        if let Some(&found) = self.sources.iter().find(|&&s| s as usize >= n_sources) {
            return Err(EdgesError::Source { found, n_sources });
        }
        Ok(())
    }
}

/// Edges that do not fit the nodes and sources they are used with.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum EdgesError {
    /// The offsets are not one more than the nodes, or do not ascend from 0 to the number of edges.
    #[error(
        "edge attention: {n_offsets} offsets to {ends} for {n_nodes} nodes and {n_edges} edges"
    )]
    Offsets {
        /// Number of offsets.
        n_offsets: usize,
        /// The last offset; 0 without any.
        ends: usize,
        /// Number of nodes expected.
        n_nodes: usize,
        /// Number of edges.
        n_edges: usize,
    },
    /// An edge from a source that does not exist.
    #[error("edge attention: source {found} is not below {n_sources}")]
    Source {
        /// The source of the edge.
        found: u32,
        /// Number of sources.
        n_sources: usize,
    },
}

/// Sizes that all rows share.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Heads {
    /// Number of heads.
    pub n: usize,
    /// Channels per head.
    pub d: usize,
    /// Features per edge.
    pub f: usize,
}

impl Heads {
    /// Numbers in a row of queries and of the result.
    pub fn width(self) -> usize {
        self.n * (self.d + self.f)
    }

    /// Factor of the products of queries and keys: 1 / √d.
    pub fn scale(self) -> f32 {
        1.0 / (self.d.max(1) as f32).sqrt()
    }
}

/// The sizes of the shipped network. As constants they give the same operations in the same order,
/// with loops that are unrolled and without divisions.
const SHIPPED: Heads = Heads { n: 4, d: 32, f: 32 };

/// One row of the result from one row of queries; `source` gives the keys and values of an edge
/// (`[2 H d]`), `feature` its features (`[F]`). `scores` is scratch and holds the attention weights
/// afterwards, `[H, edges]`.
#[inline(always)]
pub fn attend<'a>(
    heads: Heads,
    query: &[f32],
    n_edges: usize,
    source: impl Fn(usize) -> &'a [f32],
    feature: impl Fn(usize) -> &'a [f32],
    scores: &mut Vec<f32>,
    out: &mut [f32],
) {
    match heads {
        SHIPPED => attend_with(SHIPPED, query, n_edges, source, feature, scores, out),
        _ => attend_with(heads, query, n_edges, source, feature, scores, out),
    }
}

#[inline(always)]
fn attend_with<'a>(
    heads: Heads,
    query: &[f32],
    n_edges: usize,
    source: impl Fn(usize) -> &'a [f32],
    feature: impl Fn(usize) -> &'a [f32],
    scores: &mut Vec<f32>,
    out: &mut [f32],
) {
    let Heads { n, d, f } = heads;
    weigh(heads, query, n_edges, &source, &feature, scores);
    out.fill(0.0);
    let (values, averages) = out.split_at_mut(n * d);
    for e in 0..n_edges {
        let (value, feature) = (&source(e)[n * d..2 * n * d], &feature(e)[..f]);
        for h in 0..n {
            let p = scores[h * n_edges + e];
            add_scaled(
                &mut values[h * d..(h + 1) * d],
                p,
                &value[h * d..(h + 1) * d],
            );
            add_scaled(&mut averages[h * f..(h + 1) * f], p, feature);
        }
    }
}

/// The attention weights of a node, `[H, edges]`, into `scores`.
#[inline(always)]
fn weigh<'a>(
    heads: Heads,
    query: &[f32],
    n_edges: usize,
    source: &impl Fn(usize) -> &'a [f32],
    feature: &impl Fn(usize) -> &'a [f32],
    scores: &mut Vec<f32>,
) {
    let Heads { n, d, f } = heads;
    let (q, u) = query.split_at(n * d);
    let scale = heads.scale();
    dots(
        n,
        n_edges,
        scores,
        // Out of line it would not have the instructions of the function around it.
        #[inline(always)]
        |h, e, lanes| {
            let (key, feature) = (&source(e)[..n * d], &feature(e)[..f]);
            add_products(lanes, &q[h * d..(h + 1) * d], &key[h * d..(h + 1) * d]);
            for lane in lanes.iter_mut() {
                *lane *= scale;
            }
            add_products(lanes, &u[h * f..(h + 1) * f], feature);
        },
    );
    for scores in scores.chunks_exact_mut(n_edges.max(1)) {
        let sum = exp_shifted_sum(scores, max(scores));
        let by = 1.0 / sum;
        scores.iter_mut().for_each(|score| *score *= by);
    }
}

/// Sixteen sums: rows here are short.
type Lanes = [f32; 16];

/// Sums of products of all heads and edges, `[H, edges]`, whose lanes `add` fills.
///
/// Lanes are summed in a separate pass: if the compiler sees them summed right after they were
/// filled, it fills them in the order of the sum, a few at a time.
#[inline(always)]
fn dots(
    n: usize,
    n_edges: usize,
    into: &mut Vec<f32>,
    mut add: impl FnMut(usize, usize, &mut Lanes),
) {
    // 4 KB, in the first-level cache.
    const ROWS: usize = 64;
    into.clear();
    into.resize(n * n_edges, 0.0);
    let mut rows = [[0.0; 16]; ROWS];
    let mut first = 0;
    while first < n * n_edges {
        let here = ROWS.min(n * n_edges - first);
        for (i, lanes) in rows[..here].iter_mut().enumerate() {
            *lanes = [0.0; 16];
            // Edge by edge: a source's heads lie together.
            let at = first + i;
            add(at % n, at / n, lanes);
        }
        std::hint::black_box(&mut rows);
        for (i, lanes) in rows[..here].iter().enumerate() {
            let at = first + i;
            into[(at % n) * n_edges + at / n] = sum(lanes);
        }
        first += here;
    }
}

/// `lanes += x * y`, element by element, in sixteen fixed lanes.
#[inline(always)]
fn add_products(lanes: &mut Lanes, x: &[f32], y: &[f32]) {
    let ((xs, x_tail), (ys, y_tail)) = (x.as_chunks::<16>(), y.as_chunks::<16>());
    for k in 0..xs.len().min(ys.len()) {
        for i in 0..16 {
            lanes[i] += xs[k][i] * ys[k][i];
        }
    }
    for k in 0..x_tail.len().min(y_tail.len()) {
        lanes[k] += x_tail[k] * y_tail[k];
    }
}

#[inline(always)]
fn sum(x: &Lanes) -> f32 {
    let (mut eight, mut four) = ([0.0; 8], [0.0; 4]);
    for i in 0..8 {
        eight[i] = x[i] + x[i + 8];
    }
    for i in 0..4 {
        four[i] = eight[i] + eight[i + 4];
    }
    (four[0] + four[2]) + (four[1] + four[3])
}

/// `out += by * x`
#[inline(always)]
fn add_scaled(out: &mut [f32], by: f32, x: &[f32]) {
    let ((outs, out_tail), (xs, x_tail)) = (out.as_chunks_mut::<16>(), x.as_chunks::<16>());
    for k in 0..outs.len().min(xs.len()) {
        let (mut now, x) = (outs[k], xs[k]);
        for i in 0..16 {
            now[i] += by * x[i];
        }
        outs[k] = now;
    }
    for k in 0..out_tail.len().min(x_tail.len()) {
        out_tail[k] += by * x_tail[k];
    }
}

/// `out += by * x + again * y`
#[inline(always)]
fn add_both_scaled(out: &mut [f32], by: f32, x: &[f32], again: f32, y: &[f32]) {
    let (x, y) = (&x[..out.len()], &y[..out.len()]);
    let ((outs, out_tail), (xs, x_tail)) = (out.as_chunks_mut::<16>(), x.as_chunks::<16>());
    let (ys, y_tail) = y.as_chunks::<16>();
    for k in 0..outs.len() {
        let (mut now, x, y) = (outs[k], xs[k], ys[k]);
        for i in 0..16 {
            now[i] += by * x[i] + again * y[i];
        }
        outs[k] = now;
    }
    for k in 0..out_tail.len() {
        out_tail[k] += by * x_tail[k] + again * y_tail[k];
    }
}

/// The operation on slices.
#[derive(Clone, Debug)]
pub struct EdgeAttention {
    /// The sources that each node attends to.
    pub edges: Arc<Edges>,
    /// Sizes.
    pub heads: Heads,
}

impl EdgeAttention {
    /// The result `[N, H d + H F]` of queries `[N, H d + H F]`, sources `[S, 2 H d]` and features
    /// `[E, F]`.
    pub fn forward(&self, queries: &[f32], sources: &[f32], features: &[f32]) -> Vec<f32> {
        let (width, kv, f) = (
            self.heads.width(),
            2 * self.heads.n * self.heads.d,
            self.heads.f,
        );
        let mut out = vec![0.0; self.edges.n_nodes() * width];
        let mut scores = Vec::new();
        for (i, out) in out.chunks_exact_mut(width).enumerate() {
            let edges = self.edges.of(i);
            let of = &self.edges.sources[edges.clone()];
            wide(
                #[inline(always)]
                || {
                    attend(
                        self.heads,
                        &queries[i * width..(i + 1) * width],
                        of.len(),
                        |e| &sources[of[e] as usize * kv..][..kv],
                        |e| &features[(edges.start + e) * f..][..f],
                        &mut scores,
                        out,
                    );
                },
            );
        }
        out
    }

    /// Gradients of queries, sources and features, from that of the result.
    pub fn backward(
        &self,
        queries: &[f32],
        sources: &[f32],
        features: &[f32],
        d_out: &[f32],
    ) -> [Vec<f32>; 3] {
        let (width, kv, f) = (
            self.heads.width(),
            2 * self.heads.n * self.heads.d,
            self.heads.f,
        );
        let mut d_queries = vec![0.0; queries.len()];
        let mut d_sources = vec![0.0; sources.len()];
        let mut d_features = vec![0.0; features.len()];
        let (mut scores, mut slopes) = (Vec::new(), Vec::new());
        for (i, d_query) in d_queries.chunks_exact_mut(width).enumerate() {
            let edges = self.edges.of(i);
            let of = &self.edges.sources[edges.clone()];
            wide(
                #[inline(always)]
                || {
                    let query = &queries[i * width..(i + 1) * width];
                    let source = |e: usize| &sources[of[e] as usize * kv..][..kv];
                    let feature = |e: usize| &features[(edges.start + e) * f..][..f];
                    let d_out = &d_out[i * width..(i + 1) * width];
                    let n_edges = of.len();
                    let mut weigh_edges = |heads| {
                        weigh(heads, query, n_edges, &source, &feature, &mut scores);
                        let weights = &scores;
                        slopes_of(
                            heads,
                            d_out,
                            n_edges,
                            &source,
                            &feature,
                            weights,
                            &mut slopes,
                        );
                    };
                    match self.heads {
                        SHIPPED => weigh_edges(SHIPPED),
                        heads => weigh_edges(heads),
                    }
                    let node = Node {
                        query,
                        d_out,
                        weights: &scores,
                        slopes: &slopes,
                        of,
                        features: &features[edges.start * f..edges.end * f],
                    };
                    let d_features = &mut d_features[edges.start * f..edges.end * f];
                    let to = (d_query, &mut d_sources[..], d_features);
                    match self.heads {
                        SHIPPED => node.backward_shipped(sources, to),
                        heads => node.backward(heads, sources, to),
                    }
                },
            );
        }
        [d_queries, d_sources, d_features]
    }
}

/// Gradients of the scores of a node, `[H, edges]`.
#[inline(always)]
fn slopes_of<'a>(
    heads: Heads,
    d_out: &[f32],
    n_edges: usize,
    source: &impl Fn(usize) -> &'a [f32],
    feature: &impl Fn(usize) -> &'a [f32],
    weights: &[f32],
    slopes: &mut Vec<f32>,
) {
    let Heads { n, d, f } = heads;
    let (d_values, d_averages) = d_out.split_at(n * d);
    dots(
        n,
        n_edges,
        slopes,
        #[inline(always)]
        |h, e, lanes| {
            let (value, feature) = (&source(e)[n * d..2 * n * d], &feature(e)[..f]);
            let of_head = h * d..(h + 1) * d;
            add_products(lanes, &d_values[of_head.clone()], &value[of_head]);
            add_products(lanes, &d_averages[h * f..(h + 1) * f], feature);
        },
    );
    let rows = slopes.chunks_exact_mut(n_edges.max(1));
    for (slopes, weights) in rows.zip(weights.chunks_exact(n_edges.max(1))) {
        let mean: f32 = slopes.iter().zip(weights).map(|(s, p)| s * p).sum();
        for (slope, weight) in slopes.iter_mut().zip(weights) {
            *slope = weight * (*slope - mean);
        }
    }
}

/// A node in the gradient, with its edges.
struct Node<'a> {
    query: &'a [f32],
    d_out: &'a [f32],
    /// `[H, edges]`, as the slopes.
    weights: &'a [f32],
    slopes: &'a [f32],
    /// The source of each edge.
    of: &'a [u32],
    /// `[edges, F]`
    features: &'a [f32],
}

/// Gradients of a node's query, of all sources and of the node's features.
type Gradients<'a> = (&'a mut [f32], &'a mut [f32], &'a mut [f32]);

impl Node<'_> {
    #[inline(always)]
    fn backward(
        &self,
        heads: Heads,
        sources: &[f32],
        (d_query, d_sources, d_features): Gradients<'_>,
    ) {
        let (Heads { n, d, f }, scale, n_edges) = (heads, heads.scale(), self.of.len());
        let (q, u) = self.query.split_at(n * d);
        let (d_q, d_u) = d_query.split_at_mut(n * d);
        let (d_values, d_averages) = self.d_out.split_at(n * d);
        for h in 0..n {
            let (of_head, of_features) = (h * d..(h + 1) * d, h * f..(h + 1) * f);
            for (e, &s) in self.of.iter().enumerate() {
                let (p, slope) = (self.weights[h * n_edges + e], self.slopes[h * n_edges + e]);
                let row = s as usize * 2 * n * d;
                let key = &sources[row..][of_head.clone()];
                let (d_key, d_value) = d_sources[row..row + 2 * n * d].split_at_mut(n * d);
                add_scaled(&mut d_q[of_head.clone()], scale * slope, key);
                add_scaled(
                    &mut d_key[of_head.clone()],
                    scale * slope,
                    &q[of_head.clone()],
                );
                add_scaled(&mut d_value[of_head.clone()], p, &d_values[of_head.clone()]);
                let of_edge = e * f..(e + 1) * f;
                add_scaled(
                    &mut d_u[of_features.clone()],
                    slope,
                    &self.features[of_edge.clone()],
                );
                add_both_scaled(
                    &mut d_features[of_edge],
                    slope,
                    &u[of_features.clone()],
                    p,
                    &d_averages[of_features.clone()],
                );
            }
        }
    }

    /// [`Node::backward`] of four heads of 32 channels and 32 features, bit for bit: what a head
    /// reads and sums stays in registers over its edges.
    #[inline(always)]
    fn backward_shipped(&self, sources: &[f32], (d_query, d_sources, d_features): Gradients<'_>) {
        const N: usize = 4;
        const D: usize = 32;
        let (scale, n_edges) = (SHIPPED.scale(), self.of.len());
        let blocks = |row: &[f32]| -> [[f32; D]; 2 * N] {
            let row = row.as_chunks::<D>().0;
            row.try_into().expect("a row of eight blocks")
        };
        let (query, d_out) = (blocks(self.query), blocks(self.d_out));
        let (sources, _) = sources.as_chunks::<{ 2 * N * D }>();
        let (d_sources, _) = d_sources.as_chunks_mut::<{ 2 * N * D }>();
        let (features, _) = self.features.as_chunks::<D>();
        let (d_features, _) = d_features.as_chunks_mut::<D>();
        let (d_query, _) = d_query.as_chunks_mut::<D>();
        let rows = self.weights.chunks_exact(n_edges.max(1));
        for (h, (weights, slopes)) in rows
            .zip(self.slopes.chunks_exact(n_edges.max(1)))
            .enumerate()
        {
            let (q, u, d_value_of, d_average) = (query[h], query[N + h], d_out[h], d_out[N + h]);
            let (mut d_q, mut d_u) = ([0.0; D], [0.0; D]);
            for (((&s, feature), d_feature), (&p, &slope)) in (self.of.iter())
                .zip(features)
                .zip(&mut *d_features)
                .zip(weights.iter().zip(slopes))
            {
                let by = scale * slope;
                let (source, d_source) = (&sources[s as usize], &mut d_sources[s as usize]);
                let key = &source.as_chunks::<D>().0[h];
                let d_source = d_source.as_chunks_mut::<D>().0;
                for i in 0..D {
                    d_q[i] += by * key[i];
                    d_u[i] += slope * feature[i];
                    d_source[h][i] += by * q[i];
                }
                for i in 0..D {
                    d_source[N + h][i] += p * d_value_of[i];
                    d_feature[i] += slope * u[i] + p * d_average[i];
                }
            }
            (d_query[h], d_query[N + h]) = (d_q, d_u);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_shipped_sizes_have_the_same_gradients_bit_for_bit() {
        let Heads { n, d, f } = SHIPPED;
        let (n_sources, of) = (9, [3, 0, 8, 3, 5, 1, 7_u32]);
        let numbers = |count: usize, seed: usize| -> Vec<f32> {
            let at = |i: usize| ((i * 7919 + seed * 104_729) % 2003) as f32 / 1000.0 - 1.0;
            (0..count).map(at).collect()
        };
        let sources = numbers(n_sources * 2 * n * d, 1);
        let node = Node {
            query: &numbers(SHIPPED.width(), 2),
            d_out: &numbers(SHIPPED.width(), 3),
            weights: &numbers(n * of.len(), 4),
            slopes: &numbers(n * of.len(), 5),
            of: &of,
            features: &numbers(of.len() * f, 6),
        };
        let gradients = |is_shipped: bool| {
            let mut to = [
                vec![0.0; SHIPPED.width()],
                vec![0.5; sources.len()],
                vec![0.0; of.len() * f],
            ];
            let [d_query, d_sources, d_features] = &mut to;
            let parts = (&mut d_query[..], &mut d_sources[..], &mut d_features[..]);
            if is_shipped {
                node.backward_shipped(&sources, parts);
            } else {
                node.backward(SHIPPED, &sources, parts);
            }
            to
        };
        assert_eq!(gradients(true), gradients(false));
    }
}
