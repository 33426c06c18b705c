//! What `--scenarios` takes: a file, a folder, or the split of a list, `LIST.toml#SPLIT`.

use std::convert::Infallible;
use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use gump_data::{DataError, ReadOptions, Reader};
use serde::{Serialize, Serializer};

use super::{List, check, check_recorded, recorded_data};
use crate::dataset::Split;

/// Where `data benchmark` puts what it makes, unless told otherwise.
const MADE: &str = "out/data-benchmark";

/// Scenarios as they are asked for.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Scenes(String);

/// Scenarios as they were found.
#[derive(Debug)]
pub(crate) struct Found {
    /// What results call them: [`List::set`], else the name of the file or folder.
    pub(crate) set: String,
    /// One file or folder; of a list the files of its scenes.
    pub(crate) paths: Vec<PathBuf>,
}

impl Scenes {
    /// The list and the split asked for; `None` if it is none that is named.
    fn list(&self) -> Option<(&Path, Option<&str>)> {
        let (path, split) = match self.0.rsplit_once('#') {
            Some((path, split)) => (path, Some(split)),
            None => (&*self.0, None),
        };
        path.ends_with(".toml").then(|| (Path::new(path), split))
    }

    /// Looks for the scenarios; those of a list are held to its sums.
    ///
    /// Error: a list that is none, a split that it does not have, or scenes that are missing or
    /// differ. Of another file or folder, only reading it tells.
    pub(crate) fn find(&self) -> anyhow::Result<Found> {
        match self.list() {
            Some((path, split)) => find_listed(path, split, &recorded_data(), Path::new(MADE)),
            None => Ok(Found::path(Path::new(&self.0))),
        }
    }
}

fn find_listed(
    path: &Path,
    split: Option<&str>,
    data: &Path,
    made: &Path,
) -> anyhow::Result<Found> {
    let list = List::read(path)?;
    let split = choose(&list, split)?;
    let mut paths = Vec::new();
    for part in list.made.iter().filter(|part| part.split == split) {
        let file = list.file(made, part);
        anyhow::ensure!(
            file.is_file(),
            "expected scenes of the list {} at {}, found none: \
             `cargo xtask data benchmark --list {}` makes them",
            list.name,
            file.display(),
            path.display()
        );
        check(&list, part, made)?;
        paths.push(file);
    }
    for part in list.recorded.iter().filter(|part| part.split == split) {
        paths.extend(check_recorded(&list, part, data)?);
    }
    let set = list.set(split);
    Ok(Found { set, paths })
}

/// The split asked for, or the only one.
fn choose(list: &List, asked: Option<&str>) -> anyhow::Result<Split> {
    let splits = list.splits();
    let names: Vec<&str> = splits.iter().map(|split| split.name()).collect();
    let found = match (asked, &splits[..]) {
        (Some(name), _) => splits.iter().find(|split| split.name() == name).copied(),
        (None, [only]) => Some(*only),
        (None, _) => None,
    };
    let path = list.path.display();
    found.ok_or_else(|| {
        anyhow::anyhow!(
            "expected {path}#SPLIT with {}, found {path}{}",
            names.join(" or "),
            asked.map(|name| format!("#{name}")).unwrap_or_default()
        )
    })
}

impl Found {
    /// What is at a path, called by its name.
    pub(crate) fn path(path: &Path) -> Self {
        let name = path.file_name().unwrap_or(path.as_os_str());
        Self {
            set: name.to_string_lossy().into_owned(),
            paths: vec![path.to_owned()],
        }
    }

    /// Reads them one by one.
    ///
    /// Error: nothing there to read.
    pub(crate) fn open(&self, options: ReadOptions) -> Result<Reader, DataError> {
        match &self.paths[..] {
            [path] => gump_data::open_with(path, options),
            paths => Ok(gump_data::open_files(paths.to_vec(), options)),
        }
    }
}

impl FromStr for Scenes {
    type Err = Infallible;

    fn from_str(text: &str) -> Result<Self, Infallible> {
        Ok(Self(text.into()))
    }
}

impl fmt::Display for Scenes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl Serialize for Scenes {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(&self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::machine::repository;

    fn find(text: &str) -> Result<Found, String> {
        let scenes: Scenes = text.parse().unwrap();
        scenes.find().map_err(|error| format!("{error:#}"))
    }

    #[test]
    fn a_path_is_taken_as_it_is_and_names_its_set() {
        let found = find("a/b.tfrecord.gz").unwrap();
        assert_eq!(found.set, "b.tfrecord.gz");
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
        let nowhere = Path::new("nowhere");
        let path = list("synthetic-test.toml");
        let error = find_listed(Path::new(&path), None, nowhere, nowhere).unwrap_err();
        let error = format!("{error:#}");
        assert!(error.contains("data benchmark --list"), "{error}");
        let path = list("recorded.toml");
        let error = find_listed(Path::new(&path), Some("test"), nowhere, nowhere).unwrap_err();
        let error = format!("{error:#}");
        assert!(error.contains("GUMP_RECORDED"), "{error}");
    }

    #[test]
    fn recorded_scenes_are_read_in_the_order_of_the_list() {
        let path = repository().join("datasets/benchmarks/recorded.toml");
        if !recorded_data().exists() {
            eprintln!("SKIPPED: no recorded data beside the checkout");
            return;
        }
        let found = find(&format!("{}#test", path.display())).unwrap();
        assert_eq!(found.set, "recorded/test");
        let list = List::read(&path).unwrap();
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
