//! Convolutional networks: sizes, gradients, and that they learn.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use gump_scene::Seed;
use rand::Rng as _;

use super::Adam;
use super::conv_layers::Layer;
use super::conv_net::{
    Architecture, ConvNet, ConvPass, Picture, ROWS_PER_PIECE, layers, n_parameters,
};

const PICTURE: Picture = Picture {
    layers: 2,
    side: 16,
};

fn pictures(rows: usize, seed: u64) -> Vec<f32> {
    let mut rng = Seed(seed).rng();
    let mut pixel = || f32::from(u8::from(rng.random_range(0.0..1.0) < 0.3));
    (0..rows * PICTURE.len()).map(|_| pixel()).collect()
}

fn network(architecture: Architecture) -> ConvNet {
    ConvNet::new(architecture, PICTURE, &mut Seed(4).rng())
}

fn features(network: &ConvNet, pictures: &[f32]) -> Vec<f32> {
    let mut pass = ConvPass::default();
    network.forward(pictures, &mut pass);
    pass.output().to_vec()
}

#[test]
fn parameters_are_as_many_as_the_papers() {
    let count = |architecture, n_layers| {
        let picture = Picture {
            layers: n_layers,
            side: 64,
        };
        n_parameters(&layers(architecture, picture))
    };
    // ResNet-18 for colours, 11,689,512, less its last layer of 512 x 1000 + 1000.
    assert_eq!(count(Architecture::Resnet18, 3), 11_176_512);
    assert_eq!(count(Architecture::Resnet18, 8), 11_176_512 + 5 * 49 * 64);
    let small = 9 * (8 * 16 + 16 * 32 + 32 * 64 + 64 * 64) + 2 * (16 + 32 + 64 + 64);
    assert_eq!(count(Architecture::SmallConv, 8), small);
}

#[test]
fn gradients_are_finite_differences() {
    for architecture in [Architecture::SmallConv, Architecture::Resnet18] {
        let (network, pictures) = (network(architecture), pictures(3, 1));
        let mut pass = ConvPass::default();
        network.forward(&pictures, &mut pass);
        let mut rng = Seed(9).rng();
        let weights: Vec<f32> = (0..pass.output().len())
            .map(|_| rng.random_range(-1.0..1.0))
            .collect();
        let loss = |network: &ConvNet| {
            let features = features(network, &pictures);
            let products = features.iter().zip(&weights);
            products.map(|(y, w)| f64::from(y * w)).sum::<f64>()
        };
        let mut gradient = vec![0.0; network.parameters().len()];
        network.backward(&weights, &mut pass, &mut gradient);
        // Along random directions within each unit's weights, scales and shifts. Steps cross
        // kinks of ReLU, so that a few agree less well.
        let mut errors = Vec::new();
        for unit in network.layers.iter().flat_map(Layer::units) {
            let range = unit.range();
            let bound = range.start + unit.n_weights();
            for part in [range.start..bound, bound..range.end] {
                let norm = (part.len() as f32).sqrt();
                let direction: Vec<f32> = part
                    .clone()
                    .map(|_| rng.random_range(-1.0f32..1.0) / norm)
                    .collect();
                let h = 2e-3;
                let at = |h: f32| {
                    let mut moved = network.clone();
                    let parameters = &mut moved.parameters_mut()[part.clone()];
                    for (p, d) in parameters.iter_mut().zip(&direction) {
                        *p += h * d;
                    }
                    loss(&moved)
                };
                let expected = (at(h) - at(-h)) / (2.0 * f64::from(h));
                let slopes = gradient[part.clone()].iter().zip(&direction);
                let found: f64 = slopes.map(|(g, d)| f64::from(g * d)).sum();
                errors.push((found - expected).abs() / (0.5 + expected.abs()));
            }
        }
        errors.sort_by(f64::total_cmp);
        let most = errors[errors.len() * 4 / 5];
        assert!(most < 0.02, "{architecture:?}: {errors:?}");
        assert!(
            errors[errors.len() - 1] < 0.1,
            "{architecture:?}: {errors:?}"
        );
    }
}

#[test]
fn rows_do_not_depend_on_their_neighbours() {
    let network = network(Architecture::SmallConv);
    let many = pictures(ROWS_PER_PIECE + 3, 2);
    let together = features(&network, &many);
    let n = network.n_features();
    for row in [0, 1, ROWS_PER_PIECE, ROWS_PER_PIECE + 2] {
        let alone = features(&network, &many[row * PICTURE.len()..][..PICTURE.len()]);
        for (a, b) in alone.iter().zip(&together[row * n..]) {
            assert!((a - b).abs() < 1e-4, "{row}: {a} {b}");
        }
    }
}

#[test]
fn any_number_of_threads_gives_the_same_bits() {
    let network = network(Architecture::SmallConv);
    let pictures = pictures(5 * ROWS_PER_PIECE + 3, 2);
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
        pool.build().unwrap().install(|| {
            let mut pass = ConvPass::default();
            network.forward(&pictures, &mut pass);
            let above = pass.output().to_vec();
            let mut gradient = vec![0.0; network.parameters().len()];
            network.backward(&above, &mut pass, &mut gradient);
            (above, gradient)
        })
    };
    assert_eq!(run(1), run(3));
}

#[test]
fn a_square_is_told_from_its_outline() {
    // The same number of pixels on average, so only shape tells them apart.
    let mut rng = Seed(5).rng();
    let mut batch = |rows: usize| {
        let (mut pictures, mut labels) = (vec![0.0; rows * PICTURE.len()], Vec::new());
        for picture in pictures.chunks_exact_mut(PICTURE.len()) {
            let is_full = rng.random_range(0.0..1.0) < 0.5;
            let side: usize = if is_full { 4 } else { 5 };
            let x0 = rng.random_range(1..PICTURE.side - side);
            let y0 = rng.random_range(1..PICTURE.side - side);
            for (x, y) in (0..side * side).map(|i| (i % side, i / side)) {
                let is_edge = [0, side - 1].contains(&x) || [0, side - 1].contains(&y);
                if is_full || is_edge {
                    picture[(y0 + y) * PICTURE.side + x0 + x] = 1.0;
                }
            }
            labels.push(if is_full { 1.0 } else { -1.0f32 });
        }
        (pictures, labels)
    };
    let mut network = network(Architecture::SmallConv);
    let mut adam = Adam::new(network.parameters().len());
    let score = |features: &[f32]| features.iter().sum::<f32>() / 16.0 - 1.5;
    let n = network.n_features();
    let mut pass = ConvPass::default();
    for _ in 0..60 {
        let (pictures, labels) = batch(32);
        network.forward(&pictures, &mut pass);
        let rows = pass.output().chunks_exact(n).zip(&labels);
        let errors: Vec<f32> = rows.map(|(row, label)| score(row) - label).collect();
        let above: Vec<f32> = errors.iter().flat_map(|e| vec![e / 32.0; n]).collect();
        let mut gradient = vec![0.0; network.parameters().len()];
        network.backward(&above, &mut pass, &mut gradient);
        adam.step(network.parameters_mut(), &gradient, 3e-3);
    }
    let (pictures, labels) = batch(64);
    let found = features(&network, &pictures);
    let rows = found.chunks_exact(n).zip(&labels);
    let right = rows
        .filter(|(row, label)| score(row) * **label > 0.0)
        .count();
    assert!(right >= 60, "{right} of 64");
}
