//! The network's weights in the form that the engine multiplies: packed layers, read by their
//! checkpoint names.
//!
//! `mod.rs` applies the layers.

use candle_core::Tensor;
use gump_kernels::norm::NORM_EPS;
use gump_kernels::norm::normalize_row;
use gump_kernels::panels::{Panels, Precision};
use gump_kernels::wide;
use gump_model::ModelError;
use gump_model::Network;

use crate::expressible::expressible;

/// The parameters of a network by name.
pub(super) struct WeightReader<'a> {
    pub(super) network: &'a Network,
    pub(super) precision: Precision,
}

impl WeightReader<'_> {
    /// The numbers called `name`, if the network has them.
    pub(super) fn find(&self, name: &str) -> Result<Option<Vec<f32>>, ModelError> {
        let var = self.network.parameters().find(name);
        var.map(|var| numbers(var)).transpose()
    }

    /// The numbers called `name`.
    pub(super) fn get(&self, name: &str) -> Result<Vec<f32>, ModelError> {
        self.find(name)?.ok_or_else(|| ModelError::MissingTensor {
            name: name.to_owned(),
        })
    }

    /// The linear layer called `name`.
    pub(super) fn linear(&self, name: &str, n_in: usize) -> Result<Panels, ModelError> {
        let weight = self.expressible(&format!("{name}.weight"))?;
        let bias = self.find(&format!("{name}.bias"))?;
        Ok(Panels::new(&weight, n_in, bias.as_deref(), self.precision))
    }

    /// The numbers called `name`, which the precision can express.
    fn expressible(&self, name: &str) -> Result<Vec<f32>, ModelError> {
        let numbers = self.get(name)?;
        expressible(name, &numbers, self.precision)?;
        Ok(numbers)
    }

    /// Rows `first..first + n` of the linear layer called `name`.
    pub(super) fn linear_rows(
        &self,
        name: &str,
        n_in: usize,
        first: usize,
        n: usize,
    ) -> Result<Panels, ModelError> {
        let weight = self.expressible(&format!("{name}.weight"))?;
        let bias = self.find(&format!("{name}.bias"))?;
        Ok(Panels::new(
            &weight[first * n_in..(first + n) * n_in],
            n_in,
            bias.as_ref().map(|bias| &bias[first..first + n]),
            self.precision,
        ))
    }

    pub(super) fn norm(&self, name: &str) -> Result<Norm, ModelError> {
        Ok(Norm {
            weight: self.get(&format!("{name}.weight"))?,
            bias: self.get(&format!("{name}.bias"))?,
        })
    }

    /// Tanh of a gate; 1 where there is none.
    fn gate(&self, name: &str) -> Result<f32, ModelError> {
        Ok(self.find(name)?.map_or(1.0, |gate| gate[0].tanh()))
    }
}

/// The elements of a tensor.
pub(super) fn numbers(tensor: &Tensor) -> Result<Vec<f32>, ModelError> {
    Ok(tensor.flatten_all()?.to_vec1::<f32>()?)
}

/// Layer normalisation.
#[derive(Debug)]
pub(super) struct Norm {
    weight: Vec<f32>,
    bias: Vec<f32>,
}

impl Norm {
    /// Rows of `x` normalised into `y`.
    pub(super) fn apply(&self, x: &[f32], y: &mut [f32]) {
        let c = self.weight.len();
        wide(
            #[inline(always)]
            || {
                for (x, y) in x.chunks_exact(c).zip(y.chunks_exact_mut(c)) {
                    normalize_row(x, &self.weight, &self.bias, NORM_EPS as f32, y);
                }
            },
        );
    }
}

/// A normalised feed-forward.
#[derive(Debug)]
pub(super) struct Mlp {
    pub(super) norm: Norm,
    pub(super) expand: Panels,
    pub(super) contract: Panels,
    pub(super) gate: f32,
}

/// A normalised attention; keys and values come from elsewhere in cross-attention.
#[derive(Debug)]
pub(super) struct Attention {
    pub(super) norm: Norm,
    pub(super) query: Panels,
    pub(super) out: Panels,
    pub(super) gate: f32,
}

/// One block, and the cross-attention after it if there is one.
#[derive(Debug)]
pub(super) struct Layer {
    pub(super) attention: Attention,
    pub(super) key_value: Panels,
    pub(super) mlp: Mlp,
    pub(super) cross: Option<(Attention, Mlp)>,
}

impl Layer {
    pub(super) fn new(weights: &WeightReader<'_>, i: usize, c: usize) -> Result<Self, ModelError> {
        let name = format!("mct.blocks.{i}");
        let cross = format!("mct.cross.{i}");
        let mlp = |name: &str, gate: f32| {
            Ok::<_, ModelError>(Mlp {
                norm: weights.norm(&format!("{name}.norm_mlp"))?,
                expand: weights.linear(&format!("{name}.mlp_in"), c)?,
                contract: weights.linear(&format!("{name}.mlp_out"), 4 * c)?,
                gate,
            })
        };
        let cross = if i.is_multiple_of(3) {
            let attention = Attention {
                norm: weights.norm(&format!("{cross}.norm"))?,
                query: weights.linear(&format!("{cross}.query"), c)?,
                out: weights.linear(&format!("{cross}.out"), c)?,
                gate: weights.gate(&format!("{cross}.gate_attention"))?,
            };
            let gate = weights.gate(&format!("{cross}.gate_mlp"))?;
            Some((attention, mlp(&cross, gate)?))
        } else {
            None
        };
        Ok(Self {
            attention: Attention {
                norm: weights.norm(&format!("{name}.norm_attention"))?,
                query: weights.linear_rows(&format!("{name}.qkv"), c, 0, c)?,
                out: weights.linear(&format!("{name}.attention_out"), c)?,
                gate: 1.0,
            },
            key_value: weights.linear_rows(&format!("{name}.qkv"), c, c, 2 * c)?,
            mlp: mlp(&name, 1.0)?,
            cross,
        })
    }

    /// All its matrices.
    pub(super) fn matrices(&self) -> impl Iterator<Item = &Panels> {
        let own = [
            &self.attention.query,
            &self.attention.out,
            &self.key_value,
            &self.mlp.expand,
            &self.mlp.contract,
        ];
        let cross = self.cross.iter().flat_map(|(attention, mlp)| {
            [&attention.query, &attention.out, &mlp.expand, &mlp.contract]
        });
        own.into_iter().chain(cross)
    }
}
