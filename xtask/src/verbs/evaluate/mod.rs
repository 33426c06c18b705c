//! `evaluate`: the benchmarks, one file each.
//!
//! What they share: [`shard`] says which scenarios are this machine's, [`ledger`] keeps what each
//! scenario got, so that a stopped run goes on and shards add up to one run. A new benchmark is a
//! file, a variant of [`Verb`] and, if it can be sharded, a row of [`merge::BENCHMARKS`].

#[allow(dead_code, reason = "the first benchmark that shards follows")]
mod ledger;
mod merge;
#[allow(dead_code, reason = "the first benchmark that shards follows")]
mod shard;

/// Which benchmark.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Verb {
    /// Put the shards of one evaluation together
    Merge(merge::Args),
}
