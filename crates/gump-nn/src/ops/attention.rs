//! Scaled dot-product attention over heads interleaved in the channels.
//!
//! What lives here: causal and cross attention without the matrix of all scores: a few query rows
//! at a time against every visible key, one head of one batch entry per task. The gradient keeps
//! only the logarithm of each row's softmax sum and computes the probabilities again. What does
//! not: projections and the key-value cache, which the network holds.

use std::sync::OnceLock;

use candle_core::{
    CpuStorage, CustomOp1, CustomOp3, D, DType, Layout, Result, Shape, Tensor, bail,
};

use super::{Host, elements, fusible, gradient, output};
use gump_kernels::Operands;
use gump_kernels::gemm::{Mat, MatMut, Right, Store, Threads, gemm};
use gump_kernels::rows::{
    dot, exp, exp_shifted_sum, for_pieces, for_pieces2, for_pieces3, max, rows_per_task,
};
use gump_kernels::wide;

/// Attention in which query `i` sees keys `0..=i + offset`.
///
/// `offset` is how many keys precede the first query: 0 for a whole sequence, `Tk - Tq` behind a
/// cache. With `key_lengths`, keys of batch entry `b` at or beyond `key_lengths[b]` are padding and
/// invisible; a query that sees no key gives 0.
///
/// Shape: `q` `[B, Tq, C]`, `k` and `v` `[B, Tk, C]`; head `h` owns columns `h * d..(h + 1) * d`
/// with `d = C / n_heads`; `key_lengths` `[B]`; the result `[B, Tq, C]`.
///
/// Error: when the shapes do not fit or `n_heads` does not divide `C`.
pub fn causal_attention(
    q: &Tensor,
    k: &Tensor,
    v: &Tensor,
    n_heads: usize,
    offset: usize,
    key_lengths: Option<&[usize]>,
) -> Result<Tensor> {
    if q.dim(0)? != k.dim(0)? {
        bail!("causal_attention: q {:?}, k {:?}", q.shape(), k.shape());
    }
    let view = View::new(q, k, v, n_heads, Some(offset), key_lengths)?;
    attention(q, k, v, view)
}

/// Attention in which every query sees every key.
///
/// `k` and `v` may have fewer batch entries than `q`: entry `i` of them then serves the `B / Bk`
/// consecutive query entries from `i * B / Bk` on, as many futures share the memory of one scene.
///
/// Shape: `q` `[B, Tq, C]`, `k` and `v` `[Bk, Tk, C]` with `Bk` dividing `B`; heads as in
/// [`causal_attention`]; the result `[B, Tq, C]`.
///
/// Error: when the shapes do not fit or `n_heads` does not divide `C`.
pub fn cross_attention(q: &Tensor, k: &Tensor, v: &Tensor, n_heads: usize) -> Result<Tensor> {
    shared_keys(q, k, v, n_heads, None)
}

/// [`cross_attention`] in which keys of entry `i` at or beyond `key_lengths[i]` are padding and
/// invisible; a query that sees no key gives 0.
///
/// Shape: `key_lengths` `[Bk]`, the rest as in [`cross_attention`].
///
/// Error: as in [`cross_attention`], and when there are not `Bk` lengths.
pub fn cross_attention_padded(
    q: &Tensor,
    k: &Tensor,
    v: &Tensor,
    n_heads: usize,
    key_lengths: &[usize],
) -> Result<Tensor> {
    shared_keys(q, k, v, n_heads, Some(key_lengths))
}

fn shared_keys(
    q: &Tensor,
    k: &Tensor,
    v: &Tensor,
    n_heads: usize,
    key_lengths: Option<&[usize]>,
) -> Result<Tensor> {
    let (b, tq, c) = q.dims3()?;
    let bk = k.dim(0)?;
    if bk == 0 || b % bk != 0 {
        bail!("cross_attention: q {:?}, k {:?}", q.shape(), k.shape());
    }
    // Without a causal mask, queries that share keys are just more rows.
    let q = q.reshape((bk, b / bk * tq, c))?; // [Bk, B / Bk * Tq, C]
    let view = View::new(&q, k, v, n_heads, None, key_lengths)?;
    attention(&q, k, v, view)?.reshape((b, tq, c)) // [B, Tq, C]
}

/// [`causal_attention`] of a whole sequence, whose queries, keys and values lie side by side as one
/// product left them.
///
/// Shape: `qkv` `[B, T, 3C]`; the result `[B, T, C]`.
///
/// Error: when `3 n_heads` does not divide the last dimension.
pub fn causal_self_attention(qkv: &Tensor, n_heads: usize) -> Result<Tensor> {
    let (b, t, width) = qkv.dims3()?;
    if n_heads == 0 || width % (3 * n_heads) != 0 {
        bail!(
            "causal_self_attention: qkv {:?}, {n_heads} heads",
            qkv.shape()
        );
    }
    let c = width / 3;
    let view = View::of_thirds([b, t, c], n_heads);
    if fusible(&[qkv]) {
        return qkv.contiguous()?.apply_op1(Attention::new(view));
    }
    let third = |i: usize| qkv.narrow(2, i * c, c);
    composed(&third(0)?, &third(1)?, &third(2)?, &view)
}

fn attention(q: &Tensor, k: &Tensor, v: &Tensor, view: View) -> Result<Tensor> {
    if !fusible(&[q, k, v]) {
        return composed(q, k, v, &view);
    }
    q.contiguous()?
        .apply_op3(&k.contiguous()?, &v.contiguous()?, Attention::new(view))
}

fn composed(q: &Tensor, k: &Tensor, v: &Tensor, view: &View) -> Result<Tensor> {
    let heads = |x: &Tensor| {
        let (b, t, _) = x.dims3()?;
        x.reshape((b, t, view.n_heads, view.d))?
            .transpose(1, 2)?
            .contiguous() // [B, H, T, d]
    };
    let (q, k, v) = (heads(q)?, heads(k)?, heads(v)?);
    let scores = (q.matmul(&k.t()?)? * f64::from(view.scale()))?; // [B, H, Tq, Tk]
    let probabilities = if view.sees_all() {
        candle_nn::ops::softmax(&scores, D::Minus1)?
    } else {
        let mut mask = Vec::with_capacity(view.b * view.tq * view.tk);
        for b in 0..view.b {
            for i in 0..view.tq {
                let n = view.visible(b, i);
                mask.extend((0..view.tk).map(|j| u8::from(j < n)));
            }
        }
        let mask = Tensor::from_vec(mask, (view.b, 1, view.tq, view.tk), scores.device())?
            .broadcast_as(scores.shape())?
            .contiguous()?;
        // Finite, so that a row without a visible key is not 0 / 0; f16 ends at -65504.
        let low = if scores.dtype() == DType::F16 {
            -6e4
        } else {
            -1e30
        };
        let low = Tensor::full(low, (), scores.device())?
            .to_dtype(scores.dtype())?
            .broadcast_as(scores.shape())?;
        let scores = mask.where_cond(&scores, &low)?;
        let probabilities = candle_nn::ops::softmax(&scores, D::Minus1)?;
        mask.where_cond(&probabilities, &probabilities.zeros_like()?)?
    };
    probabilities
        .matmul(&v)?
        .transpose(1, 2)?
        .reshape((view.b, view.tq, view.n_heads * view.d)) // [B, Tq, C]
}

/// Sizes, and which keys a query sees.
pub(super) struct View {
    b: usize,
    tq: usize,
    tk: usize,
    n_heads: usize,
    d: usize,
    causal_offset: Option<usize>,
    key_lengths: Option<Vec<usize>>,
    /// Elements from a row of the queries to the next, and of the keys and values.
    strides: [usize; 2],
}

impl View {
    fn new(
        q: &Tensor,
        k: &Tensor,
        v: &Tensor,
        n_heads: usize,
        causal_offset: Option<usize>,
        key_lengths: Option<&[usize]>,
    ) -> Result<Self> {
        let (b, tq, c) = q.dims3()?;
        let (bk, tk, ck) = k.dims3()?;
        let fits = v.dims() == k.dims()
            && (b, c) == (bk, ck)
            && n_heads > 0
            && c % n_heads == 0
            && key_lengths.is_none_or(|l| l.len() == b);
        if !fits {
            bail!(
                "attention: q {:?}, k {:?}, v {:?}, {n_heads} heads, {:?} key lengths",
                q.shape(),
                k.shape(),
                v.shape(),
                key_lengths.map(<[usize]>::len)
            );
        }
        Ok(Self {
            b,
            tq,
            tk,
            n_heads,
            d: c / n_heads,
            causal_offset,
            key_lengths: key_lengths.map(<[usize]>::to_vec),
            strides: [c; 2],
        })
    }

    /// Causal, of queries, keys and values side by side, `[B, T, 3C]`; `n_heads` divides `c`.
    pub(super) fn of_thirds([b, t, c]: [usize; 3], n_heads: usize) -> Self {
        Self {
            b,
            tq: t,
            tk: t,
            n_heads,
            d: c / n_heads,
            causal_offset: Some(0),
            key_lengths: None,
            strides: [3 * c; 2],
        }
    }

    /// Every one of `rows` queries of a batch entry sees every key of `[B, Tk, C]`; `n_heads`
    /// divides `C`.
    pub(super) fn of_keys(keys: &Tensor, rows: usize, n_heads: usize) -> Result<Self> {
        let (b, tk, c) = keys.dims3()?;
        Ok(Self {
            b,
            tq: rows,
            tk,
            n_heads,
            d: c / n_heads,
            causal_offset: None,
            key_lengths: None,
            strides: [c; 2],
        })
    }

    fn scale(&self) -> f32 {
        1.0 / (self.d.max(1) as f32).sqrt()
    }

    fn sees_all(&self) -> bool {
        self.key_lengths.is_none() && self.causal_offset.is_none()
    }

    /// Number of keys, from the first on, that query `i` of batch entry `b` sees.
    fn visible(&self, b: usize, i: usize) -> usize {
        let length = self.key_lengths.as_ref().map_or(self.tk, |l| l[b]);
        let reach = self.causal_offset.map_or(self.tk, |o| i + o + 1);
        self.tk.min(length).min(reach)
    }

    /// Query rows worked on together: their scores stay in the second-level cache.
    fn block(&self) -> usize {
        (SCORES / self.tk.max(1)).clamp(16, 64)
    }

    /// Heads per task, so that a task is worth handing to another thread.
    fn heads_per_task(&self) -> usize {
        let work = self.tq * self.tk * self.d;
        (TASK_PRODUCTS / work.max(1)).clamp(1, self.b * self.n_heads)
    }
}

/// Scores held at a time, for one head: 256 KB, a part of a second-level cache. Not tuned.
const SCORES: usize = 64 * 1024;

/// Multiplications below which sharing out costs more than it saves: microseconds. Not tuned.
const TASK_PRODUCTS: usize = 64 * 1024;

/// Attention over tensors of one shape.
pub(super) struct Attention {
    view: View,
    operands: Operands,
    /// Logarithm of the softmax sum of each row, `[B, H, Tq]`, kept for the gradient.
    log_sums: OnceLock<Vec<f32>>,
}

impl Attention {
    pub(super) fn new(view: View) -> Self {
        Self {
            view,
            operands: Operands::current(),
            log_sums: OnceLock::new(),
        }
    }

    /// The result `[B, Tq, C]`; the three slices begin at their first rows.
    pub(super) fn forward(&self, inputs: [&[f32]; 3]) -> Vec<f32> {
        let &View {
            b, tq, n_heads, d, ..
        } = &self.view;
        let mut heads = vec![0.0; b * n_heads * tq * d]; // [B, H, Tq, d]
        let mut log_sums = vec![0.0; b * n_heads * tq];
        let per_task = self.view.heads_per_task();
        for_pieces2(
            (&mut heads, per_task * tq * d),
            (&mut log_sums, per_task * tq),
            |task, out, log_sums| {
                let mut scores = Vec::new();
                let outs = out.chunks_exact_mut(tq * d);
                for (i, (out, log_sums)) in outs.zip(log_sums.chunks_exact_mut(tq)).enumerate() {
                    let head = task * per_task + i;
                    self.forward_head(head, inputs, out, log_sums, &mut scores);
                }
            },
        );
        let _ = self.log_sums.set(log_sums);
        let mut out = vec![0.0; heads.len()];
        interleave(&mut out, [&heads], (n_heads, tq, d));
        out
    }

    /// Gradients of queries `[B, H, Tq, d]`, keys and values `[B, H, Tk, d]`.
    fn backward(&self, inputs: &Inputs<'_>) -> [Vec<f32>; 3] {
        let &View {
            b,
            tq,
            tk,
            n_heads,
            d,
            ..
        } = &self.view;
        let mut dq = vec![0.0; b * n_heads * tq * d];
        let mut dk = vec![0.0; b * n_heads * tk * d];
        let mut dv = vec![0.0; b * n_heads * tk * d];
        let per_task = self.view.heads_per_task();
        for_pieces3(
            (&mut dq, per_task * tq * d),
            (&mut dk, per_task * tk * d),
            (&mut dv, per_task * tk * d),
            |task, dq, dk, dv| {
                let mut scratch = (Vec::new(), Vec::new());
                for (i, ((dq, dk), dv)) in dq
                    .chunks_exact_mut(tq * d)
                    .zip(dk.chunks_exact_mut(tk * d))
                    .zip(dv.chunks_exact_mut(tk * d))
                    .enumerate()
                {
                    self.backward_head(task * per_task + i, inputs, dq, dk, dv, &mut scratch);
                }
            },
        );
        [dq, dk, dv]
    }

    pub(super) fn kept_log_sums(&self) -> &[f32] {
        self.log_sums.get().expect("forward ran before backward")
    }
}

impl CustomOp3 for Attention {
    fn name(&self) -> &'static str {
        "attention"
    }

    fn cpu_fwd(
        &self,
        q: &CpuStorage,
        q_layout: &Layout,
        k: &CpuStorage,
        k_layout: &Layout,
        v: &CpuStorage,
        v_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (q, k) = (elements(q, q_layout)?, elements(k, k_layout)?);
        let v = elements(v, v_layout)?;
        Ok(output(self.forward([q, k, v]), q_layout.shape()))
    }

    fn bwd(
        &self,
        q: &Tensor,
        k: &Tensor,
        v: &Tensor,
        out: &Tensor,
        d_out: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let d_out = d_out.contiguous()?;
        let hosts = [
            Host::new(q)?,
            Host::new(k)?,
            Host::new(v)?,
            Host::new(out)?,
            Host::new(&d_out)?,
        ];
        let [q_all, k_all, v_all, out, d_out] = &hosts;
        let [dq, dk, dv] = self.gradients(&Inputs {
            q: q_all.slice()?,
            k: k_all.slice()?,
            v: v_all.slice()?,
            out: out.slice()?,
            d_out: d_out.slice()?,
            log_sums: self.kept_log_sums(),
        });
        Ok((
            Some(gradient(dq, q)?),
            Some(gradient(dk, k)?),
            Some(gradient(dv, v)?),
        ))
    }
}

/// Over one tensor `[B, T, 3C]` that holds queries, keys and values.
impl CustomOp1 for Attention {
    fn name(&self) -> &'static str {
        "self-attention"
    }

    fn cpu_fwd(&self, qkv: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let qkv = elements(qkv, layout)?;
        let &View {
            b, tq, n_heads, d, ..
        } = &self.view;
        Ok(output(self.of_thirds(qkv), (b, tq, n_heads * d)))
    }

    fn bwd(&self, qkv: &Tensor, out: &Tensor, d_out: &Tensor) -> Result<Option<Tensor>> {
        let d_out = d_out.contiguous()?;
        let hosts = [Host::new(qkv)?, Host::new(out)?, Host::new(&d_out)?];
        let [all, out, d_out] = &hosts;
        let joined = self.thirds_gradient(all.slice()?, out.slice()?, d_out.slice()?);
        Ok(Some(gradient(joined, qkv)?))
    }
}

impl Attention {
    /// The result `[B, T, C]` of queries, keys and values side by side, `[B, T, 3C]`.
    pub(super) fn of_thirds(&self, qkv: &[f32]) -> Vec<f32> {
        let c = self.view.n_heads * self.view.d;
        if qkv.is_empty() {
            return Vec::new();
        }
        self.forward([qkv, &qkv[c..], &qkv[2 * c..]])
    }

    /// The gradient of [`Self::of_thirds`].
    pub(super) fn thirds_gradient(&self, qkv: &[f32], out: &[f32], d_out: &[f32]) -> Vec<f32> {
        let &View { tq, n_heads, d, .. } = &self.view;
        let c = n_heads * d;
        let mut joined = vec![0.0; qkv.len()];
        if !qkv.is_empty() {
            let thirds = self.backward(&Inputs {
                q: qkv,
                k: &qkv[c..],
                v: &qkv[2 * c..],
                out,
                d_out,
                log_sums: self.kept_log_sums(),
            });
            let thirds = thirds.each_ref().map(Vec::as_slice);
            interleave(&mut joined, thirds, (n_heads, tq, d));
        }
        joined
    }

    /// Gradients of queries, keys and values, which lie apart.
    pub(super) fn gradients(&self, inputs: &Inputs<'_>) -> [Vec<f32>; 3] {
        let &View {
            tq, tk, n_heads, d, ..
        } = &self.view;
        let parts = self.backward(inputs);
        let [dq, dk, dv] = parts.each_ref();
        [(dq, tq), (dk, tk), (dv, tk)].map(|(heads, t)| {
            let mut out = vec![0.0; heads.len()];
            interleave(&mut out, [heads.as_slice()], (n_heads, t, d));
            out
        })
    }
}

/// Inputs of the gradient.
pub(super) struct Inputs<'a> {
    pub(super) q: &'a [f32],
    pub(super) k: &'a [f32],
    pub(super) v: &'a [f32],
    pub(super) out: &'a [f32],
    pub(super) d_out: &'a [f32],
    pub(super) log_sums: &'a [f32],
}

impl Attention {
    /// One head of one batch entry; `head` counts `[B, H]`, `out` is `[Tq, d]`.
    fn forward_head(
        &self,
        head: usize,
        [q, k, v]: [&[f32]; 3],
        out: &mut [f32],
        log_sums: &mut [f32],
        scores: &mut Vec<f32>,
    ) {
        let view = &self.view;
        let (d, [of_queries, of_keys]) = (view.d, view.strides);
        let (b, column) = (head / view.n_heads, head % view.n_heads * d);
        let keys = b * view.tk * of_keys + column;
        let block = view.block();
        let tk = view.visible(b, view.tq.saturating_sub(1));
        let turned = Mat::strided(&k[keys..], tk, d, of_keys).t();
        let turned = Right::new(turned, self.operands);
        let values = Mat::strided(&v[keys..], tk, d, of_keys);
        let values = Right::new(values, self.operands);
        for start in (0..view.tq).step_by(block) {
            let rows = block.min(view.tq - start);
            let n = view.visible(b, start + rows - 1);
            if n == 0 {
                continue;
            }
            scores.resize(block * view.tk, 0.0);
            let scores = &mut scores[..rows * n];
            let queries = (b * view.tq + start) * of_queries + column;
            turned.product(
                MatMut::new(scores, rows, n),
                Store::Replace,
                view.scale(),
                Mat::strided(&q[queries..], rows, d, of_queries),
                Threads::One,
            );
            // As many as a block has at most.
            let mut reciprocals = [0.0; 64];
            wide(
                #[inline(always)]
                || {
                    for (i, row) in scores.chunks_exact_mut(n).enumerate() {
                        let (seen, hidden) = row.split_at_mut(view.visible(b, start + i));
                        hidden.fill(0.0);
                        if !seen.is_empty() {
                            let peak = max(seen);
                            let sum = exp_shifted_sum(seen, peak);
                            reciprocals[i] = 1.0 / sum;
                            log_sums[start + i] = peak + sum.ln();
                        }
                    }
                },
            );
            let out = &mut out[start * d..(start + rows) * d];
            values.product(
                MatMut::new(out, rows, d),
                Store::Replace,
                1.0,
                Mat::new(scores, rows, n),
                Threads::One,
            );
            for (row, reciprocal) in out.chunks_exact_mut(d).zip(reciprocals) {
                for o in row {
                    *o *= reciprocal;
                }
            }
        }
    }

    /// Gradients of one head of one batch entry; `dq` is `[Tq, d]`, `dk` and `dv` `[Tk, d]`.
    fn backward_head(
        &self,
        head: usize,
        inputs: &Inputs<'_>,
        dq: &mut [f32],
        dk: &mut [f32],
        dv: &mut [f32],
        (p, ds): &mut (Vec<f32>, Vec<f32>),
    ) {
        let view = &self.view;
        let (c, d) = (view.n_heads * view.d, view.d);
        let [of_queries, of_keys] = view.strides;
        let (b, column) = (head / view.n_heads, head % view.n_heads * d);
        let keys = b * view.tk * of_keys + column;
        let log_sums = &inputs.log_sums[head * view.tq..];
        let block = view.block();
        let (one, by) = (Threads::One, self.operands);
        let tk = view.visible(b, view.tq.saturating_sub(1));
        let k = Mat::strided(&inputs.k[keys..], tk, d, of_keys);
        let v = Mat::strided(&inputs.v[keys..], tk, d, of_keys);
        let [k_turned, v_turned, k] = [k.t(), v.t(), k].map(|right| Right::new(right, by));
        for start in (0..view.tq).step_by(block) {
            let rows = block.min(view.tq - start);
            let n = view.visible(b, start + rows - 1);
            if n == 0 {
                continue;
            }
            p.resize(block * view.tk, 0.0);
            ds.resize(block * view.tk, 0.0);
            let (p, ds) = (&mut p[..rows * n], &mut ds[..rows * n]);
            let queries = (b * view.tq + start) * of_queries + column;
            let results = (b * view.tq + start) * c + column;
            let q = Mat::strided(&inputs.q[queries..], rows, d, of_queries);
            let d_out = Mat::strided(&inputs.d_out[results..], rows, d, c);
            let scale = view.scale();
            // Scores, and the gradient that reaches the probabilities.
            let scores = MatMut::new(p, rows, n);
            k_turned.product(scores, Store::Replace, scale, q, one);
            let slopes = MatMut::new(ds, rows, n);
            v_turned.product(slopes, Store::Replace, 1.0, d_out, one);
            wide(
                #[inline(always)]
                || {
                    let pairs = p.chunks_exact_mut(n).zip(ds.chunks_exact_mut(n));
                    for (i, (p, ds)) in pairs.enumerate() {
                        let at = results + i * c;
                        let level = dot(&inputs.d_out[at..at + d], &inputs.out[at..at + d]);
                        let log_sum = log_sums[start + i];
                        let seen = view.visible(b, start + i);
                        for (p, ds) in p[..seen].iter_mut().zip(&mut ds[..seen]) {
                            *p = exp(*p - log_sum);
                            *ds = *p * (*ds - level);
                        }
                        p[seen..].fill(0.0);
                        ds[seen..].fill(0.0);
                    }
                },
            );
            let (p, ds) = (Mat::new(p, rows, n), Mat::new(ds, rows, n));
            let dq = MatMut::new(&mut dq[start * d..], rows, d);
            k.product(dq, Store::Replace, scale, ds, one);
            gemm(MatMut::new(dk, n, d), Store::Add, scale, ds.t(), q, one, by);
            gemm(
                MatMut::new(dv, n, d),
                Store::Add,
                1.0,
                p.t(),
                d_out,
                one,
                by,
            );
        }
    }
}

/// Lays heads `[B, H, T, d]` side by side in the rows of `out`, `[B, T, N * H * d]`, one part after
/// the other.
fn interleave<const N: usize>(
    out: &mut [f32],
    parts: [&[f32]; N],
    (n_heads, t, d): (usize, usize, usize),
) {
    let width = N * n_heads * d;
    let step = rows_per_task(width);
    for_pieces(out, step * width, |piece, out| {
        for (i, row) in out.chunks_exact_mut(width).enumerate() {
            let (b, t_idx) = ((piece * step + i) / t, (piece * step + i) % t);
            for (part, row) in parts.iter().zip(row.chunks_exact_mut(n_heads * d)) {
                for (h, out) in row.chunks_exact_mut(d).enumerate() {
                    let at = ((b * n_heads + h) * t + t_idx) * d;
                    out.copy_from_slice(&part[at..at + d]);
                }
            }
        }
    });
}

#[cfg(test)]
mod tests {
    use super::super::testing::{check, flat, var};
    use super::*;

    fn check_causal(
        [b, tq, tk, c, n_heads]: [usize; 5],
        offset: usize,
        key_lengths: Option<&[usize]>,
    ) {
        let q = var(&[b, tq, c], 1);
        let (k, v) = (var(&[b, tk, c], 2), var(&[b, tk, c], 3));
        let sharp = || q.affine(6.0, 0.0);
        check(
            &[&q, &k, &v],
            || causal_attention(&sharp()?, &k, &v, n_heads, offset, key_lengths),
            || {
                let q = sharp()?;
                let view = View::new(&q, &k, &v, n_heads, Some(offset), key_lengths)?;
                composed(&q, &k, &v, &view)
            },
        );
    }

    #[test]
    fn causal_agrees_with_the_composition() {
        check_causal([1, 1, 1, 4, 1], 0, None);
        check_causal([2, 5, 5, 6, 3], 0, None);
        check_causal([2, 131, 131, 24, 2], 0, None);
        check_causal([3, 7, 20, 16, 4], 13, None);
        check_causal([2, 1, 33, 32, 2], 32, None);
        // Fewer keys than the offset would reach, and queries beyond the last key.
        check_causal([1, 4, 3, 8, 2], 1, None);
    }

    #[test]
    fn side_by_side_agrees_with_the_composition() {
        for [b, t, c, n_heads] in [[1, 1, 4, 1], [2, 5, 6, 3], [2, 131, 24, 2]] {
            let qkv = var(&[b, t, 3 * c], 1);
            let third = |i: usize| qkv.narrow(2, i * c, c);
            check(
                &[&qkv],
                || causal_self_attention(&qkv, n_heads),
                || {
                    let (q, k, v) = (third(0)?, third(1)?, third(2)?);
                    let view = View::new(&q, &k, &v, n_heads, Some(0), None)?;
                    composed(&q, &k, &v, &view)
                },
            );
        }
        assert!(causal_self_attention(&var(&[1, 2, 8], 1), 2).is_err());
    }

    #[test]
    fn padding_is_invisible() {
        check_causal([3, 70, 70, 8, 2], 0, Some(&[70, 3, 64]));
        check_causal([2, 3, 9, 8, 1], 6, Some(&[0, 8]));
        let (q, k) = (var(&[1, 2, 4], 1), var(&[1, 3, 4], 2));
        let y = causal_attention(&q, &k, &k, 2, 1, Some(&[0])).unwrap();
        assert_eq!(flat(&y), [0.0; 8]);
    }

    #[test]
    fn cross_agrees_with_the_composition_over_repeated_keys() {
        for ([b, bk, tq, tk, c, n_heads], lengths) in [
            ([1, 1, 1, 1, 2, 1], None),
            ([6, 2, 5, 17, 12, 3], None),
            ([4, 1, 40, 65, 32, 2], None),
            ([6, 3, 2, 9, 8, 2], Some([9usize, 0, 4])),
        ] {
            let lengths = lengths.as_ref().map(<[usize; 3]>::as_slice);
            let q = var(&[b, tq, c], 1);
            let (k, v) = (var(&[bk, tk, c], 2), var(&[bk, tk, c], 3));
            let repeat = |x: &Tensor| {
                x.reshape((bk, 1, tk, c))?
                    .broadcast_as((bk, b / bk, tk, c))?
                    .reshape((b, tk, c))
            };
            let repeated: Option<Vec<usize>> =
                lengths.map(|l| (0..b).map(|i| l[i / (b / bk)]).collect());
            check(
                &[&q, &k, &v],
                || match lengths {
                    Some(l) => cross_attention_padded(&q, &k, &v, n_heads, l),
                    None => cross_attention(&q, &k, &v, n_heads),
                },
                || {
                    let (k, v) = (repeat(&k)?, repeat(&v)?);
                    let view = View::new(&q, &k, &v, n_heads, None, repeated.as_deref())?;
                    composed(&q, &k, &v, &view)
                },
            );
        }
    }

    #[test]
    fn cached_steps_equal_the_whole_sequence() {
        let q = var(&[2, 9, 8], 1);
        let (k, v) = (var(&[2, 9, 8], 2), var(&[2, 9, 8], 3));
        let whole = causal_attention(&q, &k, &v, 2, 0, None).unwrap();
        for t in 0..9 {
            let q = q.narrow(1, t, 1).unwrap();
            let (k, v) = (k.narrow(1, 0, t + 1), v.narrow(1, 0, t + 1));
            let step = causal_attention(&q, &k.unwrap(), &v.unwrap(), 2, t, None).unwrap();
            let expected = whole.narrow(1, t, 1).unwrap();
            super::super::testing::assert_close("step", &step, &expected, 1e-5);
        }
    }

    #[test]
    fn shapes_that_do_not_fit_are_errors() {
        let (q, k) = (var(&[2, 3, 6], 1), var(&[1, 3, 6], 2));
        assert!(causal_attention(&q, &k, &k, 2, 0, None).is_err());
        assert!(cross_attention(&q, &k, &k, 4).is_err());
        assert!(cross_attention_padded(&q, &k, &k, 2, &[1, 2]).is_err());
    }
}
