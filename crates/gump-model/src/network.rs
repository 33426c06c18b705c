//! The whole network with its parameters, as stored in a checkpoint.

use std::borrow::Borrow;
use std::collections::BTreeMap;
use std::sync::Arc;

use candle_core::{DType, Device, Tensor};
use gump_nn::parameters::Parameters;
use gump_raster::{Raster, RasterSpec};
use gump_scene::Seed;
use gump_tokenizer::{BEGIN, FIRST_LIGHT, Field, N_CLASSES, TABLE_ROWS};
use serde_json::{Value, json};

use crate::ModelError;
use crate::batch::Packer;
use crate::config::ModelConfig;
use crate::decoder::{CONTROL_KEYS, N_LIGHT_STATES, STEPS, StateDecoder};
use crate::local_context::LaneMap;
use crate::mct::{Mct, TokenBatch, VisualMemory};
use crate::placed_slot::PlacedSlot;
use crate::trajectory_head::TrajectoryHead;
use crate::visual::Visual;

/// A GUMP network.
#[derive(Debug)]
pub struct Network {
    config: ModelConfig,
    raster_spec: RasterSpec,
    parameters: Parameters,
    packer: Packer,
    /// The transformer.
    pub mct: Mct,
    /// From hidden vectors to states.
    pub decoder: StateDecoder,
    /// The encoder of rasters.
    pub visual: Visual,
    /// Heads that predict whole trajectories, for an auxiliary loss.
    pub trajectory_heads: Vec<TrajectoryHead>,
}

impl Network {
    /// An untrained network.
    ///
    /// # Errors
    /// [`ModelError::Config`] if the configuration contradicts itself.
    pub fn random(config: ModelConfig, seed: Seed, device: &Device) -> Result<Self, ModelError> {
        Self::build(config, Parameters::random(seed, device))
    }

    /// The network that `config` describes, with the given parameters.
    ///
    /// # Errors
    /// A tensor that is missing, superfluous or of another shape, by name.
    pub fn build(config: ModelConfig, mut parameters: Parameters) -> Result<Self, ModelError> {
        config.validate()?;
        let raster_spec = config.raster_spec()?;
        let device = parameters.device().clone();
        let mut root = parameters.root();
        let mct = Mct::new(root.part("mct"), &config)?;
        let decoder = StateDecoder::new(root.part("decoder"), &config, &device)?;
        let visual = Visual::new(root.part("visual"), &config, &device)?;
        let trajectory_heads = (0..config.trajectory_heads.len())
            .map(|i| TrajectoryHead::new(root.part(format!("trajectory.{i}")), config.width))
            .collect::<Result<_, _>>()?;
        if let Some(name) = parameters.unused().first() {
            return Err(ModelError::UnusedTensor {
                name: name.to_string(),
            });
        }
        let packer = Packer::new(&config);
        Ok(Self {
            config,
            raster_spec,
            parameters,
            packer,
            mct,
            decoder,
            visual,
            trajectory_heads,
        })
    }

    /// The same network with matrix products in another type; parameters and everything else keep
    /// theirs.
    pub fn multiplying_in(self, products: DType) -> Result<Self, ModelError> {
        let all = self.parameters.all();
        let tensors = all.map(|(name, var)| (name.to_owned(), var.as_tensor().clone()));
        let parameters = Parameters::loaded(tensors.collect(), self.device());
        Self::build(self.config, parameters.multiplied_in(products))
    }

    /// The shape it was built from.
    pub fn config(&self) -> &ModelConfig {
        &self.config
    }

    /// Its parameters.
    pub fn parameters(&self) -> &Parameters {
        &self.parameters
    }

    /// The layers of its rasters.
    pub fn raster_spec(&self) -> &RasterSpec {
        &self.raster_spec
    }

    /// Returns how many of `n` samples should be differentiated as one batch: on a CPU threads
    /// process single samples, on a device they do not, and batch statistics need all.
    pub fn samples_together(&self, n: usize) -> usize {
        let is_free = self.parameters.statistics().next().is_none();
        if is_free && self.device().is_cpu() {
            1
        } else {
            n.max(1)
        }
    }

    /// Its device.
    pub fn device(&self) -> &Device {
        self.parameters.device()
    }

    /// Sequences of slots as a batch, without their first `from`.
    pub fn pack(
        &self,
        sequences: &[&[PlacedSlot]],
        from: usize,
        memory: &VisualMemory,
    ) -> Result<TokenBatch, ModelError> {
        let lane_maps = &memory.lane_maps;
        Ok(self
            .packer
            .pack(sequences, from, lane_maps, self.device())?)
    }

    /// Rasters of several scenes as one tensor, [S, P, side, side].
    pub fn raster_tensor<R: Borrow<Raster>>(&self, rasters: &[R]) -> Result<Tensor, ModelError> {
        let side = self.raster_spec.side_px;
        let n = rasters.iter().map(|raster| raster.borrow().data.len());
        let mut data: Vec<f32> = Vec::with_capacity(n.sum());
        for raster in rasters {
            data.extend_from_slice(&raster.borrow().data);
        }
        let shape = (rasters.len(), self.raster_spec.layers.len(), side, side);
        Ok(Tensor::from_vec(data, shape, self.device())?)
    }

    /// Everything that the same network in another language needs: tensors by name and the numbers
    /// of its shape.
    ///
    /// `weight.NAME` and `statistic.NAME` are parameters and running statistics as in a checkpoint;
    /// `constant.positions` [M, C] are the sine features of the visual tokens, and with smooth bins
    /// `constant.sines.N` [bins, 2k] those of every field's bins, in the order of their tokens.
    ///
    /// # Errors
    /// The tensor library failed.
    pub fn export(&self) -> Result<(BTreeMap<String, Tensor>, Value), ModelError> {
        let mut all = BTreeMap::new();
        let of_kind = [
            ("weight", self.parameters.trainable().collect::<Vec<_>>()),
            ("statistic", self.parameters.statistics().collect()),
        ];
        for (kind, vars) in of_kind {
            for (name, var) in vars {
                all.insert(format!("{kind}.{name}"), var.as_tensor().copy()?);
            }
        }
        let positions = self.visual.positions().clone();
        all.insert("constant.positions".into(), positions);
        for (i, sines) in self.decoder.bin_sines().iter().enumerate() {
            all.insert(format!("constant.sines.{i}"), sines.clone());
        }
        let rows_of = |field: &Field| {
            let rows = StateDecoder::rows_of(*field);
            [rows.start, rows.end]
        };
        let shape = json!({
            "model": self.config,
            "token_rows": TABLE_ROWS,
            "field_row": Field::X.first_token(),
            "step_rows": STEPS.iter().map(rows_of).collect::<Vec<_>>(),
            "control_keys": CONTROL_KEYS,
            "begin": BEGIN,
            "first_light": FIRST_LIGHT,
            "light_states": N_LIGHT_STATES,
            "classes": N_CLASSES,
        });
        Ok((all, shape))
    }

    /// Visual features with their positions added, [S, M, C].
    pub fn place(&self, features: &Tensor) -> candle_core::Result<Tensor> {
        let positions = self.mct.embed_sine(self.visual.positions())?; // [M, C]
        features.broadcast_add(&positions.unsqueeze(0)?)
    }

    /// Encodes the maps once, for any number of passes.
    pub fn look<R: Borrow<Raster>>(
        &self,
        rasters: &[R],
        lane_maps: Vec<Arc<LaneMap>>,
    ) -> Result<VisualMemory, ModelError> {
        let features = self.visual.features(&self.raster_tensor(rasters)?, false)?;
        Ok(self.mct.remember(&self.place(&features)?, lane_maps)?)
    }
}
