//! Scenarios by name: a file, a folder, or the split of a list, `LIST.toml#SPLIT`.

use std::convert::Infallible;
use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use gump_data::{DataError, ReadOptions, Reader};
use serde::{Serialize, Serializer};

use super::{BenchmarkList, verify_generated, verify_recorded};
use crate::datasets::Split;
use crate::{BenchmarkError, EvalError, Monitor};

/// Scenarios by name: `PATH`, or `LIST.toml#SPLIT`.
#[derive(Clone, Debug, PartialEq)]
pub struct ScenarioSetName(String);

/// The files of some scenarios, and the name of their set.
#[derive(Clone, Debug, PartialEq)]
pub struct ScenarioSet {
    /// Its name in results: [`BenchmarkList::set`], otherwise the name of the file or folder.
    pub name: String,
    /// One file or folder; of a list the files of its scenes.
    pub paths: Vec<PathBuf>,
}

/// Folders of the scenes of lists.
#[derive(Clone, Debug, PartialEq)]
pub struct BenchmarkFolders {
    /// The folder of generated scenes, with one folder per list.
    pub generated: PathBuf,
    /// The folder of recorded data.
    pub recorded: PathBuf,
}

impl ScenarioSetName {
    /// The list and the requested split; `None` if it is not a list.
    fn list(&self) -> Option<(&Path, Option<&str>)> {
        let (path, split) = match self.0.rsplit_once('#') {
            Some((path, split)) => (path, Some(split)),
            None => (&*self.0, None),
        };
        path.ends_with(".toml").then(|| (Path::new(path), split))
    }

    /// Finds the scenarios; those of a list are verified against its checksums.
    ///
    /// # Errors
    /// A file that is not a list, a split that the list does not have, or scenes that are missing
    /// or differ. A path that is not a list is not checked.
    pub fn find(
        &self,
        folders: &BenchmarkFolders,
        monitor: &dyn Monitor,
    ) -> Result<ScenarioSet, EvalError> {
        self.find_for(None, folders, monitor)
    }

    /// As [`Self::find`], but a list without `#SPLIT` that has several splits stands for its split
    /// `purpose`.
    ///
    /// # Errors
    /// As [`Self::find`].
    pub fn find_for(
        &self,
        purpose: Option<Split>,
        folders: &BenchmarkFolders,
        monitor: &dyn Monitor,
    ) -> Result<ScenarioSet, EvalError> {
        match self.list() {
            Some((path, split)) => find_listed(path, (split, purpose), folders, monitor),
            None => Ok(ScenarioSet::of_path(Path::new(&self.0))),
        }
    }
}

fn find_listed(
    path: &Path,
    (split, purpose): (Option<&str>, Option<Split>),
    folders: &BenchmarkFolders,
    monitor: &dyn Monitor,
) -> Result<ScenarioSet, EvalError> {
    let list = BenchmarkList::read(path)?;
    let split = choose(&list, split, purpose)?;
    let mut paths = Vec::new();
    for part in list.generated.iter().filter(|part| part.split == split) {
        let file = list.file(&folders.generated, part);
        if !file.is_file() {
            return Err(BenchmarkError::NotMade {
                name: list.name,
                path: file,
                list: path.to_owned(),
            }
            .into());
        }
        verify_generated(&list, part, &folders.generated, monitor)?;
        paths.push(file);
    }
    for part in list.recorded.iter().filter(|part| part.split == split) {
        paths.extend(verify_recorded(&list, part, &folders.recorded, monitor)?);
    }
    let name = list.set(split);
    Ok(ScenarioSet { name, paths })
}

/// The requested split, or the only one, or that of the purpose.
fn choose(
    list: &BenchmarkList,
    requested: Option<&str>,
    purpose: Option<Split>,
) -> Result<Split, EvalError> {
    let splits = list.splits();
    let found = match (requested, &splits[..]) {
        (Some(name), _) => splits.iter().find(|split| split.name() == name).copied(),
        (None, [only]) => Some(*only),
        (None, _) => purpose.filter(|split| splits.contains(split)),
    };
    found.ok_or_else(|| {
        BenchmarkError::NoSuchSplit {
            list: list.path().to_owned(),
            expected: splits,
            found: requested.map(str::to_owned),
        }
        .into()
    })
}

impl ScenarioSet {
    /// The scenarios at a path; the set has the name of the file or folder.
    pub fn of_path(path: &Path) -> Self {
        let name = path.file_name().unwrap_or(path.as_os_str());
        Self {
            name: name.to_string_lossy().into_owned(),
            paths: vec![path.to_owned()],
        }
    }

    /// Reads them one by one.
    ///
    /// # Errors
    /// Nothing there to read.
    pub fn open(&self, options: ReadOptions) -> Result<Reader, DataError> {
        match &self.paths[..] {
            [path] => gump_data::open_with(path, options),
            paths => Ok(gump_data::open_files(paths.to_vec(), options)),
        }
    }
}

impl FromStr for ScenarioSetName {
    type Err = Infallible;

    fn from_str(text: &str) -> Result<Self, Infallible> {
        Ok(Self(text.into()))
    }
}

impl fmt::Display for ScenarioSetName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl Serialize for ScenarioSetName {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(&self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::benchmarks::tests::repository;

    fn folders() -> BenchmarkFolders {
        BenchmarkFolders {
            generated: "nowhere".into(),
            recorded: repository().join("../shared/data"),
        }
    }

    fn find(text: &str) -> Result<ScenarioSet, String> {
        let name: ScenarioSetName = text.parse().unwrap();
        name.find(&folders(), &())
            .map_err(|error| error.to_string())
    }

    #[test]
    fn a_path_is_taken_as_it_is_and_names_its_set() {
        let found = find("a/b.tfrecord.gz").unwrap();
        assert_eq!(found.name, "b.tfrecord.gz");
        assert_eq!(found.paths, [PathBuf::from("a/b.tfrecord.gz")]);
    }

    #[test]
    fn lists_say_which_splits_they_have_and_how_scenes_are_made() {
        let list = |name: &str| {
            let path = repository().join(format!("datasets/benchmarks/{name}"));
            path.display().to_string()
        };
        let error = find(&list("recorded.toml")).unwrap_err();
        assert!(
            error.contains("#SPLIT with train or tune or test"),
            "{error}"
        );
        let error = find(&list("recorded.toml#nonsense")).unwrap_err();
        assert!(
            error.contains("found") && error.contains("#nonsense"),
            "{error}"
        );
        let error = find(&list("synthetic-test.toml#tune")).unwrap_err();
        assert!(error.contains("#SPLIT with test"), "{error}");
        let nowhere = BenchmarkFolders {
            recorded: "nowhere".into(),
            ..folders()
        };
        let error = |name: &str, split| {
            let path = list(name);
            let found = find_listed(Path::new(&path), (split, None), &nowhere, &());
            found.unwrap_err().to_string()
        };
        let message = error("synthetic-test.toml", None);
        assert!(message.contains("data benchmark --list"), "{message}");
        let message = error("recorded.toml", Some("test"));
        assert!(message.contains("GUMP_RECORDED"), "{message}");
    }

    #[test]
    fn a_purpose_chooses_among_the_splits_of_a_list() {
        let list = |name: &str| {
            let path = repository().join(format!("datasets/benchmarks/{name}.toml"));
            BenchmarkList::read(&path).unwrap()
        };
        let (learning, testing) = (list("learning-dense"), list("planning-hard"));
        let chosen = |list, requested, purpose| choose(list, requested, purpose).ok();
        let (train, test) = (Some(Split::Train), Some(Split::Test));
        assert_eq!(chosen(&learning, None, train), train);
        assert_eq!(chosen(&learning, None, test), test);
        assert_eq!(chosen(&learning, Some("test"), train), test);
        assert_eq!(chosen(&learning, None, Some(Split::Tune)), None);
        assert_eq!(chosen(&learning, None, None), None);
        assert_eq!(chosen(&testing, None, train), test);
        assert_eq!(chosen(&testing, Some("train"), train), None);
    }

    #[test]
    fn recorded_scenes_are_read_in_the_order_of_the_list() {
        let path = repository().join("datasets/benchmarks/recorded.toml");
        if !folders().recorded.exists() {
            eprintln!("SKIPPED: no recorded data beside the checkout");
            return;
        }
        let found = find(&format!("{}#test", path.display())).unwrap();
        assert_eq!(found.name, "recorded/test");
        let list = BenchmarkList::read(&path).unwrap();
        let parts = list
            .recorded
            .iter()
            .filter(|part| part.split == Split::Test);
        let listed = parts.flat_map(|part| &part.scenes);
        let listed: Vec<&str> = listed
            .map(|line| line.rsplit_once(' ').unwrap().1)
            .collect();
        let read = found.open(ReadOptions::STATED).unwrap();
        let read: Vec<String> = read.map(|record| record.unwrap().scenario.id).collect();
        assert_eq!(read, listed);
    }
}
