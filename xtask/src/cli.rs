//! From the command line to a verb, and from an error to an exit status.
//!
//! The words are a contract with the scripts of users. A verb is offered once it works, not before.

use std::ffi::OsString;
use std::io;
use std::process::ExitCode;

use clap::{ArgMatches, Command, CommandFactory, FromArgMatches, Parser, Subcommand};
use gump_data::DataError;
use gump_eval::EvalError;
use gump_model::ModelError;
use gump_train::TrainError;
use serde::Serialize;

use crate::run::{self, Common, Run, print_error};
use crate::verbs::ablate::Sweep;
use crate::verbs::{
    ablate, bench, ci, data, demo, evaluate, generate, manual, plan, rl, simulate, submit, tidy,
    train, web,
};
use crate::{config, words};

/// The generative world model for driving: train, simulate, plan and evaluate.
#[derive(Debug, Parser)]
#[command(
    name = "cargo xtask",
    bin_name = "cargo xtask",
    args_override_self = true
)]
struct Cli {
    #[command(subcommand)]
    verb: Verb,
}

/// A verb with its arguments and its name.
#[derive(Debug)]
pub(crate) struct Invocation {
    name: String,
    verb: Verb,
}

#[derive(Debug, Subcommand)]
enum Verb {
    /// Start here: the whole pipeline on one scene, offline, and a page of results.
    Demo(demo::Args),
    /// Inspect, verify, convert and generate scenario files.
    #[command(subcommand)]
    Data(data::Verb),
    /// Train a world model.
    Train(train::Args),
    /// Roll out a recorded scene: joint futures of all agents.
    Simulate(simulate::Args),
    /// Generate a scene on a map from a prompt and constraints.
    Generate(generate::Args),
    /// Drive a planner through a scene and explain its decisions.
    Plan(plan::Args),
    /// Measure on the benchmarks of the field.
    #[command(subcommand)]
    Evaluate(evaluate::Verb),
    /// Train and evaluate driving policies by reinforcement learning.
    #[command(subcommand)]
    Rl(rl::Verb),
    /// Pack results for a challenge, checked against its rules.
    #[command(subcommand)]
    Submit(submit::Verb),
    /// Ablations: leave out or swap a part and measure the effect.
    #[command(subcommand)]
    Ablate(ablate::Verb),
    /// Benchmark speed.
    #[command(subcommand)]
    Bench(bench::Verb),
    /// Build the web page for driving inside the learned world.
    Web(web::Args),
    /// Everything CI runs: format, lints, tests, docs, layers, house rules.
    Ci(ci::Args),
    /// Check the house rules of the repository.
    Tidy(tidy::Args),
    /// Print a shell completion script.
    Completions(manual::Completions),
    /// Write the manual pages for `man`.
    Manual(manual::Manual),
}

/// The arguments are wrong: exit status 2.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub(crate) struct WrongArguments(pub(crate) String);

/// Parses the command line, after a `--config` file has been turned into flags before it.
///
/// Error: clap's own, or [`WrongArguments`] for a config file that does not fit the verb.
pub(crate) fn parse(arguments: Vec<OsString>) -> anyhow::Result<Invocation> {
    let mut command = command();
    let arguments = config::splice(&command, arguments)?;
    let notes = words::notes_on_former_names(&arguments);
    let matches = command.try_get_matches_from_mut(arguments);
    let matches = matches.map_err(words::plainer)?;
    notes.iter().for_each(|note| print_error(note));
    words::check_device(&matches)?;
    Ok(Invocation {
        name: name_of(&matches),
        verb: Cli::from_arg_matches(&matches)?.verb,
    })
}

/// The command line as it is offered.
fn command() -> Command {
    words::dressed(Cli::command())
}

impl Invocation {
    /// Runs the verb.
    pub(crate) fn execute(self) -> anyhow::Result<()> {
        let name = self.name;
        // A row runs the verbs of one group. They take nothing but their arguments, which they all
        // have in the same form; a verb is called as its subcommand is. The last row has the
        // ablations of one setting.
        macro_rules! run {
            (
                $($alone:ident)*;
                $($group:ident $module:ident: $($verb:ident)*;)*
                [$($sweep:ident)*]
            ) => {
                match self.verb {
                    $(Verb::$alone(args) => run(&name, &args.common, &args, |run| args.execute(run)),)*
                    $($(Verb::$group($module::Verb::$verb(args)) => {
                        run(&name, &args.common, &args, |run| args.execute(run))
                    })*)*
                    $(Verb::Ablate(ablate::Verb::$sweep(args)) => {
                        run(&name, &args.common, &args, |run| args.execute(run, Sweep::$sweep))
                    })*
                    Verb::Completions(args) => args.execute(command()),
                    Verb::Manual(args) => args.execute(command()),
                }
            };
        }
        run! {
            Demo Train Simulate Generate Plan Web Ci Tidy;
            Data data: Inspect Verify Stats Convert Synthesize Benchmark;
            Evaluate evaluate:
                Motion Wosac Behaviour Reactions Generation ClosedLoop OpenLoop Merge;
            Rl rl: Train Evaluate Serve Table;
            Submit submit: Wosac;
            Ablate ablate: Nar Scaling Features;
            Bench bench: Engine Train Device Wosac Planning;
            [Quantization Temperature Decay History Chunking]
        }
    }
}

/// Runs one verb.
fn run(
    name: &str,
    common: &Common,
    settings: &impl Serialize,
    work: impl FnOnce(&mut Run) -> anyhow::Result<()>,
) -> anyhow::Result<()> {
    Run::of(name, common, settings)?.execute(work)
}

/// The names of the chosen subcommands: "data inspect".
fn name_of(matches: &ArgMatches) -> String {
    let mut names = Vec::new();
    let mut level = matches.subcommand();
    while let Some((name, matches)) = level {
        names.push(name);
        level = matches.subcommand();
    }
    names.join(" ")
}

/// Prints an error as one sentence and chooses the exit status.
pub(crate) fn explain(error: &anyhow::Error) -> ExitCode {
    if let Some(error) = error.downcast_ref::<clap::Error>() {
        // Help and version are "errors" with status 0 that belong on stdout; clap knows.
        let printed = error.print();
        return if printed.is_ok() && !error.use_stderr() {
            ExitCode::SUCCESS
        } else {
            ExitCode::from(2)
        };
    }
    print_error(&format!("error: {}", sentence(error)));
    ExitCode::from(match error {
        // As shells report a program that a signal ended: 128 plus the signal's number.
        _ if run::interrupted() => 130,
        error if is_about_arguments(error) => 2,
        _ => 1,
    })
}

/// An error and what caused it as one sentence. Causes that many errors quote are there once.
pub(crate) fn sentence(error: &anyhow::Error) -> String {
    let mut sentence = String::new();
    for cause in error.chain().map(ToString::to_string) {
        if !sentence.contains(&cause) {
            let separator = if sentence.is_empty() { "" } else { ": " };
            sentence = format!("{sentence}{separator}{cause}");
        }
    }
    sentence
}

/// Whether the arguments are wrong, rather than the work failed.
pub(crate) fn is_about_arguments(error: &anyhow::Error) -> bool {
    error.is::<WrongArguments>()
        || names_nothing(error)
        || error.downcast_ref().is_some_and(EvalError::is_argument)
        || matches!(error.downcast_ref(), Some(TrainError::OtherData { .. }))
}

/// True if there is no file of the name, or no scenario of the name in it.
fn names_nothing(error: &anyhow::Error) -> bool {
    let is_missing = |cause: &io::Error| cause.kind() == io::ErrorKind::NotFound;
    error.chain().any(|cause| {
        let data = cause.downcast_ref().is_some_and(|cause: &DataError| {
            matches!(
                cause,
                DataError::NoSuchScenario { .. }
                    | DataError::SeveralFiles { .. }
                    | DataError::Missing { .. }
            )
        });
        let model = cause.downcast_ref().is_some_and(
            |cause: &ModelError| matches!(cause, ModelError::Io { cause, .. } if is_missing(cause)),
        );
        data || model || cause.downcast_ref().is_some_and(is_missing)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        command().debug_assert();
    }

    #[test]
    fn a_sentence_says_everything_once() {
        let inner = anyhow::anyhow!("no such file");
        let error = inner.context("cannot open: no such file").context("a.txt");
        assert_eq!(sentence(&error), "a.txt: cannot open: no such file");
        assert_eq!(sentence(&anyhow::anyhow!("late")), "late");
    }

    #[test]
    fn what_is_not_there_is_a_wrong_argument() {
        use anyhow::Context as _;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("none");
        let read = std::fs::read(&path).context("cannot read the file");
        assert!(is_about_arguments(&read.unwrap_err()));
        let weights = gump_model::relative::is_relative(&path).unwrap_err();
        assert!(is_about_arguments(&weights.into()));
        let data = gump_data::open(&path).err().unwrap();
        assert!(is_about_arguments(&data.into()));
        assert!(!is_about_arguments(&anyhow::anyhow!("the disk is full")));
    }

    #[test]
    fn a_verb_that_does_not_exist_is_refused() {
        let arguments = ["xtask", "fly"].map(OsString::from).to_vec();
        let error = parse(arguments).unwrap_err();
        assert!(error.is::<clap::Error>(), "{error}");
    }
}
