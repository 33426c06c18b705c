//! `data benchmark`: the scenes of a frozen list, made anew or looked for, and held to its sums.

use std::io::Write as _;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use gump_eval::benchmarks::{
    BenchmarkList, DrawRule, GeneratedPart, ListDraw, freeze, make, verify_generated,
    verify_recorded,
};
use serde::Serialize;
use serde_json::{Value, json};

use crate::benchmark;
use crate::run::{Common, Run, Unseen};

/// Arguments of `data benchmark`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// A list of scenes, for instance datasets/benchmarks/synthetic-tune.toml
    #[arg(long, value_name = "LIST.toml")]
    list: PathBuf,
    /// Only verify this folder against the list [default: generate into --out]
    #[arg(long, value_name = "DIR")]
    check: Option<PathBuf>,
    /// Folder of recorded data [default: GUMP_RECORDED, else shared/data beside the checkout]
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// Write the checksums of generated scenes into the list: for a new list, never for a
    /// published one
    #[arg(long, conflicts_with = "check")]
    freeze: bool,
    /// Only draw a new list from this one, with at most so many scenes of each split
    #[arg(long, value_name = "N", requires = "into", conflicts_with_all = ["check", "freeze"])]
    draw: Option<NonZeroUsize>,
    /// File of the new list, which is named after it
    #[arg(long, value_name = "LIST.toml", requires = "draw")]
    into: Option<PathBuf>,
    /// Draw only scenes in which a planner of --report scored below this in some world, 0 to 1
    #[arg(long, value_name = "X", requires_all = ["draw", "report"])]
    below: Option<f64>,
    /// The report.json of an `evaluate closed-loop` of this list
    #[arg(long, value_name = "FILE", requires = "below")]
    report: Option<PathBuf>,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let mut list = BenchmarkList::read(&self.list)?;
        if let (Some(n), Some(into)) = (self.draw, &self.into) {
            return self.draw(run, &list, n.get(), into);
        }
        let mut rows: Vec<Value> = Vec::new();
        let folder = self.check.clone().unwrap_or_else(|| run.out().to_owned());
        for i in 0..list.generated.len() {
            let part = &list.generated[i];
            let row = |part: &GeneratedPart, state: &str| {
                json!({
                    "part": part.file,
                    "split": part.split,
                    "generator": part.generator,
                    "seed": part.seed,
                    "scenes": part.kept(),
                    "state": state,
                })
            };
            if self.check.is_some() {
                run.phase("check", |_| {
                    Ok(verify_generated(&list, part, &folder, &Unseen)?)
                })?;
                rows.push(row(part, "as listed"));
                continue;
            }
            let progress = run.progress(&part.file, part.kept() as u64, "scenes");
            if self.freeze {
                let scenes =
                    run.phase(&part.file, |_| Ok(freeze(&list, part, &folder, &progress)?))?;
                rows.push(row(part, "frozen"));
                list.generated[i].scenes = scenes;
                continue;
            }
            let is_new = run.phase(&part.file, |_| Ok(make(&list, part, &folder, &progress)?))?;
            let state = if is_new {
                "made as listed"
            } else {
                "as listed"
            };
            rows.push(row(part, state));
        }
        let data = self.data.clone().unwrap_or_else(benchmark::recorded_data);
        for part in &list.recorded {
            let files = run.phase("check", |_| {
                Ok(verify_recorded(&list, part, &data, &Unseen)?)
            })?;
            rows.push(json!({
                "part": part.folder,
                "split": part.split,
                "scenes": files.len(),
                "state": "as listed",
            }));
        }
        if self.freeze {
            self.write(&list)?;
        }
        run.result("list", &list.name)?;
        run.result("rows", rows)
    }

    /// Writes a list that is drawn from this one; never over one that is there.
    fn draw(
        &self,
        run: &mut Run,
        list: &BenchmarkList,
        n: usize,
        into: &Path,
    ) -> anyhow::Result<()> {
        anyhow::ensure!(
            !into.exists(),
            "expected a new file for the list, found {}: a published list never changes",
            into.display()
        );
        let name = into.file_stem().unwrap_or_default().to_string_lossy();
        let worst = self.report.as_deref().map(benchmark::worst_scores);
        let worst = worst.transpose()?;
        let draw = ListDraw {
            name: name.into_owned(),
            rule: match (self.below, &worst) {
                (Some(bound), Some(worst)) => DrawRule::Below(bound, worst),
                _ => DrawRule::Any,
            },
            at_most: n,
            seed: run.seed(),
        };
        let drawn = draw.of(list)?;
        let comment = "# Drawn by `cargo xtask data benchmark --draw`; made anew on any machine by\n\
                       # `cargo xtask data benchmark --list` this file. A scene is \"SUM ID\". Never\n\
                       # changes: another set gets another name.\n";
        let text = comment.to_owned() + &toml::to_string_pretty(&drawn)?;
        gump_data::write_atomically(into, |file| {
            file.write_all(text.as_bytes())
                .with_context(|| format!("cannot write {}", into.display()))
        })?;
        let generated = drawn.generated.iter().map(|part| {
            json!({
                "part": part.file,
                "split": part.split,
                "scenes": part.scenes.len(),
                "of": part.count,
            })
        });
        let recorded = drawn.recorded.iter().map(
            |part| json!({ "part": part.folder, "split": part.split, "scenes": part.scenes.len() }),
        );
        run.result("list", &drawn.name)?;
        run.result("rows", generated.chain(recorded).collect::<Vec<Value>>())
    }

    /// The list with its new sums under the comment that it begins with.
    fn write(&self, list: &BenchmarkList) -> anyhow::Result<()> {
        let before = std::fs::read_to_string(&self.list)
            .with_context(|| format!("cannot read {}", self.list.display()))?;
        let comment = before.lines().take_while(|line| line.starts_with('#'));
        let comment: String = comment.map(|line| format!("{line}\n")).collect();
        let text = comment + &toml::to_string_pretty(list)?;
        gump_data::write_atomically(&self.list, |file| {
            file.write_all(text.as_bytes())
                .with_context(|| format!("cannot write {}", self.list.display()))
        })
    }
}
