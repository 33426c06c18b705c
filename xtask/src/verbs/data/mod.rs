//! `data`: look into scenario files, check and convert them, make new ones.

mod convert;
mod inspect;
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
    /// Turn any readable format into the cache that training reads from, or into another format
    Convert(convert::Args),
    /// Make up scenarios that are free of any recording's licence
    Synthesize(synthesize::Args),
}
