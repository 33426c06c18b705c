//! `data`: look into scenario files, check, count and convert them, make new ones.

mod benchmark;
mod convert;
mod inspect;
mod stats;
mod synthesize;
mod verify;

pub(crate) use inspect::picture;

/// What to do with data.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Verb {
    /// What is in a file or directory
    Inspect(inspect::Args),
    /// Check every record; exit status 1 if anything is broken
    Verify(verify::Args),
    /// What scenes consist of, as a table: agents, speeds, roads, lights, kinds of situation
    Stats(stats::Args),
    /// Turn any readable format into the cache that training reads from, or into another format
    Convert(convert::Args),
    /// Make up scenarios that are free of any recording's licence
    Synthesize(synthesize::Args),
    /// The scenes of a frozen list, made anew or looked for, and held to its sums
    Benchmark(benchmark::Args),
}
