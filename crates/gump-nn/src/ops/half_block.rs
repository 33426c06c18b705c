//! The two halves of a transformer block, each as one operation: normalisation, attention or
//! feed-forward, and the addition to the residual stream.
//!
//! What lives here: the operations and their composition from those of the other files, with the
//! same kernels in the same order. The tensor library zeroes and adds a gradient for every input of
//! every operation; here only the residual stream has one. What does not: parameters, which the
//! layers hold.

use std::sync::OnceLock;

use candle_core::{D, Device, Result, Tensor, bail};
use gump_kernels::rows::{add_to, dot};
use gump_kernels::wide;

use super::attention::{Attention, Inputs, View, causal_self_attention, cross_attention};
use super::carried::{Operation, apply};
use super::gelu::{activated, gelu, slope};
use super::linear::{Linear, bias_gradient, linear};
use super::norm::{gradients, layer_norm, normalized};
use super::{Host, fusible, gradient};

/// A matrix `[out, in]` and a bias `[out]`, if there is one.
#[derive(Clone, Copy, Debug)]
pub struct Affine<'a> {
    /// The matrix.
    pub weight: &'a Tensor,
    /// The bias.
    pub bias: Option<&'a Tensor>,
}

/// Scale and shift of a layer normalisation, `[C]` each, and what is added to its variance.
#[derive(Clone, Copy, Debug)]
pub struct Scaling<'a> {
    /// The scale.
    pub weight: &'a Tensor,
    /// The shift.
    pub bias: &'a Tensor,
    /// Added to the variance.
    pub eps: f32,
}

/// How a branch joins the residual stream.
#[derive(Clone, Copy, Debug)]
pub enum Join<'a> {
    /// It is added.
    Plain,
    /// It is multiplied by a tensor of its shape, which no gradient reaches: dropout.
    Masked(&'a Tensor),
    /// It is multiplied by a number, `[1]`.
    Gated(&'a Tensor),
}

impl Join<'_> {
    /// The residual stream with the branch.
    ///
    /// Error: shapes that do not fit.
    pub fn add(self, stream: &Tensor, branch: &Tensor) -> Result<Tensor> {
        match self {
            Self::Plain => stream + branch,
            Self::Masked(mask) => stream + (branch * mask)?,
            Self::Gated(gate) => stream + branch.broadcast_mul(gate)?,
        }
    }
}

/// `x` plus `second(gelu(first(layer_norm(x))))`, joined as `join` says.
///
/// Shape: `x` `[.., C]`, the result alike; `first` `[H, C]`, `second` `[C, H]`.
///
/// Error: when the shapes do not fit.
pub fn feed_forward(
    x: &Tensor,
    norm: Scaling<'_>,
    first: Affine<'_>,
    second: Affine<'_>,
    join: Join<'_>,
) -> Result<Tensor> {
    let all = Others::new(norm, [first, second], join, &[]);
    if !all.are_fusible(x) {
        return composed_feed_forward(x, norm, [first, second], join);
    }
    let (c, hidden) = (x.dim(D::Minus1)?, first.weight.dim(0)?);
    check(x, norm, [(first, [hidden, c]), (second, [c, hidden])], join)?;
    let op = FeedForward {
        norm: norm.into(),
        first: first.into(),
        second: second.into(),
        join: join.into(),
        linear: Linear::now(),
        kept: OnceLock::new(),
    };
    apply(x, &all.tensors, op)
}

/// What the queries of an attention see.
#[derive(Clone, Copy, Debug)]
pub enum Seen<'a> {
    /// The normalised tokens up to their own: the first matrix makes queries, keys and values, side
    /// by side.
    Past,
    /// Keys and values `[Bk, Tk, C]` with `Bk` dividing the batch, which consecutive entries share;
    /// the first matrix makes queries.
    Memory(&'a Tensor, &'a Tensor),
}

/// `x` plus `second(attention(first(layer_norm(x))))`, joined as `join` says.
///
/// Shape: `x` `[B, T, C]`, the result alike; `first` `[3C, C]` or `[C, C]`, see [`Seen`]; `second`
/// `[C, C]`.
///
/// Error: when the shapes do not fit or `n_heads` does not divide `C`.
pub fn attention_half(
    x: &Tensor,
    norm: Scaling<'_>,
    first: Affine<'_>,
    (seen, n_heads): (Seen<'_>, usize),
    second: Affine<'_>,
    join: Join<'_>,
) -> Result<Tensor> {
    let memory = match seen {
        Seen::Past => None,
        Seen::Memory(k, v) => Some([k.contiguous()?, v.contiguous()?]),
    };
    let both = memory.as_ref().map_or(Vec::new(), |m| m.iter().collect());
    let all = Others::new(norm, [first, second], join, &both);
    if !all.are_fusible(x) {
        return composed_attention(x, norm, [first, second], (seen, n_heads), join);
    }
    let (b, t, c) = x.dims3()?;
    if n_heads == 0 || c % n_heads != 0 {
        bail!("attention_half: x {:?}, {n_heads} heads", x.shape());
    }
    let view = match &memory {
        None => View::of_thirds([b, t, c], n_heads),
        Some([k, v]) => {
            let fits = k.dims().last() == Some(&c) && k.dims() == v.dims();
            let bk = k.dim(0)?;
            if !fits || bk == 0 || b % bk != 0 {
                bail!("attention_half: x {:?}, keys {:?}", x.shape(), k.shape());
            }
            View::of_keys(k, b / bk * t, n_heads)?
        }
    };
    let n_first = if memory.is_some() { c } else { 3 * c };
    check(x, norm, [(first, [n_first, c]), (second, [c, c])], join)?;
    let op = AttentionHalf {
        norm: norm.into(),
        first: first.into(),
        second: second.into(),
        join: join.into(),
        memory: memory.clone(),
        linear: Linear::now(),
        attention: Attention::new(view),
        kept: OnceLock::new(),
    };
    apply(x, &all.tensors, op)
}

fn composed_feed_forward(
    x: &Tensor,
    norm: Scaling<'_>,
    [first, second]: [Affine<'_>; 2],
    join: Join<'_>,
) -> Result<Tensor> {
    let unit = layer_norm(x, norm.weight, norm.bias, norm.eps)?;
    let active = gelu(&linear(&unit, first.weight, first.bias)?)?;
    join.add(x, &linear(&active, second.weight, second.bias)?)
}

fn composed_attention(
    x: &Tensor,
    norm: Scaling<'_>,
    [first, second]: [Affine<'_>; 2],
    (seen, n_heads): (Seen<'_>, usize),
    join: Join<'_>,
) -> Result<Tensor> {
    let unit = layer_norm(x, norm.weight, norm.bias, norm.eps)?;
    let q = linear(&unit, first.weight, first.bias)?;
    let attended = match seen {
        Seen::Past => causal_self_attention(&q, n_heads)?,
        Seen::Memory(k, v) => cross_attention(&q, k, v, n_heads)?,
    };
    join.add(x, &linear(&attended, second.weight, second.bias)?)
}

/// The tensors of an operation besides the residual stream, in the order of their gradients.
struct Others<'a> {
    tensors: Vec<&'a Tensor>,
    mask: Option<&'a Tensor>,
}

impl<'a> Others<'a> {
    fn new(
        norm: Scaling<'a>,
        matrices: [Affine<'a>; 2],
        join: Join<'a>,
        memory: &[&'a Tensor],
    ) -> Self {
        let mut tensors = vec![norm.weight, norm.bias];
        for matrix in matrices {
            tensors.push(matrix.weight);
            tensors.extend(matrix.bias);
        }
        tensors.extend(memory);
        let (gate, mask) = match join {
            Join::Plain => (None, None),
            Join::Masked(mask) => (None, Some(mask)),
            Join::Gated(gate) => (Some(gate), None),
        };
        tensors.extend(gate);
        Self { tensors, mask }
    }

    /// Whether the fused path takes them: f32 on a CPU, and parameters as they are stored.
    fn are_fusible(&self, x: &Tensor) -> bool {
        fusible(&self.tensors)
            && fusible(&[x, self.mask.unwrap_or(x)])
            && self.tensors.iter().all(|tensor| tensor.is_contiguous())
    }
}

/// Error: unless scale, shift, matrices of these sizes and what joins them fit `x`.
fn check(
    x: &Tensor,
    norm: Scaling<'_>,
    matrices: [(Affine<'_>, [usize; 2]); 2],
    join: Join<'_>,
) -> Result<()> {
    let c = x.dims().last().copied().unwrap_or(0);
    let affine_fits = |(matrix, sizes): &(Affine<'_>, [usize; 2])| {
        let bias = matrix.bias.is_none_or(|bias| bias.dims() == [sizes[0]]);
        matrix.weight.dims() == sizes && bias
    };
    let fits = norm.weight.dims() == [c]
        && norm.bias.dims() == [c]
        && matrices.iter().all(affine_fits)
        && match join {
            Join::Plain => true,
            Join::Masked(mask) => mask.dims() == x.dims(),
            Join::Gated(gate) => gate.dims() == [1],
        };
    if !fits {
        let [first, second] = matrices.map(|(matrix, _)| matrix.weight.shape());
        let x = x.shape();
        bail!(
            "half of a block: x {x:?}, matrices {first:?} and {second:?}, or what goes with them"
        );
    }
    Ok(())
}

struct OwnScaling {
    weight: Tensor,
    bias: Tensor,
    eps: f32,
}

impl From<Scaling<'_>> for OwnScaling {
    fn from(of: Scaling<'_>) -> Self {
        Self {
            weight: of.weight.clone(),
            bias: of.bias.clone(),
            eps: of.eps,
        }
    }
}

impl OwnScaling {
    /// The normalised rows, and their moments.
    fn forward(&self, x: &[f32]) -> Result<(Vec<f32>, Vec<f32>)> {
        let (weight, bias) = (Host::new(&self.weight)?, Host::new(&self.bias)?);
        Ok(normalized(x, weight.slice()?, bias.slice()?, self.eps))
    }

    /// The gradient of the residual stream `x`, which also has `dy` directly; then those of scale
    /// and shift.
    fn backward(
        &self,
        x: &Tensor,
        moments: &[f32],
        d_unit: &[f32],
        dy: &Tensor,
    ) -> Result<(Tensor, [Option<Tensor>; 2])> {
        let (weight, x_host, dy) = (Host::new(&self.weight)?, Host::new(x)?, Host::new(dy)?);
        let [mut dx, dw, db] = gradients(x_host.slice()?, weight.slice()?, moments, d_unit);
        let dy = dy.slice()?;
        wide(
            #[inline(always)]
            || add_to(&mut dx, dy),
        );
        let parameters = [gradient(dw, &self.weight)?, gradient(db, &self.bias)?];
        Ok((gradient(dx, x)?, parameters.map(Some)))
    }
}

struct OwnAffine {
    weight: Tensor,
    bias: Option<Tensor>,
}

impl From<Affine<'_>> for OwnAffine {
    fn from(of: Affine<'_>) -> Self {
        Self {
            weight: of.weight.clone(),
            bias: of.bias.cloned(),
        }
    }
}

impl OwnAffine {
    fn forward(&self, linear: &Linear, x: &[f32]) -> Result<Vec<f32>> {
        let weight = Host::new(&self.weight)?;
        let bias = self.bias.as_ref().map(Host::new).transpose()?;
        let bias = bias.as_ref().map(|bias| bias.slice()).transpose()?;
        linear.multiply(x, (weight.slice()?, &self.weight), bias)
    }

    /// The gradient of `x`; those of matrix and bias are put last in `others`.
    fn backward(
        &self,
        linear: &Linear,
        x: &Tensor,
        dy: &Tensor,
        others: &mut Vec<Option<Tensor>>,
    ) -> Result<Vec<f32>> {
        let (dx, dw) = linear.backward(x, &self.weight, dy, true)?;
        others.push(dw);
        if let Some(bias) = &self.bias {
            others.push(bias_gradient(bias, dy)?);
        }
        Ok(dx.expect("it was wanted"))
    }
}

enum OwnJoin {
    Plain,
    Masked(Tensor),
    Gated(Tensor),
}

impl From<Join<'_>> for OwnJoin {
    fn from(of: Join<'_>) -> Self {
        match of {
            Join::Plain => Self::Plain,
            Join::Masked(mask) => Self::Masked(mask.clone()),
            Join::Gated(gate) => Self::Gated(gate.clone()),
        }
    }
}

impl OwnJoin {
    /// The stream with the branch, and the branch itself if the gradient needs it.
    fn forward(&self, x: &[f32], mut z: Vec<f32>) -> Result<(Vec<f32>, Vec<f32>)> {
        let mut kept = Vec::new();
        match self {
            Self::Plain => {}
            Self::Masked(mask) => multiply(&mut z, Host::new(mask)?.slice()?),
            Self::Gated(gate) => {
                kept.clone_from(&z);
                scale(&mut z, number(gate)?);
            }
        }
        wide(
            #[inline(always)]
            || add_to(&mut z, x),
        );
        Ok((z, kept))
    }

    /// The gradient of the branch, and that of the gate, if there is one.
    fn backward(&self, kept: &[f32], dy: &Tensor) -> Result<(Tensor, Option<Option<Tensor>>)> {
        let host = Host::new(dy)?;
        let slopes = host.slice::<f32>()?;
        let (dz, d_gate) = match self {
            Self::Plain => return Ok((dy.clone(), None)),
            Self::Masked(mask) => {
                let mut dz = slopes.to_vec();
                multiply(&mut dz, Host::new(mask)?.slice()?);
                (dz, None)
            }
            Self::Gated(gate) => {
                let mut dz = slopes.to_vec();
                scale(&mut dz, number(gate)?);
                // Pieces, so that no sum of f32 is long.
                let pieces = slopes.chunks(PIECE).zip(kept.chunks(PIECE));
                let sum: f64 = pieces
                    .map(|(a, b)| {
                        f64::from(wide(
                            #[inline(always)]
                            || dot(a, b),
                        ))
                    })
                    .sum();
                let d_gate = gradient(vec![sum as f32], gate)?;
                (dz, Some(Some(d_gate)))
            }
        };
        Ok((gradient(dz, dy)?, d_gate))
    }
}

/// Elements of a piece of a long sum. Fixed, so that sums do not depend on threads.
const PIECE: usize = 16 * 1024;

fn number(of: &Tensor) -> Result<f32> {
    Ok(Host::new(of)?.slice::<f32>()?[0])
}

fn multiply(numbers: &mut [f32], by: &[f32]) {
    wide(
        #[inline(always)]
        || {
            for (number, by) in numbers.iter_mut().zip(by) {
                *number *= by;
            }
        },
    );
}

fn scale(numbers: &mut [f32], by: f32) {
    wide(
        #[inline(always)]
        || numbers.iter_mut().for_each(|number| *number *= by),
    );
}

/// Rows as a tensor, without a copy.
fn rows_of(numbers: Vec<f32>, columns: usize) -> Result<Tensor> {
    let rows = numbers.len() / columns.max(1);
    Tensor::from_vec(numbers, (rows, columns), &Device::Cpu)
}

struct FeedForward {
    norm: OwnScaling,
    first: OwnAffine,
    second: OwnAffine,
    join: OwnJoin,
    linear: Linear,
    kept: OnceLock<KeptHidden>,
}

/// What the gradient of [`FeedForward`] needs.
struct KeptHidden {
    moments: Vec<f32>,
    unit: Tensor,
    hidden: Tensor,
    active: Tensor,
    branch: Vec<f32>,
}

impl Operation for FeedForward {
    fn name(&self) -> &'static str {
        "feed-forward"
    }

    fn forward(&self, x: &[f32]) -> Result<Vec<f32>> {
        let (n_hidden, c) = self.first.weight.dims2()?;
        let (unit, moments) = self.norm.forward(x)?;
        let hidden = self.first.forward(&self.linear, &unit)?;
        let active = activated(&hidden);
        let z = self.second.forward(&self.linear, &active)?;
        let (y, branch) = self.join.forward(x, z)?;
        // A second run of one operation object would keep the same.
        let _ = self.kept.set(KeptHidden {
            moments,
            unit: rows_of(unit, c)?,
            hidden: rows_of(hidden, n_hidden)?,
            active: rows_of(active, n_hidden)?,
            branch,
        });
        Ok(y)
    }

    fn backward(
        &self,
        x: &Tensor,
        _: &Tensor,
        dy: &Tensor,
    ) -> Result<(Tensor, Vec<Option<Tensor>>)> {
        let kept = self.kept.get().expect("forward ran before backward");
        let (dz, d_gate) = self.join.backward(&kept.branch, dy)?;
        let (mut of_first, mut of_second) = (Vec::new(), Vec::new());
        let mut d = self
            .second
            .backward(&self.linear, &kept.active, &dz, &mut of_second)?;
        slope(Host::new(&kept.hidden)?.slice()?, &mut d);
        let d = gradient(d, &kept.hidden)?;
        let d_unit = self
            .first
            .backward(&self.linear, &kept.unit, &d, &mut of_first)?;
        let (dx, of_norm) = self.norm.backward(x, &kept.moments, &d_unit, dy)?;
        let of_matrices = of_first.into_iter().chain(of_second);
        let others = of_norm.into_iter().chain(of_matrices).chain(d_gate);
        Ok((dx, others.collect()))
    }
}

struct AttentionHalf {
    norm: OwnScaling,
    first: OwnAffine,
    second: OwnAffine,
    join: OwnJoin,
    memory: Option<[Tensor; 2]>,
    linear: Linear,
    attention: Attention,
    kept: OnceLock<KeptAttended>,
}

/// What the gradient of [`AttentionHalf`] needs.
struct KeptAttended {
    moments: Vec<f32>,
    unit: Tensor,
    /// Queries, or queries, keys and values.
    first: Tensor,
    attended: Tensor,
    branch: Vec<f32>,
}

impl Operation for AttentionHalf {
    fn name(&self) -> &'static str {
        "attention-half"
    }

    fn forward(&self, x: &[f32]) -> Result<Vec<f32>> {
        let (n_first, c) = self.first.weight.dims2()?;
        let (unit, moments) = self.norm.forward(x)?;
        let first = self.first.forward(&self.linear, &unit)?;
        let attended = match &self.memory {
            None => self.attention.of_thirds(&first),
            Some([k, v]) => {
                let (k, v) = (Host::new(k)?, Host::new(v)?);
                self.attention.forward([&first, k.slice()?, v.slice()?])
            }
        };
        let z = self.second.forward(&self.linear, &attended)?;
        let (y, branch) = self.join.forward(x, z)?;
        // A second run of one operation object would keep the same.
        let _ = self.kept.set(KeptAttended {
            moments,
            unit: rows_of(unit, c)?,
            first: rows_of(first, n_first)?,
            attended: rows_of(attended, c)?,
            branch,
        });
        Ok(y)
    }

    fn backward(
        &self,
        x: &Tensor,
        _: &Tensor,
        dy: &Tensor,
    ) -> Result<(Tensor, Vec<Option<Tensor>>)> {
        let kept = self.kept.get().expect("forward ran before backward");
        let (dz, d_gate) = self.join.backward(&kept.branch, dy)?;
        let (mut of_first, mut of_second) = (Vec::new(), Vec::new());
        let d_attended = self
            .second
            .backward(&self.linear, &kept.attended, &dz, &mut of_second)?;
        let (first, attended) = (Host::new(&kept.first)?, Host::new(&kept.attended)?);
        let (first, attended) = (first.slice::<f32>()?, attended.slice::<f32>()?);
        let (d_first, of_memory) = match &self.memory {
            None => {
                let d = self.attention.thirds_gradient(first, attended, &d_attended);
                (d, Vec::new())
            }
            Some([k, v]) => {
                let (k_host, v_host) = (Host::new(k)?, Host::new(v)?);
                let [dq, dk, dv] = self.attention.gradients(&Inputs {
                    q: first,
                    k: k_host.slice()?,
                    v: v_host.slice()?,
                    out: attended,
                    d_out: &d_attended,
                    log_sums: self.attention.kept_log_sums(),
                });
                (dq, vec![Some(gradient(dk, k)?), Some(gradient(dv, v)?)])
            }
        };
        let d_first = gradient(d_first, &kept.first)?;
        let d_unit = self
            .first
            .backward(&self.linear, &kept.unit, &d_first, &mut of_first)?;
        let (dx, of_norm) = self.norm.backward(x, &kept.moments, &d_unit, dy)?;
        let of_matrices = of_first.into_iter().chain(of_second).chain(of_memory);
        let others = of_norm.into_iter().chain(of_matrices).chain(d_gate);
        Ok((dx, others.collect()))
    }
}

#[cfg(test)]
mod tests {
    use super::super::deferred::Deferred;
    use super::super::testing::{check, flat, values, var};
    use super::*;
    use candle_core::Var;
    use gump_kernels::Operands;

    /// Parameters of both kinds of halves over `c` channels.
    struct Parameters {
        norm: [Var; 2],
        first: [Var; 2],
        second: [Var; 2],
        gate: Var,
    }

    impl Parameters {
        fn new(c: usize, n_first: usize, n_second: usize) -> Self {
            Self {
                norm: [var(&[c], 2), var(&[c], 3)],
                first: [var(&[n_first, c], 4), var(&[n_first], 5)],
                second: [var(&[c, n_second], 6), var(&[c], 7)],
                gate: var(&[1], 8),
            }
        }

        fn norm(&self) -> Scaling<'_> {
            let [weight, bias] = &self.norm;
            let eps = 1e-5;
            Scaling { weight, bias, eps }
        }

        fn matrices(&self, have_bias: bool) -> [Affine<'_>; 2] {
            [&self.first, &self.second].map(|[weight, bias]| Affine {
                weight,
                bias: have_bias.then_some(bias),
            })
        }

        /// Those that a half of this kind has a gradient for, `x` first.
        fn all<'a>(&'a self, x: &'a Var, have_bias: bool, join: Join<'_>) -> Vec<&'a Var> {
            let mut all = vec![x, &self.norm[0], &self.norm[1]];
            for [weight, bias] in [&self.first, &self.second] {
                all.push(weight);
                all.extend(have_bias.then_some(bias));
            }
            all.extend(matches!(join, Join::Gated(_)).then_some(&self.gate));
            all
        }
    }

    fn mask(shape: &[usize]) -> Tensor {
        let n = shape.iter().product();
        let keep = |v: f32| if v > 0.5 { 0.0 } else { 1.25 };
        let mask: Vec<f32> = values(n, 9).into_iter().map(keep).collect();
        Tensor::from_vec(mask, shape, &Device::Cpu).unwrap()
    }

    #[test]
    fn feed_forward_agrees_with_the_composition() {
        for (shape, hidden) in [
            (&[1usize, 1][..], 1),
            (&[5, 7], 9),
            (&[2, 67, 48], 192),
            (&[3, 1, 33], 65),
        ] {
            let x = var(shape, 1);
            let p = Parameters::new(shape[shape.len() - 1], hidden, hidden);
            let mask = mask(shape);
            for have_bias in [true, false] {
                for join in [Join::Plain, Join::Masked(&mask), Join::Gated(&p.gate)] {
                    let matrices = p.matrices(have_bias);
                    let [first, second] = matrices;
                    check(
                        &p.all(&x, have_bias, join),
                        || feed_forward(&x, p.norm(), first, second, join),
                        || composed_feed_forward(&x, p.norm(), matrices, join),
                    );
                }
            }
        }
    }

    #[test]
    fn attention_agrees_with_the_composition() {
        for [b, bk, t, tk, c, n_heads] in [
            [1, 1, 1, 1, 2, 1],
            [2, 2, 5, 3, 6, 3],
            [4, 2, 70, 131, 24, 2],
        ] {
            let x = var(&[b, t, c], 1);
            let (k, v) = (var(&[bk, tk, c], 10), var(&[bk, tk, c], 11));
            let mask = mask(&[b, t, c]);
            for (seen, n_first) in [(Seen::Past, 3 * c), (Seen::Memory(&k, &v), c)] {
                let p = Parameters::new(c, n_first, c);
                for (have_bias, join) in [
                    (true, Join::Plain),
                    (true, Join::Masked(&mask)),
                    (false, Join::Gated(&p.gate)),
                ] {
                    let mut all = p.all(&x, have_bias, join);
                    if n_first == c {
                        all.extend([&k, &v]);
                    }
                    let matrices = p.matrices(have_bias);
                    let ([first, second], seen) = (matrices, (seen, n_heads));
                    check(
                        &all,
                        || attention_half(&x, p.norm(), first, seen, second, join),
                        || composed_attention(&x, p.norm(), matrices, seen, join),
                    );
                }
            }
        }
    }

    /// Two halves behind one another, one parameter used twice: bit for bit what the operations one
    /// by one give, with operands in either format, and gradients of matrices deferred.
    #[test]
    fn every_bit_is_that_of_the_operations_one_by_one() {
        let x = var(&[2, 37, 32], 1);
        let (p, q) = (Parameters::new(32, 96, 32), Parameters::new(32, 50, 50));
        let mask = mask(&[2, 37, 32]);
        let bits = |t: &Tensor| flat(t).iter().map(|v| v.to_bits()).collect::<Vec<_>>();
        let run = |fused: bool, operands: Operands| {
            let deferred = Deferred::default();
            let build = || {
                let (join, seen) = (Join::Masked(&mask), (Seen::Past, 4));
                let ([first, second], [third, last]) = (p.matrices(true), q.matrices(true));
                let doubled = (x.as_tensor() * 2.0).unwrap();
                if fused {
                    let y = attention_half(&doubled, p.norm(), first, seen, second, join).unwrap();
                    feed_forward(&y, p.norm(), third, last, Join::Plain).unwrap()
                } else {
                    let pair = [first, second];
                    let y = composed_attention(&doubled, p.norm(), pair, seen, join).unwrap();
                    let pair = [third, last];
                    composed_feed_forward(&y, p.norm(), pair, Join::Plain).unwrap()
                }
            };
            let y = operands.during(|| deferred.during(build));
            let grads = y.sqr().unwrap().sum_all().unwrap().backward().unwrap();
            let mut found = vec![bits(&y)];
            let both = [p.all(&x, true, Join::Plain), q.all(&x, true, Join::Plain)];
            for (i, parameter) in both.iter().flatten().enumerate() {
                // Scale and shift of the second set are not used.
                if i == 8 || i == 9 {
                    continue;
                }
                let sum = grads.get(parameter.as_tensor()).cloned();
                let all = [&deferred].into_iter();
                let is_matrix = parameter.rank() == 2;
                assert_eq!(is_matrix, sum.is_none(), "parameter {i}");
                let sum = match is_matrix {
                    true => Deferred::take_in(all, parameter, sum).unwrap(),
                    false => sum,
                };
                found.push(bits(&sum.unwrap()));
            }
            found
        };
        for operands in [Operands::F32, Operands::Bf16] {
            assert_eq!(run(true, operands), run(false, operands), "{operands:?}");
        }
        assert_ne!(run(true, Operands::F32), run(true, Operands::Bf16));
    }

    #[test]
    fn shapes_that_do_not_fit_are_errors() {
        let (x, p) = (var(&[2, 3, 6], 1), Parameters::new(6, 18, 6));
        let [first, second] = p.matrices(true);
        let seen = |n_heads| (Seen::Past, n_heads);
        let plain = Join::Plain;
        assert!(attention_half(&x, p.norm(), first, seen(3), second, plain).is_ok());
        assert!(attention_half(&x, p.norm(), first, seen(4), second, plain).is_err());
        assert!(attention_half(&x, p.norm(), second, seen(3), second, plain).is_err());
        assert!(feed_forward(&x, p.norm(), first, second, plain).is_err());
        let masked = Join::Masked(&p.gate);
        assert!(attention_half(&x, p.norm(), first, seen(3), second, masked).is_err());
        let (k, v) = (var(&[2, 4, 6], 1), var(&[2, 5, 6], 1));
        let memory = (Seen::Memory(&k, &v), 3);
        assert!(attention_half(&x, p.norm(), second, memory, second, plain).is_err());
    }
}
