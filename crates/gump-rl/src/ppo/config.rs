//! Hyperparameters of proximal policy optimization, with their sources.

use serde::{Deserialize, Serialize};

use crate::RlError;

/// Hyperparameters.
///
/// "Paper" is Schulman et al. 2017, "Proximal Policy Optimization Algorithms", table 3 (continuous
/// control) where it states a value; other choices are ours.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PpoConfig {
    /// Rounds of collecting and learning.
    pub rounds: usize,
    /// Steps of every environment in a round (paper: 2048 of one; ours: 16 of many, an episode of
    /// 8 s).
    pub unroll: usize,
    /// Passes over the transitions of a round (paper: 10).
    pub epochs: usize,
    /// Transitions per gradient step (paper: 64).
    pub batch: usize,
    /// Sizes of the hidden layers of actor and critic.
    pub hidden: Vec<usize>,
    /// Initial learning rate (paper: 3e-4); it falls linearly.
    pub learning_rate: f64,
    /// Learning rate at the end.
    pub final_learning_rate: f64,
    /// Discount per step (paper: 0.99).
    pub discount: f64,
    /// Decay of later errors in an advantage (paper: 0.95).
    pub lambda: f64,
    /// The ratio of an action's densities, new over old, counts only up to this beyond 1 (paper:
    /// 0.2).
    pub ratio: f64,
    /// Passes of a round end once the policy has moved by this, nats of divergence per transition.
    pub divergence: f64,
    /// Weight of the entropy of actions before squashing (paper: 0).
    pub entropy: f64,
    /// Maximum gradient norm of each network.
    pub clip: f64,
    /// Bounds of the logarithm of the policy's standard deviation.
    pub log_std_bounds: [f64; 2],
    /// Factor of the actor's initial weights in the last layer.
    pub head_gain: f32,
    /// Gradient steps of imitation before the first round, if there are expert transitions; rewards
    /// alone rarely find out how to drive.
    pub imitation_steps: usize,
    /// Weight of the imitation loss in every gradient step after that.
    pub imitation_weight: f64,
    /// Whether this weight falls linearly, to 0 at the end of the run.
    pub imitation_anneals: bool,
    /// Rounds at the beginning in which only the critic learns: the actor would follow its errors.
    pub critic_rounds: usize,
    /// Rounds between checkpoints. All episodes start anew at each, so that a resumed run equals an
    /// uninterrupted one.
    pub segment: usize,
}

impl Default for PpoConfig {
    fn default() -> Self {
        Self {
            rounds: 500,
            unroll: 16,
            epochs: 4,
            batch: 512,
            hidden: vec![128, 128],
            learning_rate: 3e-4,
            final_learning_rate: 3e-5,
            discount: 0.98,
            lambda: 0.95,
            ratio: 0.2,
            divergence: 0.02,
            entropy: 0.0,
            clip: 0.5,
            log_std_bounds: [-2.5, 0.5],
            head_gain: 0.01,
            imitation_steps: 4000,
            imitation_weight: 0.0,
            imitation_anneals: false,
            critic_rounds: 10,
            segment: 50,
        }
    }
}

impl PpoConfig {
    /// Checks that a run can use these values.
    ///
    /// # Errors
    /// [`RlError::Parameter`] with the first of them.
    pub fn check(&self) -> Result<(), RlError> {
        let (positive, share) = ("a positive number", "a number from 0 to 1");
        let is_positive = |x: f64| x > 0.0 && x.is_finite();
        let is_weight = |x: f64| x >= 0.0 && x.is_finite();
        let is_share = |x: f64| (0.0..=1.0).contains(&x);
        let narrowest = self.hidden.iter().copied().min().unwrap_or(0) as f64;
        let [lowest, highest] = self.log_std_bounds;
        let count = |name, n: usize| (name, n as f64, n > 0, positive);
        let weight = |name, x: f64| (name, x, is_weight(x), "a number of at least 0");
        let rate = |name, x: f64| (name, x, is_positive(x), positive);
        for (name, value, fits, expected) in [
            count("unroll", self.unroll),
            count("epochs", self.epochs),
            count("batch", self.batch),
            count("segment", self.segment),
            (
                "hidden",
                narrowest,
                narrowest > 0.0,
                "at least one layer, none empty",
            ),
            rate("learning_rate", self.learning_rate),
            rate("final_learning_rate", self.final_learning_rate),
            rate("ratio", self.ratio),
            rate("divergence", self.divergence),
            rate("clip", self.clip),
            ("discount", self.discount, is_share(self.discount), share),
            ("lambda", self.lambda, is_share(self.lambda), share),
            weight("entropy", self.entropy),
            weight("imitation_weight", self.imitation_weight),
            (
                "log_std_bounds",
                lowest,
                lowest < highest,
                "the lower bound first",
            ),
        ] {
            if !fits {
                return Err(RlError::Parameter {
                    name,
                    value,
                    expected,
                });
            }
        }
        Ok(())
    }

    /// The learning rate of a round (0-based).
    pub fn rate(&self, round: usize) -> f64 {
        let fall = self.final_learning_rate - self.learning_rate;
        self.learning_rate + fall * self.done(round)
    }

    /// The weight of the imitation loss in a round (0-based).
    pub fn imitation_weight_of(&self, round: usize) -> f64 {
        match self.imitation_anneals {
            true => self.imitation_weight * (1.0 - self.done(round)),
            false => self.imitation_weight,
        }
    }

    /// The share of the run before a round.
    fn done(&self, round: usize) -> f64 {
        (round as f64 / self.rounds.max(1) as f64).min(1.0)
    }
}
