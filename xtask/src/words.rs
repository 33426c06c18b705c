//! The words of the command line that verbs share: one flag for one thing, whatever the verb calls
//! it first.
//!
//! Verbs declare their flags by themselves; here, over all of them at once, other names, short
//! ones and headings are added, and what clap says about wrong numbers is put plainly. A flag's
//! first name is a contract with scripts and never changes here. Start with [`dressed`].

use std::error::Error as _;
use std::ffi::OsString;
use std::num::{IntErrorKind, ParseFloatError, ParseIntError};
use std::sync::OnceLock;

use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::{Arg, ArgMatches, Command};
use toml::{Table, Value};

use crate::cli::WrongArguments;
use crate::{installed, machine};

/// Other names of a flag. The first one of a list that the verb does not use otherwise is shown in
/// its help, if the list is of a flag that has another word for the same thing.
const ALIASES: [(&str, &[&str]); 9] = [
    ("scenario", &["scenarios"]),
    ("scenarios", &["scenario"]),
    ("map", &["scenario", "scenarios"]),
    ("futures", &["rollouts-per-scenario"]),
    ("rollouts_per_scenario", &["futures"]),
    ("count", &["scenes"]),
    ("scenes", &["count"]),
    ("world", &["weights"]),
    ("weights", &["world"]),
];

/// Flags under their former names, which work for a release more, and under their present ones.
const FORMER: [(&str, &str); 1] = [("life", "spawn")];

/// Verbs of verbs under their former names, likewise.
const FORMER_VERBS: [([&str; 2], &str); 1] = [(["ablate", "switches"], "ablate features")];

/// Keys of the tables of a `--config` file under their former names, likewise.
const FORMER_KEYS: [(&str, &str); 2] = [
    ("sway", "lateral_perturbation"),
    ("sway_m", "lateral_perturbation_m"),
];

/// Short names; a verb's first flag with a letter has it.
const SHORT: [(char, &[&str]); 7] = [
    ('o', &["out"]),
    ('j', &["threads"]),
    ('q', &["quiet"]),
    ('s', &["scenario", "scenarios", "map"]),
    ('w', &["world", "weights"]),
    ('p', &["planner"]),
    (
        'n',
        &["rollouts_per_scenario", "futures", "count", "scenes"],
    ),
];

/// Flags of every verb.
const OF_THE_RUN: [&str; 8] = [
    "out", "seed", "config", "threads", "device", "kernel", "quiet", "wide",
];

/// Flags of a network's decoding.
const DECODING: [&str; 12] = [
    "mode",
    "cache",
    "precision",
    "temperature",
    "top_k",
    "top_p",
    "decay",
    "redraws",
    "no_limits",
    "raw",
    "paper",
    "ruled",
];

/// Flags of traffic after the present, in every world.
const TRAFFIC: [&str; 2] = ["life", "lights"];

/// Flags of the interactive planner's simulations and choices.
const THINKING: [&str; 13] = [
    "futures",
    "allocation",
    "warm_start",
    "network_modes",
    "aggregate",
    "hedge",
    "hysteresis",
    "nearest",
    "horizon",
    "think_ms",
    "replan_every",
    "yielding",
    "discount",
];

/// Flags of a drive.
const DRIVING: [&str; 3] = ["seconds", "controller", "budget_ms"];

/// Verbs without tensors: there is no device to choose.
const NOTHING_COMPUTES: [&str; 11] = [
    "data inspect",
    "data verify",
    "data stats",
    "data convert",
    "data synthesize",
    "data benchmark",
    "evaluate merge",
    "bench wosac",
    "ci",
    "tidy",
    "web",
];

/// The command line with everything that verbs share.
pub(crate) fn dressed(root: Command) -> Command {
    let root = match installed::is_installed() {
        true => root.name(installed::name()).bin_name(installed::name()),
        false => root,
    };
    let root = root.version(version()).after_help(
        "A scenario is PATH, PATH#INDEX or PATH#SCENARIO_ID; the format is detected from content.\n\
         Exit status: 0 done, 1 the work failed, 2 the arguments are wrong, 130 stopped by Ctrl-C.",
    );
    dress(root, "")
}

/// The version, with the commit if the arguments request it.
fn version() -> &'static str {
    static VERSION: OnceLock<String> = OnceLock::new();
    VERSION.get_or_init(|| {
        let version = env!("CARGO_PKG_VERSION");
        // Calling git takes milliseconds, so it is done only on request.
        match std::env::args().any(|word| word == "--version" || word == "-V") {
            true => format!("{version} ({})", machine::commit()),
            false => version.into(),
        }
    })
}

fn dress(mut command: Command, verb: &str) -> Command {
    let names: Vec<String> = command
        .get_subcommands()
        .map(|sub| sub.get_name().to_owned())
        .collect();
    for name in names {
        let verb = format!("{verb} {name}").trim().to_owned();
        command = command.mut_subcommand(name, |sub| dress(sub, &verb));
    }
    let ids: Vec<String> = command
        .get_arguments()
        .map(|arg| arg.get_id().to_string())
        .collect();
    let has = |id: &str| ids.iter().any(|other| other == id);
    let longs: Vec<String> = command
        .get_arguments()
        .filter_map(|arg| arg.get_long().map(str::to_owned))
        .collect();
    let plans = has("replan_every");
    let mut taken = longs.clone();
    for (id, aliases) in ALIASES {
        // The futures of a planner's rollouts are not those of a scenario.
        if !has(id) || (id == "futures" && plans) {
            continue;
        }
        for &alias in aliases {
            if !taken.iter().any(|name| name == alias) {
                taken.push(alias.into());
                let is_plural = alias.trim_end_matches('s') == id.trim_end_matches('s');
                command = command.mut_arg(id, |arg| match is_plural {
                    true => arg.alias(alias),
                    false => arg.visible_alias(alias),
                });
            }
        }
    }
    for (letter, of) in SHORT {
        let id = of.iter().find(|id| longs.contains(&id.replace('_', "-")));
        if let Some(id) = id.filter(|id| !(**id == "futures" && plans)) {
            command = command.mut_arg(*id, |arg| arg.short(letter));
        }
    }
    let computes = !NOTHING_COMPUTES.contains(&verb);
    let (decodes, drives) = (has("top_k"), has("controller"));
    command.mut_args(|arg| {
        let id = arg.get_id().to_string();
        let is = |ids: &[&str]| ids.contains(&id.as_str());
        let arg = signed(arg);
        if is(&["device", "kernel"]) && !computes {
            arg.hide(true)
        } else if is(&OF_THE_RUN) {
            arg.help_heading("Common options")
        } else if is(&["ruled"]) && ["simulate", "plan"].contains(&verb) {
            arg.hide(true)
        } else if decodes && is(&TRAFFIC) {
            arg.help_heading("Traffic after the present")
        } else if decodes && is(&DECODING) {
            arg.help_heading("Decoding of a learned world")
        } else if plans && is(&THINKING) {
            arg.help_heading("Interactive planner")
        } else if drives && is(&DRIVING) {
            arg.help_heading("The drive")
        } else {
            arg
        }
    })
}

/// The present name of a flag or of a key of a `--config` file.
pub(crate) fn present_name(name: &str) -> &str {
    let former = FORMER.iter().find(|(former, _)| *former == name);
    former.map_or(name, |(_, present)| present)
}

/// A sentence for each verb and each flag that is given under its former name.
pub(crate) fn notes_on_former_names(arguments: &[OsString]) -> Vec<String> {
    let given = |name: &str| {
        let mut words = arguments.iter().take_while(|word| *word != "--");
        words.any(|word| word.to_str() == Some(&format!("--{name}")))
    };
    let flags = FORMER.iter().filter(|(former, _)| given(former));
    let flags =
        flags.map(|(former, present)| note(&format!("--{former}"), &format!("--{present}")));
    let verb: Vec<&OsString> = arguments.iter().skip(1).take(2).collect();
    let verbs = FORMER_VERBS.iter().filter(|(former, _)| verb == *former);
    let verbs = verbs.map(|(former, present)| note(&former.join(" "), present));
    verbs.chain(flags).collect()
}

/// Puts the keys of a table, at any depth, under their present names; a sentence for each that had
/// its former one.
pub(crate) fn rename_former_keys(table: &mut Table) -> Vec<String> {
    let mut notes = Vec::new();
    for (former, present) in FORMER_KEYS {
        // Where both are given, the former one is refused as any unknown key.
        if !table.contains_key(present)
            && let Some(value) = table.remove(former)
        {
            table.insert(present.into(), value);
            notes.push(note(former, present));
        }
    }
    for (_, value) in table.iter_mut() {
        match value {
            Value::Table(inner) => notes.extend(rename_former_keys(inner)),
            Value::Array(items) => {
                let tables = items.iter_mut().filter_map(Value::as_table_mut);
                notes.extend(tables.flat_map(rename_former_keys));
            }
            _ => {}
        }
    }
    notes
}

fn note(former: &str, present: &str) -> String {
    format!("note: {former} is now {present}; the former name works until 0.3")
}

/// Parses `-3` as a number rather than a flag, so that the error is about the number.
fn signed(arg: Arg) -> Arg {
    match arg.get_action().takes_values() {
        true => arg.allow_negative_numbers(true),
        false => arg,
    }
}

/// Refuses a device where nothing computes.
///
/// Error: [`WrongArguments`].
pub(crate) fn check_device(matches: &ArgMatches) -> Result<(), WrongArguments> {
    let (mut matches, mut verb) = (matches, String::new());
    while let Some((name, of)) = matches.subcommand() {
        verb = format!("{verb} {name}").trim().to_owned();
        matches = of;
    }
    if !NOTHING_COMPUTES.contains(&verb.as_str()) {
        return Ok(());
    }
    let given = ["device", "kernel"].into_iter().find(|id| {
        let source = matches
            .try_contains_id(id)
            .is_ok()
            .then(|| matches.value_source(id));
        source.flatten() == Some(clap::parser::ValueSource::CommandLine)
    });
    match given {
        Some(id) => Err(WrongArguments(format!(
            "--{id}: expected no such flag, since {verb} computes nothing on a device"
        ))),
        None => Ok(()),
    }
}

/// Replaces clap's error about a number that is invalid or out of range by one plain sentence.
pub(crate) fn plainer(error: clap::Error) -> anyhow::Error {
    let context = |kind| match error.get(kind) {
        Some(ContextValue::String(text)) => Some(text.as_str()),
        _ => None,
    };
    let (argument, value) = (
        context(ContextKind::InvalidArg),
        context(ContextKind::InvalidValue),
    );
    let (ErrorKind::ValueValidation, Some(argument), Some(value)) = (error.kind(), argument, value)
    else {
        return error.into();
    };
    let Some(source) = error.source() else {
        return error.into();
    };
    let expected = if let Some(wrong) = source.downcast_ref::<ParseIntError>() {
        match wrong.kind() {
            IntErrorKind::Zero => "at least 1",
            IntErrorKind::PosOverflow => "a smaller whole number",
            _ if value.starts_with('-') => "a whole number, not below 0",
            _ => "a whole number",
        }
    } else if source.is::<ParseFloatError>() {
        "a number"
    } else {
        return error.into();
    };
    let flag = argument.split(' ').next().unwrap_or(argument);
    WrongArguments(format!("{flag}: expected {expected}, found {value}")).into()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn command() -> Command {
        let number = |name: &'static str| {
            Arg::new(name)
                .long(name)
                .value_parser(clap::value_parser!(std::num::NonZeroUsize))
        };
        let device = Arg::new("device").long("device").default_value("cpu");
        let inspect = Command::new("inspect").arg(device.clone());
        let simulate = Command::new("simulate")
            .arg(number("futures"))
            .arg(Arg::new("scenario").long("scenario"))
            .arg(device);
        let data = Command::new("data").subcommand(inspect);
        dressed(Command::new("xtask").subcommand(simulate).subcommand(data))
    }

    fn parse(words: &str) -> Result<ArgMatches, String> {
        let matches = command().try_get_matches_from(words.split(' '));
        let matches = matches.map_err(|error| plainer(error).to_string())?;
        check_device(&matches).map_err(|wrong| wrong.to_string())?;
        Ok(matches)
    }

    #[test]
    fn numbers_out_of_range_are_told_plainly() {
        let message = |words: &str| parse(words).unwrap_err();
        let zero = "--futures: expected at least 1, found 0";
        assert_eq!(message("xtask simulate --futures 0"), zero);
        assert_eq!(message("xtask simulate -n 0"), zero);
        let below = "--futures: expected a whole number, not below 0, found -3";
        assert_eq!(message("xtask simulate --futures -3"), below);
        let word = "--futures: expected a whole number, found many";
        assert_eq!(message("xtask simulate --futures many"), word);
    }

    #[test]
    fn one_thing_goes_by_any_of_its_names() {
        for flag in ["--scenario", "--scenarios", "-s"] {
            let matches = parse(&format!("xtask simulate {flag} a")).unwrap();
            let (_, of) = matches.subcommand().unwrap();
            assert_eq!(of.get_one::<String>("scenario").unwrap(), "a");
        }
        assert!(parse("xtask simulate --rollouts-per-scenario 3").is_ok());
    }

    #[test]
    fn former_names_are_noted() {
        let words = |text: &str| text.split(' ').map(OsString::from).collect::<Vec<_>>();
        let notes = notes_on_former_names(&words("xtask simulate --life --futures 2"));
        assert_eq!(notes.len(), 1);
        assert!(notes[0].contains("--life is now --spawn"), "{}", notes[0]);
        assert!(notes_on_former_names(&words("xtask simulate --spawn -- --life")).is_empty());
        assert_eq!(
            (present_name("life"), present_name("seed")),
            ("spawn", "seed")
        );
        let notes = notes_on_former_names(&words("xtask ablate switches --steps 3"));
        assert_eq!(notes.len(), 1);
        assert!(notes[0].contains("ablate switches is now ablate features"));
        assert!(notes_on_former_names(&words("xtask ablate features")).is_empty());
    }

    #[test]
    fn former_keys_of_tables_are_renamed_and_noted() {
        let text = "[train.sample]\nsway = 0.5\n[[stage]]\n[stage.train.sample]\nsway_m = 2.0\n";
        let mut table: Table = text.parse().unwrap();
        let notes = rename_former_keys(&mut table);
        assert_eq!(notes.len(), 2);
        assert!(
            notes
                .iter()
                .any(|note| note.contains("sway is now lateral_perturbation;"))
        );
        let renamed = text
            .replace("sway_m", "lateral_perturbation_m")
            .replace("sway =", "lateral_perturbation =");
        assert_eq!(table, renamed.parse().unwrap());
        let both = "lateral_perturbation = 1.0\nsway = 0.5";
        let mut both: Table = both.parse().unwrap();
        assert!(rename_former_keys(&mut both).is_empty() && both.contains_key("sway"));
    }

    #[test]
    fn a_device_is_refused_where_nothing_computes() {
        assert!(parse("xtask simulate --device cpu").is_ok());
        assert!(parse("xtask data inspect").is_ok());
        let error = parse("xtask data inspect --device cpu").unwrap_err();
        assert!(error.contains("data inspect computes nothing"), "{error}");
    }
}
