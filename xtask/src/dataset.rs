//! Data sets with splits: a folder with a `manifest.toml`, or any path for a set without.

use std::borrow::Cow;
use std::ops::Range;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use gump_data::cache::Cache;
use gump_model::ModelError;
use gump_scene::{Scenario, Seed};
use gump_train::ScenarioSource;
use serde::{Deserialize, Serialize};

use crate::fresh::{Fresh, Stream};
use crate::progress::Progress;
use crate::run::stop_if_interrupted;

/// `manifest.toml`: what a data set consists of, where it is from and who may use it.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[cfg_attr(
    not(test),
    expect(
        dead_code,
        reason = "people and tests read the fields that training does not"
    )
)]
pub(crate) struct Manifest {
    pub(crate) name: String,
    /// An SPDX expression.
    pub(crate) licence: String,
    /// How the files came about.
    pub(crate) provenance: String,
    #[serde(rename = "file")]
    pub(crate) files: Vec<ManifestFile>,
}

/// A file of a data set.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[cfg_attr(
    not(test),
    expect(
        dead_code,
        reason = "people and tests read the fields that training does not"
    )
)]
pub(crate) struct ManifestFile {
    /// Path from the manifest.
    pub(crate) path: PathBuf,
    pub(crate) scenes: usize,
    /// Lower-case hexadecimal.
    pub(crate) sha256: String,
    /// An SPDX expression, where it is not that of the set.
    pub(crate) licence: Option<String>,
    /// How it came about, where that is not how the set did.
    pub(crate) provenance: Option<String>,
    /// What must be passed on with it.
    pub(crate) notice: Option<String>,
    /// Which of its scenes are for what.
    pub(crate) split: Splits,
}

/// Indices of the scenes of each split: the first, and the one after the last.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct Splits {
    pub(crate) train: [usize; 2],
    #[serde(alias = "validation")]
    pub(crate) tune: [usize; 2],
    pub(crate) test: [usize; 2],
}

/// What scenes are for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Deserialize, Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Split {
    /// Weights learn from them.
    Train,
    /// Choices are made on them: weights, temperatures, rules.
    Tune,
    /// Nothing is chosen on them.
    Test,
}

impl Split {
    /// All of them.
    pub(crate) const ALL: [Self; 3] = [Self::Train, Self::Tune, Self::Test];

    /// Its name in lists and results.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Train => "train",
            Self::Tune => "tune",
            Self::Test => "test",
        }
    }
}

/// Scenes of one file or folder.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Part {
    pub(crate) path: PathBuf,
    /// Indices of the scenes.
    pub(crate) scenes: Range<usize>,
}

impl Part {
    /// All scenes.
    pub(crate) fn whole(path: &Path) -> Self {
        Self {
            path: path.to_owned(),
            scenes: 0..usize::MAX,
        }
    }
}

impl Manifest {
    /// Reads the manifest of a folder; `None` if it has none.
    ///
    /// Error: a manifest that cannot be read or understood.
    pub(crate) fn of(folder: &Path) -> anyhow::Result<Option<Self>> {
        let path = folder.join("manifest.toml");
        if !path.is_file() {
            return Ok(None);
        }
        let text = std::fs::read_to_string(&path)
            .with_context(|| format!("cannot read {}", path.display()))?;
        let manifest: Self = toml::from_str(&text)
            .map_err(|error| anyhow::anyhow!("{}: {}", path.display(), error.message()))?;
        Ok(Some(manifest))
    }
}

/// Where the scenes of a split are; without a manifest, all of a path is for training.
///
/// Error: a manifest that cannot be read.
pub(crate) fn parts(data: &Path, split: Split) -> anyhow::Result<Vec<Part>> {
    let Some(manifest) = Manifest::of(data)? else {
        return Ok(match split {
            Split::Train => vec![Part::whole(data)],
            Split::Tune | Split::Test => Vec::new(),
        });
    };
    let parts = manifest.files.iter().map(|file| {
        let [start, end] = match split {
            Split::Train => file.split.train,
            Split::Tune => file.split.tune,
            Split::Test => file.split.test,
        };
        Part {
            path: data.join(&file.path),
            scenes: start..end,
        }
    });
    Ok(parts.filter(|part| !part.scenes.is_empty()).collect())
}

/// Reads the scenarios of the parts.
///
/// Error: the first record that cannot be read, or Ctrl-C.
pub(crate) fn read(parts: &[Part], progress: &Progress) -> anyhow::Result<Vec<Scenario>> {
    read_first(usize::MAX, parts, progress)
}

/// Reads the first `limit` scenarios of the parts.
///
/// Error: the first record that cannot be read, or Ctrl-C.
pub(crate) fn read_first(
    limit: usize,
    parts: &[Part],
    progress: &Progress,
) -> anyhow::Result<Vec<Scenario>> {
    let mut scenarios = Vec::new();
    for part in parts {
        let records = gump_data::open(&part.path)?;
        let Range { start, end } = part.scenes;
        for record in records.take(end).skip(start) {
            if scenarios.len() == limit {
                return Ok(scenarios);
            }
            stop_if_interrupted()?;
            scenarios.push(record?.scenario);
            progress.advance(1);
        }
    }
    Ok(scenarios)
}

/// Scenarios to train on: those in a cache stay there until they are asked for, others are held;
/// or a stream of scenes that are made up.
pub(crate) struct Training {
    /// Each with the number of the first scenario after it.
    sources: Vec<(usize, Source)>,
    /// Takes the place of all sources.
    fresh: Option<Fresh>,
    /// Takes the place of both: sets of which samples are drawn in these shares.
    mixed: Vec<(f64, Training)>,
}

enum Source {
    Held(Vec<Scenario>),
    Cached { cache: Cache, start: usize },
}

impl Training {
    /// Opens the parts, and reads those that are no cache.
    ///
    /// Error: the first record that cannot be read, a damaged index of a cache, or Ctrl-C.
    pub(crate) fn open(parts: &[Part], progress: &Progress) -> anyhow::Result<Self> {
        let (mut sources, mut end) = (Vec::new(), 0);
        for part in parts {
            let source = if Cache::is_at(&part.path)? {
                let cache = Cache::open(&part.path)?;
                let Range { start, end: stop } = part.scenes;
                end += stop.min(cache.len()).saturating_sub(start);
                Source::Cached { cache, start }
            } else {
                let held = read(std::slice::from_ref(part), progress)?;
                end += held.len();
                Source::Held(held)
            };
            sources.push((end, source));
        }
        Ok(Self {
            sources,
            fresh: None,
            mixed: Vec::new(),
        })
    }

    /// A stream, for steps of `batch` samples.
    pub(crate) fn fresh(stream: Stream, batch: usize) -> Self {
        Self {
            sources: Vec::new(),
            fresh: Some(Fresh::start(stream, batch)),
            mixed: Vec::new(),
        }
    }

    /// Samples of several sets, each with its share.
    pub(crate) fn mixed(mut sets: Vec<(f64, Self)>) -> Self {
        if sets.len() == 1 {
            return sets.remove(0).1;
        }
        Self {
            sources: Vec::new(),
            fresh: None,
            mixed: sets,
        }
    }

    /// The ids of all.
    pub(crate) fn ids(&self) -> Box<dyn Iterator<Item = &str> + '_> {
        let of_mixed = self.mixed.iter().flat_map(|(_, set)| set.ids());
        let starts = std::iter::once(0).chain(self.sources.iter().map(|(end, _)| *end));
        let sources = self.sources.iter().zip(starts);
        let own = sources.flat_map(|((end, source), begin)| {
            (0..end - begin).filter_map(move |i| match source {
                Source::Held(held) => held.as_slice().get(i).map(|scene| scene.id.as_str()),
                Source::Cached { cache, start } => cache.id(start + i),
            })
        });
        Box::new(own.chain(of_mixed))
    }
}

impl ScenarioSource for Training {
    fn len(&self) -> usize {
        let held = self.sources.last().map_or(0, |(end, _)| *end);
        let own = self.fresh.as_ref().map_or(held, Fresh::len);
        own + self.mixed.iter().map(|(_, set)| set.len()).sum::<usize>()
    }

    fn pick(&self, step: usize, draw: u64) -> usize {
        if !self.mixed.is_empty() {
            let (mut left, within) = uniform_and_rest(draw);
            left *= self.mixed.iter().map(|(share, _)| share).sum::<f64>();
            let chosen = self.mixed.iter().position(|(share, _)| {
                left -= share;
                left < 0.0
            });
            let i = chosen.unwrap_or(self.mixed.len() - 1);
            return self.mixed[i].1.pick(step, within) * self.mixed.len() + i;
        }
        match &self.fresh {
            Some(fresh) => fresh.pick(step, draw),
            None => (draw % self.len() as u64) as usize,
        }
    }

    fn get(&self, index: usize) -> Result<Cow<'_, Scenario>, ModelError> {
        if let Some(fresh) = &self.fresh {
            return fresh.get(index);
        }
        if !self.mixed.is_empty() {
            let n = self.mixed.len();
            return self.mixed[index % n].1.get(index / n);
        }
        let missing = || ModelError::Scene(format!("there is no scenario {index}"));
        let i = self.sources.partition_point(|(end, _)| *end <= index);
        let begin = i.checked_sub(1).map_or(0, |before| self.sources[before].0);
        match self.sources.get(i).map(|(_, source)| source) {
            None => Err(missing()),
            Some(Source::Held(held)) => Ok(Cow::Borrowed(&held[index - begin])),
            Some(Source::Cached { cache, start }) => {
                let found = cache.get(start + index - begin);
                let found = found.map_err(|error| ModelError::Scene(error.to_string()))?;
                found.map(Cow::Owned).ok_or_else(missing)
            }
        }
    }
}

/// A number in 0..1 from a number drawn at random, and another one drawn at random.
fn uniform_and_rest(draw: u64) -> (f64, u64) {
    let seed = Seed(draw);
    let share = (seed.fork(0).0 >> 11) as f64 / (1u64 << 53) as f64;
    (share, seed.fork(1).0)
}

/// `PATH=SHARE` as a path and a share; a path alone has 1.
pub(crate) fn with_share(named: &Path) -> (PathBuf, f64) {
    let split = named.to_str().and_then(|text| text.rsplit_once('='));
    let share = split.and_then(|(path, share)| Some((path, share.parse::<f64>().ok()?)));
    match share {
        Some((path, share)) if share.is_finite() && share > 0.0 => (path.into(), share),
        _ => (named.to_owned(), 1.0),
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use sha2::{Digest, Sha256};

    use super::*;
    use crate::machine::repository;

    #[test]
    fn the_mini_set_is_as_its_manifest_says() {
        let folder = repository().join("datasets/mini");
        let manifest = Manifest::of(&folder).unwrap().unwrap();
        assert_eq!(manifest.name, "mini");
        assert!(manifest.provenance.contains("cargo xtask data synthesize"));
        assert_eq!(manifest.licence, "Apache-2.0");
        let silent = Progress::begin(true, "", 0, "");
        for file in &manifest.files {
            let is_ours = file.licence.is_none() || file.licence.as_deref() == Some("Apache-2.0");
            assert!(is_ours || file.notice.is_some(), "{}", file.path.display());
            let made = file.provenance.as_ref();
            assert!(made.is_none_or(|how| how.starts_with("cargo xtask data ")));
            let path = folder.join(&file.path);
            let digest = Sha256::digest(std::fs::read(&path).unwrap());
            let digest: String = digest.iter().map(|byte| format!("{byte:02x}")).collect();
            assert_eq!(digest, file.sha256, "{}", path.display());
            let all = read(&[Part::whole(&path)], &silent).unwrap();
            assert_eq!(all.len(), file.scenes);
        }
        let of = |split| {
            let scenes = read(&parts(&folder, split).unwrap(), &silent).unwrap();
            scenes.into_iter().map(|scene| scene.id).collect::<Vec<_>>()
        };
        let [train, tune, test] = Split::ALL.map(of);
        assert_eq!((train.len(), tune.len(), test.len()), (55, 36, 22));
        // The ids of SUMO's scenes are NETWORK-RUN-WINDOW-EGO, those of NGSIM USA_NETWORK-PLACE_...
        let network = |id: &String| {
            if let Some((name, _)) = id.strip_prefix("USA_").and_then(|id| id.split_once('-')) {
                return Some(name.to_lowercase());
            }
            let mut parts = id.rsplitn(4, '-');
            let is_numbered = parts.by_ref().take(3).all(|p| p.parse::<u32>().is_ok());
            let name = parts.next().filter(|_| is_numbered);
            name.map(str::to_owned)
        };
        let networks = |ids: &[String]| ids.iter().filter_map(network).collect::<BTreeSet<_>>();
        let [a, b, c] = [&train, &tune, &test].map(|ids| networks(ids));
        assert!(a.contains("berlin-doerpfeldstr") && c.contains("tavf-hamburg"));
        assert!(a.contains("us101") && b.contains("lanker") && c.contains("peach"));
        for (one, other) in [(&a, &b), (&a, &c), (&b, &c)] {
            assert!(one.is_disjoint(other), "{one:?} and {other:?}");
        }
        let all: BTreeSet<_> = train.iter().chain(&tune).chain(&test).collect();
        assert_eq!(all.len(), 113, "every scene has an id of its own");
    }

    #[test]
    fn a_path_without_a_manifest_is_all_for_training() {
        let folder = tempfile::tempdir().unwrap();
        let whole = Part::whole(folder.path());
        assert_eq!(parts(folder.path(), Split::Train).unwrap(), [whole]);
        assert!(parts(folder.path(), Split::Tune).unwrap().is_empty());
    }

    #[test]
    fn scenes_of_a_cache_and_of_a_file_have_the_same_numbers() {
        let folder = tempfile::tempdir().unwrap();
        let named = |id: &usize| Scenario {
            id: id.to_string(),
            ..gump_scene::fixture::scenario("lane 1: 0,0 99,0\nego vehicle 0: 0,0").unwrap()
        };
        let ids: Vec<usize> = (0..7).collect();
        let [file, shard] = ["file.tfrecord", "shard"].map(|name| folder.path().join(name));
        gump_data::womd::write_scenarios(&file, ids.iter().map(named)).unwrap();
        gump_data::cache::write_shard(&shard, ids.iter().map(named)).unwrap();
        let part = |path: &Path, scenes| Part {
            path: path.to_owned(),
            scenes,
        };
        let silent = Progress::begin(true, "", 0, "");
        let numbers = |parts: &[Part]| {
            let scenes = Training::open(parts, &silent).unwrap();
            let ids: Vec<&str> = scenes.ids().collect();
            let read = (0..scenes.len()).map(|i| scenes.get(i).unwrap().id.clone());
            assert_eq!(ids, read.collect::<Vec<_>>());
            let id = |i| scenes.get(i).unwrap().id.clone();
            assert!(scenes.get(scenes.len()).is_err());
            (0..scenes.len()).map(id).collect::<Vec<_>>().join("")
        };
        let parts = [part(&shard, 2..4), part(&file, 1..3), part(&shard, 5..99)];
        assert_eq!(numbers(&parts), "231256");
        assert_eq!(numbers(&[Part::whole(&shard)]), "0123456");
        assert_eq!(numbers(&[Part::whole(&file)]), "0123456");
    }
}
