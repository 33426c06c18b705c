//! Layers with parameters: linear, layer normalisation, dropout.

use candle_core::{DType, Device, Result, Shape, Tensor};
use gump_seed::Seed;

pub use gump_kernels::norm::NORM_EPS;

use crate::NnError;
use crate::ops;
use crate::ops::{Affine, Join, Scaling, Seen};
use crate::parameters::{Init, Scope};

/// Deviation from which every table of embeddings starts, as GPT-2's do.
pub const TABLE_DEVIATION: f64 = 0.02;

/// Layer normalisation with scale and shift.
#[derive(Debug)]
pub struct LayerNorm {
    weight: Tensor,
    bias: Tensor,
}

impl LayerNorm {
    /// A layer that starts as PyTorch's: scale 1, shift 0.
    ///
    /// # Errors
    /// Weights to be loaded that lack its tensors.
    pub fn new(
        scope: &mut Scope<'_>,
        name: &str,
        width: usize,
    ) -> std::result::Result<Self, NnError> {
        let mut scope = scope.part(name);
        let weight = scope.get("weight", width, Init::Constant(1.0))?;
        Ok(Self {
            weight,
            bias: scope.get("bias", width, Init::Constant(0.0))?,
        })
    }

    /// Shape: any `[.., width]`; the result is shaped alike.
    ///
    /// # Errors
    /// Another width.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        ops::layer_norm(x, &self.weight, &self.bias, NORM_EPS as f32)
    }
}

impl LayerNorm {
    fn scaling(&self) -> Scaling<'_> {
        Scaling {
            weight: &self.weight,
            bias: &self.bias,
            eps: NORM_EPS as f32,
        }
    }
}

/// A matrix, with or without bias.
#[derive(Debug)]
pub struct Linear {
    weight: Tensor,
    bias: Option<Tensor>,
    /// Number type in which the product is computed.
    product: DType,
}

impl Linear {
    /// Creates a layer initialised as in PyTorch: uniform.
    pub fn new(
        scope: &mut Scope<'_>,
        name: &str,
        inputs: usize,
        outputs: usize,
    ) -> std::result::Result<Self, NnError> {
        Self::with(
            scope,
            name,
            inputs,
            outputs,
            Init::FanIn(inputs),
            Some(Init::FanIn(inputs)),
        )
    }

    /// Creates a layer whose matrix and bias are initialised as given; `None` for no bias.
    ///
    /// # Errors
    /// Weights to be loaded that lack its tensors.
    pub fn with(
        scope: &mut Scope<'_>,
        name: &str,
        inputs: usize,
        outputs: usize,
        weight: Init,
        bias: Option<Init>,
    ) -> std::result::Result<Self, NnError> {
        let mut scope = scope.part(name);
        let weight = scope.get("weight", (outputs, inputs), weight)?;
        Ok(Self {
            weight,
            product: scope.products(),
            bias: bias
                .map(|init| scope.get("bias", outputs, init))
                .transpose()?,
        })
    }

    /// Shape: `[.., inputs]`; the result `[.., outputs]`.
    ///
    /// # Errors
    /// Another number of inputs.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        if self.product != DType::F32 {
            return ops::reduced_linear(x, &self.weight, self.bias.as_ref(), self.product);
        }
        ops::linear(x, &self.weight, self.bias.as_ref())
    }

    fn affine(&self) -> Affine<'_> {
        Affine {
            weight: &self.weight,
            bias: self.bias.as_ref(),
        }
    }

    /// The matrix, `[out, in]`.
    pub fn weight(&self) -> &Tensor {
        &self.weight
    }

    /// The bias, `[out]`, if there is one.
    pub fn bias(&self) -> Option<&Tensor> {
        self.bias.as_ref()
    }
}

/// `x` plus `second(gelu(first(norm(x))))`, joined as `join` says; as one operation where the
/// products are f32.
///
/// Shape: `x` `[.., C]`, the result alike.
///
/// # Errors
/// Layers of other widths.
pub fn feed_forward(
    x: &Tensor,
    norm: &LayerNorm,
    [first, second]: [&Linear; 2],
    join: Join<'_>,
) -> Result<Tensor> {
    if [first, second].iter().any(|l| l.product != DType::F32) {
        let hidden = ops::gelu(&first.forward(&norm.forward(x)?)?)?;
        return join.add(x, &second.forward(&hidden)?);
    }
    ops::feed_forward(x, norm.scaling(), first.affine(), second.affine(), join)
}

/// `x` plus `second(attention(first(norm(x))))`, joined as `join` says; as one operation where the
/// products are f32.
///
/// Shape: `x` `[B, T, C]`, the result alike; `first` makes what [`Seen`] says.
///
/// # Errors
/// Layers of other widths, or heads that do not divide theirs.
pub fn attention_half(
    x: &Tensor,
    norm: &LayerNorm,
    [first, second]: [&Linear; 2],
    (seen, n_heads): (Seen<'_>, usize),
    join: Join<'_>,
) -> Result<Tensor> {
    if [first, second].iter().any(|l| l.product != DType::F32) {
        let q = first.forward(&norm.forward(x)?)?;
        let attended = match seen {
            Seen::Past => ops::causal_self_attention(&q, n_heads)?,
            Seen::Memory(k, v) => ops::cross_attention(&q, k, v, n_heads)?,
        };
        return join.add(x, &second.forward(&attended)?);
    }
    let seen = (seen, n_heads);
    ops::attention_half(
        x,
        norm.scaling(),
        first.affine(),
        seen,
        second.affine(),
        join,
    )
}

/// The states after each step of a gated recurrent unit, given its maps of inputs and of states; as one
/// operation where the products are f32.
///
/// Shape: `inputs` `[S, N, C]`, `h` `[N, C]`; the result `[S, N, C]`.
///
/// # Errors
/// Layers of other widths or without a bias.
pub fn gru(inputs: &Tensor, h: &Tensor, [input, hidden]: [&Linear; 2]) -> Result<Tensor> {
    if input.product != DType::F32 {
        return ops::gru_of_gates(&input.forward(inputs)?, h, hidden.affine());
    }
    ops::gru(inputs, h, input.affine(), hidden.affine())
}

/// Seeded dropout: absent at inference.
#[derive(Clone, Debug)]
pub struct Dropout {
    probability: f64,
    seed: Seed,
    calls: std::cell::Cell<u64>,
}

impl Dropout {
    /// Dropout of this probability; `None` for 0.
    pub fn new(probability: f64, seed: Seed) -> Option<Self> {
        (probability > 0.0).then(|| Self {
            probability,
            seed,
            calls: 0.into(),
        })
    }

    /// The factors of the next tensor to be thinned out: 0, or what makes up for it.
    ///
    /// # Errors
    /// A tensor error.
    pub fn mask(&self, shape: &Shape, device: &Device) -> Result<Tensor> {
        let seed = self.seed.fork(self.calls.get());
        self.calls.set(self.calls.get() + 1);
        let mut rng = seed.rng();
        let keep = 1.0 / (1.0 - self.probability) as f32;
        let threshold = (self.probability * f64::from(u32::MAX)) as u32;
        let mask: Vec<f32> = (0..shape.elem_count())
            .map(|_| {
                if rand::RngCore::next_u32(&mut rng) < threshold {
                    0.0
                } else {
                    keep
                }
            })
            .collect();
        Tensor::from_vec(mask, shape, device)
    }
}

/// Drops entries of `x` and scales the rest up; returns `x` unchanged without dropout.
pub fn drop_out(x: Tensor, dropout: Option<&Dropout>) -> Result<Tensor> {
    match dropout {
        Some(dropout) => &x * dropout.mask(x.shape(), x.device())?,
        None => Ok(x),
    }
}
