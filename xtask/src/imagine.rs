//! Simulation with a progress bar that ends on Ctrl-C: [`gump_eval::imagine`] of a run.

use gump_eval::imagine as eval;
use gump_eval::worlds::World;
use gump_rollout::{ProbeConfig, SimulateConfig};
use gump_scene::{Scenario, Seed};

use crate::futures;
use crate::run::Run;

pub(crate) use gump_eval::imagine::Imagined;

/// Imagines `n_futures` of what comes after the present; the world drives the ego too.
///
/// Error: as [`eval::imagine`], Ctrl-C among them, and [`futures::check_memory`].
pub(crate) fn imagine(
    run: &Run,
    world: &World,
    scenario: &Scenario,
    n_futures: usize,
    config: &SimulateConfig,
    seed: Seed,
) -> anyhow::Result<Imagined> {
    futures::check_memory(scenario, n_futures, config.seconds)?;
    let progress = run.simulating(Some(eval::frames(scenario, n_futures, config)));
    let imagined = eval::imagine(world, scenario, n_futures, config, seed, &progress);
    Ok(imagined?)
}

/// As [`imagine`], with predictive samples where they are requested.
///
/// Error: as [`imagine`], and a world that draws nothing.
pub(crate) fn imagine_probed(
    run: &Run,
    world: &World,
    scenario: &Scenario,
    n_futures: usize,
    config: &SimulateConfig,
    probe: ProbeConfig,
) -> anyhow::Result<Imagined> {
    futures::check_memory(scenario, n_futures, config.seconds)?;
    let (seed, progress) = (
        run.seed(),
        run.simulating(Some(eval::frames(scenario, n_futures, config))),
    );
    let imagined = eval::imagine_probed(world, scenario, n_futures, config, seed, probe, &progress);
    Ok(imagined?)
}
