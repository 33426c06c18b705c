//! Settings of learning from rollouts, and their ranges.

use serde::{Deserialize, Serialize};

use crate::TrainError;
use crate::relative::divergence::{LEAST_WEIGHT, MOST_WEIGHT};

/// Settings of learning from rollouts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RelativeRewards {
    /// Futures of a scene, at least 2: each is compared with the others.
    pub rollouts: usize,
    /// Maximum number of agents of a scene, those nearest to the ego.
    pub agents: usize,
    /// Weight of the rewarded moves relative to the moves of the batch, which keep the network near
    /// the data.
    pub weight: f64,
    /// Steps after which the network that is rolled out is updated.
    pub refresh: usize,
    /// What a move is credited with.
    pub advantage: Advantage,
    /// Weight of a penalty for collisions, for leaving the road and for passing red lights, at least
    /// 0: by how many standard deviations of the group the advantage of a move falls for each of the
    /// three that its agent first commits in this move or later and does not commit in the log.
    /// Collisions of people do not count.
    pub dense: f64,
    /// The same for what a driver would notice: a stop on a free road, an acceleration beyond grip,
    /// and a vehicle that slips sideways, as [`gump_metrics::behaviour`] counts them.
    pub conduct: f64,
    /// Share of the groups that are drawn among scenes with traffic lights, 0 to 1; the others are
    /// drawn among all.
    pub lit: f64,
    /// Divergence from the network at the start of the run that is aimed at, nats a move, above 0;
    /// without it there is no such term. Its weight in the loss adapts, as in PPO with a penalty
    /// (Schulman et al., "Proximal Policy Optimization Algorithms", 2017, section 4): every
    /// `refresh` steps it doubles if the mean divergence is above 1.5 times the target, and is
    /// halved if it is below the target divided by 1.5.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub kl_target: Option<f64>,
    /// Weight of the divergence at the start, 0.001 to 1000, which are also the bounds between which
    /// it adapts. At 1 a nat of divergence a move counts as much as a nat of the batch's loss.
    pub kl_weight: f64,
    /// Divergence of one step at which the run ends with an error, nats a move; above the target.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub kl_bound: Option<f64>,
}

/// What a move is credited with.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum Advantage {
    /// With the parts of its agent's contribution to realism from its own step on.
    #[default]
    Agent,
    /// With the contribution of its whole future: one number for all moves of all agents, as
    /// published.
    Scene,
}

impl Default for RelativeRewards {
    /// Chosen by hand (docs/decisions/0018-learning-from-realism.md).
    fn default() -> Self {
        Self {
            rollouts: 8,
            agents: 40,
            weight: 0.5,
            refresh: 10,
            advantage: Advantage::Agent,
            dense: 0.0,
            conduct: 0.0,
            lit: 0.0,
            kl_target: None,
            kl_weight: 1.0,
            kl_bound: None,
        }
    }
}

impl RelativeRewards {
    /// Error: [`TrainError::Config`] naming the first number out of its range.
    pub(super) fn validate(&self) -> Result<(), TrainError> {
        let fail = |key: &'static str, what: &str| {
            let reason = format!("realism: {what}");
            Err(TrainError::Config { key, reason })
        };
        if self.rollouts < 2 {
            return fail(
                "realism.rollouts",
                "rollouts must be at least 2, as each is compared with the others",
            );
        }
        if self.agents == 0 || self.refresh == 0 {
            let key = match self.agents {
                0 => "realism.agents",
                _ => "realism.refresh",
            };
            return fail(key, "agents and refresh must be at least 1");
        }
        if !self.weight.is_finite() || self.weight <= 0.0 {
            return fail("realism.weight", "weight must be above 0");
        }
        for (weight, key, what) in [
            (self.dense, "realism.dense", "dense must be at least 0"),
            (
                self.conduct,
                "realism.conduct",
                "conduct must be at least 0",
            ),
        ] {
            if !weight.is_finite() || weight < 0.0 {
                return fail(key, what);
            }
        }
        if !(0.0..=1.0).contains(&self.lit) {
            return fail("realism.lit", "lit must be between 0 and 1");
        }
        match self.wrong_divergence() {
            Some((key, what)) => fail(key, &what),
            None => Ok(()),
        }
    }

    /// The first key of the divergence with a value that cannot be, and what it must be.
    fn wrong_divergence(&self) -> Option<(&'static str, String)> {
        let is_above = |value: f64, low: f64| value.is_finite() && value > low;
        let (target, bound) = (self.kl_target, self.kl_bound);
        if !(LEAST_WEIGHT..=MOST_WEIGHT).contains(&self.kl_weight) {
            let what = format!("kl_weight must be between {LEAST_WEIGHT} and {MOST_WEIGHT}");
            return Some(("realism.kl_weight", what));
        }
        if target.is_some_and(|target| !is_above(target, 0.0)) {
            let what = "kl_target must be above 0, in nats a move".into();
            return Some(("realism.kl_target", what));
        }
        let wrong = match (bound?, target) {
            (_, None) => "kl_bound needs a kl_target, without which no divergence is computed",
            (bound, Some(target)) if !is_above(bound, target) => {
                "kl_bound must be above kl_target, in nats a move"
            }
            _ => return None,
        };
        Some(("realism.kl_bound", wrong.into()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_out_of_range_are_refused_in_a_sentence() {
        let with = |change: fn(&mut RelativeRewards)| {
            let mut rewards = RelativeRewards {
                kl_target: Some(0.01),
                ..RelativeRewards::default()
            };
            change(&mut rewards);
            match rewards.validate() {
                Ok(()) => String::new(),
                Err(error) => error.to_string(),
            }
        };
        let low = "configuration: realism: kl_target must be above 0, in nats a move";
        assert_eq!(with(|_| ()), "");
        assert_eq!(with(|rewards| rewards.kl_bound = Some(0.02)), "");
        assert_eq!(with(|rewards| rewards.kl_target = Some(0.0)), low);
        assert_eq!(with(|rewards| rewards.kl_target = Some(f64::NAN)), low);
        assert_eq!(
            with(|rewards| rewards.kl_bound = Some(0.01)),
            "configuration: realism: kl_bound must be above kl_target, in nats a move"
        );
        assert_eq!(
            with(|rewards| (rewards.kl_target, rewards.kl_bound) = (None, Some(1.0))),
            "configuration: realism: kl_bound needs a kl_target, without which no divergence is \
             computed"
        );
        assert_eq!(
            with(|rewards| rewards.kl_weight = 0.0),
            "configuration: realism: kl_weight must be between 0.001 and 1000"
        );
        assert_eq!(
            with(|rewards| rewards.dense = -1.0),
            "configuration: realism: dense must be at least 0"
        );
        assert_eq!(
            with(|rewards| rewards.conduct = f64::NAN),
            "configuration: realism: conduct must be at least 0"
        );
        assert_eq!(
            with(|rewards| rewards.lit = 1.1),
            "configuration: realism: lit must be between 0 and 1"
        );
        let odd: Result<RelativeRewards, _> = serde_json::from_str("{\"advantage\": \"team\"}");
        let message = odd.unwrap_err().to_string();
        assert!(message.contains("expected `agent` or `scene`"), "{message}");
    }
}
