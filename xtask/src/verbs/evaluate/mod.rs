//! `evaluate`: the benchmarks, one file each.
//!
//! What they share: [`gump_eval::shard`] says which scenarios are this machine's, [`gump_eval::results`] keeps what each
//! scenario got, so that a stopped run goes on and shards add up to one run. A new benchmark is a
//! file, a variant of [`Verb`] and, if it can be sharded, a row of `BENCHMARKS` in [`merge`].

pub(crate) mod behaviour;
mod closed_loop;
pub(crate) mod generation;
mod left_out;
mod long;
mod merge;
pub(crate) mod motion;
mod open_loop;
mod prompts;
mod ranking;
pub(crate) mod reactions;
mod sources;
mod ways;
pub(crate) mod wosac;

pub(crate) use closed_loop::Driving;

/// Which benchmark.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Verb {
    /// Motion prediction: distances, misses, overlaps and mAP at 3, 5 and 8 s
    Motion(motion::Args),
    /// Realism: the Waymo Sim Agents Challenge
    Wosac(wosac::Args),
    /// What a driver would notice, in worlds and in the log: parked cars that move, overlaps, slip
    Behaviour(behaviour::Args),
    /// The ego leaves its log; who runs into it
    Reactions(reactions::Args),
    /// Generated scenes: likeness to recorded ones, overlaps, prompts
    Generation(generation::Args),
    /// How well a planner drives, as nuPlan scores it
    ClosedLoop(closed_loop::Args),
    /// How near a planner's plans are to what was driven
    OpenLoop(open_loop::Args),
    /// Put the shards of one evaluation together
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
