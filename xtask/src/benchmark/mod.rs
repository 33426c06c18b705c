//! Frozen sets of this checkout: where they are, and how their scenes are made and drawn.
//!
//! Lists themselves are in [`gump_eval::benchmarks`], which finds their scenes and holds them to
//! their checksums. [`make()`] makes those of a list that are made; [`Draw`] draws a list from a
//! larger one.

mod draw;
mod make;

use std::collections::BTreeMap;
use std::path::PathBuf;

use gump_eval::benchmarks::{self, BenchmarkFolders, ScenarioSet, ScenarioSetName};

use crate::installed::home;
use crate::machine::repository;
use crate::run::{Run, Unseen};

pub(crate) use draw::{Draw, Rule, worst_scores};
pub(crate) use make::{freeze, make};

/// Where `data benchmark` puts what it makes, unless told otherwise.
const MADE: &str = "out/data-benchmark";

/// Finds the scenarios of `--scenarios`.
///
/// Error: as [`ScenarioSetName::find`].
pub(crate) fn find(run: &mut Run, name: &ScenarioSetName) -> anyhow::Result<ScenarioSet> {
    let folders = BenchmarkFolders {
        made: MADE.into(),
        recorded: recorded_data(),
    };
    run.phase("find", |_| Ok(name.find(&folders, &Unseen)?))
}

/// Ids of the scenes that nothing may learn from, each with its set, by the lists that come with
/// the driver.
///
/// Error: a list that cannot be read.
pub(crate) fn frozen_ids() -> anyhow::Result<BTreeMap<String, String>> {
    Ok(benchmarks::frozen_ids(&home().join("datasets/benchmarks"))?)
}

/// The folder of recorded data: `GUMP_RECORDED`, else `shared/data` beside the checkout.
pub(crate) fn recorded_data() -> PathBuf {
    match std::env::var_os("GUMP_RECORDED") {
        Some(folder) => folder.into(),
        None => repository().join("../shared/data"),
    }
}
