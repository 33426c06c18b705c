//! Data sets with splits: a folder with a `manifest.toml`, or any path for a set without.
//!
//! [`parts`] lists the files of a split, [`read`] reads their scenarios. Frozen test sets are in
//! [`benchmarks`](crate::benchmarks).

use std::ops::Range;
use std::path::{Path, PathBuf};

use gump_scene::Scenario;
use serde::{Deserialize, Serialize};

use crate::{EvalError, Monitor};

/// `manifest.toml`: contents, source and licence of a data set.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[non_exhaustive]
pub struct Manifest {
    /// The name of the set.
    pub name: String,
    /// An SPDX expression.
    pub licence: String,
    /// Origin of the files.
    pub provenance: String,
    /// Its files.
    #[serde(rename = "file")]
    pub files: Vec<ManifestFile>,
}

/// A file of a data set.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[non_exhaustive]
pub struct ManifestFile {
    /// Path from the manifest.
    pub path: PathBuf,
    /// Number of its scenes.
    pub scenes: usize,
    /// Lower-case hexadecimal.
    pub sha256: String,
    /// An SPDX expression, where it is not that of the set.
    pub licence: Option<String>,
    /// Origin, if it differs from that of the set.
    pub provenance: Option<String>,
    /// Notice that must be passed on with it.
    pub notice: Option<String>,
    /// Assignment of its scenes to splits.
    pub split: SplitRanges,
}

/// Indices of the scenes of each split: the first, and the one after the last.
#[derive(Clone, Copy, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SplitRanges {
    /// Of [`Split::Train`].
    pub train: [usize; 2],
    /// Of [`Split::Tune`].
    #[serde(alias = "validation")]
    pub tune: [usize; 2],
    /// Of [`Split::Test`].
    pub test: [usize; 2],
}

/// Purpose of scenes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Deserialize, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Split {
    /// Training of weights.
    Train,
    /// Choice of weights, temperatures and rules.
    Tune,
    /// Final evaluation; nothing is chosen on them.
    Test,
}

impl Split {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Train, Self::Tune, Self::Test];

    /// Its name in lists and results.
    pub fn name(self) -> &'static str {
        match self {
            Self::Train => "train",
            Self::Tune => "tune",
            Self::Test => "test",
        }
    }
}

/// Scenes of one file or folder.
#[derive(Clone, Debug, PartialEq)]
pub struct Part {
    /// The file or folder.
    pub path: PathBuf,
    /// Indices of the scenes.
    pub scenes: Range<usize>,
}

impl Part {
    /// All scenes of a path.
    pub fn whole(path: &Path) -> Self {
        Self {
            path: path.to_owned(),
            scenes: 0..usize::MAX,
        }
    }
}

impl Manifest {
    /// Reads the manifest of a folder; `None` if it has none.
    ///
    /// # Errors
    /// A manifest that cannot be read or understood.
    pub fn of(folder: &Path) -> Result<Option<Self>, EvalError> {
        let path = folder.join("manifest.toml");
        if !path.is_file() {
            return Ok(None);
        }
        let text =
            std::fs::read_to_string(&path).map_err(|cause| EvalError::io("read", &path, cause))?;
        let manifest = toml::from_str(&text).map_err(|cause| EvalError::Dataset {
            path,
            cause: Box::new(cause),
        })?;
        Ok(Some(manifest))
    }
}

/// The files and scenes of a split; without a manifest, all scenes of a path are for training.
///
/// # Errors
/// A manifest that cannot be read.
pub fn parts(data: &Path, split: Split) -> Result<Vec<Part>, EvalError> {
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

/// Reads the scenarios of the parts; the monitor counts scenarios.
///
/// # Errors
/// The first record that cannot be read, or [`EvalError::Stopped`].
pub fn read(parts: &[Part], monitor: &dyn Monitor) -> Result<Vec<Scenario>, EvalError> {
    read_first(usize::MAX, parts, monitor)
}

/// Reads the first `limit` scenarios of the parts.
///
/// # Errors
/// As [`read`].
pub fn read_first(
    limit: usize,
    parts: &[Part],
    monitor: &dyn Monitor,
) -> Result<Vec<Scenario>, EvalError> {
    let mut scenarios = Vec::new();
    for part in parts {
        let records = gump_data::open(&part.path)?;
        let Range { start, end } = part.scenes;
        for record in records.take(end).skip(start) {
            if scenarios.len() == limit {
                return Ok(scenarios);
            }
            monitor.check()?;
            scenarios.push(record?.scenario);
            monitor.advance(1);
        }
    }
    Ok(scenarios)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::digest;

    #[test]
    fn the_mini_set_is_as_its_manifest_says() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../datasets/mini");
        let manifest = Manifest::of(&folder).unwrap().unwrap();
        assert_eq!(manifest.name, "mini");
        assert!(manifest.provenance.contains("cargo xtask data synthesize"));
        assert_eq!(manifest.licence, "Apache-2.0");
        for file in &manifest.files {
            let is_ours = file.licence.is_none() || file.licence.as_deref() == Some("Apache-2.0");
            assert!(is_ours || file.notice.is_some(), "{}", file.path.display());
            let provenance = file.provenance.as_ref();
            assert!(provenance.is_none_or(|how| how.starts_with("cargo xtask data ")));
            let path = folder.join(&file.path);
            let digest = digest::of_bytes(&std::fs::read(&path).unwrap());
            assert_eq!(digest, file.sha256, "{}", path.display());
            let all = read(&[Part::whole(&path)], &()).unwrap();
            assert_eq!(all.len(), file.scenes);
        }
        let of = |split| {
            let scenes = read(&parts(&folder, split).unwrap(), &()).unwrap();
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
}
