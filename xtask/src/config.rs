//! `--config FILE.toml`: flags from a file.
//!
//! Every scalar key at the top of the file is a long flag of the verb, so clap checks its value
//! and a flag on the command line overrides it. Tables belong to the verb itself, which reads them
//! with [`tables`] and checks them with [`check_keys`]; so do lists of tables.

use std::ffi::OsString;
use std::path::Path;

use anyhow::Context as _;
use clap::Command;
use toml::{Table, Value};

use crate::cli::WrongArguments;
use crate::words;

/// Puts the flags of the `--config` file right after the verb, before the flags given by hand, so
/// that the latter win.
///
/// Error: an unreadable file; [`WrongArguments`] for a key that is no flag of the verb.
pub(crate) fn splice(
    root: &Command,
    mut arguments: Vec<OsString>,
) -> anyhow::Result<Vec<OsString>> {
    let Some(path) = config_path(&arguments) else {
        return Ok(arguments);
    };
    let path = Path::new(&path);
    let (verb, n_words) = verb(root, &arguments);
    let flags = flags(path, &read(path)?, verb)?;
    arguments.splice(n_words..n_words, flags);
    Ok(arguments)
}

/// The tables of a config file, without the keys that are flags.
pub(crate) fn tables(path: &Path) -> anyhow::Result<Table> {
    let mut table = read(path)?;
    table.retain(|_, value| holds_keys(value));
    Ok(table)
}

/// True for a table and for a list of tables, which are the verb's own.
fn holds_keys(value: &Value) -> bool {
    match value {
        Value::Table(_) => true,
        Value::Array(items) => !items.is_empty() && items.iter().all(Value::is_table),
        _ => false,
    }
}

/// Refuses keys of `given` that `known` does not have, at any depth.
///
/// Error: [`WrongArguments`] with the nearest known key.
pub(crate) fn check_keys(path: &Path, given: &Table, known: &Table) -> anyhow::Result<()> {
    for (key, value) in given {
        match (value, known.get(key)) {
            (_, None) => {
                return Err(unknown_key(path, key, known.keys().map(String::as_str)));
            }
            (Value::Table(given), Some(Value::Table(known))) => check_keys(path, given, known)?,
            _ => {}
        }
    }
    Ok(())
}

/// The value after `--config`, if it is there.
fn config_path(arguments: &[OsString]) -> Option<OsString> {
    let mut words = arguments.iter().take_while(|word| *word != "--");
    while let Some(word) = words.next() {
        if word == "--config" {
            return words.next().cloned();
        }
        if let Some(path) = word
            .to_str()
            .and_then(|word| word.strip_prefix("--config="))
        {
            return Some(path.into());
        }
    }
    None
}

/// The command that the first words name, and how many words that are, the program included.
fn verb<'a>(root: &'a Command, arguments: &[OsString]) -> (&'a Command, usize) {
    let mut command = root;
    let mut n_words = 1;
    while let Some(next) = arguments
        .get(n_words)
        .and_then(|word| command.find_subcommand(word))
    {
        command = next;
        n_words += 1;
    }
    (command, n_words)
}

fn read(path: &Path) -> anyhow::Result<Table> {
    let text = std::fs::read_to_string(path)
        .with_context(|| format!("cannot read the config file {}", path.display()))?;
    text.parse::<Table>().map_err(|error| {
        let message = error.message().trim().replace('\n', ", ");
        let line = error
            .span()
            .map_or(1, |span| text[..span.start].matches('\n').count() + 1);
        WrongArguments(format!("{}, line {line}: {message}", path.display())).into()
    })
}

fn flags(path: &Path, table: &Table, verb: &Command) -> anyhow::Result<Vec<OsString>> {
    let known: Vec<&str> = verb
        .get_arguments()
        .filter(|argument| !argument.is_hide_set())
        .filter_map(|argument| argument.get_long_and_visible_aliases())
        .flatten()
        .filter(|name| !["config", "help", "version"].contains(name))
        .collect();
    let mut flags = Vec::new();
    for (key, value) in table {
        // TOML habit writes top_k where a flag is --top-k; both are understood.
        let name = key.replace('_', "-");
        if holds_keys(value) {
            continue;
        }
        // A former name stays as it is, so that the command line says what it is now.
        if !known.contains(&words::present_name(&name)) {
            return Err(unknown_key(path, key, known.iter().copied()));
        }
        match value {
            Value::Boolean(false) => {}
            Value::Boolean(true) => flags.push(format!("--{name}").into()),
            Value::String(text) => flags.push(format!("--{name}={text}").into()),
            Value::Integer(_) | Value::Float(_) => flags.push(format!("--{name}={value}").into()),
            Value::Table(_) | Value::Array(_) | Value::Datetime(_) => {
                let found = value.type_str();
                return Err(WrongArguments(format!(
                    "{}: {key} is a {found}, expected a number, a string or true/false",
                    path.display()
                ))
                .into());
            }
        }
    }
    Ok(flags)
}

fn unknown_key<'a>(path: &Path, key: &str, known: impl Iterator<Item = &'a str>) -> anyhow::Error {
    let hint = nearest(key, known).map_or(String::new(), |near| format!("; did you mean {near}?"));
    WrongArguments(format!("{}: unknown key {key}{hint}", path.display())).into()
}

/// The known word with the smallest edit distance; the first of equals.
fn nearest<'a>(word: &str, known: impl Iterator<Item = &'a str>) -> Option<&'a str> {
    known.min_by_key(|candidate| edit_distance(word, candidate))
}

/// Levenshtein distance over bytes, with `_` and `-` taken as equal.
fn edit_distance(a: &str, b: &str) -> usize {
    let plain = |word: &str| word.replace('_', "-").into_bytes();
    strsim::generic_levenshtein(&plain(a), &plain(b))
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Arg;

    fn command() -> Command {
        let simulate = Command::new("simulate")
            .arg(Arg::new("futures").long("futures"))
            .arg(Arg::new("top-k").long("top-k"))
            .arg(Arg::new("config").long("config"));
        Command::new("xtask").subcommand(simulate)
    }

    fn spliced(file: &str) -> Result<String, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("c.toml");
        std::fs::write(&path, file).unwrap();
        let arguments = ["xtask", "simulate", "--futures=4", "--config"].map(OsString::from);
        let mut arguments = arguments.to_vec();
        arguments.push(path.into());
        let words = splice(&command(), arguments).map_err(|error| error.to_string())?;
        let words: Vec<_> = words[..words.len() - 1]
            .iter()
            .map(|word| word.to_string_lossy())
            .collect();
        Ok(words.join(" "))
    }

    #[test]
    fn keys_become_flags_before_those_given_by_hand() {
        assert_eq!(
            spliced("futures = 8\ntop_k = 3\n[model]\nlayers = 2").unwrap(),
            "xtask simulate --futures=8 --top-k=3 --futures=4 --config"
        );
    }

    #[test]
    fn an_unknown_key_is_refused_with_the_nearest() {
        let error = spliced("futurs = 8").unwrap_err();
        assert!(
            error.ends_with("unknown key futurs; did you mean futures?"),
            "{error}"
        );
    }

    #[test]
    fn broken_toml_names_the_line() {
        let error = spliced("futures = 8\ntop_k = = 3").unwrap_err();
        assert!(error.contains("line 2"), "{error}");
    }

    #[test]
    fn tables_are_checked_at_depth() {
        let known: Table = "[model]\nlayers = 1\nwidth = 2".parse().unwrap();
        let given: Table = "[model]\nlayer = 1".parse().unwrap();
        let error = check_keys(Path::new("c.toml"), &given, &known).unwrap_err();
        assert_eq!(
            error.to_string(),
            "c.toml: unknown key layer; did you mean layers?"
        );
    }

    #[test]
    fn edit_distances() {
        assert_eq!(edit_distance("kitten", "sitting"), 3);
        assert_eq!(edit_distance("top_k", "top-k"), 0);
    }
}
