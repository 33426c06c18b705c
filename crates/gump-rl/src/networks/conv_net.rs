//! Convolutional networks from images to features, with hand-written gradients.

use gump_scene::Rng;
use rand::Rng as _;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::conv_layers::{Layer, LayerPass, Unit};
use super::convolution::Convolution;

/// Rows of a batch that go through the layers together: few enough for their columns to stay near
/// the processor. Fixed, so that sums do not depend on the number of threads.
pub(super) const ROWS_PER_PIECE: usize = 16;
/// Partial gradients of a batch, each as long as the parameters; as many threads as can work on
/// them. Bounds the memory; fixed for the same reason. Not tuned.
const PARTIAL_SUMS: usize = 4;

/// The architecture of the layers between an image and its features.
///
/// Group normalization replaces the batch normalization of He et al.: it works for small batches
/// and for the target copy.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Architecture {
    /// Four convolutions of 3 x 3, each halving the side: 16, 32, 64, 64 channels, with all pixels
    /// of the last as features. For CPUs.
    SmallConv,
    /// ResNet-18 (He et al. 2015) up to its mean over pixels: 512 features. The paper's encoder.
    Resnet18,
}

/// The shape of an image with square layers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Picture {
    /// Layers, > 0.
    pub layers: usize,
    /// Pixels along each side, > 0.
    pub side: usize,
}

impl Picture {
    /// Numbers in an image, `[layer, row, column]`.
    #[allow(clippy::len_without_is_empty, reason = "a picture has pixels")]
    pub fn len(&self) -> usize {
        self.layers * self.side * self.side
    }
}

/// A convolutional network without a head.
///
/// All parameters lie in one slice, layer after layer: weights `[out, in, y, x]`, then scales and
/// shifts of the normalization, `[out]` each.
#[derive(Clone, Debug, PartialEq)]
pub struct ConvNet {
    architecture: Architecture,
    picture: Picture,
    pub(super) layers: Vec<Layer>,
    parameters: Vec<f32>,
}

/// Values of a forward pass that the backward pass needs; reused from batch to batch.
#[derive(Clone, Debug, Default)]
pub struct ConvPass {
    pieces: Vec<Piece>,
    features: Vec<f32>,
    partial_sums: Vec<Vec<f32>>,
}

/// The memory of some rows of the batch.
#[derive(Clone, Debug, Default)]
struct Piece {
    rows: usize,
    /// The images as `[layer, row of the batch, y, x]`.
    input: Vec<f32>,
    layers: Vec<LayerPass>,
    columns: Vec<f32>,
}

impl ConvPass {
    /// The output of the network. Shape: `[rows, n_features]`.
    pub fn output(&self) -> &[f32] {
        &self.features
    }
}

impl ConvNet {
    /// A network for such images, with random parameters.
    ///
    /// Weights are uniform with variance 2 / inputs (He et al. 2015, for ReLU); normalization
    /// changes nothing at first.
    pub fn new(architecture: Architecture, picture: Picture, rng: &mut Rng) -> Self {
        let layers = layers(architecture, picture);
        let mut parameters = vec![0.0; n_parameters(&layers)];
        for unit in layers.iter().flat_map(Layer::units) {
            let (weights, rest) = parameters[unit.range()].split_at_mut(unit.n_weights());
            let bound = (6.0 / unit.convolution.taps() as f32).sqrt();
            weights.fill_with(|| bound * rng.random_range(-1.0f32..1.0));
            rest[..unit.convolution.outputs].fill(1.0);
        }
        Self {
            architecture,
            picture,
            layers,
            parameters,
        }
    }

    /// The network with these parameters; `None` if there are more or fewer than it has.
    pub fn from_parameters(
        architecture: Architecture,
        picture: Picture,
        parameters: Vec<f32>,
    ) -> Option<Self> {
        if picture.len() == 0 {
            return None;
        }
        let layers = layers(architecture, picture);
        (parameters.len() == n_parameters(&layers)).then_some(Self {
            architecture,
            picture,
            layers,
            parameters,
        })
    }

    /// Its architecture.
    pub fn architecture(&self) -> Architecture {
        self.architecture
    }

    /// The shape of its input.
    pub fn picture(&self) -> Picture {
        self.picture
    }

    /// Number of features per image.
    pub fn n_features(&self) -> usize {
        let (channels, side) = self.last_maps();
        match self.architecture {
            Architecture::SmallConv => channels * side * side,
            Architecture::Resnet18 => channels,
        }
    }

    /// All parameters.
    pub fn parameters(&self) -> &[f32] {
        &self.parameters
    }

    /// All parameters, mutably.
    pub fn parameters_mut(&mut self) -> &mut [f32] {
        &mut self.parameters
    }

    /// Moves every parameter towards that of `online` by the share `tau` of the difference.
    ///
    /// # Panics
    /// If the networks differ in size.
    pub fn follow(&mut self, online: &Self, tau: f32) {
        assert_eq!(self.layers, online.layers, "a target is a copy");
        for (target, online) in self.parameters.iter_mut().zip(&online.parameters) {
            *target += tau * (online - *target);
        }
    }

    /// Runs images through the network; the features are in `pass`.
    ///
    /// Shape: `[rows, layers, side, side]`.
    ///
    /// # Panics
    /// If the numbers are no whole pictures.
    pub fn forward(&self, pictures: &[f32], pass: &mut ConvPass) {
        let (len, n_features) = (self.picture.len(), self.n_features());
        let rows = pictures.len() / len;
        assert_eq!(pictures.len(), rows * len, "rows of {len} pixels");
        let n_pieces = rows.div_ceil(ROWS_PER_PIECE);
        pass.pieces.resize_with(n_pieces, Piece::default);
        pass.features.clear();
        pass.features.resize(rows * n_features, 0.0);
        let pieces = pictures.par_chunks(ROWS_PER_PIECE * len);
        let features = pass.features.par_chunks_mut(ROWS_PER_PIECE * n_features);
        pieces
            .zip(&mut pass.pieces)
            .zip(features)
            .for_each(|((pictures, piece), features)| self.see(pictures, piece, features));
    }

    /// Adds the gradient of the parameters to `gradient`, given that of the features.
    ///
    /// # Panics
    /// If the sizes do not fit the last [`ConvNet::forward`] into `pass`.
    pub fn backward(&self, feature_gradient: &[f32], pass: &mut ConvPass, gradient: &mut [f32]) {
        assert_eq!(feature_gradient.len(), pass.features.len(), "features");
        assert_eq!(gradient.len(), self.parameters.len(), "parameters");
        let share = pass.pieces.len().div_ceil(PARTIAL_SUMS).max(1);
        let n_sums = pass.pieces.len().div_ceil(share);
        pass.partial_sums.resize_with(n_sums, Vec::new);
        let gradients = feature_gradient.par_chunks(share * ROWS_PER_PIECE * self.n_features());
        gradients
            .zip(pass.pieces.par_chunks_mut(share))
            .zip(&mut pass.partial_sums)
            .for_each(|((gradients, pieces), sum)| {
                sum.clear();
                sum.resize(self.parameters.len(), 0.0);
                let gradients = gradients.chunks(ROWS_PER_PIECE * self.n_features());
                for (gradient, piece) in gradients.zip(pieces) {
                    self.back(gradient, piece, sum);
                }
            });
        for sum in &pass.partial_sums {
            for (total, part) in gradient.iter_mut().zip(sum) {
                *total += part;
            }
        }
    }

    /// The way of one piece.
    fn see(&self, pictures: &[f32], piece: &mut Piece, features: &mut [f32]) {
        let (area, len) = (self.picture.side.pow(2), self.picture.len());
        let rows = pictures.len() / len;
        piece.rows = rows;
        piece.input.clear();
        for layer in 0..self.picture.layers {
            for row in 0..rows {
                let map = &pictures[row * len + layer * area..][..area];
                piece.input.extend_from_slice(map);
            }
        }
        piece
            .layers
            .resize_with(self.layers.len(), LayerPass::default);
        let mut input = &piece.input;
        for (layer, memory) in self.layers.iter().zip(&mut piece.layers) {
            layer.forward(&self.parameters, input, rows, &mut piece.columns, memory);
            input = &memory.output;
        }
        let maps = input;
        self.each_feature(rows, |feature, pixels| {
            features[feature] = maps[pixels.clone()].iter().sum::<f32>() / pixels.len() as f32;
        });
    }

    /// The way back of one piece.
    fn back(&self, gradient: &[f32], piece: &mut Piece, sum: &mut [f32]) {
        let rows = piece.rows;
        let (channels, side) = self.last_maps();
        let mut delta = vec![0.0; channels * rows * side * side];
        self.each_feature(rows, |feature, pixels| {
            let share = gradient[feature] / pixels.len() as f32;
            delta[pixels].fill(share);
        });
        for i in (0..self.layers.len()).rev() {
            let (before, rest) = piece.layers.split_at_mut(i);
            let input = before.last().map_or(&piece.input, |memory| &memory.output);
            let parameters = (self.parameters.as_slice(), &mut *sum);
            let columns = &mut piece.columns;
            delta = self.layers[i].backward(parameters, input, &rest[0], delta, rows, columns);
        }
    }

    /// Visits every feature of every row with the pixels of the last maps that it is the mean of.
    fn each_feature(&self, rows: usize, mut visit: impl FnMut(usize, std::ops::Range<usize>)) {
        let (channels, side) = self.last_maps();
        let area = side * side;
        let pixels = match self.architecture {
            Architecture::SmallConv => 1,
            Architecture::Resnet18 => area,
        };
        let per_map = area / pixels;
        for channel in 0..channels {
            for row in 0..rows {
                for k in 0..per_map {
                    let feature = (row * channels + channel) * per_map + k;
                    let begin = (channel * rows + row) * area + k * pixels;
                    visit(feature, begin..begin + pixels);
                }
            }
        }
    }

    /// Channels and side of the last maps.
    fn last_maps(&self) -> (usize, usize) {
        let last = self.layers.last().expect("every architecture has layers");
        (last.channels_out(), last.side_out())
    }
}

pub(super) fn n_parameters(layers: &[Layer]) -> usize {
    let units = layers.iter().flat_map(Layer::units);
    units.map(|unit| unit.range().end).max().unwrap_or(0)
}

/// The layers of an architecture, their parameters one after another.
pub(super) fn layers(architecture: Architecture, picture: Picture) -> Vec<Layer> {
    let mut builder = Builder {
        channels: picture.layers,
        side: picture.side,
        n_parameters: 0,
    };
    match architecture {
        Architecture::SmallConv => [16, 32, 64, 64]
            .map(|channels| Layer::Plain(builder.unit(channels, 3, 2)))
            .to_vec(),
        Architecture::Resnet18 => {
            let mut layers = vec![Layer::Plain(builder.unit(64, 7, 2)), builder.pool()];
            for (channels, stride) in [(64, 1), (128, 2), (256, 2), (512, 2)] {
                layers.push(builder.block(channels, stride));
                layers.push(builder.block(channels, 1));
            }
            layers
        }
    }
}

/// The maps after the layers so far.
struct Builder {
    channels: usize,
    side: usize,
    n_parameters: usize,
}

impl Builder {
    fn unit(&mut self, outputs: usize, kernel: usize, stride: usize) -> Unit {
        let convolution = Convolution {
            inputs: self.channels,
            outputs,
            kernel,
            stride,
            side: self.side,
        };
        let unit = Unit::new(convolution, self.n_parameters);
        self.n_parameters = unit.range().end;
        self.channels = outputs;
        self.side = convolution.side_out();
        unit
    }

    fn pool(&mut self) -> Layer {
        let pool = Layer::Pool {
            channels: self.channels,
            side: self.side,
        };
        self.side = pool.side_out();
        pool
    }

    fn block(&mut self, channels: usize, stride: usize) -> Layer {
        let (inputs, side) = (self.channels, self.side);
        let first = self.unit(channels, 3, stride);
        let second = self.unit(channels, 3, 1);
        let shortcut = (stride > 1 || inputs != channels).then(|| {
            self.channels = inputs;
            self.side = side;
            self.unit(channels, 1, stride)
        });
        Layer::Residual {
            first,
            second,
            shortcut,
        }
    }
}
