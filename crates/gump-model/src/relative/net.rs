//! The network: nodes attend along their edges, layer by layer, and a short recurrence predicts the
//! next move field by field.
//!
//! Shapes: `N` nodes, `M` pieces of the map, `E` edges, `C` width, `F` features per edge, `H` heads.

use std::collections::BTreeMap;
use std::sync::Arc;

use candle_core::{Device, Result, Tensor};
use gump_kernels::edge_attention::Edges;
use gump_kernels::smoothing::OrdinalSmoothing;
use gump_nn::layers::{LayerNorm, Linear, TABLE_DEVIATION, gru};
use gump_nn::ops;
use gump_nn::ops::Targets;
use gump_nn::parameters::{Init, Parameters, Scope};

use crate::ModelError;
use crate::relative::RelativeConfig;
use crate::relative::graph::{EDGE_NUMBERS, NODE_NUMBERS};
use crate::relative::grid::{ALL_BINS, BINS, FIELDS, first_bin};
use crate::relative::map::PIECE_NUMBERS;
use crate::relative::sample::Sample;

/// The output matrices of a layer's residual branches.
const ADDS: [&str; 2] = [".out.weight", ".mlp_out.weight"];

/// Two layers with an activation between them.
#[derive(Debug)]
pub(super) struct Mlp {
    pub(super) first: Linear,
    pub(super) second: Linear,
}

impl Mlp {
    fn new(mut scope: Scope<'_>, sizes: [usize; 3]) -> std::result::Result<Self, ModelError> {
        Ok(Self {
            first: Linear::new(&mut scope, "first", sizes[0], sizes[1])?,
            second: Linear::new(&mut scope, "second", sizes[1], sizes[2])?,
        })
    }

    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        self.second.forward(&ops::gelu(&self.first.forward(x)?)?)
    }
}

/// Attention along edges and a feed-forward part, each before a norm.
#[derive(Debug)]
pub(super) struct Layer {
    pub(super) norm: LayerNorm,
    /// To the queries and their part for edge features, `[H d + H F]`.
    pub(super) queries: Linear,
    /// To keys and values of nodes, `[2 H d]`.
    pub(super) sources: Linear,
    /// To those of pieces of the map.
    pub(super) piece_sources: Linear,
    /// From averages of values and of edge features.
    pub(super) out: Linear,
    pub(super) norm_mlp: LayerNorm,
    pub(super) mlp_in: Linear,
    pub(super) mlp_out: Linear,
}

impl Layer {
    fn new(mut scope: Scope<'_>, config: &RelativeConfig) -> std::result::Result<Self, ModelError> {
        let (c, attended) = (
            config.width,
            config.width + config.heads * config.edge_width,
        );
        let zero = Some(Init::Constant(0.0));
        let residual = Init::Normal(TABLE_DEVIATION / (2.0 * config.layers as f64).sqrt());
        Ok(Self {
            norm: LayerNorm::new(&mut scope, "norm", c)?,
            queries: Linear::with(&mut scope, "queries", c, attended, Init::Xavier, zero)?,
            sources: Linear::with(&mut scope, "sources", c, 2 * c, Init::Xavier, zero)?,
            piece_sources: Linear::with(&mut scope, "piece_sources", c, 2 * c, Init::Xavier, zero)?,
            out: Linear::with(&mut scope, "out", attended, c, residual, zero)?,
            norm_mlp: LayerNorm::new(&mut scope, "norm_mlp", c)?,
            mlp_in: Linear::with(&mut scope, "mlp_in", c, 4 * c, Init::Xavier, zero)?,
            mlp_out: Linear::with(&mut scope, "mlp_out", 4 * c, c, residual, zero)?,
        })
    }

    fn forward(
        &self,
        x: &Tensor,
        pieces: &Tensor,
        features: &Tensor,
        edges: &Arc<Edges>,
        heads: usize,
    ) -> Result<Tensor> {
        let normed = self.norm.forward(x)?; // [N, C]
        let sources = Tensor::cat(
            &[
                &self.sources.forward(&normed)?,
                &self.piece_sources.forward(pieces)?,
            ],
            0,
        )?; // [N + M, 2C]
        let queries = self.queries.forward(&normed)?; // [N, C + HF]
        let attended = ops::edge_attention(&queries, &sources, features, edges, heads)?;
        let x = (x + self.out.forward(&attended)?)?;
        let hidden = ops::gelu(&self.mlp_in.forward(&self.norm_mlp.forward(&x)?)?)?;
        &x + self.mlp_out.forward(&hidden)?
    }
}

/// From the hidden vector of a node to its next move, field by field.
#[derive(Debug)]
pub(super) struct MoveDecoder {
    /// Rows by which bins enter, [ALL_BINS, C].
    pub(super) table: Tensor,
    /// Input added at each step, [FIELDS, C].
    pub(super) slots: Tensor,
    pub(super) input: Linear,
    pub(super) hidden: Linear,
    /// [ALL_BINS, C]
    pub(super) head: Linear,
}

impl MoveDecoder {
    fn new(mut scope: Scope<'_>, c: usize) -> std::result::Result<Self, ModelError> {
        let fan = Init::FanIn(c);
        Ok(Self {
            table: scope.get("table", (ALL_BINS, c), Init::Normal(TABLE_DEVIATION))?,
            slots: scope.get("slots", (FIELDS, c), Init::Normal(TABLE_DEVIATION))?,
            input: Linear::with(&mut scope, "input", c, 3 * c, fan, Some(fan))?,
            hidden: Linear::with(&mut scope, "hidden", c, 3 * c, fan, Some(fan))?,
            head: Linear::with(&mut scope, "head", c, ALL_BINS, Init::Normal(0.02), None)?,
        })
    }

    /// Outputs of all steps with the true bins as input, [FIELDS, K, C]; `rows` are those of the
    /// table for the first three bins of each node, [FIELDS - 1, K].
    fn forced(&self, hidden: &Tensor, rows: &Tensor) -> Result<Tensor> {
        let (k, c) = hidden.dims2()?;
        let embedded = ops::embedding_sum(&self.table, &rows.reshape(((), 1))?)?
            .reshape((FIELDS - 1, k, c))?
            .pad_with_zeros(0, 1, 0)?;
        let inputs = embedded.broadcast_add(&self.slots.reshape((FIELDS, 1, c))?)?;
        gru(&inputs, hidden, [&self.input, &self.hidden])
    }
}

/// The relative network.
#[derive(Debug)]
pub struct RelativeNetwork {
    config: RelativeConfig,
    parameters: Parameters,
    pub(super) nodes: Mlp,
    pub(super) pieces: Mlp,
    pub(super) edges: Mlp,
    pub(super) layers: Vec<Layer>,
    pub(super) norm: LayerNorm,
    pub(super) decoder: MoveDecoder,
}

impl RelativeNetwork {
    /// An untrained network.
    ///
    /// # Errors
    /// [`ModelError::Config`] if the configuration contradicts itself.
    pub fn random(
        config: RelativeConfig,
        seed: gump_scene::Seed,
        device: &Device,
    ) -> std::result::Result<Self, ModelError> {
        Self::build(config, Parameters::random(seed, device))
    }

    /// The network that `config` describes, with the given parameters.
    ///
    /// # Errors
    /// A tensor that is missing, superfluous or of another shape, by name.
    pub fn build(
        config: RelativeConfig,
        mut parameters: Parameters,
    ) -> std::result::Result<Self, ModelError> {
        config.validate()?;
        let c = config.width;
        let mut root = parameters.root();
        let nodes = Mlp::new(root.part("nodes"), [NODE_NUMBERS, 2 * c, c])?;
        let pieces = Mlp::new(root.part("pieces"), [PIECE_NUMBERS, c, c])?;
        let sizes = [EDGE_NUMBERS, config.edge_hidden, config.edge_width];
        let edges = Mlp::new(root.part("edges"), sizes)?;
        let layers = (0..config.layers)
            .map(|i| Layer::new(root.part(format!("layers.{i}")), &config))
            .collect::<std::result::Result<_, _>>()?;
        let norm = LayerNorm::new(&mut root, "norm", c)?;
        let decoder = MoveDecoder::new(root.part("decoder"), c)?;
        if let Some(name) = parameters.unused().first() {
            return Err(ModelError::UnusedTensor {
                name: name.to_string(),
            });
        }
        Ok(Self {
            config,
            parameters,
            nodes,
            pieces,
            edges,
            layers,
            norm,
            decoder,
        })
    }

    /// The same network with additional final layers, drawn from `seed`, which contribute nothing
    /// at first: its output is unchanged until it is trained further.
    ///
    /// # Errors
    /// [`ModelError::Config`] if there would be fewer layers than now.
    pub fn deepened(
        &self,
        layers: usize,
        seed: gump_scene::Seed,
    ) -> std::result::Result<Self, ModelError> {
        let now = self.config.layers;
        if layers < now {
            return Err(ModelError::Config {
                key: "layers",
                reason: format!("a network of {now} layers cannot go on with {layers}"),
            });
        }
        let config = RelativeConfig {
            layers,
            ..self.config.clone()
        };
        let deeper = Self::random(config, seed, self.parameters.device())?;
        for (name, var) in deeper.parameters.all() {
            match self.parameters.find(name) {
                Some(own) => var.set(own.as_tensor())?,
                None if ADDS.iter().any(|end| name.ends_with(end)) => {
                    var.set(&var.as_tensor().zeros_like()?)?;
                }
                None => {}
            }
        }
        Ok(deeper)
    }

    /// The network whose weights are the means of those of several of one shape. If they continue each
    /// other, or began with the same weights, it is often better than any of them
    /// ([Izmailov et al. 2018](https://arxiv.org/abs/1803.05407)).
    ///
    /// # Errors
    /// [`ModelError::Config`] if there is none, or if their shapes differ.
    pub fn mean(networks: &[Self]) -> std::result::Result<Self, ModelError> {
        let fail = |reason: &str| {
            let reason = reason.to_owned();
            let key = "relative";
            Err(ModelError::Config { key, reason })
        };
        let Some((first, rest)) = networks.split_first() else {
            return fail("a mean of no networks");
        };
        if rest.iter().any(|other| other.config != first.config) {
            return fail("a mean of networks of several shapes");
        }
        let mut sums = BTreeMap::new();
        for (name, var) in first.parameters.all() {
            let mut sum = var.as_tensor().clone();
            for other in rest {
                match other.parameters.find(name) {
                    Some(own) => sum = (sum + own.as_tensor())?,
                    None => return fail("a mean of networks of several shapes"),
                }
            }
            sums.insert(name.to_owned(), (sum / networks.len() as f64)?);
        }
        let device = first.parameters.device();
        Self::build(first.config.clone(), Parameters::loaded(sums, device))
    }

    /// The shape it was built from.
    pub fn config(&self) -> &RelativeConfig {
        &self.config
    }

    /// Its parameters.
    pub fn parameters(&self) -> &Parameters {
        &self.parameters
    }

    /// The final vector of every node of a sample, [N, C].
    pub fn hidden(&self, sample: &Sample) -> Result<Tensor> {
        let device = self.parameters.device();
        let tensor = |numbers: &[f32], width: usize| {
            Tensor::from_slice(numbers, (numbers.len() / width, width), device)
        };
        let mut x = self.nodes.forward(&tensor(&sample.nodes, NODE_NUMBERS)?)?; // [N, C]
        let pieces = self
            .pieces
            .forward(&tensor(&sample.pieces, PIECE_NUMBERS)?)?; // [M, C]
        let features = self
            .edges
            .forward(&tensor(&sample.edge_numbers, EDGE_NUMBERS)?)?; // [E, F]
        for layer in &self.layers {
            x = layer.forward(&x, &pieces, &features, &sample.edges, self.config.heads)?;
        }
        self.norm.forward(&x)
    }

    /// This sample's part of the weighted mean over all moves of a batch, for differentiation, and
    /// the sums of the fields' cross-entropies as numbers, nats.
    ///
    /// `total` is the weight of all moves of the batch.
    pub fn loss(
        &self,
        sample: &Sample,
        total: f64,
        smoothing_bins: f64,
    ) -> Result<(Tensor, [f64; FIELDS])> {
        let outputs = self.forced(sample)?;
        self.cross_entropy(sample, &outputs, total, smoothing_bins, |weight| weight)
    }

    /// The decoder's outputs for the fields of the moves, [FIELDS, K, C]; each field sees those before
    /// it.
    pub(super) fn forced(&self, sample: &Sample) -> Result<Tensor> {
        let device = self.parameters.device();
        let targets = &sample.targets;
        let nodes: Vec<u32> = targets.iter().map(|target| target.node).collect();
        let hidden = self
            .hidden(sample)?
            .index_select(&Tensor::new(nodes, device)?, 0)?;
        let rows = (0..FIELDS - 1).flat_map(|field| {
            let first = first_bin(field) as u32;
            targets
                .iter()
                .map(move |t| first + u32::from(t.bins[field]))
        });
        let shape = (FIELDS - 1, targets.len());
        let rows = Tensor::from_vec(rows.collect::<Vec<u32>>(), shape, device)?;
        self.decoder.forced(&hidden, &rows)
    }

    /// Cross-entropies of the moves, each with the weight that `weigh` computes.
    pub(super) fn cross_entropy(
        &self,
        sample: &Sample,
        outputs: &Tensor,
        total: f64,
        smoothing_bins: f64,
        weigh: impl Fn(f32) -> f32,
    ) -> Result<(Tensor, [f64; FIELDS])> {
        let device = self.parameters.device();
        let targets = &sample.targets;
        let weight = |field: usize, target: &crate::relative::sample::Target| {
            let counts = field == 0 || target.bins[0] != crate::relative::grid::STANDS;
            if counts { weigh(target.weight) } else { 0.0 }
        };
        let by_field = (0..FIELDS).map(|field| {
            let field_targets = Targets {
                bins: targets.iter().map(|t| u32::from(t.bins[field])).collect(),
                weights: targets.iter().map(|t| weight(field, t)).collect(),
                smoothing: (field > 0 && smoothing_bins > 0.0).then_some(OrdinalSmoothing {
                    sigma_bins: smoothing_bins as f32,
                    circular: false,
                }),
                exact: Vec::new(),
            };
            let first = first_bin(field);
            (first..first + BINS[field], field_targets)
        });
        let matrix = self.decoder.head.weight();
        let means = ops::linear_cross_entropy(outputs, matrix, by_field.collect())?; // [FIELDS]
        let shares: Vec<f64> = (0..FIELDS)
            .map(|field| targets.iter().map(|t| f64::from(weight(field, t))).sum())
            .collect();
        let values = means.to_vec1::<f32>()?;
        let sums = std::array::from_fn(|field| shares[field] * f64::from(values[field]));
        let shares: Vec<f32> = shares.iter().map(|s| (s / total) as f32).collect();
        let loss = (means * Tensor::new(shares, device)?)?.sum_all()?;
        Ok((loss, sums))
    }
}
