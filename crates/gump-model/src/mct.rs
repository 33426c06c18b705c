//! The multimodal causal transformer.
//!
//! Tokens are embedded, pass through `layers` blocks of causal self-attention with gated
//! cross-attention to the map after every third block, and become one hidden vector per token.
//! [`crate::decoder`] turns the hidden vector at an agent's *key* into its state.
//!
//! Shapes: `B` sequences, `T` tokens, `C` width, `M` visual tokens, `S` scenes; `B` is a multiple of
//! `S`, and `B / S` consecutive sequences share a scene.
//!
//! Source: GUMP (ECCV 2024); GPT-2 blocks; gated cross-attention after Flamingo.

use std::sync::Arc;

use candle_core::{Result, Tensor};
use gump_nn::layers::{
    Dropout, LayerNorm, Linear, TABLE_DEVIATION, attention_half, drop_out, feed_forward,
};
use gump_nn::ops;
use gump_nn::ops::{Join, Seen, embedding_sum};
use gump_nn::parameters::{Init, Scope};
use gump_tokenizer::N_CLASSES;

use crate::ModelError;
use crate::config::{Gate, ModelConfig};
use crate::embedding::Tables;
use crate::local_context::{LaneMap, n_numbers};

/// Self-attention and MLP, pre-norm.
#[derive(Debug)]
struct Block {
    norm_attention: LayerNorm,
    qkv: Linear,
    attention_out: Linear,
    norm_mlp: LayerNorm,
    mlp_in: Linear,
    mlp_out: Linear,
    heads: usize,
}

impl Block {
    fn new(mut scope: Scope<'_>, config: &ModelConfig) -> std::result::Result<Self, ModelError> {
        let c = config.width;
        let zero = Some(Init::Constant(0.0));
        // Residual projections start small so that the variance does not grow with depth (GPT-2).
        let residual = Init::Normal(TABLE_DEVIATION / (2.0 * config.layers as f64).sqrt());
        Ok(Self {
            norm_attention: LayerNorm::new(&mut scope, "norm_attention", c)?,
            qkv: Linear::with(&mut scope, "qkv", c, 3 * c, Init::Xavier, zero)?,
            attention_out: Linear::with(&mut scope, "attention_out", c, c, residual, zero)?,
            norm_mlp: LayerNorm::new(&mut scope, "norm_mlp", c)?,
            mlp_in: Linear::with(&mut scope, "mlp_in", c, 4 * c, Init::Xavier, zero)?,
            mlp_out: Linear::with(&mut scope, "mlp_out", 4 * c, c, residual, zero)?,
            heads: config.heads,
        })
    }

    fn forward(
        &self,
        x: &Tensor,
        cache: Option<&mut Option<(Tensor, Tensor)>>,
        dropout: Option<&Dropout>,
    ) -> Result<Tensor> {
        let mask = || dropout.map(|d| d.mask(x.shape(), x.device())).transpose();
        let (norm, out) = (&self.norm_attention, &self.attention_out);
        let attention_mask = mask()?;
        let join = attention_mask.as_ref().map_or(Join::Plain, Join::Masked);
        let x = match cache {
            None => attention_half(x, norm, [&self.qkv, out], (Seen::Past, self.heads), join)?,
            Some(past) => {
                let c = x.dim(2)?;
                let qkv = self.qkv.forward(&norm.forward(x)?)?; // [B, T, 3C]
                let q = qkv.narrow(2, 0, c)?;
                let mut k = qkv.narrow(2, c, c)?;
                let mut v = qkv.narrow(2, 2 * c, c)?;
                let mut offset = 0;
                if let Some((past_k, past_v)) = past.as_ref() {
                    offset = past_k.dim(1)?;
                    k = Tensor::cat(&[past_k, &k], 1)?;
                    v = Tensor::cat(&[past_v, &v], 1)?;
                }
                *past = Some((k.contiguous()?, v.contiguous()?));
                let attended = ops::causal_attention(&q, &k, &v, self.heads, offset, None)?;
                join.add(x, &out.forward(&attended)?)?
            }
        }; // [B, T, C]
        let mlp_mask = mask()?;
        let join = mlp_mask.as_ref().map_or(Join::Plain, Join::Masked);
        feed_forward(&x, &self.norm_mlp, [&self.mlp_in, &self.mlp_out], join)
    }
}

/// Gated cross-attention to the map.
#[derive(Debug)]
struct CrossBlock {
    norm: LayerNorm,
    query: Linear,
    key_value: Linear,
    out: Linear,
    gate_attention: Tensor,
    norm_mlp: LayerNorm,
    mlp_in: Linear,
    mlp_out: Linear,
    gate_mlp: Option<Tensor>,
    heads: usize,
}

impl CrossBlock {
    fn new(mut scope: Scope<'_>, config: &ModelConfig) -> std::result::Result<Self, ModelError> {
        let c = config.width;
        let mut matrix = |name: &str, inputs, outputs| {
            Linear::with(&mut scope, name, inputs, outputs, Init::Xavier, None)
        };
        let (query, key_value, out) = (
            matrix("query", c, c)?,
            matrix("key_value", c, 2 * c)?,
            matrix("out", c, c)?,
        );
        let (mlp_in, mlp_out) = (matrix("mlp_in", c, 4 * c)?, matrix("mlp_out", 4 * c, c)?);
        let (gate_attention, gate_mlp) = match config.gate {
            Gate::Flamingo => {
                let zero = Init::Constant(0.0);
                (
                    scope.get("gate_attention", 1, zero)?,
                    Some(scope.get("gate_mlp", 1, zero)?),
                )
            }
            // The released code's deviation.
            Gate::Released => (scope.get("gate_attention", 1, Init::Normal(0.3))?, None),
        };
        let norm = LayerNorm::new(&mut scope, "norm", c)?;
        let norm_mlp = LayerNorm::new(&mut scope, "norm_mlp", c)?;
        let heads = config.heads;
        Ok(Self {
            norm,
            query,
            key_value,
            out,
            gate_attention,
            norm_mlp,
            mlp_in,
            mlp_out,
            gate_mlp,
            heads,
        })
    }

    /// Keys and values of the visual tokens, [S, M, C] each.
    fn remember(&self, visual: &Tensor) -> Result<(Tensor, Tensor)> {
        let c = visual.dim(2)?;
        let kv = self.key_value.forward(visual)?; // [S, M, 2C]
        Ok((
            kv.narrow(2, 0, c)?.contiguous()?,
            kv.narrow(2, c, c)?.contiguous()?,
        ))
    }

    fn forward(&self, x: &Tensor, (k, v): &(Tensor, Tensor)) -> Result<Tensor> {
        let gate = self.gate_attention.tanh()?;
        let layers = [&self.query, &self.out];
        let seen = (Seen::Memory(k, v), self.heads);
        let x = attention_half(x, &self.norm, layers, seen, Join::Gated(&gate))?;
        let gate = self.gate_mlp.as_ref().map(Tensor::tanh).transpose()?;
        let join = gate.as_ref().map_or(Join::Plain, Join::Gated);
        feed_forward(&x, &self.norm_mlp, [&self.mlp_in, &self.mlp_out], join)
    }
}

/// The encoding of a scene's map: keys and values per cross-attention block, `[S, M, C]`; computed
/// once and shared by all futures of the scene.
#[derive(Clone, Debug)]
pub struct VisualMemory {
    /// Per scene, its prepared map for local contexts.
    pub lane_maps: Vec<Arc<LaneMap>>,
    /// The visual tokens themselves, for reading the map under an object.
    pub visual: Tensor,
    /// By layer of cross-attention.
    pub key_values: Vec<(Tensor, Tensor)>,
}

impl VisualMemory {
    /// The memories of several scenes as one batch, in the given order.
    pub fn join(parts: &[&Self]) -> Result<Self> {
        if let [only] = parts {
            return Ok((*only).clone());
        }
        let blocks = parts.first().map_or(0, |part| part.key_values.len());
        let join = |pick: &dyn Fn(&Self) -> Tensor| {
            Tensor::cat(&parts.iter().map(|part| pick(part)).collect::<Vec<_>>(), 0)
        };
        let key_values = (0..blocks).map(|i| {
            Ok((
                join(&|part| part.key_values[i].0.clone())?,
                join(&|part| part.key_values[i].1.clone())?,
            ))
        });
        let lane_maps = parts.iter().flat_map(|part| &part.lane_maps);
        Ok(Self {
            lane_maps: lane_maps.cloned().collect(),
            visual: join(&|part| part.visual.clone())?,
            key_values: key_values.collect::<Result<_>>()?,
        })
    }
}

/// Keys and values of the tokens seen so far, per self-attention block, `[B, T, C]`.
#[derive(Clone, Debug)]
pub struct Cache {
    layers: Vec<Option<(Tensor, Tensor)>>,
}

impl Cache {
    /// Nothing is kept yet.
    pub fn new(layers: usize) -> Self {
        Self {
            layers: vec![None; layers],
        }
    }

    /// Whether no token is remembered.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Tokens remembered.
    pub fn len(&self) -> usize {
        self.layers[0].as_ref().map_or(0, |(k, _)| k.dims()[1])
    }
}

/// The output of a forward pass.
#[derive(Debug)]
pub struct Features {
    /// After the final normalisation, [B, T, C].
    pub hidden: Tensor,
    /// After each block a trajectory head reads, [B, T, C] each.
    pub levels: Vec<Tensor>,
}

/// Token embeddings and the transformer.
#[derive(Debug)]
pub struct Mct {
    table: Tensor,
    sine_in: Linear,
    sine_norm: LayerNorm,
    sine_out: Linear,
    blocks: Vec<Block>,
    cross: Vec<CrossBlock>,
    norm: LayerNorm,
    levels: Vec<usize>,
    /// One map per position that an object looks at, if the network has this option.
    local: Vec<Linear>,
    /// Two layers over local contexts, if the network has this option.
    local_context: Option<(Linear, Linear)>,
}

/// Tokens ready to embed: `B` sequences of `T` tokens each.
#[derive(Debug)]
pub struct TokenBatch {
    /// Table rows per token, [B * T, ROWS_PER_TOKEN].
    pub(crate) rows: Tensor,
    /// Flat indices of the tokens that have coordinates, [N].
    pub(crate) sine_positions: Tensor,
    /// Their sine features, [N, C].
    pub(crate) sines: Tensor,
    /// Flat indices of the keys that read the map under their object, [K].
    pub(crate) local_map_rows: Tensor,
    /// Per position they look at, the visual token there, counted within a scene, [K] each.
    pub(crate) places: [Vec<u32>; PLACES.len()],
    /// Row of the batch each of them stands in, [K].
    pub(crate) local_map_sequences: Vec<u32>,
    /// Flat indices of the keys with a local context, [K'].
    pub(crate) context_rows: Tensor,
    /// Their local contexts, [K', n] with n the numbers that this network uses.
    pub(crate) local_context: Tensor,
    /// (B, T)
    pub shape: (usize, usize),
}

impl TokenBatch {
    /// Returns the inputs of the transformer by name, for code in other languages: `rows`,
    /// `sine_positions`, `sines`, `local_map_rows`, `context_rows` and `local_context` as stored, and
    /// `places` \[places, K\], rows of the visual tokens of all sequences, of which each has
    /// `visual_tokens`.
    ///
    /// Every sequence must have a separate scene.
    ///
    /// # Errors
    /// The tensor library failed.
    pub fn named(&self, visual_tokens: usize) -> Result<Vec<(&'static str, Tensor)>> {
        let of_row = |(row, cell): (&u32, &u32)| row * visual_tokens as u32 + cell;
        let places: Vec<u32> = self
            .places
            .iter()
            .flat_map(|cells| self.local_map_sequences.iter().zip(cells).map(of_row))
            .collect();
        let shape = (PLACES.len(), self.local_map_sequences.len());
        Ok(vec![
            ("rows", self.rows.clone()),
            ("sine_positions", self.sine_positions.clone()),
            ("sines", self.sines.clone()),
            ("local_map_rows", self.local_map_rows.clone()),
            (
                "places",
                Tensor::from_vec(places, shape, self.rows.device())?,
            ),
            ("context_rows", self.context_rows.clone()),
            ("local_context", self.local_context.clone()),
        ])
    }
}

/// Positions at which an object reads the map: seconds ahead on its present course. Up to the reach
/// of a chunk, about; not tuned (decision 10).
pub const PLACES: [f64; 3] = [0.0, 1.0, 2.0];

impl Mct {
    pub(crate) fn new(
        mut scope: Scope<'_>,
        config: &ModelConfig,
    ) -> std::result::Result<Self, ModelError> {
        let c = config.width;
        let tables = Tables::new(config);
        let n_places = if config.local_map { PLACES.len() } else { 0 };
        let local = (0..n_places)
            .map(|i| {
                Linear::with(
                    &mut scope,
                    &format!("local.{i}"),
                    c,
                    c,
                    Init::Constant(0.0),
                    None,
                )
            })
            .collect::<std::result::Result<_, _>>()?;
        let local_context = config
            .local_context
            .then(|| {
                let mut scope = scope.part("surroundings");
                let zero = Some(Init::Constant(0.0));
                let small = Init::Normal(TABLE_DEVIATION);
                Ok::<_, ModelError>((
                    Linear::new(&mut scope, "in", n_numbers(config), 2 * c)?,
                    Linear::with(&mut scope, "out", 2 * c, c, small, zero)?,
                ))
            })
            .transpose()?;
        Ok(Self {
            local_context,
            table: scope.get(
                "tables",
                (tables.n_rows(), c),
                Init::Normal(TABLE_DEVIATION),
            )?,
            sine_in: Linear::new(&mut scope, "sine_in", c, 2 * c)?,
            sine_norm: LayerNorm::new(&mut scope, "sine_norm", 2 * c)?,
            sine_out: Linear::new(&mut scope, "sine_out", 2 * c, c)?,
            blocks: (0..config.layers)
                .map(|i| Block::new(scope.part(format!("blocks.{i}")), config))
                .collect::<std::result::Result<_, _>>()?,
            cross: (0..config.layers)
                .filter(|i| i % 3 == 0)
                .map(|i| CrossBlock::new(scope.part(format!("cross.{i}")), config))
                .collect::<std::result::Result<_, _>>()?,
            norm: LayerNorm::new(&mut scope, "norm", c)?,
            levels: config.trajectory_heads.clone(),
            local,
        })
    }

    /// The rows of the token table, [TABLE_ROWS, C], which the decoder reads too.
    pub fn token_table(&self) -> Result<Tensor> {
        self.table.narrow(0, 0, Tables::CLASS)
    }

    /// Logits over the class of an agent not seen before, from the slot before its key; the same
    /// rows embed classes as inputs; [N, 3].
    pub fn class_logits(&self, hidden: &Tensor) -> Result<Tensor> {
        let rows = ops::table_rows(&self.table, Tables::CLASS, N_CLASSES)?;
        ops::linear(hidden, &rows, None)
    }

    /// The MLP over sine features, [N, C] to [N, C].
    pub(crate) fn embed_sine(&self, sines: &Tensor) -> Result<Tensor> {
        let hidden = self
            .sine_norm
            .forward(&self.sine_in.forward(sines)?)?
            .relu()?;
        self.sine_out.forward(&hidden)
    }

    /// Encodes the visual tokens of scenes once, [S, M, C].
    pub fn remember(&self, visual: &Tensor, lane_maps: Vec<Arc<LaneMap>>) -> Result<VisualMemory> {
        let key_values = self.cross.iter().map(|cross| cross.remember(visual));
        Ok(VisualMemory {
            lane_maps,
            visual: visual.clone(),
            key_values: key_values.collect::<Result<_>>()?,
        })
    }

    /// The map under and ahead of every object that reads it, [K, C].
    fn encode_local_context(&self, batch: &TokenBatch, memory: &VisualMemory) -> Result<Tensor> {
        let (scenes, m, c) = memory.visual.dims3()?;
        let flat = memory.visual.reshape((scenes * m, c))?;
        let sharing = (batch.shape.0 / scenes) as u32;
        let mut seen: Option<Tensor> = None;
        for (map, cells) in self.local.iter().zip(&batch.places) {
            let rows = batch.local_map_sequences.iter().zip(cells);
            let rows: Vec<u32> = rows
                .map(|(row, cell)| row / sharing * m as u32 + cell)
                .collect();
            let place = map.forward(&flat.index_select(&Tensor::new(rows, flat.device())?, 0)?)?;
            seen = Some(match seen {
                Some(seen) => (seen + place)?,
                None => place,
            });
        }
        seen.ok_or_else(|| candle_core::Error::Msg("no place to look at".into()))
    }

    /// One pass over `batch`, after the tokens in `cache` if there is one; the new tokens are added
    /// to the cache.
    pub fn forward(
        &self,
        batch: &TokenBatch,
        visual: &VisualMemory,
        mut cache: Option<&mut Cache>,
        dropout: Option<&Dropout>,
    ) -> Result<Features> {
        let (b, t) = batch.shape;
        let mut x = embedding_sum(&self.table, &batch.rows)?; // [B * T, C]
        if batch.sines.dim(0)? > 0 {
            x = x.index_add(&batch.sine_positions, &self.embed_sine(&batch.sines)?, 0)?;
        }
        if !batch.local_map_sequences.is_empty() {
            x = x.index_add(
                &batch.local_map_rows,
                &self.encode_local_context(batch, visual)?,
                0,
            )?;
        }
        if let Some((first, second)) = &self.local_context
            && batch.local_context.dim(0)? > 0
        {
            let seen = second.forward(&ops::gelu(&first.forward(&batch.local_context)?)?)?;
            x = x.index_add(&batch.context_rows, &seen, 0)?;
        }
        let mut x = drop_out(x.reshape((b, t, ()))?, dropout)?; // [B, T, C]
        let mut levels = Vec::with_capacity(self.levels.len());
        for (i, block) in self.blocks.iter().enumerate() {
            x = block.forward(
                &x,
                cache.as_mut().map(|cache| &mut cache.layers[i]),
                dropout,
            )?;
            if i % 3 == 0 {
                x = self.cross[i / 3].forward(&x, &visual.key_values[i / 3])?;
            }
            if self.levels.contains(&i) {
                levels.push(x.clone());
            }
        }
        Ok(Features {
            hidden: self.norm.forward(&x)?,
            levels,
        })
    }
}
