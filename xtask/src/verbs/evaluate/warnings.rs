//! What has to be known of a table of planners before it is quoted: drives that failed, and intervals
//! that do not exist.

use serde_json::Value;

use crate::run::Run;

/// Prints warnings, and keeps them in the report.
pub(super) fn report(run: &mut Run, sentences: &[String]) -> anyhow::Result<()> {
    for sentence in sentences {
        run.print(&format!("warning: {sentence}"));
    }
    run.result_hidden("warnings", sentences)
}

/// Names the planners that failed in some scenarios, with how often. `rows` have a planner, perhaps a
/// world, and the numbers of scenarios and failures.
pub(super) fn failed_drives(rows: &[Value]) -> Option<String> {
    let failed = rows.iter().filter(|row| row["failed"] != 0);
    let failed: Vec<String> = failed
        .map(|row| format!("{} in {} of {}", who(row), row["failed"], row["scenarios"]))
        .collect();
    (!failed.is_empty()).then(|| {
        format!(
            "scenarios in which a planner failed are left out of its means and comparisons, which \
             favours one that fails where it is hard: {}",
            failed.join(", ")
        )
    })
}

/// Names the planners whose score has no interval, because it is that of a single scenario.
pub(super) fn missing_intervals(rows: &[Value]) -> Option<String> {
    let is_single = |row: &&Value| row["score"].is_number() && row["low"].is_null();
    let single: Vec<String> = rows.iter().filter(is_single).map(who).collect();
    (!single.is_empty()).then(|| {
        format!(
            "an interval takes at least 2 scenarios, found 1, so there is none for {}",
            single.join(", ")
        )
    })
}

/// Scenarios below which an interval says little: resampled, they are mostly the same few. Chosen by
/// hand.
const FEW: u64 = 10;

/// Notes that the intervals of `rows` are over few scenarios, if they are.
pub(super) fn few_scenarios(rows: &[Value]) -> Option<String> {
    let driven = |row: &Value| Some(row["scenarios"].as_u64()? - row["failed"].as_u64()?);
    let spanned = rows.iter().filter(|row| row["low"].is_number());
    let fewest = spanned.filter_map(driven).min().filter(|n| *n < FEW)?;
    Some(format!(
        "note: intervals over fewer than {FEW} scenarios mean little, found {fewest}"
    ))
}

/// The planner of a row, and its world in tables of several.
fn who(row: &Value) -> String {
    let planner = row["planner"].as_str().unwrap_or_default();
    match row["world"].as_str() {
        Some(world) => format!("{planner} among {world}"),
        None => planner.into(),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn planners_that_failed_and_single_scenarios_are_named() {
        let row = |planner: &str, world: &str, failed: usize, low: Option<f64>| {
            json!({ "planner": planner, "world": world, "scenarios": 5, "failed": failed,
                    "score": 0.5, "low": low })
        };
        let all_well = [row("a", "idm", 0, Some(0.4))];
        assert_eq!(failed_drives(&all_well), None);
        assert_eq!(missing_intervals(&all_well), None);
        let rows = [
            row("a", "idm", 0, Some(0.4)),
            row("b", "idm", 2, Some(0.4)),
            row("b", "log", 4, None),
        ];
        let failed = failed_drives(&rows).unwrap();
        assert!(
            failed.ends_with("hard: b among idm in 2 of 5, b among log in 4 of 5"),
            "{failed}"
        );
        let single = missing_intervals(&rows).unwrap();
        assert!(
            single.ends_with("there is none for b among log"),
            "{single}"
        );
        let nothing = json!({ "planner": "c", "scenarios": 5, "failed": 5, "score": null });
        let failed = failed_drives(std::slice::from_ref(&nothing)).unwrap();
        assert!(failed.ends_with("hard: c in 5 of 5"), "{failed}");
        assert_eq!(
            few_scenarios(&all_well).unwrap().matches("found 5").count(),
            1
        );
        let many = json!({ "scenarios": 12, "failed": 2, "low": 0.5 });
        assert_eq!(few_scenarios(&[many]), None);
        // No score, no interval to miss.
        assert_eq!(missing_intervals(&[nothing]), None);
    }
}
