//! The map as visual tokens: a convolutional encoder, its position grid, and the decoder that
//! reconstructs the raster from the same features.
//!
//! Shapes: `S` scenes, `P` raster layers, `M` visual tokens in row-major order, row 0 ahead of the
//! centre agent.

use candle_core::{Result, Tensor, Var};
use gump_nn::layers::Linear;
use gump_nn::ops;
use gump_nn::ops::Then;
use gump_nn::parameters::{Init, Scope};

use crate::ModelError;
use crate::config::{Encoder, ModelConfig};
use crate::embedding::sine_of_point;

type Built<T> = std::result::Result<T, ModelError>;

/// A convolution without bias unless stated.
#[derive(Debug)]
struct Conv {
    weight: Tensor,
    bias: Option<Tensor>,
    stride: usize,
    padding: usize,
}

impl Conv {
    fn new(
        scope: &mut Scope<'_>,
        name: &str,
        (inputs, outputs): (usize, usize),
        kernel: usize,
        stride: usize,
        bias: bool,
    ) -> Built<Self> {
        let mut scope = scope.part(name);
        let fan_in = Init::FanIn(inputs * kernel * kernel);
        let weight = scope.get("weight", (outputs, inputs, kernel, kernel), fan_in)?;
        let bias = if bias {
            Some(scope.get("bias", outputs, Init::Constant(0.0))?)
        } else {
            None
        };
        // A kernel as wide as its stride cuts the image into patches and needs no border.
        let padding = if kernel == stride { 0 } else { kernel / 2 };
        Ok(Self {
            weight,
            bias,
            stride,
            padding,
        })
    }

    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        ops::conv2d(
            x,
            &self.weight,
            self.bias.as_ref(),
            self.stride,
            self.padding,
        )
    }
}

/// Batch normalisation with running statistics (momentum 0.1, as PyTorch).
#[derive(Debug)]
struct BatchNorm {
    weight: Tensor,
    bias: Tensor,
    mean: Var,
    variance: Var,
}

impl BatchNorm {
    fn new(scope: &mut Scope<'_>, name: &str, channels: usize) -> Built<Self> {
        let mut scope = scope.part(name);
        Ok(Self {
            weight: scope.get("weight", channels, Init::Constant(1.0))?,
            bias: scope.get("bias", channels, Init::Constant(0.0))?,
            mean: scope.buffer("running_mean", channels, Init::Constant(0.0))?,
            variance: scope.buffer("running_variance", channels, Init::Constant(1.0))?,
        })
    }

    /// `x` is [S, channels, H, W].
    fn forward(&self, x: &Tensor, then: Then<'_>, training: bool) -> Result<Tensor> {
        if training {
            let (y, [mean, variance]) = ops::batch_norm(x, &self.weight, &self.bias, then)?;
            // PyTorch's momentum, and below its addition to variances.
            for (running, batch) in [(&self.mean, mean), (&self.variance, variance)] {
                running.set(&((running.as_tensor() * 0.9)? + (batch * 0.1)?)?)?;
            }
            return Ok(y);
        }
        let channels = x.dim(1)?;
        let spread = |t: &Tensor| t.reshape((1, channels, 1, 1));
        let (mean, variance) = (self.mean.as_tensor(), self.variance.as_tensor());
        let normal = x
            .broadcast_sub(&spread(&mean.detach())?)?
            .broadcast_div(&(spread(&variance.detach())? + 1e-5)?.sqrt()?)?;
        let normal = normal
            .broadcast_mul(&spread(&self.weight)?)?
            .broadcast_add(&spread(&self.bias)?)?;
        then.apply(normal)
    }
}

/// A residual block of ResNet: two 3x3 convolutions, or 1x1, 3x3, 1x1 with four times the channels.
#[derive(Debug)]
struct Residual {
    convolutions: Vec<(Conv, BatchNorm)>,
    shortcut: Option<(Conv, BatchNorm)>,
}

impl Residual {
    fn new(
        mut scope: Scope<'_>,
        inputs: usize,
        channels: usize,
        stride: usize,
        bottleneck: bool,
    ) -> Built<Self> {
        let outputs = if bottleneck { 4 * channels } else { channels };
        let plan: Vec<(usize, usize, usize, usize)> = if bottleneck {
            vec![
                (inputs, channels, 1, 1),
                (channels, channels, 3, stride),
                (channels, outputs, 1, 1),
            ]
        } else {
            vec![(inputs, channels, 3, stride), (channels, channels, 3, 1)]
        };
        let mut convolutions = Vec::with_capacity(plan.len());
        for (i, (from, to, kernel, stride)) in plan.into_iter().enumerate() {
            let conv = Conv::new(
                &mut scope,
                &format!("conv{i}"),
                (from, to),
                kernel,
                stride,
                false,
            )?;
            convolutions.push((conv, BatchNorm::new(&mut scope, &format!("norm{i}"), to)?));
        }
        let shortcut = if stride != 1 || inputs != outputs {
            let conv = pointwise(&mut scope, "shortcut_conv", inputs, outputs, stride)?;
            Some((conv, BatchNorm::new(&mut scope, "shortcut_norm", outputs)?))
        } else {
            None
        };
        Ok(Self {
            convolutions,
            shortcut,
        })
    }

    fn forward(&self, x: &Tensor, training: bool) -> Result<Tensor> {
        let straight = match &self.shortcut {
            Some((conv, norm)) => norm.forward(&conv.forward(x)?, Then::Nothing, training)?,
            None => x.clone(),
        };
        let mut y = x.clone();
        for (i, (conv, norm)) in self.convolutions.iter().enumerate() {
            let then = if i + 1 < self.convolutions.len() {
                Then::Rectify
            } else {
                Then::AddAndRectify(&straight)
            };
            y = norm.forward(&conv.forward(&y)?, then, training)?;
        }
        Ok(y)
    }
}

/// A 1x1 convolution, which needs no border whatever its stride.
fn pointwise(
    scope: &mut Scope<'_>,
    name: &str,
    inputs: usize,
    outputs: usize,
    stride: usize,
) -> Built<Conv> {
    Ok(Conv {
        padding: 0,
        ..Conv::new(scope, name, (inputs, outputs), 1, stride, false)?
    })
}

/// ResNet without its classification head (He et al. 2016), stride 32.
#[derive(Debug)]
struct ResNet {
    stem: (Conv, BatchNorm),
    blocks: Vec<Residual>,
    channels: usize,
}

impl ResNet {
    fn new(
        mut scope: Scope<'_>,
        planes: usize,
        depths: [usize; 4],
        bottleneck: bool,
    ) -> Built<Self> {
        let stem = (
            Conv::new(&mut scope, "stem_conv", (planes, 64), 7, 2, false)?,
            BatchNorm::new(&mut scope, "stem_norm", 64)?,
        );
        let mut inputs = 64;
        let mut blocks = Vec::new();
        for (stage, depth) in depths.into_iter().enumerate() {
            let channels = 64 << stage;
            for i in 0..depth {
                let stride = if i == 0 && stage > 0 { 2 } else { 1 };
                let part = scope.part(format!("stages.{stage}.{i}"));
                blocks.push(Residual::new(part, inputs, channels, stride, bottleneck)?);
                inputs = if bottleneck { 4 * channels } else { channels };
            }
        }
        Ok(Self {
            stem,
            blocks,
            channels: inputs,
        })
    }

    fn forward(&self, x: &Tensor, training: bool) -> Result<Tensor> {
        let (conv, norm) = &self.stem;
        let x = norm.forward(&conv.forward(x)?, Then::Rectify, training)?;
        let x = ops::largest_of_nine(&x)?;
        self.blocks
            .iter()
            .try_fold(x, |x, block| block.forward(&x, training))
    }
}

/// The encoder for CPUs: patches of 4 px, then halved once; no batch statistics, so a scene's
/// features never depend on its batch.
#[derive(Debug)]
struct Compact {
    patches: Conv,
    refine_patches: Conv,
    halve: Conv,
    refine: Conv,
}

impl Compact {
    /// At a quarter and at an eighth of the side. Chosen by hand for a CPU's time; not tuned.
    const CHANNELS: [usize; 2] = [32, 96];

    fn new(mut scope: Scope<'_>, planes: usize) -> Built<Self> {
        let [fine, coarse] = Self::CHANNELS;
        Ok(Self {
            patches: Conv::new(&mut scope, "patches", (planes, fine), 4, 4, true)?,
            refine_patches: Conv::new(&mut scope, "refine_patches", (fine, fine), 3, 1, true)?,
            halve: Conv::new(&mut scope, "halve", (fine, coarse), 3, 2, true)?,
            refine: Conv::new(&mut scope, "refine", (coarse, coarse), 3, 1, true)?,
        })
    }

    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let x = ops::gelu(&self.patches.forward(x)?)?; // [S, 32, side / 4, side / 4]
        let x = (&x + ops::gelu(&self.refine_patches.forward(&x)?)?)?;
        let x = ops::gelu(&self.halve.forward(&x)?)?; // [S, 96, side / 8, side / 8]
        &x + ops::gelu(&self.refine.forward(&x)?)?
    }
}

#[derive(Debug)]
enum Backbone {
    Compact(Compact),
    ResNet(ResNet),
}

/// Encoder, adaptor and position of the visual tokens.
#[derive(Debug)]
pub struct Visual {
    backbone: Backbone,
    adaptor: (Conv, Option<BatchNorm>),
    /// Sine features of the cell centres, [M, C].
    positions: Tensor,
    reconstruction: Option<Reconstruction>,
}

impl Visual {
    pub(crate) fn new(
        mut scope: Scope<'_>,
        config: &ModelConfig,
        device: &candle_core::Device,
    ) -> Built<Self> {
        let (c, planes) = (config.width, config.visual.layers.len());
        let part = scope.part("backbone");
        let (backbone, channels) = match config.visual.encoder {
            Encoder::Compact => (
                Backbone::Compact(Compact::new(part, planes)?),
                Compact::CHANNELS[1],
            ),
            encoder => {
                let (depths, bottleneck) = match encoder {
                    Encoder::Resnet18 => ([2, 2, 2, 2], false),
                    Encoder::Resnet34 => ([3, 4, 6, 3], false),
                    _ => ([3, 4, 6, 3], true),
                };
                let resnet = ResNet::new(part, planes, depths, bottleneck)?;
                let channels = resnet.channels;
                (Backbone::ResNet(resnet), channels)
            }
        };
        let adaptor = if matches!(backbone, Backbone::Compact(_)) {
            (pointwise(&mut scope, "adaptor", channels, c, 1)?, None)
        } else {
            let conv = Conv::new(&mut scope, "adaptor", (channels, c), 3, 1, false)?;
            (conv, Some(BatchNorm::new(&mut scope, "adaptor_norm", c)?))
        };
        let reconstruction = if config.reconstruction {
            Some(Reconstruction::new(scope.part("reconstruction"), config)?)
        } else {
            None
        };
        let positions = cell_positions(config, device)?;
        Ok(Self {
            backbone,
            adaptor,
            positions,
            reconstruction,
        })
    }

    /// `raster` [S, P, side, side] to features [S, M, C], without positions.
    pub fn features(&self, raster: &Tensor, training: bool) -> Result<Tensor> {
        let map = match &self.backbone {
            Backbone::Compact(net) => net.forward(raster)?,
            Backbone::ResNet(net) => net.forward(raster, training)?,
        };
        let adapted = self.adaptor.0.forward(&map)?;
        let adapted = match &self.adaptor.1 {
            Some(norm) => {
                let x = norm.forward(&adapted, Then::Nothing, training)?;
                // The released code's leaky ReLU.
                x.maximum(&(&x * 0.01)?)?
            }
            None => adapted,
        }; // [S, C, rows, columns]
        adapted.flatten_from(2)?.transpose(1, 2)?.contiguous() // [S, M, C]
    }

    /// Sine features of the cell centres, [M, C].
    pub(crate) fn positions(&self) -> &Tensor {
        &self.positions
    }

    /// The decoder of the auxiliary loss, if the configuration asks for one.
    pub fn reconstruction(&self) -> Option<&Reconstruction> {
        self.reconstruction.as_ref()
    }
}

/// The ground under every visual token: x falls along the rows, y along the columns.
fn cell_positions(config: &ModelConfig, device: &candle_core::Device) -> Result<Tensor> {
    let side = config.visual_side();
    let cell = config.visual.metres_per_px * config.visual.encoder.stride() as f64;
    let centre = |i: usize| (side as f64 / 2.0 - i as f64 - 0.5) * cell;
    let features: Vec<f32> = (0..side * side)
        .flat_map(|i| sine_of_point(centre(i / side), centre(i % side), config.width))
        .collect();
    Tensor::from_vec(features, (side * side, config.width), device)
}

/// The raster decoder: every visual token reconstructs its pixels by a transposed convolution whose
/// kernel is its stride.
#[derive(Debug)]
pub struct Reconstruction {
    hidden: Linear,
    pixels: Linear,
    planes: usize,
    stride: usize,
}

impl Reconstruction {
    fn new(mut scope: Scope<'_>, config: &ModelConfig) -> Built<Self> {
        let (c, stride) = (config.width, config.visual.encoder.stride());
        let planes = config.visual.layers.len();
        Ok(Self {
            hidden: Linear::new(&mut scope, "hidden", c, c)?,
            pixels: Linear::new(&mut scope, "pixels", c, planes * stride * stride)?,
            planes,
            stride,
        })
    }

    /// Mean absolute difference between the reconstructed raster and the raster itself.
    ///
    /// `features` [S, M, C], `raster` [S, P, side, side].
    pub fn loss(&self, features: &Tensor, raster: &Tensor) -> Result<Tensor> {
        let (scenes, planes, side, _) = raster.dims4()?;
        let n = side / self.stride;
        let drawn = self
            .pixels
            .forward(&ops::gelu(&self.hidden.forward(features)?)?)?;
        let patches = raster
            .reshape(vec![scenes, planes, n, self.stride, n, self.stride])?
            .permute(vec![0, 2, 4, 1, 3, 5])?
            .reshape((scenes, n * n, self.planes * self.stride * self.stride))?;
        ops::mean_absolute_difference(&drawn, &patches)
    }
}
