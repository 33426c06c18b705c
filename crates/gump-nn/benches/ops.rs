//! The fused operations against the same composed from candle's, in one run.
//!
//! What lives here: the operations alone and one transformer block forward and backward, at the
//! shapes of the small models. Run one with `cargo bench -p gump-nn --bench ops -- block`.

use candle_core::{D, DType, Device, Result, Tensor, Var};
use criterion::{Criterion, criterion_group, criterion_main};
use gump_nn::ops;

#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn var(shape: &[usize], scale: f32) -> Var {
    let n: usize = shape.iter().product();
    let values: Vec<f32> = (0..n)
        .map(|i| ((i as f32 * 0.618_034).fract() - 0.5) * scale)
        .collect();
    Var::from_vec(values, shape, &Device::Cpu).expect("shape and values agree")
}

fn pair(
    c: &mut Criterion,
    name: &str,
    fused: impl Fn() -> Result<Tensor>,
    composed: impl Fn() -> Result<Tensor>,
) {
    let mut group = c.benchmark_group(name);
    group.bench_function("fused", |b| b.iter(|| fused().expect("shapes fit")));
    group.bench_function("composed", |b| b.iter(|| composed().expect("shapes fit")));
    group.finish();
}

/// Forward and backward; returns a value so that nothing is skipped.
fn learn(y: &Tensor) -> Result<Tensor> {
    y.sum_all()?.backward()?;
    Ok(y.clone())
}

fn layer_norm(x: &Tensor, w: &Tensor, b: &Tensor) -> Result<Tensor> {
    let centred = x.broadcast_sub(&x.mean_keepdim(D::Minus1)?)?;
    let variance = centred.sqr()?.mean_keepdim(D::Minus1)?;
    centred
        .broadcast_div(&(variance + 1e-5)?.sqrt()?)?
        .broadcast_mul(w)?
        .broadcast_add(b)
}

fn linear(x: &Tensor, w: &Tensor, b: &Tensor) -> Result<Tensor> {
    let (batch, t, c) = x.dims3()?;
    let y = x.reshape((batch * t, c))?.matmul(&w.t()?)?;
    y.broadcast_add(b)?.reshape((batch, t, ()))
}

fn attention(q: &Tensor, k: &Tensor, v: &Tensor, n_heads: usize) -> Result<Tensor> {
    let (b, t, c) = q.dims3()?;
    let heads = |x: &Tensor| {
        x.reshape((b, t, n_heads, c / n_heads))?
            .transpose(1, 2)?
            .contiguous()
    };
    let (q, k, v) = (heads(q)?, heads(k)?, heads(v)?);
    let scores = (q.matmul(&k.t()?)? * ((c / n_heads) as f64).powf(-0.5))?;
    let mask: Vec<f32> = (0..t * t)
        .map(|i| if i % t > i / t { -1e9 } else { 0.0 })
        .collect();
    let scores = scores.broadcast_add(&Tensor::from_vec(mask, (t, t), &Device::Cpu)?)?;
    candle_nn::ops::softmax(&scores, D::Minus1)?
        .matmul(&v)?
        .transpose(1, 2)?
        .reshape((b, t, c))
}

fn cross_entropy(logits: &Tensor, targets: &Tensor, weights: &Tensor) -> Result<Tensor> {
    let log_p = candle_nn::ops::log_softmax(logits, D::Minus1)?;
    let hit = log_p.gather(&targets.unsqueeze(1)?, 1)?.squeeze(1)?;
    (hit * weights)?
        .sum_all()?
        .neg()?
        .div(&weights.sum_all()?.maximum(1e-9)?)
}

struct Block {
    norms: [(Var, Var); 2],
    projections: Vec<(Var, Var)>,
    n_heads: usize,
}

impl Block {
    fn new(c: usize, n_heads: usize) -> Self {
        let norm = || (var(&[c], 1.0), var(&[c], 1.0));
        let affine = |i, o| (var(&[o, i], 0.1), var(&[o], 0.1));
        Self {
            norms: [norm(), norm()],
            projections: vec![
                affine(c, c),
                affine(c, c),
                affine(c, c),
                affine(c, c),
                affine(c, 4 * c),
                affine(4 * c, c),
            ],
            n_heads,
        }
    }

    fn fused(&self, x: &Tensor) -> Result<Tensor> {
        let norm = |i: usize, x: &Tensor| {
            let (w, b) = &self.norms[i];
            ops::layer_norm(x, w, b, 1e-5)
        };
        let affine = |i: usize, x: &Tensor| {
            let (w, b) = &self.projections[i];
            ops::linear(x, w, Some(b))
        };
        let n = norm(0, x)?;
        let (q, k, v) = (affine(0, &n)?, affine(1, &n)?, affine(2, &n)?);
        let a = ops::causal_attention(&q, &k, &v, self.n_heads, 0, None)?;
        let x = (x + affine(3, &a)?)?;
        let hidden = ops::gelu(&affine(4, &norm(1, &x)?)?)?;
        &x + affine(5, &hidden)?
    }

    fn composed(&self, x: &Tensor) -> Result<Tensor> {
        let norm = |i: usize, x: &Tensor| layer_norm(x, &self.norms[i].0, &self.norms[i].1);
        let affine = |i: usize, x: &Tensor| {
            let (w, b) = &self.projections[i];
            linear(x, w, b)
        };
        let n = norm(0, x)?;
        let (q, k, v) = (affine(0, &n)?, affine(1, &n)?, affine(2, &n)?);
        let a = attention(&q, &k, &v, self.n_heads)?;
        let x = (x + affine(3, &a)?)?;
        let hidden = affine(4, &norm(1, &x)?)?.gelu_erf()?;
        &x + affine(5, &hidden)?
    }
}

fn rows(c: &mut Criterion) {
    let x = var(&[2048, 1536], 6.0);
    let (plain, x2) = (x.detach(), var(&[2048, 384], 2.0));
    pair(
        c,
        "gelu_2048x1536",
        || ops::gelu(&plain),
        || plain.gelu_erf(),
    );
    pair(
        c,
        "gelu_2048x1536_backward",
        || learn(&ops::gelu(&x)?),
        || learn(&x.gelu_erf()?),
    );
    let (w, b) = (var(&[384], 1.0), var(&[384], 1.0));
    let plain = [x2.detach(), w.detach(), b.detach()];
    pair(
        c,
        "layer_norm_2048x384",
        || ops::layer_norm(&plain[0], &plain[1], &plain[2], 1e-5),
        || layer_norm(&plain[0], &plain[1], &plain[2]),
    );
    pair(
        c,
        "layer_norm_2048x384_backward",
        || learn(&ops::layer_norm(&x2, &w, &b, 1e-5)?),
        || learn(&layer_norm(&x2, &w, &b)?),
    );
    let logits = var(&[512, 2974], 8.0);
    let targets: Vec<u32> = (0..512).map(|i| i * 5).collect();
    let targets = Tensor::from_vec(targets, 512, &Device::Cpu).expect("512 targets");
    let weights = Tensor::ones(512, DType::F32, &Device::Cpu).expect("512 weights");
    pair(
        c,
        "cross_entropy_512x2974_backward",
        || {
            learn(&ops::masked_cross_entropy(
                &logits, &targets, &weights, None,
            )?)
        },
        || learn(&cross_entropy(&logits, &targets, &weights)?),
    );
    let table = var(&[2974, 192], 1.0);
    let ids: Vec<u32> = (0..2048).map(|i| i * 7 % 2974).collect();
    let ids = Tensor::from_vec(ids, 2048, &Device::Cpu).expect("2048 ids");
    c.bench_function("embedding_2048_of_2974x192_backward", |b| {
        b.iter(|| learn(&table.index_select(&ids, 0).expect("ids fit")));
    });
}

fn products(c: &mut Criterion) {
    for (n_in, n_out) in [(192, 192), (192, 768), (768, 192), (384, 1536)] {
        let (x, w) = (var(&[1, 2048, n_in], 1.0), var(&[n_out, n_in], 0.1));
        let b = var(&[n_out], 1.0);
        let plain = [x.detach(), w.detach(), b.detach()];
        pair(
            c,
            &format!("linear_2048x{n_in}x{n_out}"),
            || ops::linear(&plain[0], &plain[1], Some(&plain[2])),
            || linear(&plain[0], &plain[1], &plain[2]),
        );
        pair(
            c,
            &format!("linear_2048x{n_in}x{n_out}_backward"),
            || learn(&ops::linear(&x, &w, Some(&b))?),
            || learn(&linear(&x, &w, &b)?),
        );
        c.bench_function(
            &format!("linear_2048x{n_in}x{n_out}_backward/bfloat16"),
            |bench| {
                let y = || ops::in_bfloat16(|| ops::linear(&x, &w, Some(&b)));
                bench.iter(|| learn(&y().expect("shapes fit")).expect("it learns"));
            },
        );
    }
    let shape = [4, 512, 384];
    let (q, k, v) = (var(&shape, 2.0), var(&shape, 2.0), var(&shape, 2.0));
    let plain = [q.detach(), k.detach(), v.detach()];
    pair(
        c,
        "attention_4x6x512x64",
        || ops::causal_attention(&plain[0], &plain[1], &plain[2], 6, 0, None),
        || attention(&plain[0], &plain[1], &plain[2], 6),
    );
    pair(
        c,
        "attention_4x6x512x64_backward",
        || learn(&ops::causal_attention(&q, &k, &v, 6, 0, None)?),
        || learn(&attention(&q, &k, &v, 6)?),
    );
    let (x, w) = (var(&[8, 64, 56, 56], 1.0), var(&[64, 64, 3, 3], 0.1));
    let plain = [x.detach(), w.detach()];
    pair(
        c,
        "conv_8x64x56x56",
        || ops::conv2d(&plain[0], &plain[1], None, 1, 1),
        || plain[0].conv2d(&plain[1], 1, 1, 1, 1),
    );
    pair(
        c,
        "conv_8x64x56x56_backward",
        || learn(&ops::conv2d(&x, &w, None, 1, 1)?),
        || learn(&x.conv2d(&w, 1, 1, 1, 1)?),
    );
}

fn decode(c: &mut Criterion) {
    let (q, k) = (var(&[1, 1, 192], 1.0), var(&[1, 512, 192], 1.0));
    let (q, k) = (q.detach(), k.detach());
    c.bench_function("attention_step_1x4x512x48", |b| {
        b.iter(|| ops::causal_attention(&q, &k, &k, 4, 511, None).expect("shapes fit"));
    });
    let (q, k) = (var(&[32, 1, 192], 1.0), var(&[32, 512, 192], 1.0));
    let (q, k) = (q.detach(), k.detach());
    c.bench_function("attention_step_32x4x512x48", |b| {
        b.iter(|| ops::causal_attention(&q, &k, &k, 4, 511, None).expect("shapes fit"));
    });
    for rows in [1, 32] {
        let (x, w) = (var(&[rows, 1, 192], 1.0), var(&[768, 192], 1.0));
        let (x, w, bias) = (x.detach(), w.detach(), var(&[768], 1.0).detach());
        pair(
            c,
            &format!("linear_{rows}x192x768"),
            || ops::linear(&x, &w, Some(&bias)),
            || linear(&x, &w, &bias),
        );
    }
    let (x, h) = (var(&[16, 150, 192], 1.0), var(&[150, 192], 1.0));
    let (w, bias) = (var(&[576, 192], 0.1), var(&[576], 0.1));
    let map = ops::Affine {
        weight: &w,
        bias: Some(&bias),
    };
    c.bench_function("gru_16x150x192", |b| {
        b.iter(|| learn(&ops::gru(&x, &h, map, map).expect("shapes fit")).expect("it learns"));
    });
}

fn blocks(c: &mut Criterion) {
    for (width, n_heads) in [(192, 4), (384, 6)] {
        let block = Block::new(width, n_heads);
        let x = var(&[4, 512, width], 2.0);
        pair(
            c,
            &format!("block_{width}_4x512_backward"),
            || learn(&block.fused(&x)?),
            || learn(&block.composed(&x)?),
        );
        c.bench_function(&format!("block_{width}_4x512_backward/bfloat16"), |bench| {
            let y = || ops::in_bfloat16(|| block.fused(&x));
            bench.iter(|| learn(&y().expect("shapes fit")).expect("it learns"));
        });
    }
}

criterion_group! {
    name = benches;
    config = Criterion::default()
        .sample_size(10)
        .warm_up_time(std::time::Duration::from_millis(200))
        .measurement_time(std::time::Duration::from_millis(800));
    targets = rows, products, decode, blocks
}
criterion_main!(benches);
