//! `evaluate`: the benchmarks, one file each.
//!
//! Each reads its arguments, shows the progress of an evaluation of [`gump_eval`] and reports its
//! results. [`gump_eval::shard`] says which scenarios are this machine's, [`gump_eval::results`] keeps
//! the results of each, from which a stopped run resumes and shards are merged. A new benchmark is a
//! file, a variant of [`Verb`] and, if it can be sharded, a row of `BENCHMARKS` in [`merge`].

pub(crate) mod behaviour;
mod closed_loop;
mod columns;
mod exclusions;
pub(crate) mod generation;
mod merge;
pub(crate) mod motion;
mod open_loop;
mod ranking;
pub(crate) mod reactions;
mod warnings;
pub(crate) mod wosac;

use serde_json::json;

pub(crate) use closed_loop::Driving;

use crate::run::Run;

/// The benchmarks.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Verb {
    /// Motion prediction: distances, misses, overlaps and mAP at 3, 5 and 8 s
    Motion(motion::Args),
    /// Realism: the Waymo Sim Agents Challenge
    Wosac(wosac::Args),
    /// Implausible actions in worlds and in the log: parked cars that move, overlaps, slip
    Behaviour(behaviour::Args),
    /// Reactions of agents to an ego that departs from its log
    Reactions(reactions::Args),
    /// Generated scenes: similarity to recorded ones, overlaps, prompt satisfaction
    Generation(generation::Args),
    /// Closed-loop planning, with nuPlan's scores
    ClosedLoop(closed_loop::Args),
    /// Open-loop planning: distance of plans from the recorded drive
    OpenLoop(open_loop::Args),
    /// Merge the shards of one evaluation
    Merge(merge::Args),
}

/// Fails, after all else is reported, if scenarios could not be read; `unreadable` are their names
/// and why.
fn all_readable(
    run: &mut Run,
    unreadable: &[(&str, String)],
    scenarios: usize,
) -> anyhow::Result<()> {
    let Some((id, why)) = unreadable.first() else {
        return Ok(());
    };
    let rows = unreadable
        .iter()
        .map(|(id, error)| json!({ "id": id, "error": error }));
    run.result("unreadable", rows.collect::<Vec<_>>())?;
    anyhow::bail!(
        "expected scenarios that can be read, found {} of {scenarios} broken, which are left out; \
         the first, {id}: {why}",
        unreadable.len()
    )
}

/// Fails with the first error if no scenario of a report went through.
fn any_succeeded(scenarios: &[serde_json::Value]) -> anyhow::Result<()> {
    let errors = scenarios.iter().map(|entry| entry["error"].as_str());
    match errors.collect::<Option<Vec<&str>>>() {
        None => Ok(()),
        Some(errors) => anyhow::bail!(
            "every scenario failed, the first because: {}",
            errors.first().unwrap_or(&"there was none")
        ),
    }
}
