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
    // The sizes of the shipped network as constants: the same operations in the same order, with
    // loops that are unrolled and without divisions.
    const SHIPPED: Heads = Heads { n: 4, d: 32, f: 32 };
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
    dots(n, n_edges, scores, |h, e, lanes| {
        let (key, feature) = (&source(e)[..n * d], &feature(e)[..f]);
        add_products(lanes, &q[h * d..(h + 1) * d], &key[h * d..(h + 1) * d]);
        for lane in lanes.iter_mut() {
            *lane *= scale;
        }
        add_products(lanes, &u[h * f..(h + 1) * f], feature);
    });
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
                    weigh(self.heads, query, of.len(), &source, &feature, &mut scores);
                    let d_out = &d_out[i * width..(i + 1) * width];
                    self.slopes(d_out, of.len(), &source, &feature, &scores, &mut slopes);
                    for (e, &s) in of.iter().enumerate() {
                        let d_source = &mut d_sources[s as usize * kv..][..kv];
                        let d_feature = &mut d_features[(edges.start + e) * f..][..f];
                        let at = Edge {
                            e,
                            n_edges: of.len(),
                            source: source(e),
                            feature: feature(e),
                        };
                        self.backward_edge(
                            &at, query, d_out, &scores, &slopes, d_query, d_source, d_feature,
                        );
                    }
                },
            );
        }
        [d_queries, d_sources, d_features]
    }

    /// Gradients of the scores of a node, `[H, edges]`.
    #[inline(always)]
    fn slopes<'a>(
        &self,
        d_out: &[f32],
        n_edges: usize,
        source: &impl Fn(usize) -> &'a [f32],
        feature: &impl Fn(usize) -> &'a [f32],
        weights: &[f32],
        slopes: &mut Vec<f32>,
    ) {
        let Heads { n, d, f } = self.heads;
        let (d_values, d_averages) = d_out.split_at(n * d);
        dots(n, n_edges, slopes, |h, e, lanes| {
            let (value, feature) = (&source(e)[n * d..2 * n * d], &feature(e)[..f]);
            let of_head = h * d..(h + 1) * d;
            add_products(lanes, &d_values[of_head.clone()], &value[of_head]);
            add_products(lanes, &d_averages[h * f..(h + 1) * f], feature);
        });
        let rows = slopes.chunks_exact_mut(n_edges.max(1));
        for (slopes, weights) in rows.zip(weights.chunks_exact(n_edges.max(1))) {
            let mean: f32 = slopes.iter().zip(weights).map(|(s, p)| s * p).sum();
            for (slope, weight) in slopes.iter_mut().zip(weights) {
                *slope = weight * (*slope - mean);
            }
        }
    }

    #[inline(always)]
    #[allow(
        clippy::too_many_arguments,
        reason = "the rows of one edge, each of its own array; a struct of references would only rename them"
    )]
    fn backward_edge(
        &self,
        at: &Edge<'_>,
        query: &[f32],
        d_out: &[f32],
        weights: &[f32],
        slopes: &[f32],
        d_query: &mut [f32],
        d_source: &mut [f32],
        d_feature: &mut [f32],
    ) {
        let Heads { n, d, f } = self.heads;
        let scale = self.heads.scale();
        let (q, u) = query.split_at(n * d);
        let (d_q, d_u) = d_query.split_at_mut(n * d);
        let (d_key, d_value) = d_source.split_at_mut(n * d);
        let (d_values, d_averages) = d_out.split_at(n * d);
        for h in 0..n {
            let (p, slope) = (
                weights[h * at.n_edges + at.e],
                slopes[h * at.n_edges + at.e],
            );
            let (of_head, of_features) = (h * d..(h + 1) * d, h * f..(h + 1) * f);
            add_scaled(
                &mut d_q[of_head.clone()],
                scale * slope,
                &at.source[of_head.clone()],
            );
            add_scaled(
                &mut d_key[of_head.clone()],
                scale * slope,
                &q[of_head.clone()],
            );
            add_scaled(&mut d_value[of_head.clone()], p, &d_values[of_head]);
            add_scaled(&mut d_u[of_features.clone()], slope, at.feature);
            add_both_scaled(
                d_feature,
                slope,
                &u[of_features.clone()],
                p,
                &d_averages[of_features],
            );
        }
    }
}

/// An edge in the gradient.
struct Edge<'a> {
    e: usize,
    n_edges: usize,
    source: &'a [f32],
    feature: &'a [f32],
}
