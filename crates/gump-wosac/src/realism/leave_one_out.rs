//! The contribution of each rollout to the score of all, as a reward for training.
//!
//! Realism is a property of a set of rollouts. The contribution of one of them is the score of all
//! minus the score of the others (its leave-one-out value). Features are computed once; leaving a
//! rollout out subtracts its counts from the histograms.

use std::collections::BTreeMap;

use gump_scene::AgentId;

use super::estimate::leave_one_out;
use super::reference::{Evaluation, geometric_mean};
use super::scores::{Scores, rounded};

/// Scores without each rollout, and the attribution of the difference to agents and steps.
#[derive(Clone, Debug, PartialEq)]
pub struct LeaveOneOut {
    /// Metametric of all rollouts except this one, by rollout.
    pub metametric: Vec<f64>,
    /// The scored agents.
    pub agents: Vec<AgentId>,
    /// Scored steps.
    pub n_steps: usize,
    /// The contribution of each rollout to the metametric, split by agent and step:
    /// `[rollout][agent, step]`.
    ///
    /// With components `c` of weight `w` and likelihood `L` over `n` values that count, the part of
    /// a value is `w L / n` times the difference of its log-likelihood with and without the
    /// rollout; to first order the parts of a rollout sum to its leave-one-out value. The part of
    /// an indicator (such as a collision) counts at the step where it first holds in the rollout,
    /// and at the last one if it never does.
    pub credit: Vec<Vec<f64>>,
}

impl Evaluation<'_> {
    /// The contribution of each rollout; `None` if there is only one.
    ///
    /// The values equal those of evaluating the other rollouts again.
    pub fn leave_one_out(&self) -> Option<LeaveOneOut> {
        let n = self.imagined.len();
        if n * self.copies < 2 {
            return None;
        }
        let reference = self.reference;
        let log = reference.features();
        let (n_agents, n_steps) = (log.agents.len(), log.n_steps);
        let mut components = vec![BTreeMap::new(); n];
        let mut credit = vec![vec![0.0; n_agents * n_steps]; n];
        for (component, feature) in reference.config.components() {
            let (steps, values) = self.values(component);
            let (own, imagined) = values.split_first().expect("the log comes first");
            let imagined: Vec<&[f32]> = imagined.iter().map(AsRef::as_ref).collect();
            let shape = super::FeatureShape {
                agents: n_agents,
                steps,
            };
            let without = leave_one_out(feature, own, &imagined, self.copies, shape);
            let mask = (!component.is_indication()).then(|| reference.mask(component));
            let mask = mask.as_deref();
            let with = &self.log_likelihoods[&component];
            let counted = mask.map_or(with.len(), |m| m.iter().filter(|&&m| m).count());
            let likelihood = geometric_mean(with, mask);
            let share = f64::from(feature.weight) * likelihood / counted.max(1) as f64;
            let held = component.is_indication();
            let held = held.then(|| self.first_indications(component));
            for (i, without) in without.iter().enumerate() {
                let held = held.as_ref().map(|held| &held[i]);
                components[i].insert(component, rounded(geometric_mean(without, mask)));
                let gains = with.iter().zip(without).enumerate();
                for (at, (with, without)) in gains {
                    if mask.is_some_and(|mask| !mask[at]) {
                        continue;
                    }
                    let last = n_steps - 1;
                    let place = held.map_or(at, |held| at * n_steps + held[at].unwrap_or(last));
                    credit[i][place] += share * f64::from(with - without);
                }
            }
        }
        let config = reference.config;
        let scores = components.into_iter();
        Some(LeaveOneOut {
            metametric: scores
                .map(|found| Scores::of_components(config, found).metametric)
                .collect(),
            agents: log.agents.clone(),
            n_steps,
            credit,
        })
    }
}
