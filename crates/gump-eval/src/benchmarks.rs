//! Frozen sets: lists of scenes that all evaluations share.
//!
//! A list names scenes and holds none: generated ones by generator version, seed, network and
//! checksum, recorded ones by id, file and checksum. [`ScenarioSetName::find`] finds the scenes of
//! a list and verifies them; [`make()`] makes the generated ones, and [`ListDraw`] draws a list
//! from a larger one.

mod checksum;
mod draw;
mod make;
mod scenario_set;
mod verify;

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::datasets::Split;
use crate::{BenchmarkError, EvalError, PartProblem};

pub use checksum::checksum;
pub use draw::{DrawRule, ListDraw};
pub use make::{freeze, make};
pub use scenario_set::{BenchmarkFolders, ScenarioSet, ScenarioSetName};
pub use verify::{checksums, sha256, verify_generated, verify_recorded};

/// Seeds that only lists may use, so that no training set has the roads of a frozen set.
pub const RESERVED_SEEDS: Range<u64> = 900_000_000..1_000_000_000;

/// Seeds outside [`RESERVED_SEEDS`] that tune and test splits may have as well: policies were tested
/// on their scenes, and the results published, before there were lists for learning. Training is
/// warned of these scenes by their ids.
const SEEDS_OF_RESULTS: [u64; 2] = [777, 778];

/// A list of scenes.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct BenchmarkList {
    /// The name that results carry.
    pub name: String,
    /// Reason for the choice of these scenes.
    pub about: String,
    /// Generated scenes.
    #[serde(default, rename = "made", skip_serializing_if = "Vec::is_empty")]
    pub generated: Vec<GeneratedPart>,
    /// Recorded scenes.
    #[serde(default, rename = "recorded", skip_serializing_if = "Vec::is_empty")]
    pub recorded: Vec<RecordedPart>,
    /// Path of the list.
    #[serde(skip)]
    path: PathBuf,
}

/// Scenes from one generator and seed: one file.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct GeneratedPart {
    /// Its name, without the ending.
    pub file: String,
    /// Split of its scenes.
    pub split: Split,
    /// "procedural" or "sumo", a slash, and its version.
    pub generator: String,
    /// Version of SUMO, where the generator needs it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sumo: Option<String>,
    /// Seed of the generator.
    pub seed: u64,
    /// Factor of the number of agents; by default the generator's own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub density: Option<f64>,
    /// Number of scenes that the generator makes.
    pub count: usize,
    /// Indices of the scenes that are kept, in order; all if empty.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub keep: Vec<usize>,
    /// Maximum number of scenes from one run of SUMO.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub per_run: Option<usize>,
    /// Sum and id of every scene, in order.
    #[serde(default)]
    pub scenes: Vec<String>,
    /// Networks to use in turn; if empty, one is generated for every run.
    #[serde(default, rename = "network", skip_serializing_if = "Vec::is_empty")]
    pub networks: Vec<NetworkFile>,
}

/// A network that scenes are made on.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct NetworkFile {
    /// Path relative to the list.
    pub path: PathBuf,
    /// Lower-case hexadecimal.
    pub sha256: String,
    /// An SPDX expression.
    pub licence: String,
    /// Source, and the notice that must be passed on with it.
    pub notice: String,
}

/// Recorded scenes of one folder.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct RecordedPart {
    /// Split of its scenes.
    pub split: Split,
    /// Path relative to the folder of recorded data.
    pub folder: PathBuf,
    /// Reason why they are in this split.
    pub about: String,
    /// SHA-256, file and id of every scene, in order; the id is left out where a file holds several.
    pub scenes: Vec<String>,
}

/// A recorded scene of a list.
pub struct RecordedScene<'a> {
    /// SHA-256 of its file, lower-case hexadecimal.
    pub sha256: &'a str,
    /// Path relative to the folder.
    pub file: &'a str,
    /// Left out where the file holds several scenes.
    pub id: Option<&'a str>,
}

impl BenchmarkList {
    /// Reads a list.
    ///
    /// # Errors
    /// A file that cannot be read or is not a list.
    pub fn read(path: &Path) -> Result<Self, EvalError> {
        let text = std::fs::read_to_string(path)
            .map_err(|cause| EvalError::io("read the list", path, cause))?;
        let list: Self = toml::from_str(&text).map_err(|error: toml::de::Error| {
            let before = &text[..error.span().map_or(0, |span| span.start)];
            let line = 1 + before.matches('\n').count();
            BenchmarkError::Malformed {
                path: path.to_owned(),
                line,
                cause: Box::new(error),
            }
        })?;
        let list = Self {
            path: path.to_owned(),
            ..list
        };
        for part in &list.generated {
            part.validate().map_err(|problem| BenchmarkError::Part {
                part: part.file.clone(),
                list: path.to_owned(),
                problem,
            })?;
        }
        for scene in list.recorded.iter().flat_map(|part| &part.scenes) {
            RecordedScene::parse(scene)?;
        }
        Ok(list)
    }

    /// The splits that have scenes, each once.
    pub fn splits(&self) -> Vec<Split> {
        let generated = self.generated.iter().map(|part| part.split);
        let all: Vec<Split> = generated
            .chain(self.recorded.iter().map(|part| part.split))
            .collect();
        let is_there = |split: &Split| all.contains(split);
        Split::ALL.into_iter().filter(is_there).collect()
    }

    /// The name of a split in results: `NAME/SPLIT`, or the name alone if there is no other split.
    pub fn set(&self, split: Split) -> String {
        match self.splits()[..] {
            [_] => self.name.clone(),
            _ => format!("{}/{}", self.name, split.name()),
        }
    }

    /// Path of the list.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Resolves a path of the list, which is relative to it.
    pub fn beside(&self, path: &Path) -> PathBuf {
        self.path.parent().unwrap_or(Path::new("")).join(path)
    }

    /// The generated file of a part.
    pub fn file(&self, folder: &Path, part: &GeneratedPart) -> PathBuf {
        folder
            .join(&self.name)
            .join(format!("{}.tfrecord.gz", part.file))
    }
}

impl GeneratedPart {
    /// Checks the part.
    fn validate(&self) -> Result<(), PartProblem> {
        // Scenes to train on need not be kept from training.
        let is_reserved =
            RESERVED_SEEDS.contains(&self.seed) || SEEDS_OF_RESULTS.contains(&self.seed);
        if self.split != Split::Train && !is_reserved {
            return Err(PartProblem::Seed { found: self.seed });
        }
        let (found, expected) = (self.scenes.len(), self.kept());
        if found != expected && found != 0 {
            return Err(PartProblem::ChecksumCount { expected, found });
        }
        let count = self.count;
        if !self.keep.is_sorted_by(|a, b| a < b) || self.keep.iter().any(|&i| i >= count) {
            return Err(PartProblem::Keep { count });
        }
        match self.density {
            Some(found) if !(0.1..=3.0).contains(&found) => {
                return Err(PartProblem::Density { found });
            }
            _ => {}
        }
        let is_plain = |c: char| c.is_ascii_alphanumeric() || c == '-';
        if self.file.is_empty() || !self.file.chars().all(is_plain) {
            let found = self.file.clone();
            return Err(PartProblem::Name { found });
        }
        Ok(())
    }

    /// Number of scenes in its file.
    pub fn kept(&self) -> usize {
        match self.keep.len() {
            0 => self.count,
            n => n,
        }
    }

    /// Whether the scene of that index is kept.
    pub fn keeps(&self, index: usize) -> bool {
        self.keep.is_empty() || self.keep.binary_search(&index).is_ok()
    }
}

impl<'a> RecordedScene<'a> {
    /// Reads `SHA256 FILE [ID]`.
    ///
    /// # Errors
    /// A malformed line.
    pub fn parse(line: &'a str) -> Result<Self, EvalError> {
        let words: Vec<&str> = line.split(' ').collect();
        match words[..] {
            [sha256, file, ref id @ ..] if sha256.len() == 64 && id.len() < 2 => Ok(Self {
                sha256,
                file,
                id: id.first().copied(),
            }),
            _ => {
                let found = line.into();
                Err(BenchmarkError::SceneLine { found }.into())
            }
        }
    }
}

/// Ids of the scenes that nothing may learn from, each with its set: those of the tune and test
/// splits of the lists in a folder; none where there is no folder.
///
/// # Errors
/// A list that cannot be read.
pub fn frozen_ids(folder: &Path) -> Result<BTreeMap<String, String>, EvalError> {
    let mut ids = BTreeMap::new();
    let Ok(entries) = std::fs::read_dir(folder) else {
        return Ok(ids);
    };
    for entry in entries {
        let entry = entry.map_err(|cause| EvalError::io("list", folder, cause))?;
        let path = entry.path();
        if path.extension().is_none_or(|extension| extension != "toml") {
            continue;
        }
        let list = BenchmarkList::read(&path)?;
        let generated = list.generated.iter().map(|part| (part.split, &part.scenes));
        let recorded = list.recorded.iter().map(|part| (part.split, &part.scenes));
        let frozen = generated
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

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use std::collections::BTreeSet;

    pub(crate) fn repository() -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
    }

    fn shipped(name: &str) -> BenchmarkList {
        BenchmarkList::read(&repository().join(format!("datasets/benchmarks/{name}.toml"))).unwrap()
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
                let parts = list.generated.iter();
                let parts = parts.filter(|part| part.generator.starts_with(kind));
                parts.map(|part| part.scenes.len()).sum()
            };
            assert_eq!(count("procedural/"), count("sumo/"), "{}", list.name);
            assert!(count("procedural/") >= 100, "{}", list.name);
            assert_eq!(list.splits().len(), 1);
            for part in &list.generated {
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
    fn lists_for_learning_train_and_test_on_different_scenes() {
        let frozen = frozen_ids(&repository().join("datasets/benchmarks")).unwrap();
        for (name, seeds, density) in [
            ("learning-usual", [1, 777], None),
            ("learning-dense", [21, 778], Some(3.0)),
        ] {
            let list = shipped(name);
            assert_eq!(list.splits(), [Split::Train, Split::Test], "{name}");
            let parts = list.generated.iter();
            let of_parts = parts.map(|part| (part.seed, part.density, part.scenes.len()));
            let expected = [(seeds[0], density, 1500), (seeds[1], density, 200)];
            assert_eq!(of_parts.collect::<Vec<_>>(), expected);
            let ids = |part: &GeneratedPart| -> BTreeSet<String> {
                let ids = part.scenes.iter().map(|scene| scene.split_once(' '));
                ids.map(|pair| pair.unwrap().1.to_owned()).collect()
            };
            let [train, test] = [0, 1].map(|i| ids(&list.generated[i]));
            assert_eq!((train.len(), test.len()), (1500, 200));
            let set = format!("{name}/test");
            assert!(test.iter().all(|id| frozen[id] == set));
            assert!(train.iter().all(|id| !frozen.contains_key(id)));
        }
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
            format!("{:#}", BenchmarkList::read(&path).unwrap_err())
        };
        assert!(error("nonsense").contains("expected a list of scenes"));
        assert!(error(&part.replace("count", "cuont")).contains("line 8"));
        let few = format!("{part}scenes = [\"0 a\"]\n");
        assert!(error(&few).contains("expected 2 scenes with their sums, found 1"));
        let seed = part.replace("900000001", "1");
        let train = seed.replace("\"tune\"", "\"train\"");
        std::fs::write(&path, &train).unwrap();
        assert!(BenchmarkList::read(&path).is_ok());
        assert!(error(&seed).contains("which training never uses"));
        assert!(error(&part.replace("\"a\"", "\"../a\"")).contains("letters, digits"));
    }
}
