//! Attention of nodes along the edges of a graph, with relative features on every edge.
//!
//! Node `i` attends to the sources of its edges `i`. An edge carries a vector of relative features
//! that enters keys and values linearly, so that no matrix is multiplied per edge: the query is
//! projected into the space of the features once per node, and the features are averaged with the
//! attention weights and projected once per node, too.
//!
//! What lives here: the operation on tensors. What does not: its arithmetic, which is
//! [`gump_kernels::edge_attention`]'s, projections, and which edges there are.

use std::sync::Arc;

use candle_core::{CpuStorage, CustomOp3, Error, Layout, Result, Shape, Tensor, bail};

use gump_kernels::edge_attention::{EdgeAttention, Edges, Heads};

use super::{Host, elements, fusible, gradient, output};

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
    edges.check(n, n_sources).map_err(Error::msg)?;
    if n_edges != edges.sources.len() {
        bail!(
            "edge attention: {n_edges} rows of features for {} edges",
            edges.sources.len()
        );
    }
    if !fusible(&[queries, sources, features]) {
        bail!("edge attention runs in f32 on a CPU only");
    }
    let op = Op(EdgeAttention {
        edges: Arc::clone(edges),
        heads,
    });
    queries
        .contiguous()?
        .apply_op3(&sources.contiguous()?, &features.contiguous()?, op)
}

struct Op(EdgeAttention);

impl CustomOp3 for Op {
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
        let out = self.0.forward(
            elements(queries, queries_layout)?,
            elements(sources, sources_layout)?,
            elements(features, features_layout)?,
        );
        Ok(output(out, (self.0.edges.n_nodes(), self.0.heads.width())))
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
        let [d_q, d_s, d_f] = self
            .0
            .backward(q.slice()?, s.slice()?, f.slice()?, d.slice()?);
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
