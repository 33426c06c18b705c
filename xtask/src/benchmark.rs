//! Frozen sets of this checkout: their folders and lists.
//!
//! Lists, and how their scenes are found, made and drawn, are in [`gump_eval::benchmarks`].

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use gump_eval::benchmarks::{self, BenchmarkFolders, ScenarioSet, ScenarioSetName};
use gump_eval::datasets::Split;
use serde_json::Value;

use crate::installed::home;
use crate::machine::repository;
use crate::run::{Run, Unseen};

/// Default output folder of `data benchmark`.
const GENERATED: &str = "out/data-benchmark";

/// Finds the scenarios of `--scenarios`.
///
/// Error: as [`ScenarioSetName::find`].
pub(crate) fn find(run: &mut Run, name: &ScenarioSetName) -> anyhow::Result<ScenarioSet> {
    find_for(run, name, None)
}

/// As [`find`], with the split of a list that stands for it where the name has none.
///
/// Error: as [`ScenarioSetName::find_for`].
pub(crate) fn find_for(
    run: &mut Run,
    name: &ScenarioSetName,
    purpose: Option<Split>,
) -> anyhow::Result<ScenarioSet> {
    let folders = BenchmarkFolders {
        generated: GENERATED.into(),
        recorded: recorded_data(),
    };
    run.phase("find", |_| Ok(name.find_for(purpose, &folders, &Unseen)?))
}

/// Warns if scenes to learn from are of a frozen set, by the lists that come with the driver.
/// `scores` are those that then say nothing.
///
/// Error: a list that cannot be read.
pub(crate) fn warn_of_frozen<'a>(
    run: &Run,
    ids: impl Iterator<Item = &'a str>,
    scores: &str,
) -> anyhow::Result<()> {
    let frozen = benchmarks::frozen_ids(&home().join("datasets/benchmarks"))?;
    let sets = ids.filter_map(|id| Some((id, frozen.get(id)?)));
    let found: Vec<_> = sets.collect();
    if let Some((id, set)) = found.first() {
        run.print(&format!(
            "warning: {} training scenes are of frozen sets, {id} of {set} for one: \
             {scores} there says nothing",
            found.len()
        ));
    }
    Ok(())
}

/// The folder of recorded data: `GUMP_RECORDED`, else `shared/data` beside the checkout.
pub(crate) fn recorded_data() -> PathBuf {
    match std::env::var_os("GUMP_RECORDED") {
        Some(folder) => folder.into(),
        None => repository().join("../shared/data"),
    }
}

/// The worst score of every scenario of a closed-loop report, over its planners and worlds. Drives
/// that failed do not count.
///
/// Error: a file that is no report of `evaluate closed-loop`.
pub(crate) fn worst_scores(report: &Path) -> anyhow::Result<BTreeMap<String, f64>> {
    let text = std::fs::read_to_string(report)
        .with_context(|| format!("cannot read {}", report.display()))?;
    let report_json: Value = serde_json::from_str(&text)
        .with_context(|| format!("expected a report, found {}", report.display()))?;
    let scenarios = report_json["results"]["scenarios"].as_array();
    let scenarios = scenarios.with_context(|| {
        format!(
            "expected results.scenarios of evaluate closed-loop in {}",
            report.display()
        )
    })?;
    let mut worst = BTreeMap::new();
    for scenario in scenarios {
        if let (Some(id), Some(score)) = (scenario["id"].as_str(), scenario["score"].as_f64()) {
            let known = worst.entry(id.to_owned()).or_insert(score);
            *known = score.min(*known);
        }
    }
    Ok(worst)
}
