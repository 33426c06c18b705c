//! `data verify`: are the records sound?

use std::collections::BTreeMap;
use std::path::PathBuf;

use gump_data::{FormatCounts, Severity, Verification, list_files, verify, verify_one_of_many};
use serde::Serialize;
use serde_json::{Value, json};

use crate::run::{self, Common, Run};

/// Arguments of `data verify`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// Files or directories
    #[arg(value_name = "PATH", required = true)]
    paths: Vec<PathBuf>,
    /// List every suspicious item, not only counts
    #[arg(long)]
    list: bool,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let mut findings = Vec::new();
        let all = run.phase("verify", |run| {
            let mut files = Vec::new();
            for path in &self.paths {
                let of_path = list_files(path)?;
                files.extend(of_path.into_iter().map(|file| (file, path.is_dir())));
            }
            let progress = run.progress("verifying", files.len() as u64, "files");
            let mut all = Verification::default();
            for (file, one_of_many) in &files {
                run::stop_if_interrupted()?;
                let mut found = if *one_of_many {
                    verify_one_of_many(file)
                } else {
                    verify(file)?
                };
                let listed = found
                    .findings
                    .drain(..)
                    .filter(|finding| self.list || finding.severity == Severity::Broken);
                findings.extend(listed.map(|finding| {
                    json!({
                        "severity": finding.severity,
                        "problem": finding.problem,
                        "detail": finding.detail,
                        "scenario": finding.scenario,
                        "path": file,
                    })
                }));
                all.merge(found);
                progress.advance(1);
            }
            Ok(all)
        })?;
        let sum = |of: fn(&FormatCounts) -> usize| all.formats.values().map(of).sum::<usize>();
        let broken = sum(|counts| counts.broken);
        run.result("paths", self.paths.len())?;
        run.result("files", sum(|counts| counts.files))?;
        run.result("scenarios", all.scenarios)?;
        run.result("broken", broken)?;
        run.result("suspicious", sum(|counts| counts.suspicious))?;
        run.result("counts", &all.counts)?;
        run.result("skipped", &all.skipped)?;
        run.result("dropped", &all.report.dropped)?;
        run.result("inferred", &all.report.inferred)?;
        run.result("formats", rows(&all.formats)?)?;
        if self.list {
            for finding in &findings {
                let text = |key: &str| finding[key].as_str().unwrap_or_default();
                let (severity, problem) = (text("severity"), text("problem"));
                let (scenario, detail) = (text("scenario"), text("detail"));
                run.print(&format!(
                    "{severity}: {problem}: {scenario}: {detail}: {}",
                    text("path")
                ));
            }
        }
        run.result("findings", findings)?;
        anyhow::ensure!(
            broken == 0,
            "found broken data, expected none: {broken} findings"
        );
        anyhow::ensure!(
            all.scenarios > 0,
            "expected scenarios, found none in {} files of other kinds",
            all.skipped.values().sum::<usize>()
        );
        Ok(())
    }
}

/// One row per format.
fn rows(formats: &BTreeMap<&'static str, FormatCounts>) -> anyhow::Result<Vec<Value>> {
    let mut rows = Vec::new();
    for (name, counts) in formats {
        let mut row = serde_json::Map::new();
        row.insert("format".into(), json!(name));
        if let Value::Object(fields) = serde_json::to_value(counts)? {
            row.extend(fields);
        }
        rows.push(Value::Object(row));
    }
    Ok(rows)
}
