//! Plans against the expert.

use gump_nuplan::metrics::{OpenLoop, OpenLoopConfig, Sample, Scoring, open_loop};
use gump_scene::{EgoState, MapGraph};
use serde_json::Value;

use crate::common::{assert_close, drive, egos, golden, list, number};

/// The statistics of one metric in the devkit's order, without the yes or no in the midst.
pub(crate) fn statistics(found: &OpenLoop, metric: &str) -> Vec<f64> {
    let of = |value: fn(&gump_nuplan::metrics::HorizonError) -> f64| {
        let each = found.horizons.each_ref().map(value);
        let mean = each.iter().sum::<f64>() / each.len() as f64;
        [each.as_slice(), &[mean]].concat()
    };
    match metric {
        "planner_expert_average_l2_error_within_bound" => of(|h| h.ade),
        "planner_expert_final_l2_error_within_bound" => of(|h| h.fde),
        "planner_expert_average_heading_error_within_bound" => of(|h| h.ahe),
        "planner_expert_final_heading_error_within_bound" => of(|h| h.fhe),
        "planner_miss_rate_within_bound" => found.horizons.map(|h| h.miss_rate).to_vec(),
        other => panic!("unknown metric {other}"),
    }
}

/// Compares with recorded [name, type, value] rows; the yes or no is in the score.
pub(crate) fn assert_metric(found: &OpenLoop, metric: &str, rows: &[Value], tolerance: f64) {
    let found = statistics(found, metric);
    let rows = rows.iter().filter(|row| row[1] != "BOOLEAN");
    let expected: Vec<f64> = rows.map(|row| number(&row[2])).collect();
    assert_eq!(found.len(), expected.len(), "{metric}");
    for (found, expected) in found.iter().zip(&expected) {
        assert_close(*found, *expected, tolerance, metric);
    }
}

#[test]
fn random_plans_agree() {
    let golden = golden("open_loop_random");
    let cases = list(&golden["cases"]);
    assert_eq!(cases.len(), 6);
    for case in cases {
        let n = case["n_history"].as_u64().unwrap() as usize;
        let expert = egos(&case["expert"]);
        let interval = number(&case["database_interval"]);
        let stride = (1.0 / interval) as usize;
        let sampled = list(&case["sampled_planner_trajectories"]);
        let plan = |i: usize| -> Vec<EgoState> {
            let of = sampled.iter().find(|entry| entry[0] == i);
            of.map_or(Vec::new(), |entry| egos(&entry[1]))
        };
        let samples: Vec<Sample> = (0..n)
            .map(|i| Sample {
                ego: expert[i],
                plan: plan(i),
                ..Sample::default()
            })
            .collect();
        let last = (n - 1) / stride * stride;
        let future: Vec<EgoState> = (1..=8).map(|s| expert[last + s * stride]).collect();
        let map = MapGraph::default();
        let config = OpenLoopConfig {
            interval,
            ..OpenLoopConfig::default()
        };
        let found = open_loop(&drive(&samples, &expert[..n], &map), &future, &config).unwrap();
        for (metric, expected) in case["outputs"].as_object().unwrap() {
            assert_metric(&found, metric, list(&expected["statistics"]), 1e-6);
            let score = found.scores[metric].unwrap();
            assert_close(score, number(&expected["score"]), 1e-6, metric);
        }
        let score = Scoring::open_loop().score(&found.scores);
        assert_close(score, number(&case["scenario_score"]), 1e-6, "score");
    }
}
