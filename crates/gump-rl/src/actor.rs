//! The learned policy: a distribution of actions for every observation.

use std::borrow::Cow;

use gump_scene::{Rng, Seed, standard_normal};

use crate::networks::{ConvNet, ConvPass, Mlp, Normalizer, Pass};
use crate::sac::{SacConfig, Squashed};
use crate::{ObservationForm, RlError, VectorEnv};

/// Preprocessing of observations, and a network that outputs mean and log standard deviation of
/// every component of an action.
#[derive(Clone, Debug, PartialEq)]
pub struct Actor {
    pub(crate) perception: Perception,
    pub(crate) network: Mlp,
    pub(crate) log_std_bounds: [f64; 2],
}

/// Preprocessing of observations for dense networks.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Perception {
    /// Numbers are normalized one by one.
    Scaled(Normalizer),
    /// Images pass through a convolutional encoder.
    Encoded(ConvNet),
}

impl Actor {
    /// An untrained actor.
    ///
    /// # Panics
    /// For an image encoder with vector observations; see [`SacConfig::check_form`].
    pub fn new(
        config: &SacConfig,
        form: impl Into<ObservationForm>,
        action_len: usize,
        seed: Seed,
    ) -> Self {
        let form = form.into();
        let (perception, n_features) = match (config.encoder, form) {
            (None, form) => {
                let scale = Normalizer::identity(form.len());
                (Perception::Scaled(scale), form.len())
            }
            (Some(architecture), ObservationForm::Bits(picture)) => {
                let encoder = ConvNet::new(architecture, picture, &mut seed.fork(0).rng());
                let n_features = encoder.n_features();
                (Perception::Encoded(encoder), n_features)
            }
            (Some(_), ObservationForm::Numbers(len)) => {
                panic!("an encoder of pictures over {len} numbers")
            }
        };
        let mut sizes = vec![n_features];
        sizes.extend(&config.hidden);
        sizes.push(2 * action_len);
        Self {
            perception,
            network: Mlp::new(&sizes, config.head_gain, &mut seed.rng()),
            log_std_bounds: config.log_std_bounds,
        }
    }

    /// Length of an observation.
    pub fn observation_len(&self) -> usize {
        match &self.perception {
            Perception::Scaled(_) => self.n_features(),
            Perception::Encoded(encoder) => encoder.picture().len(),
        }
    }

    /// Number of inputs of the dense network.
    pub(crate) fn n_features(&self) -> usize {
        self.network.sizes()[0]
    }

    /// Length of an action.
    pub fn action_len(&self) -> usize {
        self.network.sizes().last().map_or(0, |outputs| outputs / 2)
    }

    /// The normalizer of vector observations, if there is one.
    pub(crate) fn normalizer(&self) -> Option<&Normalizer> {
        match &self.perception {
            Perception::Scaled(normalizer) => Some(normalizer),
            Perception::Encoded(_) => None,
        }
    }

    /// The encoder of image observations, if there is one.
    pub fn encoder(&self) -> Option<&ConvNet> {
        match &self.perception {
            Perception::Scaled(_) => None,
            Perception::Encoded(encoder) => Some(encoder),
        }
    }

    pub(crate) fn encoder_mut(&mut self) -> Option<&mut ConvNet> {
        match &mut self.perception {
            Perception::Scaled(_) => None,
            Perception::Encoded(encoder) => Some(encoder),
        }
    }

    /// The actions without exploration: tanh of the means.
    ///
    /// Shape: `[rows, observation_len]` to `[rows, action_len]`, in (-1, 1).
    ///
    /// # Panics
    /// If the observations are no whole number of rows.
    pub fn modes(&self, observations: &[f32]) -> Vec<f32> {
        self.act(observations, |dimension| dimension.mode())
    }

    /// Random actions from the distributions. Shape: as [`Actor::modes`].
    ///
    /// # Panics
    /// If the observations are no whole number of rows.
    pub fn sample(&self, observations: &[f32], rng: &mut Rng) -> Vec<f32> {
        self.act(observations, |dimension| {
            dimension.draw(standard_normal(rng)).action
        })
    }

    fn act(&self, observations: &[f32], mut choose: impl FnMut(Squashed) -> f64) -> Vec<f32> {
        let mut seen = ConvPass::default();
        let input = match &self.perception {
            Perception::Scaled(normalizer) => {
                let mut input = observations.to_vec();
                normalizer.apply(&mut input);
                Cow::Owned(input)
            }
            Perception::Encoded(encoder) => {
                encoder.forward(observations, &mut seen);
                Cow::Borrowed(seen.output())
            }
        };
        let mut pass = Pass::default();
        self.network.forward(&input, &mut pass);
        let dimensions = pass.output().chunks_exact(2);
        dimensions
            .map(|d| choose(self.dimension(d)) as f32)
            .collect()
    }

    /// Error: [`RlError::Shape`] for an environment with other observations or actions.
    pub(crate) fn check_shape(&self, env: &dyn VectorEnv) -> Result<(), RlError> {
        let pairs = [
            (
                "observations",
                self.observation_len(),
                env.observation_len(),
            ),
            ("actions", self.action_len(), env.action_len()),
        ];
        for (what, expected, found) in pairs {
            if expected != found {
                return Err(RlError::Shape {
                    what,
                    expected,
                    found,
                });
            }
        }
        Ok(())
    }

    /// The distribution with these two network outputs.
    pub(crate) fn dimension(&self, outputs: &[f32]) -> Squashed {
        Squashed::new(outputs[0], outputs[1], self.log_std_bounds)
    }
}
