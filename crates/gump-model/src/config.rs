//! The shape of a network; a checkpoint contains one and needs nothing else to load.
//!
//! The file format is TOML, in which unknown keys are errors. Presets have the published sizes and
//! `tiny`, which trains on a laptop.

use gump_raster::{Layer, RasterSpec};
use serde::{Deserialize, Serialize};

use crate::ModelError;

/// An agent whose surrogate leaves this range is not tokenized any more (released code), metres:
/// the grid of positions less 4 m.
pub const KEEP_RANGE_M: f64 = 96.0;

/// The shape of a network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelConfig {
    /// Model width, the `C` of every shape.
    pub width: usize,
    /// Self-attention blocks.
    pub layers: usize,
    /// Attention heads; must divide the width.
    pub heads: usize,
    /// Maximum length of a token sequence, and rows of the position table.
    pub block_size: usize,
    /// Layers of the GRU that decodes an agent's state.
    pub gru_layers: usize,
    /// Blocks (0-based) after which a trajectory head reads, shallow to deep; the last is the
    /// deepest. Empty: no trajectory heads.
    pub trajectory_heads: Vec<usize>,
    /// The gates of gated cross-attention.
    pub gate: Gate,
    /// Whether the two tokens of an object share their content: the value also has the key's id and
    /// class, and the key the object's last value in the window (the paper: neither), so that
    /// attention does not have to learn to find an object's own past.
    pub pairs_share: bool,
    /// Whether every bin's row of the decoder's tables has a learned map of the bin's sines added
    /// (the paper: free rows), so that neighbouring bins share what is learned.
    pub smooth_bins: bool,
    /// Whether an object's key reads the visual features under the object, and one and two seconds
    /// ahead of it, directly (the paper: through cross-attention only); needs `pairs_share`.
    pub local_map: bool,
    /// Whether an object's chunk is expressed in the frame of its last state, in finer bins (the
    /// paper: in the frame of the scene), so that motion is independent of position and direction.
    #[serde(default, rename = "anchored", alias = "local_frame")]
    pub local_frame: bool,
    /// Whether every object gets the paths ahead, road edges and neighbours in its own frame, as
    /// numbers at its key (the paper: the raster and the tokens only).
    #[serde(default, rename = "surroundings", alias = "local_context")]
    pub local_context: bool,
    /// Whether the local context contains marks of unknown inputs: speed limits, stop signs, lights
    /// and sizes that the source of a scene does not state. Without marks there are only default
    /// values.
    #[serde(default)]
    pub unknown_marks: bool,
    /// Probability of dropping an activation in training.
    pub dropout: f64,
    /// Whether there is a decoder that reconstructs the raster from the visual features.
    pub reconstruction: bool,
    /// The visual branch.
    pub visual: VisualConfig,
}

/// The gates of gated cross-attention.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Gate {
    /// Attention and feed-forward each behind tanh of a scalar that starts at 0 (Alayrac et al.
    /// 2022): the network starts as the text-only transformer.
    Flamingo,
    /// Attention behind tanh of a scalar from N(0, 0.3²), feed-forward ungated: GUMP's released
    /// code.
    Released,
}

/// The visual branch: its raster and encoder.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VisualConfig {
    /// The convolutional network.
    pub encoder: Encoder,
    /// Side of the square raster, pixels.
    pub side_px: usize,
    /// Side of a pixel on the ground, metres.
    pub metres_per_px: f64,
    /// Raster layers by name, in channel order.
    pub layers: Vec<String>,
}

/// The convolutional network that reads the raster.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Encoder {
    /// Three strided stages with a residual block each, stride 8, for CPUs.
    Compact,
    /// ResNet-18, stride 32.
    Resnet18,
    /// ResNet-34, stride 32.
    Resnet34,
    /// ResNet-50, stride 32.
    Resnet50,
}

impl Encoder {
    /// Raster pixels per visual token along one side.
    pub fn stride(self) -> usize {
        if self == Self::Compact { 8 } else { 32 }
    }
}

impl ModelConfig {
    /// Names accepted by [`ModelConfig::preset`].
    pub const PRESETS: [&'static str; 4] = ["tiny", "small", "base", "medium"];

    /// The configuration called `name`: `tiny`, or one of the paper's `small`, `base`, `medium`.
    pub fn preset(name: &str) -> Option<Self> {
        match name {
            "tiny" => Some(Self::tiny()),
            "small" => Some(Self::paper(384, 12, 6, Encoder::Resnet18, [2, 5, 8, 11])),
            "base" => Some(Self::paper(768, 12, 12, Encoder::Resnet34, [2, 5, 8, 11])),
            "medium" => Some(Self::paper(
                1024,
                24,
                16,
                Encoder::Resnet50,
                [5, 11, 17, 23],
            )),
            _ => None,
        }
    }

    /// The size for training on two CPU cores: 3.5 million parameters. Other sizes and rasters were
    /// not tried for shipped weights; result 14 has a scaling law.
    pub fn tiny() -> Self {
        Self {
            width: 128,
            layers: 4,
            heads: 4,
            block_size: 2048,
            gru_layers: 1,
            trajectory_heads: vec![3],
            gate: Gate::Flamingo,
            pairs_share: true,
            smooth_bins: true,
            local_map: true,
            local_frame: true,
            local_context: true,
            unknown_marks: true,
            dropout: 0.0,
            reconstruction: true,
            visual: VisualConfig {
                encoder: Encoder::Compact,
                side_px: 208,
                metres_per_px: 1.0,
                layers: layer_names(&RasterSpec::full(208, 1.0)),
            },
        }
    }

    /// A published size on the paper's canvas, 416 px at 0.5 m.
    fn paper(
        width: usize,
        layers: usize,
        heads: usize,
        encoder: Encoder,
        depths: [usize; 4],
    ) -> Self {
        Self {
            width,
            layers,
            heads,
            block_size: 2048,
            gru_layers: 2,
            trajectory_heads: depths.to_vec(),
            gate: Gate::Flamingo,
            pairs_share: false,
            smooth_bins: false,
            local_map: false,
            local_frame: false,
            local_context: false,
            unknown_marks: false,
            dropout: 0.1,
            reconstruction: true,
            visual: VisualConfig {
                encoder,
                side_px: 416,
                metres_per_px: 0.5,
                layers: layer_names(&RasterSpec::paper()),
            },
        }
    }

    /// Checks that the numbers fit together.
    ///
    /// # Errors
    /// [`ModelError::Config`] naming the first contradiction.
    pub fn validate(&self) -> Result<(), ModelError> {
        let fail = |key: &'static str, reason: String| Err(ModelError::Config { key, reason });
        if self.heads == 0 || !self.width.is_multiple_of(self.heads) {
            return fail(
                "heads",
                format!(
                    "width {} is not a multiple of {} heads",
                    self.width, self.heads
                ),
            );
        }
        if self.width < 14 {
            return fail(
                "width",
                format!(
                    "width {} leaves no room for the sine of seven fields",
                    self.width
                ),
            );
        }
        if self.layers == 0 || self.gru_layers == 0 {
            let key = if self.layers == 0 {
                "layers"
            } else {
                "gru_layers"
            };
            return fail(key, "layers and gru_layers must be at least 1".into());
        }
        if let Some(depth) = self
            .trajectory_heads
            .iter()
            .find(|&&depth| depth >= self.layers)
        {
            return fail(
                "trajectory_heads",
                format!(
                    "trajectory head after block {depth}, but there are {} blocks",
                    self.layers
                ),
            );
        }
        if !(0.0..1.0).contains(&self.dropout) {
            return fail(
                "dropout",
                format!("dropout {} is not in 0..1", self.dropout),
            );
        }
        let (side, stride) = (self.visual.side_px, self.visual.encoder.stride());
        if side == 0 || !side.is_multiple_of(stride) {
            return fail(
                "visual.side_px",
                format!("raster side {side} px is not a multiple of the encoder's stride {stride}"),
            );
        }
        self.raster_spec().map(|_| ())
    }

    /// The layers of the raster.
    ///
    /// # Errors
    /// [`ModelError::Config`] naming a layer that does not exist.
    pub fn raster_spec(&self) -> Result<RasterSpec, ModelError> {
        let layer = |name: &String| {
            name.parse::<Layer>().map_err(|_| ModelError::Config {
                key: "visual.layers",
                reason: format!("unknown raster layer \"{name}\""),
            })
        };
        Ok(RasterSpec {
            side_px: self.visual.side_px,
            metres_per_px: self.visual.metres_per_px,
            layers: self
                .visual
                .layers
                .iter()
                .map(layer)
                .collect::<Result<_, _>>()?,
        })
    }

    /// Visual tokens along one side.
    pub fn visual_side(&self) -> usize {
        self.visual.side_px / self.visual.encoder.stride()
    }
}

fn layer_names(spec: &RasterSpec) -> Vec<String> {
    spec.layers
        .iter()
        .map(|layer| layer.name().to_owned())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shapes_are_read_under_former_and_present_names() {
        let shape = ModelConfig::tiny();
        let stored = serde_json::to_string(&shape).unwrap();
        assert!(stored.contains("\"surroundings\":true") && stored.contains("\"anchored\":true"));
        let present = stored
            .replace("surroundings", "local_context")
            .replace("anchored", "local_frame");
        for text in [stored, present] {
            assert_eq!(serde_json::from_str::<ModelConfig>(&text).unwrap(), shape);
        }
    }
}
