//! `data convert`: from any readable format to one that programs read fast, or that others read.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::Instant;

use anyhow::Context as _;
use gump_data::{
    Converted, DataError, INCOMPLETE, OutputFormat, ReadOptions, convert, groups, list_files,
    list_unfinished,
};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::choices::{FORMATS, one_of};
use crate::cli::WrongArguments;
use crate::run::{self, Common, Run};

/// Name of the ledger in a folder of converted scenes.
const LEDGER: &str = "conversion.json";

/// Arguments of `data convert`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// A file or directory of any readable format
    #[arg(long, value_name = "PATH")]
    from: PathBuf,
    /// Folder for the converted files; an interrupted conversion resumes there
    #[arg(long, value_name = "DIR")]
    to: PathBuf,
    /// Output format
    #[arg(long, value_parser = one_of(FORMATS), default_value_t = OutputFormat::Cache)]
    format: OutputFormat,
    /// Smooth the tracks of noisy recordings, such as NGSIM's, with velocities that fit; those of
    /// Waymo, nuPlan, SUMO and the cache stay as they are
    #[arg(long)]
    smooth: bool,
    /// Exit status 1 if anything could not be converted, also if no file is damaged
    #[arg(long)]
    strict: bool,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

/// The finished part of a conversion, stored in its folder; a conversion of the same sources to the
/// same format resumes from it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
struct Conversion {
    /// SHA-256 of the format and of every source's path and size.
    source: String,
    /// Result for each group of sources, by its number.
    groups: BTreeMap<usize, Group>,
}

/// Result for a group of sources.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
struct Group {
    scenarios: usize,
    bytes: u64,
    /// Names of the files written.
    files: Vec<String>,
    /// Sentences about what could not be converted.
    refused: Vec<String>,
    /// Those of them about files that are damaged, so that scenarios are missing.
    #[serde(default)]
    damaged: Vec<String>,
    skipped: BTreeMap<String, usize>,
    dropped: BTreeMap<String, usize>,
    inferred: BTreeMap<String, usize>,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let files = list_files(&self.from)?;
        let groups = groups(&files);
        let ledger = self.ledger(&files)?;
        let mark = self.mark()?;
        let resumed = ledger.groups.len();
        let before: usize = ledger.groups.values().map(|group| group.scenarios).sum();
        if resumed > 0 {
            run.print(&format!("{resumed} of {} files are there", groups.len()));
        }
        let ledger = Mutex::new(ledger);
        let began = Instant::now();
        let options = ReadOptions {
            smooth: self.smooth,
            ..ReadOptions::ALL
        };
        let converted = run.phase("convert", |run| {
            let progress = run.progress("converting", 0, "scenes");
            groups.par_iter().enumerate().try_for_each(|(i, range)| {
                if lock(&ledger).groups.contains_key(&i) {
                    return Ok(());
                }
                let stem = self.to.join(format!("scenes-{i:05}"));
                let converted =
                    convert(&files[range.clone()], options, self.format, &stem, |_| {
                        progress.advance(1);
                        run::stop_if_interrupted()
                    })?;
                let mut ledger = lock(&ledger);
                ledger.groups.insert(i, Group::of(&converted));
                self.save(&ledger)
            })
        });
        let seconds = began.elapsed().as_secs_f64();
        let ledger = ledger
            .into_inner()
            .unwrap_or_else(std::sync::PoisonError::into_inner);
        let all = Group::sum(ledger.groups.into_values());
        let source_bytes = files.iter().filter_map(|file| file.metadata().ok());
        run.result("scenarios", all.scenarios)?;
        run.result("bytes", all.bytes)?;
        run.result("source_bytes", source_bytes.map(|m| m.len()).sum::<u64>())?;
        let fresh = (all.scenarios - before) as f64;
        run.result("records_per_second", fresh / seconds)?;
        run.result("files", all.files.len())?;
        run.result("resumed", resumed)?;
        run.result("refused", all.refused.len())?;
        run.result("skipped", &all.skipped)?;
        run.result("dropped", &all.dropped)?;
        run.result("inferred", &all.inferred)?;
        run.result("problems", &all.refused)?;
        if run::interrupted() && converted.is_err() {
            anyhow::bail!(
                "stopped by Ctrl-C; the same command resumes, and until it is done {} says that \
                 the data set is not whole",
                mark.display()
            );
        }
        converted?;
        if all.damaged.is_empty() || all.scenarios == 0 {
            let removed = std::fs::remove_file(&mark);
            removed.with_context(|| format!("cannot remove {}", mark.display()))?;
        }
        for problem in all.refused.iter().take(MOST_PRINTED) {
            run.print(&format!("refused: {problem}"));
        }
        if all.scenarios == 0 {
            // An error of the path as a whole says more than a count.
            gump_data::open(&self.from).map(drop)?;
            anyhow::bail!("expected scenarios, none could be converted");
        }
        if let Some(first) = all.damaged.first() {
            anyhow::bail!(
                "expected whole files, found damage at {} {}, the first: {first}; the rest is \
                 converted, and {} says that scenarios are missing: convert mended files into \
                 another --to, or remove it to use the rest",
                all.damaged.len(),
                if all.damaged.len() == 1 {
                    "place"
                } else {
                    "places"
                },
                mark.display()
            );
        }
        anyhow::ensure!(
            !self.strict || all.refused.is_empty(),
            "expected every record to be converted, {} were refused",
            all.refused.len()
        );
        Ok(())
    }

    /// The ledger of an earlier run of the same conversion, without what has disappeared since; an
    /// empty one for a new folder.
    ///
    /// Error: [`WrongArguments`] for a folder that holds something else.
    fn ledger(&self, files: &[PathBuf]) -> anyhow::Result<Conversion> {
        let [from, to] = [&self.from, &self.to].map(std::path::absolute);
        let wrong = |why: String| anyhow::Error::from(WrongArguments(why));
        if to?.starts_with(from?) {
            return Err(wrong(format!(
                "--to {} lies in --from: its files would be converted again",
                self.to.display()
            )));
        }
        std::fs::create_dir_all(&self.to)
            .with_context(|| format!("cannot create the folder {}", self.to.display()))?;
        let source = self.fingerprint(files)?;
        let Ok(text) = std::fs::read_to_string(self.to.join(LEDGER)) else {
            let others = list_unfinished(&self.to)?;
            let others = others
                .iter()
                .filter(|file| !file.ends_with(INCOMPLETE))
                .count();
            if others > 0 {
                return Err(wrong(format!(
                    "--to {} holds {others} files of something else",
                    self.to.display()
                )));
            }
            let groups = BTreeMap::new();
            return Ok(Conversion { source, groups });
        };
        let mut ledger: Conversion = serde_json::from_str(&text)
            .with_context(|| format!("expected a ledger: {}", self.to.join(LEDGER).display()))?;
        if ledger.source != source {
            return Err(wrong(format!(
                "--to {} holds the conversion of other files, to another format or with another --smooth",
                self.to.display()
            )));
        }
        let is_there = |name: &String| self.to.join(name).is_file();
        ledger
            .groups
            .retain(|_, group| group.files.iter().all(is_there));
        Ok(ledger)
    }

    /// Fingerprint of a conversion: a hash of all that it depends on.
    fn fingerprint(&self, files: &[PathBuf]) -> anyhow::Result<String> {
        let mut hash = Sha256::new();
        hash.update(serde_json::to_string(&self.format)?);
        if self.smooth {
            hash.update("smooth");
        }
        for file in files {
            let size = |path: &Path| path.metadata().map(|metadata| metadata.len());
            let bytes = size(file).with_context(|| format!("cannot read {}", file.display()))?;
            hash.update(format!("{}\0{bytes}\0", file.display()));
        }
        let digest = hash.finalize();
        Ok(digest.iter().map(|byte| format!("{byte:02x}")).collect())
    }

    /// Marks the folder as unfinished, which readers refuse.
    fn mark(&self) -> anyhow::Result<PathBuf> {
        let mark = self.to.join(INCOMPLETE);
        let text = "A conversion into this folder was begun and is not done: start it again.\n";
        std::fs::write(&mark, text).with_context(|| format!("cannot write {}", mark.display()))?;
        Ok(mark)
    }

    fn save(&self, ledger: &Conversion) -> anyhow::Result<()> {
        let path = self.to.join(LEDGER);
        gump_data::write_atomically(&path, |file| {
            serde_json::to_writer_pretty(file, ledger)
                .with_context(|| format!("cannot write {}", path.display()))
        })
    }
}

/// Number of refused records printed on the terminal; the report has all. Chosen by hand.
const MOST_PRINTED: usize = 10;

/// Whether a file is damaged, rather than a sound record not usable.
fn is_damage(error: &DataError) -> bool {
    !matches!(
        error,
        DataError::Scenario { .. }
            | DataError::Field { .. }
            | DataError::Proto { .. }
            | DataError::Unwritable { .. }
    )
}

fn lock(ledger: &Mutex<Conversion>) -> std::sync::MutexGuard<'_, Conversion> {
    ledger
        .lock()
        .unwrap_or_else(std::sync::PoisonError::into_inner)
}

impl Group {
    fn of(converted: &Converted) -> Self {
        let named = |counts: &BTreeMap<&'static str, usize>| {
            let pairs = counts.iter();
            pairs.map(|(&name, &n)| (name.to_owned(), n)).collect()
        };
        let names = converted.files.iter().filter_map(|file| file.file_name());
        let damaged = converted.refused.iter().filter(|error| is_damage(error));
        Self {
            scenarios: converted.scenarios,
            bytes: converted.bytes,
            files: names
                .map(|name| name.to_string_lossy().into_owned())
                .collect(),
            refused: converted.refused.iter().map(ToString::to_string).collect(),
            damaged: damaged.map(ToString::to_string).collect(),
            skipped: named(&converted.skipped),
            dropped: named(&converted.report.dropped),
            inferred: named(&converted.report.inferred),
        }
    }

    fn sum(groups: impl Iterator<Item = Self>) -> Self {
        groups.fold(Self::default(), |mut sum, group| {
            sum.scenarios += group.scenarios;
            sum.bytes += group.bytes;
            sum.files.extend(group.files);
            sum.refused.extend(group.refused);
            sum.damaged.extend(group.damaged);
            for (to, from) in [
                (&mut sum.skipped, group.skipped),
                (&mut sum.dropped, group.dropped),
                (&mut sum.inferred, group.inferred),
            ] {
                for (name, n) in from {
                    *to.entry(name).or_default() += n;
                }
            }
            sum
        })
    }
}
