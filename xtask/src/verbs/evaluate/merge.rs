//! `evaluate merge`: the shards of one evaluation as one.

use std::path::PathBuf;

use gump_eval::results::{self, MissingShards};
use serde::Serialize;

use super::super::rl;
use super::{behaviour, closed_loop, motion, reactions, wosac};
use crate::run::{Common, Run};

/// Reports on a benchmark from the folders of its shards.
type ReportMerged = fn(&mut Run, &[PathBuf], MissingShards) -> anyhow::Result<()>;

/// Benchmarks that can be sharded, by the name in their ledgers.
const BENCHMARKS: &[(&str, ReportMerged)] = &[
    (gump_eval::behaviour::BENCHMARK, behaviour::report_merged),
    (
        gump_eval::closed_loop::BENCHMARK,
        closed_loop::report_merged,
    ),
    (motion::NAME, motion::report_merged),
    (gump_eval::reactions::BENCHMARK, reactions::report_merged),
    (rl::evaluate::BENCHMARK, rl::columns::report_merged),
    (wosac::BENCHMARK, wosac::report_merged),
];

/// Arguments of `evaluate merge`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// Output folders of all shards, in any order
    #[arg(value_name = "DIR", required = true)]
    folders: Vec<PathBuf>,
    /// Report on the shards given, though others are missing
    #[arg(long)]
    incomplete: bool,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let benchmark = results::header(&self.folders[0])?.benchmark;
        let Some((_, report)) = BENCHMARKS.iter().find(|(name, _)| *name == benchmark) else {
            let known: Vec<_> = BENCHMARKS.iter().map(|(name, _)| *name).collect();
            anyhow::bail!(
                "expected shards of {}, found {benchmark}: {}",
                known.join(", "),
                self.folders[0].display()
            );
        };
        let missing = match self.incomplete {
            true => MissingShards::Allow,
            false => MissingShards::Refuse,
        };
        report(run, &self.folders, missing)?;
        if self.incomplete {
            let mut shards = Vec::new();
            for folder in &self.folders {
                shards.push(results::header(folder)?.shard.to_string());
            }
            run.result("shards", shards.join(" "))?;
        }
        Ok(())
    }
}
