//! `data benchmark`: the scenes of a frozen list, made anew or looked for, and held to its sums.

use std::io::Write as _;
use std::path::PathBuf;

use anyhow::Context as _;
use serde::Serialize;
use serde_json::{Value, json};

use crate::benchmark::{self, List};
use crate::run::{Common, Run};

/// Arguments of `data benchmark`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// A list of scenes, for instance datasets/benchmarks/synthetic-tune.toml
    #[arg(long, value_name = "LIST.toml")]
    list: PathBuf,
    /// Make nothing: hold what is in this folder to the list [default: make into --out]
    #[arg(long, value_name = "DIR")]
    check: Option<PathBuf>,
    /// Folder of recorded data [default: GUMP_RECORDED, else shared/data beside the checkout]
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// Write the sums of what is made into the list: for a new list, never for a published one
    #[arg(long, conflicts_with = "check")]
    freeze: bool,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let mut list = List::read(&self.list)?;
        let mut rows: Vec<Value> = Vec::new();
        let folder = self.check.clone().unwrap_or_else(|| run.out().to_owned());
        for i in 0..list.made.len() {
            let part = &list.made[i];
            let row = |part: &benchmark::Made, state: &str| {
                json!({
                    "part": part.file,
                    "split": part.split,
                    "generator": part.generator,
                    "seed": part.seed,
                    "scenes": part.count,
                    "state": state,
                })
            };
            if self.check.is_some() {
                run.phase("check", |_| benchmark::check(&list, part, &folder))?;
                rows.push(row(part, "as listed"));
                continue;
            }
            let progress = run.progress(&part.file, part.count as u64, "scenes");
            if self.freeze {
                let scenes = run.phase(&part.file, |_| {
                    benchmark::freeze(&list, part, &folder, &progress)
                })?;
                rows.push(row(part, "frozen"));
                list.made[i].scenes = scenes;
                continue;
            }
            let made = run.phase(&part.file, |_| {
                benchmark::make(&list, part, &folder, &progress)
            })?;
            rows.push(row(part, if made { "made as listed" } else { "as listed" }));
        }
        let data = self.data.clone().unwrap_or_else(benchmark::recorded_data);
        for part in &list.recorded {
            let files = run.phase("check", |_| benchmark::check_recorded(&list, part, &data))?;
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

    /// The list with its new sums under the comment that it begins with.
    fn write(&self, list: &List) -> anyhow::Result<()> {
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
