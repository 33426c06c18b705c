//! Frozen sets: lists of scenes that everybody scores on, and the scenes of a list.
//!
//! A list names scenes, it holds none: made ones by generator version, seed, network and sum
//! ([`make()`] makes them anew), recorded ones by id, file and sum. [`Scenes`] is what
//! `--scenarios` takes; [`fingerprint`] is the sum of a scene.

mod draw;
mod fingerprint;
mod make;
mod recorded;
mod scenes;

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use serde::{Deserialize, Serialize};

use crate::dataset::Split;
use crate::installed::home;
use crate::machine::repository;

pub(crate) use draw::{Draw, Rule, worst_scores};
pub(crate) use make::{check, freeze, make};
pub(crate) use recorded::check_recorded;
pub(crate) use scenes::{Found, Scenes};

/// Seeds that only lists of this folder may use: `data synthesize` refuses them, so that no
/// training set is made of a frozen set's roads.
pub(crate) const RESERVED: Range<u64> = 900_000_000..1_000_000_000;

/// A list of scenes.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct List {
    /// The name that results carry.
    pub(crate) name: String,
    /// Why these scenes.
    pub(crate) about: String,
    /// Scenes that are made.
    #[serde(default, rename = "made", skip_serializing_if = "Vec::is_empty")]
    pub(crate) made: Vec<Made>,
    /// Scenes that somebody recorded.
    #[serde(default, rename = "recorded", skip_serializing_if = "Vec::is_empty")]
    pub(crate) recorded: Vec<Recorded>,
    /// Where the list lies.
    #[serde(skip)]
    path: PathBuf,
}

/// Scenes from one generator and seed: one file.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Made {
    /// Its name, without the ending.
    pub(crate) file: String,
    pub(crate) split: Split,
    /// "procedural" or "sumo", a slash, and its version.
    pub(crate) generator: String,
    /// Version of SUMO, where the generator needs it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) sumo: Option<String>,
    pub(crate) seed: u64,
    /// Multiplies the number of agents; else the generator's own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) density: Option<f64>,
    /// How many scenes.
    pub(crate) count: usize,
    /// Which of them, in order; none: all.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(crate) keep: Vec<usize>,
    /// Scenes taken of a run of SUMO, at most.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) per_run: Option<usize>,
    /// Sum and id of every scene, in order.
    #[serde(default)]
    pub(crate) scenes: Vec<String>,
    /// Networks to take in turn; none: made anew for every run.
    #[serde(default, rename = "network", skip_serializing_if = "Vec::is_empty")]
    pub(crate) networks: Vec<NetworkFile>,
}

/// A network that scenes are made on.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct NetworkFile {
    /// From the list.
    pub(crate) path: PathBuf,
    /// Lower-case hexadecimal.
    pub(crate) sha256: String,
    /// An SPDX expression.
    pub(crate) licence: String,
    /// Where it is from, and what must be passed on with it.
    pub(crate) notice: String,
}

/// Recorded scenes of one folder.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Recorded {
    pub(crate) split: Split,
    /// From the folder of recorded data.
    pub(crate) folder: PathBuf,
    /// Why they are of this split.
    pub(crate) about: String,
    /// SHA-256, file and id of every scene, in order; the id is left out where a file holds several.
    pub(crate) scenes: Vec<String>,
}

/// A recorded scene of a list.
pub(crate) struct RecordedScene<'a> {
    pub(crate) sha256: &'a str,
    /// From the folder.
    pub(crate) file: &'a str,
    pub(crate) id: Option<&'a str>,
}

impl List {
    /// Reads a list.
    ///
    /// Error: a file that cannot be read, or that is no list.
    pub(crate) fn read(path: &Path) -> anyhow::Result<Self> {
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("cannot read the list {}", path.display()))?;
        let list: Self = toml::from_str(&text).map_err(|error| {
            let before = &text[..error.span().map_or(0, |span| span.start)];
            let line = 1 + before.matches('\n').count();
            anyhow::anyhow!(
                "expected a list of scenes, found in line {line} of {}: {}",
                path.display(),
                error.message().replace('\n', ", ")
            )
        })?;
        let list = Self {
            path: path.to_owned(),
            ..list
        };
        for part in &list.made {
            list.validate(part)?;
        }
        for scene in list.recorded.iter().flat_map(|part| &part.scenes) {
            RecordedScene::parse(scene)
                .with_context(|| format!("expected \"SHA256 FILE [ID]\", found \"{scene}\""))?;
        }
        Ok(list)
    }

    fn validate(&self, part: &Made) -> anyhow::Result<()> {
        let place = format!("part {} of {}", part.file, self.path.display());
        anyhow::ensure!(
            RESERVED.contains(&part.seed),
            "{place}: expected a seed from {} to {}, which training never uses, found {}",
            RESERVED.start,
            RESERVED.end - 1,
            part.seed
        );
        let n = part.scenes.len();
        anyhow::ensure!(
            n == part.kept() || n == 0,
            "{place}: expected {} scenes with their sums, found {n}",
            part.kept()
        );
        anyhow::ensure!(
            part.keep.is_sorted_by(|a, b| a < b) && part.keep.iter().all(|&i| i < part.count),
            "{place}: expected the indices to keep in order, all below {}",
            part.count
        );
        anyhow::ensure!(
            part.density
                .is_none_or(|density| (0.1..=3.0).contains(&density)),
            "{place}: expected a density from 0.1 to 3, found {:?}",
            part.density
        );
        let is_plain = |c: char| c.is_ascii_alphanumeric() || c == '-';
        anyhow::ensure!(
            part.file.chars().all(is_plain) && !part.file.is_empty(),
            "{place}: expected a name of letters, digits and -, found \"{}\"",
            part.file
        );
        Ok(())
    }

    /// The splits that have scenes, each once.
    pub(crate) fn splits(&self) -> Vec<Split> {
        let made = self.made.iter().map(|part| part.split);
        let all: Vec<Split> = made
            .chain(self.recorded.iter().map(|part| part.split))
            .collect();
        let is_there = |split: &Split| all.contains(split);
        Split::ALL.into_iter().filter(is_there).collect()
    }

    /// What results call a split: `NAME/SPLIT`, or the name alone if there is no other split.
    pub(crate) fn set(&self, split: Split) -> String {
        match self.splits()[..] {
            [_] => self.name.clone(),
            _ => format!("{}/{}", self.name, split.name()),
        }
    }

    /// A path that the list gives from itself.
    fn beside(&self, path: &Path) -> PathBuf {
        self.path.parent().unwrap_or(Path::new("")).join(path)
    }

    /// The file of a part among what was made.
    fn file(&self, folder: &Path, part: &Made) -> PathBuf {
        folder
            .join(&self.name)
            .join(format!("{}.tfrecord.gz", part.file))
    }
}

impl Made {
    /// How many scenes its file has.
    pub(crate) fn kept(&self) -> usize {
        match self.keep.len() {
            0 => self.count,
            n => n,
        }
    }

    fn keeps(&self, index: usize) -> bool {
        self.keep.is_empty() || self.keep.binary_search(&index).is_ok()
    }
}

impl<'a> RecordedScene<'a> {
    /// `None` for what is no `SHA256 FILE [ID]`.
    pub(crate) fn parse(line: &'a str) -> Option<Self> {
        let mut words = line.split(' ');
        let sha256 = words.next().filter(|sum| sum.len() == 64)?;
        let (file, id) = (words.next()?, words.next());
        words.next().is_none().then_some(Self { sha256, file, id })
    }
}

/// Ids of the scenes that nothing may learn from, each with its set: those of the tune and test
/// splits of the lists that come with the driver; none where there are no lists.
///
/// Error: a list that cannot be read.
pub(crate) fn frozen_ids() -> anyhow::Result<BTreeMap<String, String>> {
    let folder = home().join("datasets/benchmarks");
    let mut ids = BTreeMap::new();
    let Ok(entries) = std::fs::read_dir(&folder) else {
        return Ok(ids);
    };
    for entry in entries {
        let path = entry?.path();
        if path.extension().is_none_or(|extension| extension != "toml") {
            continue;
        }
        let list = List::read(&path)?;
        let made = list.made.iter().map(|part| (part.split, &part.scenes));
        let recorded = list.recorded.iter().map(|part| (part.split, &part.scenes));
        let frozen = made
            .chain(recorded)
            .filter(|(split, _)| *split != Split::Train);
        for (split, scenes) in frozen {
            let set = list.set(split);
            // The id is the last word, of lines that have one.
            let id = |line: &String| line.rsplit_once(' ').map(|(_, id)| id.to_owned());
            ids.extend(scenes.iter().filter_map(id).map(|id| (id, set.clone())));
        }
    }
    Ok(ids)
}

/// The folder of recorded data: `GUMP_RECORDED`, else `shared/data` beside the checkout.
pub(crate) fn recorded_data() -> PathBuf {
    match std::env::var_os("GUMP_RECORDED") {
        Some(folder) => folder.into(),
        None => repository().join("../shared/data"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    fn shipped(name: &str) -> List {
        List::read(&repository().join(format!("datasets/benchmarks/{name}.toml"))).unwrap()
    }

    #[test]
    fn the_synthetic_lists_are_large_and_share_nothing() {
        let lists = [shipped("synthetic-tune"), shipped("synthetic-test")];
        let (mut seeds, mut networks, mut ids, mut sums) = (
            BTreeSet::new(),
            BTreeSet::new(),
            BTreeSet::new(),
            BTreeSet::new(),
        );
        let mut n_parts = 0;
        for list in &lists {
            let count = |kind: &str| -> usize {
                let parts = list.made.iter();
                let parts = parts.filter(|part| part.generator.starts_with(kind));
                parts.map(|part| part.scenes.len()).sum()
            };
            assert_eq!(count("procedural/"), count("sumo/"), "{}", list.name);
            assert!(count("procedural/") >= 100, "{}", list.name);
            assert_eq!(list.splits().len(), 1);
            for part in &list.made {
                n_parts += 1;
                seeds.insert(part.seed);
                for network in &part.networks {
                    assert!(networks.insert(network.sha256.clone()), "{network:?}");
                }
                for scene in &part.scenes {
                    let (sum, id) = scene.split_once(' ').unwrap();
                    assert!(ids.insert(id.to_owned()), "{id} is there twice");
                    assert!(sums.insert(sum.to_owned()), "{sum} is there twice");
                }
            }
        }
        assert_eq!(seeds.len(), n_parts, "a seed is there twice");
    }

    #[test]
    fn recorded_lists_put_every_scene_into_one_split() {
        for name in ["recorded", "recorded-other"] {
            let list = shipped(name);
            let scenes = list.recorded.iter().flat_map(|part| &part.scenes);
            let scenes: Vec<RecordedScene<'_>> =
                scenes.map(|s| RecordedScene::parse(s).unwrap()).collect();
            let sums: BTreeSet<&str> = scenes.iter().map(|scene| scene.sha256).collect();
            assert_eq!(sums.len(), scenes.len(), "{name}: a file is there twice");
            let ids: Vec<&str> = scenes.iter().filter_map(|scene| scene.id).collect();
            assert_eq!(ids.iter().collect::<BTreeSet<_>>().len(), ids.len());
            assert_eq!(list.splits(), Split::ALL, "{name}");
        }
        let of = |split| -> usize {
            let list = shipped("recorded");
            let parts = list.recorded.iter().filter(|part| part.split == split);
            parts.map(|part| part.scenes.len()).sum()
        };
        assert_eq!(Split::ALL.map(of), [137, 41, 25]);
    }

    #[test]
    fn what_is_no_list_is_told_in_one_sentence() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("list.toml");
        let part = "name = \"l\"\nabout = \"\"\n[[made]]\nfile = \"a\"\nsplit = \"tune\"\n\
                    generator = \"procedural/1\"\nseed = 900000001\ncount = 2\n";
        let error = |text: &str| {
            std::fs::write(&path, text).unwrap();
            format!("{:#}", List::read(&path).unwrap_err())
        };
        assert!(error("nonsense").contains("expected a list of scenes"));
        assert!(error(&part.replace("count", "cuont")).contains("line 8"));
        let few = format!("{part}scenes = [\"0 a\"]\n");
        assert!(error(&few).contains("expected 2 scenes with their sums, found 1"));
        let seed = part.replace("900000001", "1");
        assert!(error(&seed).contains("which training never uses"));
        assert!(error(&part.replace("\"a\"", "\"../a\"")).contains("letters, digits"));
    }
}
