//! `scenarios.toml`: the results of an evaluation, one table per scenario.
//!
//! Totals are always computed from these entries in order of the scenarios, whether they were
//! written by this run, by the run it resumes or by shards on other machines: equal entries give
//! equal totals, bit for bit. The format is TOML, because it keeps all digits of numbers, and NaN.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io::Write as _;
use std::path::{Path, PathBuf};

use gump_data::{DataError, ScenarioRecord};
use gump_scene::Scenario;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::shard::Shard;
use crate::{ErrorContext, EvalError, Monitor, ResultsError, ResumePoint};

/// Name of a complete store in an output folder.
const NAME: &str = "scenarios.toml";

/// Header of the table of a scenario.
const ENTRY: &str = "[[scenario]]";

/// Key of [`Header::settings`] for the checksums of what an evaluation reads: the ids of the
/// scenarios, files of weights. Their names do not tell whether two machines read the same.
/// Ledgers of version 0.1 have no checksums, so only those count that two headers have both.
pub const CHECKSUMS: &str = "checksums";

/// Identifies the evaluation; the first table of the file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Header {
    /// Name of the benchmark, for instance "wosac".
    pub benchmark: String,
    /// The shard of the scenarios.
    pub shard: Shard,
    /// Everything that the entries depend on; the same for all shards of one evaluation, with
    /// [`CHECKSUMS`] of what was read.
    pub settings: toml::Table,
}

impl Header {
    /// Whether the settings are the same, whatever was read.
    fn has_settings_of(&self, other: &Self) -> bool {
        let settings = |header: &Self| {
            let all = header.settings.clone().into_iter();
            all.filter(|(key, _)| key != CHECKSUMS)
                .collect::<toml::Table>()
        };
        self.benchmark == other.benchmark
            && self.shard.n == other.shard.n
            && settings(self) == settings(other)
    }

    /// Checksums by what they are of.
    fn checksums(&self) -> impl Iterator<Item = (&str, &str)> {
        let stored = self.settings.get(CHECKSUMS).and_then(toml::Value::as_table);
        let stored = stored.into_iter().flatten();
        stored.filter_map(|(input, checksum)| Some((input.as_str(), checksum.as_str()?)))
    }

    /// Whether nothing that both have a checksum of differs.
    fn has_inputs_of(&self, other: &Self) -> bool {
        let others: BTreeMap<&str, &str> = other.checksums().collect();
        let mut own = self.checksums();
        own.all(|(input, checksum)| others.get(input).is_none_or(|found| *found == checksum))
    }
}

/// The result of one scenario.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Entry<T> {
    /// Position among all scenarios of the evaluation.
    pub index: usize,
    /// Its id.
    pub id: String,
    /// The benchmark's own fields.
    pub scores: T,
}

/// The structure of the file.
#[derive(Serialize, Deserialize)]
struct Document<T> {
    #[serde(skip_serializing_if = "Option::is_none")]
    evaluation: Option<Header>,
    #[serde(default = "Vec::new", skip_serializing_if = "Vec::is_empty")]
    scenario: Vec<T>,
}

/// A store being written; an entry is safe once [`ResultStore::add`] returns.
pub struct ResultStore<T> {
    folder: PathBuf,
    shard: Shard,
    file: File,
    entries: BTreeMap<usize, Entry<T>>,
}

impl<T: Serialize + DeserializeOwned + Clone> ResultStore<T> {
    /// Opens the store of a folder: resumes an interrupted run of the same evaluation, or starts a
    /// new one.
    ///
    /// # Errors
    /// [`ResultsError::OtherShard`] in a folder with another shard of the same evaluation and
    /// [`ResultsError::ForeignShard`] in one with a shard of another evaluation, whose results would
    /// be lost, and errors of writing.
    pub fn open(folder: &Path, header: &Header) -> Result<Self, EvalError> {
        let path = partial(folder);
        refuse_other_shard(folder, header)?;
        let kept: Vec<Entry<T>> = match fs::read_to_string(&path) {
            Ok(text) => resumable(&text, header),
            Err(_) => Vec::new(),
        };
        let file = File::create(&path).map_err(|cause| EvalError::io("create", &path, cause))?;
        let mut store = Self {
            folder: folder.to_owned(),
            shard: header.shard,
            file,
            entries: BTreeMap::new(),
        };
        store.write(&Document::<Entry<T>> {
            evaluation: Some(header.clone()),
            scenario: Vec::new(),
        })?;
        for entry in kept {
            store.add(entry)?;
        }
        Ok(store)
    }

    /// Scores scenario after scenario: those of the shard that are not done yet. `score` gets the
    /// position and the scenario; the monitor counts scenarios.
    ///
    /// # Errors
    /// The first record that cannot be read, the error of `score` with its scenario, or
    /// [`EvalError::StoppedAndStored`].
    pub fn fill(
        &mut self,
        records: impl Iterator<Item = Result<ScenarioRecord, DataError>>,
        monitor: &dyn Monitor,
        mut score: impl FnMut(usize, &Scenario) -> Result<T, EvalError>,
    ) -> Result<(), EvalError> {
        for (index, record) in records.enumerate() {
            if !self.is_wanted(index) {
                continue;
            }
            let scenario = record?.scenario;
            let place = || ErrorContext::Evaluation {
                id: scenario.id.clone(),
            };
            let scores = score(index, &scenario).map_err(|error| error.at(place()))?;
            self.add(Entry {
                index,
                id: scenario.id.clone(),
                scores,
            })?;
            monitor.advance(1);
            if monitor.is_stopped() {
                let from = ResumePoint::After(index);
                return Err(EvalError::StoppedAndStored { from });
            }
        }
        Ok(())
    }

    /// The shard whose scenarios belong into the store.
    pub fn shard(&self) -> Shard {
        self.shard
    }

    /// True if the scenario at `index` is of the shard and not done yet.
    pub fn is_wanted(&self, index: usize) -> bool {
        self.shard.holds(index) && !self.has(index)
    }

    /// True if the scenario at `index` is already done.
    pub fn has(&self, index: usize) -> bool {
        self.entries.contains_key(&index)
    }

    /// Indices of the scenarios already done.
    pub fn indices(&self) -> BTreeSet<usize> {
        self.entries.keys().copied().collect()
    }

    /// Adds a scenario.
    pub fn add(&mut self, entry: Entry<T>) -> Result<(), EvalError> {
        self.write(&Document {
            evaluation: None,
            scenario: vec![entry.clone()],
        })?;
        self.entries.insert(entry.index, entry);
        Ok(())
    }

    /// Gives the file its final name; all entries in order of the scenarios.
    pub fn close(self) -> Result<Vec<Entry<T>>, EvalError> {
        let (from, to) = (partial(&self.folder), self.folder.join(NAME));
        fs::rename(&from, &to).map_err(|cause| EvalError::io("write", &to, cause))?;
        Ok(self.entries.into_values().collect())
    }

    fn write(&mut self, document: &Document<Entry<T>>) -> Result<(), EvalError> {
        let mut text = toml::to_string(document).map_err(ResultsError::Unwritable)?;
        text.push('\n');
        self.file
            .write_all(text.as_bytes())
            .map_err(|cause| EvalError::io("write", &partial(&self.folder), cause))
    }
}

fn partial(folder: &Path) -> PathBuf {
    folder.join(format!("{NAME}.partial"))
}

/// Error: the folder has another shard of the evaluation, or a shard of another evaluation, finished
/// or not.
fn refuse_other_shard(folder: &Path, header: &Header) -> Result<(), EvalError> {
    for path in [partial(folder), folder.join(NAME)] {
        let Ok(text) = fs::read_to_string(&path) else {
            continue;
        };
        let start = &text[..text.find(ENTRY).unwrap_or(text.len())];
        let Ok(Document::<toml::Table> {
            evaluation: Some(stored),
            ..
        }) = toml::from_str(start)
        else {
            continue;
        };
        if stored.has_settings_of(header) {
            if stored.shard != header.shard {
                return Err(ResultsError::OtherShard {
                    path,
                    stored: stored.shard,
                    requested: header.shard,
                }
                .into());
            }
        } else if stored.shard != Shard::WHOLE {
            // A whole evaluation is begun anew by anyone who changes a flag; a shard is one of many
            // that are waited for.
            return Err(ResultsError::ForeignShard {
                path,
                stored: Box::new(stored),
                requested: Box::new(header.clone()),
            }
            .into());
        }
    }
    Ok(())
}

/// The entries of an interrupted run, if it was of the same evaluation; without the last one, which
/// may be truncated.
fn resumable<T: DeserializeOwned>(text: &str, header: &Header) -> Vec<Entry<T>> {
    let whole = &text[..text.rfind(ENTRY).unwrap_or(0)];
    let is_same = |found: &Header| {
        found.shard == header.shard && found.has_settings_of(header) && found.has_inputs_of(header)
    };
    match toml::from_str::<Document<Entry<T>>>(whole) {
        Ok(found) if found.evaluation.as_ref().is_some_and(is_same) => found.scenario,
        _ => Vec::new(),
    }
}

/// The header of the evaluation in `folder`, without reading its entries.
///
/// Error: no complete store there.
pub fn header(folder: &Path) -> Result<Header, EvalError> {
    let text = text(folder)?;
    let start = &text[..text.find(ENTRY).unwrap_or(text.len())];
    parse::<toml::Table>(start, folder).map(|(header, _)| header)
}

/// Treatment of missing shards.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MissingShards {
    /// An error.
    Refuse,
    /// The result is that of the scenarios of the others, for a look at an evaluation in progress.
    Allow,
}

/// Entries of the shards of one evaluation in order of the scenarios, and the header without shard.
///
/// Error: shards given twice, of different evaluations or of different inputs, scenarios that are
/// there twice or not of their shard, and missing shards unless they are allowed.
pub fn merge<T: DeserializeOwned>(
    folders: &[PathBuf],
    when_missing: MissingShards,
) -> Result<(Header, Vec<Entry<T>>), EvalError> {
    let mut shards: BTreeMap<usize, &Path> = BTreeMap::new();
    let mut first: Option<(Header, &Path)> = None;
    let mut entries = BTreeMap::new();
    let mut inputs = BTreeMap::new();
    for folder in folders {
        let (header, scenarios) = parse::<Entry<T>>(&text(folder)?, folder)?;
        let (expected, example) = first.get_or_insert_with(|| (header.clone(), folder));
        check_same(expected, example, &header, folder)?;
        check_inputs(&mut inputs, &header, folder)?;
        if let Some(other) = shards.insert(header.shard.k, folder) {
            return Err(ResultsError::RepeatedShard {
                shard: header.shard,
                first: other.to_owned(),
                second: folder.clone(),
            }
            .into());
        }
        for entry in scenarios {
            let shard = header.shard;
            if !shard.holds(entry.index) {
                return Err(ResultsError::ForeignScenario {
                    index: entry.index,
                    shard,
                    folder: folder.clone(),
                }
                .into());
            }
            let index = entry.index;
            if entries.insert(index, entry).is_some() {
                let folder = folder.clone();
                return Err(ResultsError::RepeatedScenario { index, folder }.into());
            }
        }
    }
    let (header, _) = first.ok_or(ResultsError::NoFolders)?;
    let n = header.shard.n;
    let missing: Vec<_> = (1..=n).filter(|k| !shards.contains_key(k)).collect();
    if !missing.is_empty() && when_missing == MissingShards::Refuse {
        return Err(ResultsError::MissingShards { n, missing }.into());
    }
    let shard = Shard::WHOLE;
    Ok((Header { shard, ..header }, entries.into_values().collect()))
}

fn check_same(
    expected: &Header,
    example: &Path,
    found: &Header,
    folder: &Path,
) -> Result<(), EvalError> {
    if expected.has_settings_of(found) {
        return Ok(());
    }
    Err(ResultsError::DifferentEvaluations {
        expected: Box::new(expected.clone()),
        expected_in: example.to_owned(),
        found: Box::new(found.clone()),
        found_in: folder.to_owned(),
    }
    .into())
}

/// Compares the checksums of a shard with those of the shards before it, of which `known` has each
/// with the first folder that stores it.
fn check_inputs<'a>(
    known: &mut BTreeMap<String, (String, &'a Path)>,
    header: &Header,
    folder: &'a Path,
) -> Result<(), EvalError> {
    for (input, checksum) in header.checksums() {
        let first = known.entry(input.to_owned());
        let (expected, expected_in) = first.or_insert_with(|| (checksum.to_owned(), folder));
        if expected != checksum {
            return Err(ResultsError::DifferentInputs {
                input: input.to_owned(),
                expected: expected.clone(),
                expected_in: expected_in.to_owned(),
                found: checksum.to_owned(),
                found_in: folder.to_owned(),
            }
            .into());
        }
    }
    Ok(())
}

fn text(folder: &Path) -> Result<String, EvalError> {
    let path = folder.join(NAME);
    fs::read_to_string(&path).map_err(|cause| ResultsError::Unfinished { path, cause }.into())
}

fn parse<T: DeserializeOwned>(text: &str, folder: &Path) -> Result<(Header, Vec<T>), EvalError> {
    let path = folder.join(NAME);
    let document: Document<T> = match toml::from_str(text) {
        Ok(document) => document,
        Err(error) => {
            let cause = Box::new(error);
            return Err(ResultsError::Malformed { path, cause }.into());
        }
    };
    let header = document.evaluation;
    let header = header.ok_or(ResultsError::NoHeader { path })?;
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

    /// Writes a complete shard with a number per scenario that has no short decimal form.
    fn shard(folder: &Path, k: usize, n: usize) {
        fs::create_dir_all(folder).unwrap();
        let mut store = ResultStore::open(folder, &header(k, n)).unwrap();
        for index in (0..10).filter(|&i| Shard { k, n }.holds(i)) {
            store.add(entry(index, (index as f64 + 0.1).sin())).unwrap();
        }
        store.close().unwrap();
    }

    #[test]
    fn shards_in_any_order_are_the_whole_to_the_bit() {
        let folder = tempfile::tempdir().unwrap();
        let place = |name: &str| folder.path().join(name);
        shard(&place("whole"), 1, 1);
        for k in 1..=3 {
            shard(&place(&k.to_string()), k, 3);
        }
        let (_, whole) = merge::<f64>(&[place("whole")], MissingShards::Refuse).unwrap();
        let (_, parts) =
            merge::<f64>(&[place("3"), place("1"), place("2")], MissingShards::Allow).unwrap();
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
            let error = format!(
                "{:#}",
                merge::<f64>(&folders, MissingShards::Refuse).unwrap_err()
            );
            assert!(error.contains(part), "{error}");
        };
        fails(&["1of2"], "expected all 2 shards, missing shard 2/2");
        let (_, half) = merge::<f64>(&[place("1of2")], MissingShards::Allow).unwrap();
        assert_eq!(
            half.iter().map(|e| e.index).collect::<Vec<_>>(),
            [0, 2, 4, 6, 8]
        );
        fails(&["1of2", "also 1of2"], "every shard once, found 1/2");
        fails(&["1of2", "1of3"], "one evaluation, but ");
        fails(&["1of2", "1of3"], " differ: number of shards 2 and 3");
        fails(&["nowhere"], "cannot read");
        let edit = |name: &str, from: &str, to: &str| {
            let path = place("1of2").join(NAME);
            let text = fs::read_to_string(path).unwrap();
            assert_eq!(text.matches(from).count(), 1, "{from}");
            fs::create_dir_all(place(name)).unwrap();
            fs::write(place(name).join(NAME), text.replace(from, to)).unwrap();
        };
        edit("foreign", "index = 4\n", "index = 5\n");
        fails(&["foreign"], "scenario 5 is not of shard 1/2");
        edit("doubled", "index = 4\n", "index = 2\n");
        fails(&["doubled"], "found scenario 2 twice in");
    }

    /// The header of a shard that read weights with this checksum; none as of version 0.1.
    fn header_with(k: usize, n: usize, checksum: Option<&str>) -> Header {
        let mut header = header(k, n);
        if let Some(checksum) = checksum {
            let checksums = toml::Table::from_iter([("weights".into(), checksum.into())]);
            header.settings.insert(CHECKSUMS.into(), checksums.into());
        }
        header
    }

    #[test]
    fn shards_of_other_weights_under_the_same_name_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let place = |name: &str| folder.path().join(name);
        let write = |name: &str, k: usize, checksum: Option<&str>| {
            fs::create_dir_all(place(name)).unwrap();
            let header = header_with(k, 3, checksum);
            let mut store = ResultStore::open(&place(name), &header).unwrap();
            store.add(entry(k - 1, 0.5)).unwrap();
            store.close().unwrap();
        };
        write("old", 1, None);
        write("a2", 2, Some("aa"));
        write("a3", 3, Some("aa"));
        write("b3", 3, Some("bb"));
        let merged = |names: [&str; 3]| {
            let merged = merge::<f64>(&names.map(place), MissingShards::Refuse);
            merged.map(|(_, entries)| entries.len())
        };
        // Results without checksums go with any, and do not hide that others differ.
        assert_eq!(merged(["old", "a2", "a3"]).unwrap(), 3);
        assert_eq!(merged(["a3", "a2", "old"]).unwrap(), 3);
        for names in [["old", "a2", "b3"], ["b3", "old", "a2"]] {
            let error = merged(names).unwrap_err().to_string();
            let parts = ["found weights of checksum", "aa in", "bb in"];
            assert!(parts.iter().all(|part| error.contains(part)), "{error}");
        }
    }

    #[test]
    fn a_run_resumes_with_the_weights_that_it_began_with() {
        let n_kept = |before: Option<&str>, now: Option<&str>| {
            let folder = tempfile::tempdir().unwrap();
            let mut store = ResultStore::open(folder.path(), &header_with(1, 1, before)).unwrap();
            store.add(entry(0, 0.5)).unwrap();
            store.add(entry(1, 0.5)).unwrap();
            drop(store);
            let resumed = ResultStore::<f64>::open(folder.path(), &header_with(1, 1, now));
            resumed.unwrap().indices().len()
        };
        // The last entry may be truncated, so it does not count.
        assert_eq!(n_kept(Some("aa"), Some("aa")), 1);
        assert_eq!(n_kept(None, Some("aa")), 1);
        assert_eq!(n_kept(Some("bb"), Some("aa")), 0);
    }

    #[test]
    fn a_shard_does_not_replace_another_one_of_its_evaluation() {
        let folder = tempfile::tempdir().unwrap();
        let open = |k, n| ResultStore::<f64>::open(folder.path(), &header(k, n));
        let refused = |k, n| {
            let error = open(k, n).err().unwrap().to_string();
            let expected = "expected a folder for shard 2/3 alone, found shard 1/3";
            assert!(error.starts_with(expected), "{error}");
        };
        let mut store = open(1, 3).unwrap();
        refused(2, 3);
        store.add(entry(0, 0.5)).unwrap();
        store.close().unwrap();
        refused(2, 3);
        let (_, entries) = merge::<f64>(&[folder.path().to_owned()], MissingShards::Allow).unwrap();
        assert_eq!(entries.len(), 1);
        let other = |k, n| {
            let settings = toml::Table::from_iter([("year".into(), 2024.into())]);
            let header = Header {
                settings,
                ..header(k, n)
            };
            ResultStore::<f64>::open(folder.path(), &header)
        };
        for (error, differs) in [
            (open(1, 2).err(), "number of shards 3 and 2"),
            (open(1, 1).err(), "number of shards 3 and 1"),
            (other(1, 3).err(), "year 2025 and 2024"),
        ] {
            let error = error.unwrap().to_string();
            let parts = ["found shard 1/3 of another", differs, "another --out"];
            assert!(parts.iter().all(|part| error.contains(part)), "{error}");
        }
        // The same shard again begins anew.
        open(1, 3).unwrap();
    }

    #[test]
    fn an_interrupted_run_goes_on() {
        let folder = tempfile::tempdir().unwrap();
        let mut store = ResultStore::open(folder.path(), &header(1, 1)).unwrap();
        store.add(entry(0, 0.5)).unwrap();
        store.add(entry(1, 1.5)).unwrap();
        // Stopped in the middle of a number.
        let cut = b"[[scenario]]\nindex = 2\nid = \"s2\"\nscores = 2";
        store.file.write_all(cut).unwrap();
        drop(store);
        let mut store = ResultStore::open(folder.path(), &header(1, 1)).unwrap();
        assert_eq!(store.indices(), BTreeSet::from([0, 1]));
        store.add(entry(2, 2.5)).unwrap();
        assert_eq!(store.close().unwrap().len(), 3);
        let (_, entries) =
            merge::<f64>(&[folder.path().to_owned()], MissingShards::Refuse).unwrap();
        assert_eq!(entries.iter().map(|e| e.scores).sum::<f64>(), 4.5);
    }

    #[test]
    fn another_evaluation_begins_anew() {
        let folder = tempfile::tempdir().unwrap();
        let mut store = ResultStore::open(folder.path(), &header(1, 1)).unwrap();
        store.add(entry(0, 0.5)).unwrap();
        drop(store);
        let other = Header {
            settings: toml::Table::new(),
            ..header(1, 1)
        };
        assert!(
            ResultStore::<f64>::open(folder.path(), &other)
                .unwrap()
                .indices()
                .is_empty()
        );
    }
}
