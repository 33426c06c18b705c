//! Attention of nodes along the edges of a graph, with relative features on every edge.
//!
//! Node `i` attends to the sources of its edges `i`. An edge carries a vector of relative features
//! that enters keys and values linearly, so that no matrix is multiplied per edge: the query is
//! projected into the space of the features once per node, and the features are averaged with the
//! attention weights and projected once per node, too.
//!
//! What lives here: the operation and its gradient. What does not: projections, and which edges
//! there are.

use std::sync::Arc;

use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor, bail};

use super::kernels::wide;
use super::rows::{exp_shifted_sum, max};
use super::{Host, elements, fusible, gradient, output};

/// Which sources every node attends to.
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
    fn of(&self, node: usize) -> std::ops::Range<usize> {
        self.offsets[node] as usize..self.offsets[node + 1] as usize
    }

    /// Error: unless the offsets ascend to the number of sources and every source is below
    /// `n_sources`.
    fn check(&self, n_nodes: usize, n_sources: usize) -> Result<()> {
        let ascend = self.offsets.first() == Some(&0) && self.offsets.is_sorted();
        let ends = self.offsets.last().map_or(0, |&end| end as usize);
        if self.n_nodes() != n_nodes || !ascend || ends != self.sources.len() {
            bail!(
                "edge attention: {} offsets to {ends} for {n_nodes} nodes and {} edges",
                self.offsets.len(),
                self.sources.len()
            );
        }
        if let Some(source) = self.sources.iter().find(|&&s| s as usize >= n_sources) {
            bail!("edge attention: source {source} is not below {n_sources}");
        }
        Ok(())
    }
}

/// Sizes that all rows share.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Heads {
    pub(crate) n: usize,
    /// Channels per head.
    pub(crate) d: usize,
    /// Features per edge.
    pub(crate) f: usize,
}

impl Heads {
    fn width(self) -> usize {
        self.n * (self.d + self.f)
    }

    fn scale(self) -> f32 {
        1.0 / (self.d.max(1) as f32).sqrt()
    }
}

/// Attention of every node to the sources of its edges.
///
/// The score of edge `e` from node `i` to source `s` in head `h` is
/// `q[i, h] · k[s, h] / √d + u[i, h] · features[e]`; the result holds, head by head, the averages of
/// `v[s, h]`, then those of `features[e]`. A node without edges gives 0.
///
/// Shape: `queries` `[N, H d + H F]` (q of all heads, then u of all heads), `sources` `[S, 2 H d]` (k
/// of all heads, then v), `features` `[E, F]`; the result `[N, H d + H F]`.
///
/// Error: when shapes or edges do not fit, or tensors are not f32 on a CPU.
pub fn edge_attention(
    queries: &Tensor,
    sources: &Tensor,
    features: &Tensor,
    edges: &Arc<Edges>,
    n_heads: usize,
) -> Result<Tensor> {
    let ((n, width), (n_sources, kv)) = (queries.dims2()?, sources.dims2()?);
    let (n_edges, f) = features.dims2()?;
    let d = kv / 2 / n_heads.max(1);
    let heads = Heads { n: n_heads, d, f };
    if n_heads == 0 || kv != 2 * n_heads * d || width != heads.width() {
        bail!(
            "edge attention: queries {:?}, sources {:?}, features {:?}, {n_heads} heads",
            queries.shape(),
            sources.shape(),
            features.shape()
        );
    }
    edges.check(n, n_sources)?;
    if n_edges != edges.sources.len() {
        bail!(
            "edge attention: {n_edges} rows of features for {} edges",
            edges.sources.len()
        );
    }
    if !fusible(&[queries, sources, features]) {
        bail!("edge attention runs in f32 on a CPU only");
    }
    let op = EdgeAttention {
        edges: Arc::clone(edges),
        heads,
    };
    queries
        .contiguous()?
        .apply_op3(&sources.contiguous()?, &features.contiguous()?, op)
}

/// One row of the result from one row of queries; `source` gives the keys and values of an edge
/// (`[2 H d]`), `feature` its features (`[F]`). `scores` is scratch and holds the attention weights
/// afterwards, `[H, edges]`.
#[inline(always)]
pub(crate) fn attend<'a>(
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
/// Lanes are summed in a pass of their own. Where the compiler sees them summed right after they were
/// filled it fills them in the order of the sum, a few at a time.
#[inline(always)]
fn dots(
    n: usize,
    n_edges: usize,
    into: &mut Vec<f32>,
    mut add: impl FnMut(usize, usize, &mut Lanes),
) {
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

struct EdgeAttention {
    edges: Arc<Edges>,
    heads: Heads,
}

impl EdgeAttention {
    fn forward(&self, queries: &[f32], sources: &[f32], features: &[f32]) -> Vec<f32> {
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

    /// Gradients of queries, sources and features.
    fn backward(
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

impl CustomOp3 for EdgeAttention {
    fn name(&self) -> &'static str {
        "edge-attention"
    }

    fn cpu_fwd(
        &self,
        queries: &CpuStorage,
        queries_layout: &Layout,
        sources: &CpuStorage,
        sources_layout: &Layout,
        features: &CpuStorage,
        features_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let out = self.forward(
            elements(queries, queries_layout)?,
            elements(sources, sources_layout)?,
            elements(features, features_layout)?,
        );
        Ok(output(out, (self.edges.n_nodes(), self.heads.width())))
    }

    fn bwd(
        &self,
        queries: &Tensor,
        sources: &Tensor,
        features: &Tensor,
        _out: &Tensor,
        d_out: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let d_out = d_out.contiguous()?;
        let hosts = [
            Host::new(queries)?,
            Host::new(sources)?,
            Host::new(features)?,
            Host::new(&d_out)?,
        ];
        let [q, s, f, d] = &hosts;
        let [d_q, d_s, d_f] = self.backward(q.slice()?, s.slice()?, f.slice()?, d.slice()?);
        Ok((
            Some(gradient(d_q, queries)?),
            Some(gradient(d_s, sources)?),
            Some(gradient(d_f, features)?),
        ))
    }
}

#[cfg(test)]
mod tests {
    use candle_core::{D, Device};

    use super::super::testing::{check, var};
    use super::*;

    /// The same from tensor operations, node by node.
    fn composed(
        queries: &Tensor,
        sources: &Tensor,
        features: &Tensor,
        edges: &Edges,
        heads: Heads,
    ) -> Result<Tensor> {
        let Heads { n, d, f } = heads;
        let mut rows = Vec::new();
        for i in 0..edges.n_nodes() {
            let of = edges.of(i);
            if of.is_empty() {
                rows.push(Tensor::zeros(
                    (1, heads.width()),
                    queries.dtype(),
                    &Device::Cpu,
                )?);
                continue;
            }
            let index = Tensor::new(&edges.sources[of.clone()], &Device::Cpu)?;
            let source = sources.index_select(&index, 0)?;
            let feature = features.narrow(0, of.start, of.len())?;
            let (mut values, mut averages) = (Vec::new(), Vec::new());
            for h in 0..n {
                let q = queries.narrow(0, i, 1)?.narrow(1, h * d, d)?;
                let u = queries.narrow(0, i, 1)?.narrow(1, n * d + h * f, f)?;
                let k = source.narrow(1, h * d, d)?;
                let v = source.narrow(1, n * d + h * d, d)?;
                let scores = ((q.matmul(&k.t()?)? * f64::from(heads.scale()))?
                    + u.matmul(&feature.t()?)?)?;
                let p = candle_nn::ops::softmax(&scores, D::Minus1)?;
                values.push(p.matmul(&v.contiguous()?)?);
                averages.push(p.matmul(&feature.contiguous()?)?);
            }
            values.extend(averages);
            rows.push(Tensor::cat(&values, 1)?);
        }
        Tensor::cat(&rows, 0)
    }

    fn edges(n_nodes: usize, n_sources: usize) -> Edges {
        let mut edges = Edges {
            offsets: vec![0],
            sources: Vec::new(),
        };
        for i in 0..n_nodes {
            let sources = (0..(i * 5) % 7).map(|j| ((i * 3 + j * 11) % n_sources) as u32);
            edges.sources.extend(sources);
            edges.offsets.push(edges.sources.len() as u32);
        }
        edges
    }

    #[test]
    fn agrees_with_the_composition() {
        for (nodes, sources, n, d, f) in [(9, 5, 2, 3, 4), (17, 40, 4, 32, 32), (6, 9, 1, 20, 7)] {
            let edges = Arc::new(edges(nodes, sources));
            let heads = Heads { n, d, f };
            let q = var(&[nodes, heads.width()], 1);
            let s = var(&[sources, 2 * n * d], 2);
            let features = var(&[edges.sources.len(), f], 3);
            check(
                &[&q, &s, &features],
                || edge_attention(&q, &s, &features, &edges, n),
                || composed(&q, &s, &features, &edges, heads),
            );
        }
    }

    #[test]
    fn what_does_not_fit_is_an_error() {
        let (q, s, f) = (var(&[2, 14], 1), var(&[3, 12], 2), var(&[4, 4], 3));
        let of = |offsets: &[u32], sources: &[u32]| {
            Arc::new(Edges {
                offsets: offsets.to_vec(),
                sources: sources.to_vec(),
            })
        };
        let good = of(&[0, 1, 4], &[0, 1, 2, 0]);
        assert!(edge_attention(&q, &s, &f, &good, 2).is_ok());
        assert!(edge_attention(&q, &s, &f, &good, 5).is_err());
        for bad in [
            of(&[0, 4], &[0, 1, 2, 0]),
            of(&[0, 1, 3], &[0, 1, 2, 0]),
            of(&[0, 1, 4], &[0, 1, 3, 0]),
        ] {
            assert!(edge_attention(&q, &s, &f, &bad, 2).is_err());
        }
    }
}
