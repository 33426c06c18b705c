//! The driver: `cargo xtask <verb>`.
//!
//! One file per verb under `verbs/`, each a thin layer over the crates: it reads its arguments,
//! shows progress, calls crates and fills a report. What every verb shares is in [`run`] (output
//! folder, seed, threads, phases), [`report`] (`report.json` and the table on the terminal),
//! [`config`] (TOML files as flags), [`words`] (other names of flags), [`choices`] (values of
//! flags) and [`progress`]; [`installed`] is what differs outside of a checkout. Start with [`cli`].
#![allow(
    clippy::disallowed_methods,
    reason = "the driver measures phases and stamps reports; layers 0-3 may not"
)]

mod annotations;
mod benchmark;
mod charts;
mod checks;
mod choices;
mod cli;
mod config;
mod films;
mod futures;
mod imagine;
mod installed;
mod losses;
mod machine;
mod notes;
mod peers;
mod planners;
mod progress;
mod report;
mod run;
mod sampling;
mod sharding;
mod shipped;
mod table;
mod tables;
mod targets;
mod verbs;
mod words;

use std::process::ExitCode;

#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    installed::settle();
    run::catch_interrupts();
    let arguments = std::env::args_os().collect();
    match cli::parse(arguments).and_then(cli::Invocation::execute) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => cli::explain(&error),
    }
}
