//! `data verify`: are the records sound?

use std::collections::BTreeMap;
use std::path::PathBuf;

use gump_data::{Severity, verify};
use serde::Serialize;
use serde_json::json;

use crate::run::{self, Common, Run};

/// Arguments of `data verify`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// Files or directories
    #[arg(value_name = "PATH", required = true)]
    paths: Vec<PathBuf>,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
        let (mut scenarios, mut broken, mut findings) = (0, 0, Vec::new());
        run.phase("verify", |run| {
            let progress = run.progress("verifying", self.paths.len() as u64, "files");
            for path in &self.paths {
                run::stop_if_interrupted()?;
                let verification = verify(path)?;
                scenarios += verification.scenarios;
                for (problem, n) in verification.counts {
                    *counts.entry(problem).or_default() += n;
                }
                for finding in verification.findings {
                    broken += usize::from(finding.severity == Severity::Broken);
                    findings.push(json!({
                        "severity": finding.severity,
                        "problem": finding.problem,
                        "detail": finding.detail,
                        "scenario": finding.scenario,
                        "path": path,
                    }));
                }
                progress.advance(1);
            }
            Ok(())
        })?;
        run.result("paths", self.paths.len())?;
        run.result("scenarios", scenarios)?;
        run.result("broken", broken)?;
        run.result("suspicious", findings.len() - broken)?;
        run.result("counts", counts)?;
        run.result("findings", findings)?;
        anyhow::ensure!(
            broken == 0,
            "found broken data, expected none: {broken} findings"
        );
        Ok(())
    }
}
