//! What the ledger keeps of a scenario.

use gump_metrics::reactions::{Attempt, Contact, Manoeuvre, Outcome, Reason, Unfit};
use gump_scene::Rollout;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::super::ways::Named;

/// What a scenario's results depend on, beside the scenario.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Settings {
    /// The set, or the name of the file or folder.
    pub(super) scenarios: String,
    pub(super) manoeuvres: Vec<String>,
    pub(super) seconds: u32,
    pub(super) futures: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) limit: Option<usize>,
    /// How learned worlds decode, as JSON.
    pub(super) sampling: String,
    pub(super) seed: String,
    pub(super) worlds: Vec<Named>,
}

/// What came of one scenario.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Scored {
    /// Why it says nothing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) unfit: Option<String>,
    /// In the order of the settings; empty if it says nothing.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(super) tried: Vec<Tried>,
}

/// What came of one manoeuvre.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Tried {
    pub(super) manoeuvre: String,
    /// Why it is not scored.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) why: Option<String>,
    /// Agents near.
    #[serde(default)]
    pub(super) agents: usize,
    /// How many of them run into the ego where they follow their logs.
    #[serde(default)]
    pub(super) log: usize,
    /// In the order of the settings; empty if it is not scored.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(super) worlds: Vec<Seen>,
}

/// What a world showed of one manoeuvre.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Seen {
    pub(super) futures: usize,
    /// Futures in which the ego itself ran into somebody.
    pub(super) ego_at_fault: usize,
    /// Who ran into the ego, future by future, in order of time.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(super) hits: Vec<Hit>,
}

/// One that ran into the ego.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Hit {
    pub(super) future: usize,
    pub(super) agent: i64,
    /// Seconds after the present.
    pub(super) at_s: f64,
    /// Whether it is one of those that are near.
    pub(super) near: bool,
}

impl Scored {
    pub(super) fn unfit(why: &Unfit) -> Self {
        let unfit = Some(why.to_string());
        let tried = Vec::new();
        Self { unfit, tried }
    }
}

impl Tried {
    pub(super) fn not_scored(manoeuvre: Manoeuvre, why: Reason) -> Self {
        Self {
            manoeuvre: manoeuvre.name().into(),
            why: Some(why.name().into()),
            agents: 0,
            log: 0,
            worlds: Vec::new(),
        }
    }

    pub(super) fn scored(manoeuvre: Manoeuvre, attempt: &Attempt<'_>, worlds: Vec<Seen>) -> Self {
        Self {
            manoeuvre: manoeuvre.name().into(),
            why: None,
            agents: attempt.near().len(),
            log: attempt.replayed().run_into_ego.len(),
            worlds,
        }
    }
}

impl Seen {
    pub(super) fn of(attempt: &Attempt<'_>, rollouts: &[Rollout]) -> Self {
        let outcomes: Vec<Outcome> = rollouts
            .par_iter()
            .map(|rollout| attempt.outcome(rollout))
            .collect();
        let is_own = |outcome: &&Outcome| outcome.ego_runs_into.is_some();
        let ego_at_fault = outcomes.iter().filter(is_own).count();
        let mut hits = Vec::new();
        for (future, outcome) in outcomes.iter().enumerate() {
            let hit = |contact: &Contact, near: bool| Hit {
                future,
                agent: contact.agent.0,
                at_s: contact.at_s,
                near,
            };
            hits.extend(outcome.run_into_ego.iter().map(|c| hit(c, true)));
            hits.extend(outcome.others.iter().map(|c| hit(c, false)));
        }
        Self {
            futures: rollouts.len(),
            ego_at_fault,
            hits,
        }
    }

    /// Agents near that ran into the ego, mean over futures.
    pub(super) fn run_into(&self) -> f64 {
        let near = self.hits.iter().filter(|hit| hit.near).count();
        near as f64 / self.futures.max(1) as f64
    }

    /// The share of futures in which anybody ran into the ego.
    pub(super) fn struck(&self) -> f64 {
        let mut futures: Vec<usize> = self.hits.iter().map(|hit| hit.future).collect();
        futures.sort_unstable();
        futures.dedup();
        futures.len() as f64 / self.futures.max(1) as f64
    }

    /// The share of futures in which the ego ran into somebody.
    pub(super) fn at_fault(&self) -> f64 {
        self.ego_at_fault as f64 / self.futures.max(1) as f64
    }
}
