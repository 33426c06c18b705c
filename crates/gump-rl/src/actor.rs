//! The policy that is learned: from observations to a distribution of actions.

use gump_scene::{Rng, Seed};

use crate::networks::{Mlp, Normalizer, Pass, standard_normal};
use crate::sac::{SacConfig, Squashed};

/// A normalizer and a network that gives two numbers, mean and log standard deviation, per number
/// of an action.
#[derive(Clone, Debug, PartialEq)]
pub struct Actor {
    pub(crate) normalizer: Normalizer,
    pub(crate) network: Mlp,
    pub(crate) log_std_bounds: [f64; 2],
}

impl Actor {
    /// An actor that has learned nothing.
    pub fn new(config: &SacConfig, observation_len: usize, action_len: usize, seed: Seed) -> Self {
        let mut sizes = vec![observation_len];
        sizes.extend(&config.hidden);
        sizes.push(2 * action_len);
        Self {
            normalizer: Normalizer::identity(observation_len),
            network: Mlp::new(&sizes, config.head_gain, &mut seed.rng()),
            log_std_bounds: config.log_std_bounds,
        }
    }

    /// Numbers in an observation.
    pub fn observation_len(&self) -> usize {
        self.network.sizes()[0]
    }

    /// Numbers in an action.
    pub fn action_len(&self) -> usize {
        self.network.sizes().last().map_or(0, |outputs| outputs / 2)
    }

    /// The most likely actions before squashing: what to do when not exploring.
    ///
    /// Shape: `[rows, observation_len]` to `[rows, action_len]`, in (-1, 1).
    ///
    /// # Panics
    /// If the observations are no whole number of rows.
    pub fn modes(&self, observations: &[f32]) -> Vec<f32> {
        self.act(observations, |dimension| dimension.mode())
    }

    /// Actions drawn at random. Shape: as [`Actor::modes`].
    ///
    /// # Panics
    /// If the observations are no whole number of rows.
    pub fn sample(&self, observations: &[f32], rng: &mut Rng) -> Vec<f32> {
        self.act(observations, |dimension| {
            dimension.draw(standard_normal(rng)).action
        })
    }

    fn act(&self, observations: &[f32], mut choose: impl FnMut(Squashed) -> f64) -> Vec<f32> {
        let mut input = observations.to_vec();
        self.normalizer.apply(&mut input);
        let mut pass = Pass::default();
        self.network.forward(&input, &mut pass);
        let dimensions = pass.output().chunks_exact(2);
        dimensions
            .map(|d| choose(self.dimension(d)) as f32)
            .collect()
    }

    /// The distribution that two outputs of the network stand for.
    pub(crate) fn dimension(&self, outputs: &[f32]) -> Squashed {
        Squashed::new(outputs[0], outputs[1], self.log_std_bounds)
    }
}
