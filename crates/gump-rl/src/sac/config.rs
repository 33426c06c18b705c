//! Hyperparameters of the learner, with their sources.

use serde::{Deserialize, Serialize};

use crate::networks::Architecture;
use crate::{ObservationForm, RlError};

/// Hyperparameters.
///
/// Sources: "paper" is GUMP's appendix on reinforcement learning, "ALF" the defaults of the
/// framework that it used. Where neither states a value the choice is ours, and marked as such.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SacConfig {
    /// Gradient steps (paper: 40,000 "steps", which we take for gradient steps).
    pub steps: usize,
    /// Transitions per gradient step (paper: 2048).
    pub batch: usize,
    /// Sizes of the hidden layers of actor and critics (ours: 256 twice).
    pub hidden: Vec<usize>,
    /// Encoder of image observations for actor and critics (paper: ResNet-18); without one they
    /// read the observation directly.
    pub encoder: Option<Architecture>,
    /// Whether actor and critics have separate encoders, each trained by its own loss, instead of
    /// one trained by the critics' loss only (ALF: one).
    pub separate_encoders: bool,
    /// Initial learning rate (paper: 1e-4).
    pub learning_rate: f64,
    /// Learning rate after the drop (paper: 2e-5).
    pub final_learning_rate: f64,
    /// Share of the steps after which it drops, in 0..=1 (paper: 0.7).
    pub drop_at: f64,
    /// Discount per step (ALF: 0.99).
    pub discount: f64,
    /// Rate of the target critics' updates (ALF's examples: 0.005).
    pub tau: f64,
    /// Gradient steps between target updates (ALF: 1).
    pub target_period: usize,
    /// Steps of every environment between gradient steps (ours: 1; ALF: 8).
    pub unroll: usize,
    /// Gradient steps that follow them (ALF: 1 in its examples).
    pub updates: usize,
    /// Environment steps by uniformly random actions before learning (ALF's examples: 1000 and up).
    pub initial_steps: usize,
    /// Capacity of the replay buffer (ALF: 1024 per environment, of which the paper has 128).
    pub replay_capacity: usize,
    /// Logarithm of the initial temperature (ALF: 0).
    pub initial_log_alpha: f64,
    /// Whether the temperature is learned (ALF: yes).
    pub learn_alpha: bool,
    /// Target entropy, nats per component of an action (ALF: a tenth of the range, ln 2 + ln 0.1;
    /// Haarnoja et al.: -1).
    pub target_entropy: f64,
    /// Whether future entropy is part of a state's value (ALF: yes).
    pub entropy_in_target: bool,
    /// Whether actor and temperature are also trained on the next observations (ALF: yes, as it
    /// samples pairs; without it the actor's part costs half).
    pub actor_on_next: bool,
    /// Beyond this error the critics' loss is linear (ALF: never).
    pub huber: Option<f64>,
    /// Maximum gradient norm of each network (ALF: any).
    pub clip: Option<f64>,
    /// Bounds of the logarithm of the policy's standard deviation (ALF: -20 and 2).
    pub log_std_bounds: [f64; 2],
    /// Factor of the actor's initial weights in the last layer (ALF: 0.3).
    pub head_gain: f32,
    /// Share of expert transitions in a batch (paper: 0.2).
    pub imitation_share: f64,
    /// Weight of the imitation loss in the actor's (ours: 1).
    pub imitation_weight: f64,
    /// Highest norm of the imitation loss's gradient by the actor's outputs, as a multiple of that
    /// of the rest of the actor's loss; where it is higher, the gradient is scaled down (ours:
    /// any). Imitation grows as the policy narrows: for a given error the gradient of a log density
    /// by the mean is inversely proportional to the variance.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub imitation_limit: Option<f64>,
    /// Whether vector observations are scaled to mean 0 and variance 1, by the transitions known
    /// when learning begins (ours: yes, as they are in metres). Images are not changed.
    pub normalize: bool,
    /// Gradient steps between checkpoints. All episodes start anew at each, so that a resumed run
    /// equals an uninterrupted one (ours: 1000).
    pub segment: usize,
}

impl Default for SacConfig {
    /// The paper's, then ALF's, then ours.
    fn default() -> Self {
        Self {
            steps: 40_000,
            batch: 2048,
            hidden: vec![256, 256],
            encoder: None,
            separate_encoders: false,
            learning_rate: 1e-4,
            final_learning_rate: 2e-5,
            drop_at: 0.7,
            discount: 0.99,
            tau: 0.005,
            target_period: 1,
            unroll: 1,
            updates: 1,
            initial_steps: 1000,
            replay_capacity: 1024 * 128,
            initial_log_alpha: 0.0,
            learn_alpha: true,
            target_entropy: (2.0f64 * 0.1).ln(),
            entropy_in_target: true,
            actor_on_next: true,
            huber: None,
            clip: None,
            log_std_bounds: [-20.0, 2.0],
            head_gain: 0.3,
            imitation_share: 0.2,
            imitation_weight: 1.0,
            imitation_limit: None,
            normalize: true,
            segment: 1000,
        }
    }
}

impl SacConfig {
    /// Checks that a run can use these values.
    ///
    /// # Errors
    /// [`RlError::Parameter`] with the first of them.
    pub fn check(&self) -> Result<(), RlError> {
        let positive = "a positive number";
        let share = "a number from 0 to 1";
        let is_positive = |x: f64| x > 0.0 && x.is_finite();
        let is_share = |x: f64| (0.0..=1.0).contains(&x);
        let narrowest = self.hidden.iter().copied().min().unwrap_or(0) as f64;
        let [lowest, highest] = self.log_std_bounds;
        for (name, value, fits, expected) in [
            ("batch", self.batch as f64, self.batch > 0, positive),
            (
                "hidden",
                narrowest,
                narrowest > 0.0,
                "at least one layer, none empty",
            ),
            (
                "learning_rate",
                self.learning_rate,
                is_positive(self.learning_rate),
                positive,
            ),
            (
                "final_learning_rate",
                self.final_learning_rate,
                is_positive(self.final_learning_rate),
                positive,
            ),
            ("drop_at", self.drop_at, is_share(self.drop_at), share),
            ("discount", self.discount, is_share(self.discount), share),
            ("tau", self.tau, is_share(self.tau), share),
            ("target_period", 0.0, self.target_period > 0, positive),
            ("unroll", 0.0, self.unroll > 0, positive),
            ("updates", 0.0, self.updates > 0, positive),
            ("segment", 0.0, self.segment > 0, positive),
            ("replay_capacity", 0.0, self.replay_capacity > 0, positive),
            (
                "initial_log_alpha",
                self.initial_log_alpha,
                self.initial_log_alpha.is_finite(),
                "a finite number",
            ),
            (
                "target_entropy",
                self.target_entropy,
                self.target_entropy.is_finite(),
                "a finite number",
            ),
            (
                "log_std_bounds",
                lowest,
                lowest < highest,
                "the lower bound first",
            ),
            (
                "imitation_share",
                self.imitation_share,
                is_share(self.imitation_share),
                share,
            ),
            (
                "imitation_weight",
                self.imitation_weight,
                self.imitation_weight >= 0.0 && self.imitation_weight.is_finite(),
                "a number of at least 0",
            ),
            (
                "imitation_limit",
                self.imitation_limit.unwrap_or(1.0),
                self.imitation_limit.is_none_or(is_positive),
                positive,
            ),
            (
                "huber",
                self.huber.unwrap_or(1.0),
                self.huber.is_none_or(is_positive),
                positive,
            ),
            (
                "clip",
                self.clip.unwrap_or(1.0),
                self.clip.is_none_or(is_positive),
                positive,
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

    /// Checks that the networks can read these observations.
    ///
    /// # Errors
    /// [`RlError::NoPicture`].
    pub fn check_form(&self, form: ObservationForm) -> Result<(), RlError> {
        match (self.encoder, form) {
            (Some(_), ObservationForm::Numbers(found)) => Err(RlError::NoPicture { found }),
            _ => Ok(()),
        }
    }

    /// The learning rate of a gradient step (0-based).
    pub fn rate(&self, step: usize) -> f64 {
        if (step as f64) < self.drop_at * self.steps as f64 {
            self.learning_rate
        } else {
            self.final_learning_rate
        }
    }

    /// Number of expert transitions in a batch.
    pub fn n_imitated(&self) -> usize {
        (self.batch as f64 * self.imitation_share).round() as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_learning_rate_drops_at_seventy_per_cent() {
        let config = SacConfig {
            steps: 10_000,
            ..SacConfig::default()
        };
        assert_eq!(config.rate(0), 1e-4);
        assert_eq!(config.rate(6_999), 1e-4);
        assert_eq!(config.rate(7_000), 2e-5);
        assert_eq!(config.rate(9_999), 2e-5);
    }

    #[test]
    fn a_fifth_of_the_batch_is_imitated() {
        assert_eq!(SacConfig::default().n_imitated(), 410);
        assert!((SacConfig::default().target_entropy + 1.609_437_9).abs() < 1e-6);
    }

    #[test]
    fn numbers_out_of_range_are_named() {
        let check = |change: fn(&mut SacConfig), expected: &str| {
            let mut config = SacConfig::default();
            change(&mut config);
            let error = config.check().unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        };
        assert!(SacConfig::default().check().is_ok());
        check(|c| c.batch = 0, "batch");
        check(|c| c.hidden = vec![64, 0], "hidden");
        check(|c| c.tau = 1.5, "tau is 1.5");
        check(|c| c.discount = f64::NAN, "discount");
        check(|c| c.learning_rate = 0.0, "learning_rate");
        check(|c| c.imitation_share = -0.1, "imitation_share");
        check(|c| c.log_std_bounds = [2.0, -20.0], "log_std_bounds");
    }
}
