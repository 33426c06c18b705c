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

pub(crate) use closed_loop::Driving;

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
