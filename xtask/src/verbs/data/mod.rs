//! `data`: look into scenario files, check, count and convert them, make new ones.

mod benchmark;
mod convert;
mod inspect;
mod stats;
mod synthesize;
mod verify;

pub(crate) use inspect::picture;

/// The verbs of `data`.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Verb {
    /// Show what is in a file or directory
    Inspect(inspect::Args),
    /// Check every record; exit status 1 if anything is broken
    Verify(verify::Args),
    /// Statistics of scenes: agents, speeds, roads, lights, kinds of situation
    Stats(stats::Args),
    /// Convert any readable format into the training cache or another format
    Convert(convert::Args),
    /// Generate synthetic scenarios, free of any recording's licence
    Synthesize(synthesize::Args),
    /// Regenerate or find a frozen list's scenes and verify checksums
    Benchmark(benchmark::Args),
}
