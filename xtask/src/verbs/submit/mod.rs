//! `submit`: archives that challenges take, one file per challenge.

pub(crate) mod wosac;

/// The challenges.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Verb {
    /// Pack futures of many scenarios for the Waymo Sim Agents Challenge, or check an archive
    Wosac(wosac::Args),
}
