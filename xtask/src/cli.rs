//! From the command line to a verb, and from an error to an exit status.
//!
//! The words are a contract with the scripts of users. A verb is offered once it works, not before.

use std::ffi::OsString;
use std::process::ExitCode;

use clap::{Command, CommandFactory, FromArgMatches, Parser, Subcommand};
use gump_data::DataError;
use gump_eval::EvalError;

use crate::run::{self, Run, print_error};
use crate::verbs::ablate::Knob;
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
pub(crate) struct Cli {
    #[command(subcommand)]
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
pub(crate) fn parse(arguments: Vec<OsString>) -> anyhow::Result<Cli> {
    let mut command = command();
    let arguments = config::splice(&command, arguments)?;
    let matches = command.try_get_matches_from_mut(arguments);
    let matches = matches.map_err(words::plainer)?;
    words::check_device(&matches)?;
    Ok(Cli::from_arg_matches(&matches)?)
}

/// The command line as it is offered.
fn command() -> Command {
    words::dressed(Cli::command())
}

impl Cli {
    /// Does what was asked.
    pub(crate) fn execute(self) -> anyhow::Result<()> {
        match self.verb {
            Verb::Demo(args) => {
                Run::of("demo", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Data(data::Verb::Inspect(args)) => {
                Run::of("data inspect", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Data(data::Verb::Verify(args)) => {
                Run::of("data verify", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Data(data::Verb::Stats(args)) => {
                Run::of("data stats", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Data(data::Verb::Convert(args)) => {
                Run::of("data convert", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Data(data::Verb::Synthesize(args)) => {
                Run::of("data synthesize", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Data(data::Verb::Benchmark(args)) => {
                Run::of("data benchmark", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Train(args) => {
                Run::of("train", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Simulate(args) => {
                Run::of("simulate", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Generate(args) => {
                Run::of("generate", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Evaluate(evaluate::Verb::Motion(args)) => {
                Run::of("evaluate motion", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Evaluate(evaluate::Verb::Wosac(args)) => {
                Run::of("evaluate wosac", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Evaluate(evaluate::Verb::Behaviour(args)) => {
                Run::of("evaluate behaviour", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Evaluate(evaluate::Verb::Reactions(args)) => {
                Run::of("evaluate reactions", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Plan(args) => {
                Run::of("plan", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Evaluate(evaluate::Verb::Generation(args)) => {
                Run::of("evaluate generation", &args.common, &args)?
                    .execute(|run| args.execute(run))
            }
            Verb::Evaluate(evaluate::Verb::ClosedLoop(args)) => {
                Run::of("evaluate closed-loop", &args.common, &args)?
                    .execute(|run| args.execute(run))
            }
            Verb::Evaluate(evaluate::Verb::OpenLoop(args)) => {
                Run::of("evaluate open-loop", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Evaluate(evaluate::Verb::Merge(args)) => {
                Run::of("evaluate merge", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Rl(rl::Verb::Train(args)) => {
                Run::of("rl train", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Rl(rl::Verb::Evaluate(args)) => {
                Run::of("rl evaluate", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Rl(rl::Verb::Serve(args)) => {
                Run::of("rl serve", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Rl(rl::Verb::Table(args)) => {
                Run::of("rl table", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Submit(submit::Verb::Wosac(args)) => {
                Run::of("submit wosac", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Ablate(ablate::Verb::Nar(args)) => {
                Run::of("ablate nar", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Ablate(ablate::Verb::Quantization(args)) => {
                Run::of("ablate quantization", &args.common, &args)?
                    .execute(|run| args.execute(run, Knob::Precision))
            }
            Verb::Ablate(ablate::Verb::Temperature(args)) => {
                Run::of("ablate temperature", &args.common, &args)?
                    .execute(|run| args.execute(run, Knob::Temperature))
            }
            Verb::Ablate(ablate::Verb::Decay(args)) => {
                Run::of("ablate decay", &args.common, &args)?
                    .execute(|run| args.execute(run, Knob::Decay))
            }
            Verb::Ablate(ablate::Verb::History(args)) => {
                Run::of("ablate history", &args.common, &args)?
                    .execute(|run| args.execute(run, Knob::History))
            }
            Verb::Ablate(ablate::Verb::Chunking(args)) => {
                Run::of("ablate chunking", &args.common, &args)?
                    .execute(|run| args.execute(run, Knob::Chunking))
            }
            Verb::Ablate(ablate::Verb::Scaling(args)) => {
                Run::of("ablate scaling", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Ablate(ablate::Verb::Switches(args)) => {
                Run::of("ablate switches", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Bench(bench::Verb::Engine(args)) => {
                Run::of("bench engine", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Bench(bench::Verb::Train(args)) => {
                Run::of("bench train", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Bench(bench::Verb::Device(args)) => {
                Run::of("bench device", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Bench(bench::Verb::Wosac(args)) => {
                Run::of("bench wosac", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Bench(bench::Verb::Planning(args)) => {
                Run::of("bench planning", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Web(args) => {
                Run::of("web", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Ci(args) => Run::of("ci", &args.common, &args)?.execute(|run| args.execute(run)),
            Verb::Tidy(args) => {
                Run::of("tidy", &args.common, &args)?.execute(|run| args.execute(run))
            }
            Verb::Completions(args) => args.execute(command()),
            Verb::Manual(args) => args.execute(command()),
        }
    }
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
    print_error(&format!("error: {error:#}"));
    ExitCode::from(match error {
        // As shells tell of a program that a signal ended: 128 and the signal's number.
        _ if run::interrupted() => 130,
        error if error.is::<WrongArguments>() || names_nothing(error) => 2,
        error if error.downcast_ref().is_some_and(EvalError::is_argument) => 2,
        _ => 1,
    })
}

/// True if what was read is sound and the name of a scenario in it is not.
fn names_nothing(error: &anyhow::Error) -> bool {
    let mut causes = error.chain().filter_map(|cause| cause.downcast_ref());
    causes.any(|cause: &DataError| {
        matches!(
            cause,
            DataError::NoSuchScenario { .. } | DataError::SeveralFiles { .. }
        )
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
    fn a_verb_that_does_not_exist_is_refused() {
        let arguments = ["xtask", "fly"].map(OsString::from).to_vec();
        let error = parse(arguments).unwrap_err();
        assert!(error.is::<clap::Error>(), "{error}");
    }
}
