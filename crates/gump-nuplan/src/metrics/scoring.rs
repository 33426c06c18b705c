//! Combination of metrics into one number per scenario, per type of scenario and in total.
//!
//! The weights are data, in `scoring.toml` beside this file.

use std::collections::BTreeMap;

use serde::Deserialize;

use super::NuPlanError;

/// Scores by the names of nuPlan's metrics; `None` where a metric has no score.
pub type MetricScores = BTreeMap<String, Option<f64>>;

/// Combination of the scores of metrics into one.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scoring {
    /// Metrics whose scores multiply the weighted mean.
    pub multipliers: Vec<String>,
    /// Multipliers that are also part of the weighted mean.
    #[serde(default)]
    pub also_averaged: Vec<String>,
    /// Weights of metrics in the mean.
    #[serde(default)]
    pub weights: BTreeMap<String, f64>,
    /// Weight of a metric that is not listed.
    pub default: f64,
}

/// The table of `scoring.toml`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Shipped {
    closed_loop: Scoring,
    open_loop: Scoring,
    paper_table: Scoring,
    default: Scoring,
}

impl Scoring {
    /// nuPlan's closed-loop challenges, reactive and not.
    pub fn closed_loop() -> Self {
        shipped().closed_loop
    }

    /// nuPlan's open-loop challenge.
    pub fn open_loop() -> Self {
        shipped().open_loop
    }

    /// The closed-loop weights as printed in the GUMP paper, 21 in sum: driving direction is
    /// averaged as well as multiplied. Published scores are not computed this way.
    pub fn paper_table() -> Self {
        shipped().paper_table
    }

    /// Every metric with weight 1, no multipliers.
    pub fn equal_weights() -> Self {
        shipped().default
    }

    /// Reads a scoring from a table in the format of `scoring.toml`.
    ///
    /// # Errors
    /// [`NuPlanError::Scoring`] for other keys, missing ones and negative weights.
    pub fn from_toml(text: &str) -> Result<Self, NuPlanError> {
        let scoring: Self = toml::from_str(text).map_err(|e| NuPlanError::Scoring {
            what: e.message().to_owned(),
        })?;
        let weights = scoring.weights.values().chain([&scoring.default]);
        let is_weight = |weight: &f64| weight.is_finite() && *weight >= 0.0;
        if let Some(weight) = weights.copied().find(|weight| !is_weight(weight)) {
            return Err(NuPlanError::Scoring {
                what: format!("weight {weight}, expected a number of at least 0"),
            });
        }
        Ok(scoring)
    }

    /// The score of one scenario; metrics without a score do not count. 0 if nothing is averaged.
    pub fn score(&self, scores: &MetricScores) -> f64 {
        let mut product = 1.0;
        let (mut sum, mut total_weight) = (0.0, 0.0);
        for (name, score) in scores {
            let Some(score) = score else {
                continue;
            };
            let multiplies = self.multipliers.contains(name);
            if multiplies {
                product *= score;
            }
            if !multiplies || self.also_averaged.contains(name) {
                let weight = self.weights.get(name).copied().unwrap_or(self.default);
                sum += weight * score;
                total_weight += weight;
            }
        }
        if total_weight > 0.0 {
            product * sum / total_weight
        } else {
            0.0
        }
    }

    /// Scores many scenarios, per type and in total.
    ///
    /// Scenarios that failed to run are not included: report them beside the table.
    pub fn aggregate(&self, scenarios: &[ScenarioScores]) -> AggregateScores {
        let mut by_kind: BTreeMap<&str, Vec<(f64, &MetricScores)>> = BTreeMap::new();
        let mut scores = Vec::with_capacity(scenarios.len());
        for scenario in scenarios {
            let score = self.score(&scenario.scores);
            scores.push(score);
            let of_kind = by_kind.entry(&scenario.kind).or_default();
            of_kind.push((score, &scenario.scores));
        }
        let kinds: BTreeMap<String, AggregateRow> = by_kind
            .into_iter()
            .map(|(kind, members)| (kind.to_owned(), AggregateRow::of_kind(&members)))
            .collect();
        let total = AggregateRow::of_all(kinds.values());
        AggregateScores {
            scores,
            kinds,
            total,
        }
    }
}

/// The metrics of one scenario.
#[derive(Clone, Debug, PartialEq)]
pub struct ScenarioScores {
    /// The type of scenario.
    pub kind: String,
    /// Its metrics.
    pub scores: MetricScores,
}

/// A table of scenarios: one row per type and one for all.
#[derive(Clone, Debug, PartialEq)]
pub struct AggregateScores {
    /// Score of each scenario, in the order given.
    pub scores: Vec<f64>,
    /// By type: mean score and **sums** of the metrics, as nuPlan reports them.
    pub kinds: BTreeMap<String, AggregateRow>,
    /// Over all scenarios: mean score and means of the metrics.
    pub total: AggregateRow,
}

/// One row of the aggregated scores: a type of scenario, or all.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct AggregateRow {
    /// Number of scenarios.
    pub n: usize,
    /// Mean score of the scenarios; 0 if there are none.
    pub score: f64,
    /// Metrics; `None` where no scenario has a value.
    pub metrics: MetricScores,
}

impl AggregateRow {
    fn of_kind(members: &[(f64, &MetricScores)]) -> Self {
        let mut metrics = MetricScores::new();
        for (_, scores) in members {
            add(&mut metrics, scores);
        }
        Self {
            n: members.len(),
            score: members.iter().map(|(score, _)| score).sum::<f64>() / members.len() as f64,
            metrics,
        }
    }

    /// The mean over scenarios, not over types.
    fn of_all<'a>(kinds: impl Iterator<Item = &'a Self>) -> Self {
        let mut total = Self::default();
        for kind in kinds {
            total.n += kind.n;
            total.score += kind.score * kind.n as f64;
            add(&mut total.metrics, &kind.metrics);
        }
        let n = (total.n as f64).max(1.0);
        total.score /= n;
        for sum in total.metrics.values_mut().flatten() {
            *sum /= n;
        }
        total
    }
}

fn add(sums: &mut MetricScores, scores: &MetricScores) {
    for (name, score) in scores {
        let sum = sums.entry(name.clone()).or_default();
        if let Some(score) = score {
            *sum = Some(sum.unwrap_or_default() + score);
        }
    }
}

fn shipped() -> Shipped {
    toml::from_str(include_str!("scoring.toml")).expect("the shipped scoring is well formed")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scores(list: &[(&str, f64)]) -> MetricScores {
        let entry = |(name, score): &(&str, f64)| ((*name).to_owned(), Some(*score));
        list.iter().map(entry).collect()
    }

    #[test]
    fn the_challenge_divides_by_16_and_the_papers_table_by_21() {
        let mut all = scores(&[
            ("no_ego_at_fault_collisions", 1.0),
            ("drivable_area_compliance", 1.0),
            ("driving_direction_compliance", 0.5),
            ("ego_is_making_progress", 1.0),
            ("ego_progress_along_expert_route", 0.8),
            ("time_to_collision_within_bound", 1.0),
            ("speed_limit_compliance", 0.5),
            ("ego_is_comfortable", 0.0),
        ]);
        assert_eq!(Scoring::closed_loop().score(&all), 0.5 * 11.0 / 16.0);
        assert_eq!(Scoring::paper_table().score(&all), 0.5 * 13.5 / 21.0);
        all.insert("no_ego_at_fault_collisions".to_owned(), Some(0.0));
        assert_eq!(Scoring::closed_loop().score(&all), 0.0);
    }

    #[test]
    fn a_scoring_of_ones_own_is_checked() {
        let own = Scoring::from_toml("multipliers = []\ndefault = 2.0").unwrap();
        assert_eq!(own.score(&scores(&[("a", 0.5), ("b", 1.0)])), 0.75);
        let check = |text: &str, expected: &str| {
            let error = Scoring::from_toml(text).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        };
        check("multipliers = []\ndefault = -1.0", "weight -1");
        check("multipliers = []\ndefault = 1.0\nweigths = 3", "weigths");
        check("multipliers = []", "default");
    }

    #[test]
    fn no_scenarios_make_an_empty_table() {
        let table = Scoring::closed_loop().aggregate(&[]);
        assert_eq!((table.total.n, table.total.score), (0, 0.0));
    }
}
