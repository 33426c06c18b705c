//! The placement network on plain numbers: a vehicle is drawn from the places of a scene.

use std::sync::{Arc, LazyLock};

use gump_kernels::gelu::gelu_row;
use gump_kernels::panels::{Panels, Precision, Scratch};
use gump_model::placement::PlacementWeights;
use gump_model::{ModelError, WeightsError};

use super::places::{N_FEATURES, NewVehicle, PlaceKind, Places, Traffic};

/// The shipped weights, trained on synthetic scenes (docs/results/0029-placement.md).
static SHIPPED: LazyLock<Arc<PlacementScorer>> = LazyLock::new(|| {
    let bytes = include_bytes!("placement.safetensors");
    let weights = PlacementWeights::read(bytes).expect("the shipped weights are valid");
    Arc::new(PlacementScorer::new(&weights).expect("the shipped weights fit"))
});

/// Share of the probability of places beside lanes that the likely ones hold. Chosen by hand: the
/// others take most of the time.
const KEPT: f64 = 0.98;
/// Places scored at once: their hidden layers stay in the cache.
const ROWS: usize = 64;

/// Scores places.
#[derive(Debug)]
pub struct PlacementScorer {
    layers: Vec<Panels>,
}

impl PlacementScorer {
    /// Packs the weights.
    ///
    /// # Errors
    /// [`ModelError::Weights`] for weights with other properties of places than this version's.
    pub fn new(weights: &PlacementWeights) -> Result<Self, ModelError> {
        let config = weights.config();
        if config.features != N_FEATURES {
            return Err(WeightsError::OtherInputs {
                expected: N_FEATURES,
                found: config.features,
            }
            .into());
        }
        let layers = weights.layers().iter();
        let layers = layers.map(|(weight, bias)| {
            let n_in = weight.len() / bias.len();
            Panels::new(weight, n_in, Some(bias), Precision::F32)
        });
        Ok(Self {
            layers: layers.collect(),
        })
    }

    /// The network with the shipped weights.
    pub fn shipped() -> Arc<Self> {
        Arc::clone(&SHIPPED)
    }

    /// Which places are worth a score before others are placed: all on lanes, and of those beside
    /// them the most likely that together hold nearly all of their probability, for a car that
    /// stands.
    pub fn likely(&self, places: &Places) -> Arc<[bool]> {
        let all = places.all();
        let beside = |i: &usize| all[*i].kind != PlaceKind::OnLane;
        let which: Vec<usize> = (0..all.len()).filter(beside).collect();
        let mut likely = vec![true; all.len()];
        let traffic = Traffic::new(places, Vec::new());
        let scores = self.scores(places, &traffic, &NewVehicle::STANDING_CAR, &which);
        let peak = scores.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let weights: Vec<f64> = scores.iter().map(|s| f64::from(s - peak).exp()).collect();
        let mut order: Vec<usize> = (0..which.len()).collect();
        order.sort_by(|a, b| weights[*b].total_cmp(&weights[*a]));
        let mut left = KEPT * weights.iter().sum::<f64>();
        for k in order {
            likely[which[k]] = left > 0.0;
            left -= weights[k];
        }
        likely.into()
    }

    /// The scores of these places for a vehicle, natural logarithms of probabilities but for a
    /// constant.
    pub fn scores(
        &self,
        places: &Places,
        traffic: &Traffic,
        own: &NewVehicle,
        which: &[usize],
    ) -> Vec<f32> {
        let mut scores = Vec::with_capacity(which.len());
        let mut scratch = Scratch::default();
        let mut rows = vec![0.0; ROWS * N_FEATURES];
        let (mut hidden, mut next) = (Vec::new(), Vec::new());
        for part in which.chunks(ROWS) {
            for (i, row) in part.iter().zip(rows.chunks_exact_mut(N_FEATURES)) {
                places.write(traffic, own, *i, row);
            }
            hidden.clear();
            hidden.extend_from_slice(&rows[..part.len() * N_FEATURES]);
            for (n, layer) in self.layers.iter().enumerate() {
                next.clear();
                next.resize(part.len() * layer.n_out(), 0.0);
                layer.apply(&hidden, &mut next, &mut scratch);
                if n + 1 < self.layers.len() {
                    gelu_row(&mut next);
                }
                std::mem::swap(&mut hidden, &mut next);
            }
            scores.extend_from_slice(&hidden);
        }
        scores
    }
}

#[cfg(test)]
mod tests {
    use gump_geometry::{OrientedBox, Pose, dvec2};
    use gump_scene::fixture;

    use super::*;
    use crate::placement::places::PlacedVehicle;

    /// The most likely place of a vehicle that stands, on a road with a red light at x = 40.
    fn best(vehicles: &[f64]) -> f64 {
        let scenario = fixture::scenario(
            "lane 1: -60,0 40,0 width 3.6 next 2\nlane 2: 40,0 60,0\nlight 2 red: 40,0\n\
             ego vehicle 0: 0,0",
        )
        .unwrap();
        let lights = scenario.present().now().lights().to_vec();
        let places = Places::new(&scenario.map, Pose::IDENTITY, &lights);
        let placed = vehicles.iter().map(|x| PlacedVehicle {
            outline: OrientedBox {
                pose: Pose::new(*x, 0.0, 0.0),
                length: 4.8,
                width: 2.0,
            },
            speed: 0.0,
        });
        let traffic = Traffic::new(&places, placed.collect());
        let free = |i: &usize| {
            let at = places.all()[*i].pose.position;
            vehicles.iter().all(|x| at.distance(dvec2(*x, 0.0)) > 5.0)
        };
        let which: Vec<usize> = (0..places.all().len()).filter(free).collect();
        let scorer = PlacementScorer::shipped();
        let scores = scorer.scores(&places, &traffic, &NewVehicle::STANDING_CAR, &which);
        let best = (0..scores.len()).max_by(|a, b| scores[*a].total_cmp(&scores[*b]));
        places.all()[which[best.unwrap()]].pose.position.x
    }

    #[test]
    fn queues_form_before_red_lights() {
        let first = best(&[]);
        assert!((30.0..40.0).contains(&first), "{first}");
        // Behind the first, or before it where there is room, close up.
        let second = best(&[36.0]);
        assert!((27.0..31.0).contains(&second), "{second}");
    }

    #[test]
    fn bytes_that_are_no_weights_are_refused() {
        let error = PlacementWeights::read(b"no weights").unwrap_err();
        assert!(error.to_string().contains("safetensors"), "{error}");
    }
}
