//! Scores of one scenario, and means over many.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::config::{Component, Config, Group};

/// Scores of rollouts, of one scenario or averaged over many.
///
/// A number is NaN where nothing could be scored (for instance, no valid step of any vehicle), as
/// in the reference; the metametric is then NaN as well.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Scores {
    /// The weighted sum of the components: realism, at most 1.
    pub metametric: f64,
    /// Weighted mean of the kinematic components.
    pub kinematic: f64,
    /// Weighted mean of the interactive components.
    pub interactive: f64,
    /// Weighted mean of the map-based components.
    pub map_based: f64,
    /// Mean distance from the log in space, metres, over all 91 steps, including those of the past,
    /// where it is 0. Lower is better; not part of the metametric.
    pub ade: f64,
    /// `ade` of the best rollout for all scored agents together, metres.
    pub min_ade: f64,
    /// Share of scored agents in rollouts that collide.
    pub collision_rate: f64,
    /// Share of scored agents in rollouts that leave the road.
    pub offroad_rate: f64,
    /// Share of scored agents in rollouts that pass a red light; since 2025.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub traffic_light_violation_rate: Option<f64>,
    /// Likelihoods, 0 to 1.
    pub components: BTreeMap<Component, f64>,
}

impl Scores {
    /// Averages over scenarios; `None` without any.
    ///
    /// The order affects only the last bit of the sums.
    pub fn mean(scores: &[Self]) -> Option<Self> {
        let first = scores.first()?;
        let n = scores.len() as f64;
        let mean = |f: &dyn Fn(&Self) -> f64| scores.iter().map(f).sum::<f64>() / n;
        let of = |c: &Component| mean(&|s| s.components.get(c).copied().unwrap_or(f64::NAN));
        Some(Self {
            metametric: mean(&|s| s.metametric),
            kinematic: mean(&|s| s.kinematic),
            interactive: mean(&|s| s.interactive),
            map_based: mean(&|s| s.map_based),
            ade: mean(&|s| s.ade),
            min_ade: mean(&|s| s.min_ade),
            collision_rate: mean(&|s| s.collision_rate),
            offroad_rate: mean(&|s| s.offroad_rate),
            traffic_light_violation_rate: first
                .traffic_light_violation_rate
                .map(|_| mean(&|s| s.traffic_light_violation_rate.unwrap_or(f64::NAN))),
            components: first.components.keys().map(|c| (*c, of(c))).collect(),
        })
    }

    /// Computes metametric and groups from components; the rest is 0.
    pub(crate) fn of_components(config: &Config, components: BTreeMap<Component, f64>) -> Self {
        // Weights and likelihoods are f32 in the reference, sums are f64 and stored as f32.
        let weighted = |wanted: Option<Group>| {
            let chosen = config.components();
            let chosen = chosen.filter(|(c, _)| wanted.is_none_or(|group| c.group() == group));
            chosen.fold((0.0, 0.0), |(sum, weights), (component, feature)| {
                let weight = f64::from(feature.weight);
                let likelihood = components.get(&component).copied().unwrap_or(f64::NAN);
                (sum + weight * likelihood, weights + weight)
            })
        };
        let mean = |group| {
            let (sum, weights) = weighted(Some(group));
            rounded(sum / weights)
        };
        Self {
            metametric: rounded(weighted(None).0),
            kinematic: mean(Group::Kinematic),
            interactive: mean(Group::Interactive),
            map_based: mean(Group::MapBased),
            ade: 0.0,
            min_ade: 0.0,
            collision_rate: 0.0,
            offroad_rate: 0.0,
            traffic_light_violation_rate: None,
            components,
        }
    }
}

/// As the reference stores it.
pub(crate) fn rounded(value: f64) -> f64 {
    f64::from(value as f32)
}
