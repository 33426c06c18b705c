//! `scenarios.toml`: what each scenario of an evaluation got, one table each.
//!
//! Totals are always computed from these entries in order of the scenarios, whether they were
//! written by this run, by the run it resumes or by shards on other machines: equal entries give
//! equal totals, to the bit. TOML, because its numbers come back exactly as they were, NaN too.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io::Write as _;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::shard::Shard;

/// Name of a complete ledger in an output folder.
const NAME: &str = "scenarios.toml";

/// How the table of a scenario starts.
const ENTRY: &str = "[[scenario]]";

/// Which evaluation the entries are of; the first table of the file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Header {
    /// Name of the benchmark, for instance "wosac".
    pub(crate) benchmark: String,
    /// Which scenarios.
    pub(crate) shard: Shard,
    /// Everything that the entries depend on; shards of one evaluation agree in it.
    pub(crate) settings: toml::Table,
}

/// What one scenario got.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Entry<T> {
    /// Position among all scenarios of the evaluation.
    pub(crate) index: usize,
    /// Its id.
    pub(crate) id: String,
    /// The benchmark's own fields.
    pub(crate) scores: T,
}

/// The form of the file.
#[derive(Serialize, Deserialize)]
struct Document<T> {
    #[serde(skip_serializing_if = "Option::is_none")]
    evaluation: Option<Header>,
    #[serde(default = "Vec::new", skip_serializing_if = "Vec::is_empty")]
    scenario: Vec<T>,
}

/// A ledger being written; an entry is safe once [`Ledger::enter`] returns.
pub(crate) struct Ledger<T> {
    folder: PathBuf,
    file: File,
    entries: BTreeMap<usize, Entry<T>>,
}

impl<T: Serialize + DeserializeOwned + Clone> Ledger<T> {
    /// Opens the ledger of a folder: goes on where an interrupted run of the same evaluation
    /// stopped, else begins.
    pub(crate) fn open(folder: &Path, header: &Header) -> anyhow::Result<Self> {
        let path = partial(folder);
        let kept: Vec<Entry<T>> = match fs::read_to_string(&path) {
            Ok(text) => resumable(&text, header),
            Err(_) => Vec::new(),
        };
        let file =
            File::create(&path).with_context(|| format!("cannot create {}", path.display()))?;
        let mut ledger = Self {
            folder: folder.to_owned(),
            file,
            entries: BTreeMap::new(),
        };
        ledger.write(&Document::<Entry<T>> {
            evaluation: Some(header.clone()),
            scenario: Vec::new(),
        })?;
        for entry in kept {
            ledger.enter(entry)?;
        }
        Ok(ledger)
    }

    /// True if the scenario at `index` needs no more work.
    pub(crate) fn has(&self, index: usize) -> bool {
        self.entries.contains_key(&index)
    }

    /// Scenarios that need no more work.
    pub(crate) fn indices(&self) -> BTreeSet<usize> {
        self.entries.keys().copied().collect()
    }

    /// Adds a scenario.
    pub(crate) fn enter(&mut self, entry: Entry<T>) -> anyhow::Result<()> {
        self.write(&Document {
            evaluation: None,
            scenario: vec![entry.clone()],
        })?;
        self.entries.insert(entry.index, entry);
        Ok(())
    }

    /// Gives the file its final name; all entries in order of the scenarios.
    pub(crate) fn close(self) -> anyhow::Result<Vec<Entry<T>>> {
        let (from, to) = (partial(&self.folder), self.folder.join(NAME));
        fs::rename(&from, &to).with_context(|| format!("cannot write {}", to.display()))?;
        Ok(self.entries.into_values().collect())
    }

    fn write(&mut self, document: &Document<Entry<T>>) -> anyhow::Result<()> {
        let mut text = toml::to_string(document)?;
        text.push('\n');
        self.file
            .write_all(text.as_bytes())
            .with_context(|| format!("cannot write {}", partial(&self.folder).display()))
    }
}

fn partial(folder: &Path) -> PathBuf {
    folder.join(format!("{NAME}.partial"))
}

/// The entries of an interrupted run, if it was of the same evaluation; without the last, which
/// may have been cut off.
fn resumable<T: DeserializeOwned>(text: &str, header: &Header) -> Vec<Entry<T>> {
    let whole = &text[..text.rfind(ENTRY).unwrap_or(0)];
    match toml::from_str::<Document<Entry<T>>>(whole) {
        Ok(found) if found.evaluation.as_ref() == Some(header) => found.scenario,
        _ => Vec::new(),
    }
}

/// Which evaluation `folder` holds, its entries unread.
///
/// Error: no complete ledger there.
pub(crate) fn header(folder: &Path) -> anyhow::Result<Header> {
    let text = text(folder)?;
    let start = &text[..text.find(ENTRY).unwrap_or(text.len())];
    parse::<toml::Table>(start, folder).map(|(header, _)| header)
}

/// Entries of the shards of one evaluation in order of the scenarios, and the header without shard.
///
/// Error: shards that are missing, given twice, or of different evaluations.
pub(crate) fn unite<T: DeserializeOwned>(
    folders: &[PathBuf],
) -> anyhow::Result<(Header, Vec<Entry<T>>)> {
    let mut shards: BTreeMap<usize, &Path> = BTreeMap::new();
    let mut first: Option<(Header, &Path)> = None;
    let mut entries = BTreeMap::new();
    for folder in folders {
        let (header, scenarios) = parse::<Entry<T>>(&text(folder)?, folder)?;
        let (expected, example) = first.get_or_insert_with(|| (header.clone(), folder));
        check_same(expected, example, &header, folder)?;
        if let Some(other) = shards.insert(header.shard.k, folder) {
            anyhow::bail!(
                "expected every shard once, found {} in {} and {}",
                header.shard,
                other.display(),
                folder.display()
            );
        }
        for entry in scenarios {
            let shard = header.shard;
            anyhow::ensure!(
                shard.holds(entry.index),
                "scenario {} is not of shard {shard}: {}",
                entry.index,
                folder.display()
            );
            entries.insert(entry.index, entry);
        }
    }
    let (header, _) = first.context("expected at least one folder")?;
    let n = header.shard.n;
    let missing: Vec<_> = (1..=n).filter(|k| !shards.contains_key(k)).collect();
    anyhow::ensure!(
        missing.is_empty(),
        "expected all {n} shards, missing are {missing:?}"
    );
    let shard = Shard::WHOLE;
    Ok((Header { shard, ..header }, entries.into_values().collect()))
}

fn check_same(
    expected: &Header,
    example: &Path,
    found: &Header,
    folder: &Path,
) -> anyhow::Result<()> {
    let same = expected.benchmark == found.benchmark
        && expected.settings == found.settings
        && expected.shard.n == found.shard.n;
    anyhow::ensure!(
        same,
        "expected shards of one evaluation, found {} {} of {} in {} but {} {} of {} in {}",
        expected.benchmark,
        expected.settings,
        expected.shard.n,
        example.display(),
        found.benchmark,
        found.settings,
        found.shard.n,
        folder.display()
    );
    Ok(())
}

fn text(folder: &Path) -> anyhow::Result<String> {
    let path = folder.join(NAME);
    fs::read_to_string(&path).with_context(|| {
        format!(
            "expected a finished evaluation, cannot read {}",
            path.display()
        )
    })
}

fn parse<T: DeserializeOwned>(text: &str, folder: &Path) -> anyhow::Result<(Header, Vec<T>)> {
    let path = folder.join(NAME);
    let document: Document<T> = toml::from_str(text).with_context(|| {
        format!(
            "expected the scenarios of an evaluation in {}",
            path.display()
        )
    })?;
    let header = document.evaluation;
    let header =
        header.with_context(|| format!("expected a table evaluation in {}", path.display()))?;
    Ok((header, document.scenario))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header(k: usize, n: usize) -> Header {
        Header {
            benchmark: "test".into(),
            settings: toml::Table::from_iter([("year".into(), 2025.into())]),
            shard: Shard { k, n },
        }
    }

    fn entry(index: usize, scores: f64) -> Entry<f64> {
        let id = format!("s{index}");
        Entry { index, id, scores }
    }

    /// Writes a complete shard with a number per scenario that no short decimal can hold.
    fn shard(folder: &Path, k: usize, n: usize) {
        fs::create_dir_all(folder).unwrap();
        let mut ledger = Ledger::open(folder, &header(k, n)).unwrap();
        for index in (0..10).filter(|&i| Shard { k, n }.holds(i)) {
            ledger
                .enter(entry(index, (index as f64 + 0.1).sin()))
                .unwrap();
        }
        ledger.close().unwrap();
    }

    #[test]
    fn shards_in_any_order_are_the_whole_to_the_bit() {
        let folder = tempfile::tempdir().unwrap();
        let place = |name: &str| folder.path().join(name);
        shard(&place("whole"), 1, 1);
        for k in 1..=3 {
            shard(&place(&k.to_string()), k, 3);
        }
        let (_, whole) = unite::<f64>(&[place("whole")]).unwrap();
        let (_, parts) = unite::<f64>(&[place("3"), place("1"), place("2")]).unwrap();
        assert_eq!(whole.len(), 10);
        assert_eq!(whole, parts);
        assert_eq!(whole[7].scores.to_bits(), 7.1f64.sin().to_bits());
    }

    #[test]
    fn what_does_not_add_up_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let place = |name: &str| folder.path().join(name);
        shard(&place("1of2"), 1, 2);
        shard(&place("also 1of2"), 1, 2);
        shard(&place("1of3"), 1, 3);
        let fails = |names: &[&str], part: &str| {
            let folders: Vec<_> = names.iter().map(|name| place(name)).collect();
            let error = format!("{:#}", unite::<f64>(&folders).unwrap_err());
            assert!(error.contains(part), "{error}");
        };
        fails(&["1of2"], "missing are [2]");
        fails(&["1of2", "also 1of2"], "every shard once, found 1/2");
        fails(&["1of2", "1of3"], "one evaluation");
        fails(&["nowhere"], "cannot read");
    }

    #[test]
    fn an_interrupted_run_goes_on() {
        let folder = tempfile::tempdir().unwrap();
        let mut ledger = Ledger::open(folder.path(), &header(1, 1)).unwrap();
        ledger.enter(entry(0, 0.5)).unwrap();
        ledger.enter(entry(1, 1.5)).unwrap();
        // Stopped in the middle of a number.
        let cut = b"[[scenario]]\nindex = 2\nid = \"s2\"\nscores = 2";
        ledger.file.write_all(cut).unwrap();
        drop(ledger);
        let mut ledger = Ledger::open(folder.path(), &header(1, 1)).unwrap();
        assert_eq!(ledger.indices(), BTreeSet::from([0, 1]));
        ledger.enter(entry(2, 2.5)).unwrap();
        assert_eq!(ledger.close().unwrap().len(), 3);
        let (_, entries) = unite::<f64>(&[folder.path().to_owned()]).unwrap();
        assert_eq!(entries.iter().map(|e| e.scores).sum::<f64>(), 4.5);
    }

    #[test]
    fn another_evaluation_begins_anew() {
        let folder = tempfile::tempdir().unwrap();
        let mut ledger = Ledger::open(folder.path(), &header(1, 1)).unwrap();
        ledger.enter(entry(0, 0.5)).unwrap();
        drop(ledger);
        let other = Header {
            settings: toml::Table::new(),
            ..header(1, 1)
        };
        assert!(
            Ledger::<f64>::open(folder.path(), &other)
                .unwrap()
                .indices()
                .is_empty()
        );
    }
}
