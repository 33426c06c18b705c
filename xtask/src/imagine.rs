//! Simulation with a progress bar that ends on Ctrl-C: [`gump_eval::imagine`] of a run.

use gump_eval::imagine as eval;
use gump_eval::worlds::World;
use gump_rollout::{Policy, SimulateConfig};
use gump_scene::{Scenario, Seed};

use crate::run::Run;

pub(crate) use gump_eval::imagine::Imagined;

/// Imagines `n_futures` of what comes after the present; the world drives the ego too.
///
/// Error: as [`eval::imagine`], Ctrl-C among them.
pub(crate) fn imagine(
    run: &Run,
    world: &World,
    scenario: &Scenario,
    n_futures: usize,
    config: &SimulateConfig,
    seed: Seed,
) -> anyhow::Result<Imagined> {
    imagine_around(run, world, scenario, n_futures, config, seed, None)
}

/// The same around an ego that `driver` drives, if there is one.
///
/// Error: as [`imagine`], and what the driver reports.
pub(crate) fn imagine_around(
    run: &Run,
    world: &World,
    scenario: &Scenario,
    n_futures: usize,
    config: &SimulateConfig,
    seed: Seed,
    driver: Option<&mut dyn Policy>,
) -> anyhow::Result<Imagined> {
    let progress = run.simulating(Some(eval::frames(scenario, n_futures, config)));
    let imagined =
        eval::imagine_around(world, scenario, n_futures, config, seed, driver, &progress);
    Ok(imagined?)
}
