//! From metrics to scenarios, types of scenarios and the final score.

use gump_nuplan::metrics::{AggregateRow, MetricScores, ScenarioScores, Scoring};
use serde_json::Value;

use crate::common::{assert_close, entries, golden, number};

/// Columns of the recorded tables that are no metrics.
const LABELS: [&str; 6] = [
    "log_name",
    "planner_name",
    "aggregator_type",
    "scenario_type",
    "num_scenarios",
    "score",
];

fn scores(row: &Value) -> MetricScores {
    let metrics = entries(row).filter(|(name, _)| !LABELS.contains(&name.as_str()));
    let score = |value: &Value| (!value.is_null()).then(|| number(value));
    metrics.map(|(name, v)| (name.clone(), score(v))).collect()
}

fn assert_row(found: &AggregateRow, expected: &Value, what: &str) {
    assert_eq!(found.n as u64, expected["num_scenarios"].as_u64().unwrap());
    if let Some(score) = expected.get("score").filter(|score| !score.is_null()) {
        assert_close(found.score, number(score), 1e-9, what);
    }
    let expected = scores(expected);
    assert_eq!(found.metrics.len(), expected.len(), "{what}");
    for (name, value) in expected {
        match (found.metrics[&name], value) {
            (Some(found), Some(value)) => assert_close(found, value, 1e-9, &name),
            (found, value) => assert_eq!(found, value, "{what} {name}"),
        }
    }
}

fn check(table: &str, scoring: &Scoring) {
    let golden = golden("aggregator");
    let golden = &golden[table];
    let scenarios: Vec<ScenarioScores> = entries(&golden["input"])
        .map(|(_, row)| ScenarioScores {
            kind: row["scenario_type"].as_str().unwrap().to_owned(),
            scores: scores(row),
        })
        .collect();
    let found = scoring.aggregate(&scenarios);
    let expected = entries(&golden["scenario_scores"]);
    for ((name, expected), found) in expected.zip(&found.scores) {
        assert_close(*found, number(expected), 1e-9, name);
    }
    assert_eq!(
        found.kinds.len(),
        entries(&golden["scenario_types"]).count()
    );
    for (kind, row) in entries(&golden["scenario_types"]) {
        assert_row(&found.kinds[kind], row, kind);
    }
    assert_row(&found.total, &golden["final"], "final");
}

#[test]
fn tables_agree() {
    check("closed_loop", &Scoring::closed_loop());
    check("open_loop", &Scoring::open_loop());
    check("default_no_multipliers", &Scoring::equal_weights());
}

#[test]
fn the_weights_are_the_devkits() {
    let weights = &golden("aggregator")["weights"];
    for (name, scoring) in [
        ("closed_loop", Scoring::closed_loop()),
        ("open_loop", Scoring::open_loop()),
    ] {
        for (metric, weight) in entries(&weights[name]) {
            let found = match metric.as_str() {
                "default" => scoring.default,
                metric => scoring.weights[metric],
            };
            assert_eq!(found, number(weight), "{metric}");
        }
        let mut multipliers: Vec<&str> = scoring.multipliers.iter().map(String::as_str).collect();
        let expected = weights[&format!("{name}_multipliers")].as_array().unwrap();
        let mut expected: Vec<&str> = expected.iter().map(|m| m.as_str().unwrap()).collect();
        multipliers.sort_unstable();
        expected.sort_unstable();
        assert_eq!(multipliers, expected);
    }
}
