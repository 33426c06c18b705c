//! Training stages: a run has one stage, or several that continue each other.
//!
//! In the file, `[train]` holds for all stages, and each `[[stage]]` overrides it: `data` (a folder
//! in `--data`, a stream `fresh:PROFILE`, or a list of those, each with `=SHARE` if samples are not
//! drawn equally from all), `stop_at` and `[stage.train]`.

use std::path::{Path, PathBuf};

use gump_eval::fresh::PREFIX;
use gump_model::ModelConfig;
use gump_train::{ClosedLoopConfig, RunConfig, TrainConfig};
use serde::Serialize;
use serde::de::DeserializeOwned;
use toml::{Table, Value};

use super::{Args, check_batch};
use crate::cli::WrongArguments;
use crate::run::print_error;
use crate::{config, words};

/// What the names of the folders of stages begin with; a number follows.
pub(super) const FOLDER: &str = "stage-";

/// A part of a run with a separate schedule.
#[derive(Debug)]
pub(super) struct Stage<C = RunConfig> {
    pub(super) config: C,
    /// Sources of training data, each with `=SHARE` if the shares are not equal.
    pub(super) data: Vec<PathBuf>,
    /// The stages whose weights it begins with the mean of, 0 being those of `--from`; without, the one
    /// before.
    pub(super) from: Option<Vec<usize>>,
    pub(super) files: Files,
}

/// Last step and files of a stage.
#[derive(Debug)]
pub(super) struct Files {
    /// The step to stop after.
    pub(super) stop_at: usize,
    /// Folder of its files, relative to the folder of the run.
    folder: PathBuf,
}

impl Files {
    /// Whether they are those of the run, which has no stages.
    pub(super) fn is_of_the_run(&self) -> bool {
        self.folder.as_os_str().is_empty()
    }

    /// Path of a file of the stage, relative to the folder of the run.
    pub(super) fn path(&self, name: &str) -> String {
        self.folder.join(name).display().to_string()
    }
}

impl Args {
    /// The stages as flags and file describe them.
    ///
    /// Error: [`WrongArguments`] for a key that does not exist or does not fit.
    pub(super) fn stages(&self) -> anyhow::Result<Vec<Stage>> {
        self.stages_of(&known_keys()?, |table| self.config(table))
    }

    /// The stages, whose configurations are read from tables with the keys of `known`.
    ///
    /// Error: [`WrongArguments`] for a key that does not exist or does not fit.
    pub(super) fn stages_of<C>(
        &self,
        known: &Table,
        config: impl Fn(&Table) -> anyhow::Result<C>,
    ) -> anyhow::Result<Vec<Stage<C>>> {
        let mut table = match &self.common.config {
            Some(path) => config::tables(path)?,
            None => Table::new(),
        };
        let notes = words::rename_former_keys(&mut table);
        notes.iter().for_each(|note| print_error(note));
        let stages = match table.remove("stage") {
            Some(Value::Array(stages)) => stages,
            _ => Vec::new(),
        };
        let path = self.common.config.as_deref().unwrap_or(Path::new(""));
        config::check_keys(path, &table, known)?;
        if let Some(name) = &self.model {
            table.insert("model".into(), name.clone().into());
        }
        table.entry("model").or_insert_with(|| "tiny".into());
        if stages.is_empty() {
            return Ok(vec![Stage {
                config: config(&table)?,
                data: vec![self.data.clone()],
                from: None,
                files: Files {
                    stop_at: self.stop_at.unwrap_or(usize::MAX),
                    folder: PathBuf::new(),
                },
            }]);
        }
        if self.stop_at.is_some() {
            let wrong = "--stop-at: the configuration says where each of its stages stops";
            return Err(WrongArguments(wrong.into()).into());
        }
        let mut known = known.clone();
        if known.contains_key("weights") {
            known.insert("from".into(), Value::Array(Vec::new()));
        }
        for of_the_run in ["model", "relative", "weights"] {
            known.remove(of_the_run);
        }
        known.insert("data".into(), "".into());
        known.insert("stop_at".into(), 1.into());
        let stages = stages.into_iter().enumerate().map(|(i, stage)| {
            let Value::Table(mut stage) = stage else {
                unreachable!("the file was checked to hold tables")
            };
            config::check_keys(path, &stage, &known)?;
            let mut table = table.clone();
            if let Some(train) = stage.remove("train") {
                merge(&mut table, Table::from_iter([("train".to_owned(), train)]));
            }
            Ok(Stage {
                config: config(&table)?,
                data: self.data_of(path, stage.get("data"))?,
                from: match stage.get("from") {
                    None => None,
                    Some(from) => Some(stages_before(path, i + 1, from)?),
                },
                files: Files {
                    stop_at: match stage.get("stop_at") {
                        Some(Value::Integer(step)) if *step > 0 => *step as usize,
                        None => usize::MAX,
                        Some(other) => return Err(wrong(path, "stop_at", "a step", other)),
                    },
                    folder: format!("{FOLDER}{}", i + 1).into(),
                },
            })
        });
        stages.collect()
    }

    /// The sources of training data of a stage.
    fn data_of(&self, path: &Path, data: Option<&Value>) -> anyhow::Result<Vec<PathBuf>> {
        let one = |data: &Value| match data {
            Value::String(stream) if stream.starts_with(PREFIX) => Ok(stream.into()),
            Value::String(folder) => Ok(self.data.join(folder)),
            other => Err(wrong(path, "data", "a folder or a list of folders", other)),
        };
        match data {
            None => Ok(vec![self.data.clone()]),
            Some(Value::Array(all)) if !all.is_empty() => all.iter().map(one).collect(),
            Some(data) => Ok(vec![one(data)?]),
        }
    }

    fn config(&self, table: &Table) -> anyhow::Result<RunConfig> {
        let wrong = |error: String| WrongArguments(error.trim().replace('\n', " "));
        let mut config =
            RunConfig::from_toml(&table.to_string()).map_err(|error| wrong(error.to_string()))?;
        config.train.steps = self.steps.unwrap_or(config.train.steps);
        config.train.batch = self.batch.unwrap_or(config.train.batch);
        check_batch(config.train.batch)?;
        config.train.seed = self.common.seed.unwrap_or(config.train.seed);
        let checked = config.model().and_then(|model| Ok(model.validate()?));
        checked
            .and_then(|()| config.train.validate(1))
            .map_err(|error| wrong(error.to_string()))?;
        Ok(config)
    }
}

/// Numbers of stages before stage `i`, at least one.
fn stages_before(path: &Path, i: usize, from: &Value) -> anyhow::Result<Vec<usize>> {
    let number = |value: &Value| value.as_integer().and_then(|n| usize::try_from(n).ok());
    let numbers = from.as_array().into_iter().flatten();
    let numbers: Option<Vec<usize>> = numbers.map(number).collect();
    let numbers = numbers.filter(|all| !all.is_empty() && all.iter().all(|n| *n < i));
    numbers.ok_or_else(|| {
        wrong(
            path,
            "from",
            &format!("a list of stages, 0 to {}", i - 1),
            from,
        )
    })
}

fn wrong(path: &Path, key: &str, expected: &str, found: &Value) -> anyhow::Error {
    let what = format!("{}: {key} is {found}, expected {expected}", path.display());
    WrongArguments(what).into()
}

/// Puts the keys of `changes` into `table`, at any depth.
fn merge(table: &mut Table, changes: Table) {
    for (key, change) in changes {
        match (table.get_mut(&key), change) {
            (Some(Value::Table(old)), Value::Table(new)) => merge(old, new),
            (_, change) => {
                table.insert(key, change);
            }
        }
    }
}

fn known_keys() -> anyhow::Result<Table> {
    let mut known = Table::new();
    let mut model = Table::try_from(ModelConfig::tiny())?;
    // Weights store these two under their former names; files may have either.
    model.insert("local_context".into(), true.into());
    model.insert("local_frame".into(), true.into());
    known.insert("model".into(), model.into());
    let train = TrainConfig {
        ema: Some(0.0),
        closed_loop: Some(ClosedLoopConfig::default()),
        ..TrainConfig::default()
    };
    known.insert("train".into(), Table::try_from(train)?.into());
    Ok(known)
}

/// The first key in which two configurations differ, with both values.
pub(super) fn difference<C: Serialize + DeserializeOwned>(
    requested: &C,
    begun: &C,
) -> anyhow::Result<Option<String>> {
    // Through JSON, as a checkpoint holds it, so that no number differs by its last digit.
    let requested: C = serde_json::from_str(&serde_json::to_string(requested)?)?;
    let tables = [Table::try_from(&requested)?, Table::try_from(begun)?];
    Ok(first_difference(&tables[0], &tables[1]))
}

fn first_difference(requested: &Table, begun: &Table) -> Option<String> {
    let keys = requested.keys().chain(begun.keys());
    let mut differ = keys.filter(|&key| requested.get(key) != begun.get(key));
    let key = differ.next()?;
    let text = |value: Option<&Value>| value.map_or("nothing".into(), Value::to_string);
    match (requested.get(key), begun.get(key)) {
        (Some(Value::Table(requested)), Some(Value::Table(begun))) => {
            first_difference(requested, begun)
        }
        (requested, begun) => Some(format!(
            "{key} is {}, the run to resume began with {}",
            text(requested),
            text(begun)
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn changes_go_as_deep_as_they_are() {
        let mut table: Table =
            "[train]\nbatch = 4\n[train.sample]\nlateral_perturbation = 0.6\nframes = 5"
                .parse()
                .unwrap();
        merge(
            &mut table,
            "[train.sample]\nlateral_perturbation = 0.0"
                .parse()
                .unwrap(),
        );
        let expected = "[train]\nbatch = 4\n[train.sample]\nlateral_perturbation = 0.0\nframes = 5";
        assert_eq!(table, expected.parse().unwrap());
    }

    #[test]
    fn the_first_difference_is_named() {
        let begun = TrainConfig::default();
        let mut requested = begun.clone();
        assert_eq!(difference(&requested, &begun).unwrap(), None);
        requested.sample.lateral_perturbation = 0.5;
        let message = difference(&requested, &begun).unwrap().unwrap();
        assert_eq!(
            message,
            "lateral_perturbation is 0.5, the run to resume began with 0.0"
        );
        requested = begun.clone();
        requested.ema = Some(0.9);
        let message = difference(&requested, &begun).unwrap().unwrap();
        assert_eq!(message, "ema is 0.9, the run to resume began with nothing");
    }
}
