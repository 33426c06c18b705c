//! Keeping a network that learns from rewards near the one with which the run began.
//!
//! The divergence from that network is part of the loss, with a weight that adapts towards a target,
//! as in the variant of PPO with an adaptive penalty (Schulman et al., "Proximal Policy Optimization
//! Algorithms", 2017, section 4). Divergences are computed by `gump-model`.

use gump_model::checkpoint::Archive;
use gump_model::relative::{Anchor, RelativeNetwork};

use crate::TrainError;
use crate::relative::settings::RelativeRewards;

/// Bounds of the weight, chosen by hand: with less it is negligible beside the other losses, and
/// could not grow again in time; with more nothing is learned.
pub(super) const LEAST_WEIGHT: f64 = 1e-3;
pub(super) const MOST_WEIGHT: f64 = 1e3;
/// Factor by which a mean divergence has to miss the target for the weight to change, from the
/// paper.
const TOLERANCE: f64 = 1.5;
/// Factor by which the weight changes, from the paper.
const CHANGE: f64 = 2.0;
/// Header entry of a checkpoint.
const STATE: &str = "divergence";

/// The network at the start of a run, and the weight of the divergence from it.
pub(super) struct Tether {
    reference: RelativeNetwork,
    target: f64,
    bound: f64,
    /// Steps after which the weight adapts.
    every: usize,
    adaptive: Adaptive,
}

/// A weight, and the divergences since it last changed.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Adaptive {
    weight: f64,
    sum: f64,
    n: usize,
}

impl Adaptive {
    fn observe(&mut self, divergence: f64, target: f64, every: usize) {
        self.sum += divergence;
        self.n += 1;
        if self.n < every {
            return;
        }
        let mean = self.sum / self.n as f64;
        let weight = if mean > TOLERANCE * target {
            self.weight * CHANGE
        } else if mean < target / TOLERANCE {
            self.weight / CHANGE
        } else {
            self.weight
        };
        *self = Self {
            weight: weight.clamp(LEAST_WEIGHT, MOST_WEIGHT),
            sum: 0.0,
            n: 0,
        };
    }
}

impl Tether {
    /// At the start of a run; `None` if its settings have no target.
    pub(super) fn begin(
        rewards: Option<&RelativeRewards>,
        reference: impl FnOnce() -> Result<RelativeNetwork, TrainError>,
    ) -> Result<Option<Self>, TrainError> {
        let Some((rewards, target)) = rewards.and_then(|own| own.kl_target.map(|kl| (own, kl)))
        else {
            return Ok(None);
        };
        Ok(Some(Self {
            reference: reference()?,
            target,
            bound: rewards.kl_bound.unwrap_or(f64::INFINITY),
            every: rewards.refresh,
            adaptive: Adaptive {
                weight: rewards.kl_weight,
                sum: 0.0,
                n: 0,
            },
        }))
    }

    /// As it was when it wrote its [`Self::entry`] to a checkpoint.
    ///
    /// Error: an entry that is missing or that it did not write.
    pub(super) fn restored(mut self, archive: &Archive) -> Result<Self, TrainError> {
        let text = archive.entry(STATE)?;
        let parts: Vec<&str> = text.split(' ').collect();
        let read = || {
            let [weight, sum, n] = parts.as_slice() else {
                return None;
            };
            Some(Adaptive {
                weight: weight.parse().ok()?,
                sum: sum.parse().ok()?,
                n: n.parse().ok()?,
            })
        };
        self.adaptive = read().ok_or_else(|| {
            archive.error(format!("its {STATE} is \"{text}\", expected three numbers"))
        })?;
        Ok(self)
    }

    /// The header entry of a checkpoint.
    pub(super) fn entry(&self) -> (String, String) {
        // Rust prints the digits that read back as the same number.
        let Adaptive { weight, sum, n } = self.adaptive;
        (STATE.to_owned(), format!("{weight} {sum} {n}"))
    }

    pub(super) fn reference(&self) -> &RelativeNetwork {
        &self.reference
    }

    /// Weight of the divergence in the loss of the next step, for the mean over moves.
    pub(super) fn weight(&self) -> f64 {
        self.adaptive.weight
    }

    /// For a step with so many moves.
    pub(super) fn anchor(&self, n_moves: usize) -> Anchor<'_> {
        Anchor {
            reference: &self.reference,
            weight: self.adaptive.weight / n_moves as f64,
        }
    }

    /// Error: [`TrainError::TooFar`] for a divergence above the bound, or one that is not a number.
    pub(super) fn check(&self, divergence: f64, step: usize) -> Result<(), TrainError> {
        if !divergence.is_finite() {
            let field = "divergence".to_owned();
            return Err(TrainError::LossNotFinite { step, field });
        }
        if divergence > self.bound {
            return Err(TrainError::TooFar {
                step,
                divergence,
                bound: self.bound,
            });
        }
        Ok(())
    }

    /// Adapts the weight to the divergence of a step that was done.
    pub(super) fn observe(&mut self, divergence: f64) {
        let (target, every) = (self.target, self.every);
        self.adaptive.observe(divergence, target, every);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const START: Adaptive = Adaptive {
        weight: 1.0,
        sum: 0.0,
        n: 0,
    };

    #[test]
    fn the_weight_follows_the_mean_of_a_few_steps() {
        let after = |divergences: [f64; 2]| {
            let mut weight = START;
            weight.observe(divergences[0], 0.02, 2);
            assert_eq!(weight.weight, 1.0);
            weight.observe(divergences[1], 0.02, 2);
            assert_eq!((weight.sum, weight.n), (0.0, 0));
            weight.weight
        };
        assert_eq!(after([0.0, 0.061]), 2.0);
        assert_eq!(after([0.0, 0.059]), 1.0);
        assert_eq!(after([0.013, 0.014]), 1.0);
        assert_eq!(after([0.013, 0.013]), 0.5);
    }

    #[test]
    fn the_weight_stays_within_its_bounds() {
        let after = |divergence: f64| {
            let mut weight = START;
            (0..20).for_each(|_| weight.observe(divergence, 0.02, 1));
            weight.weight
        };
        assert_eq!((after(1.0), after(0.0)), (MOST_WEIGHT, LEAST_WEIGHT));
    }
}
