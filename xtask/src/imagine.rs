//! Imagining with a progress bar, a clock and an ear for Ctrl-C.
//!
//! The engine in `gump-rollout` knows no clock, so the world is watched from outside.

use std::sync::Mutex;
use std::time::{Duration, Instant};

use gump_eval::worlds::World;
use gump_rollout::{BoxError, Policy, Session, SimulateConfig, Start, WorldModel, simulate};
use gump_scene::{AgentState, Frame, Rollout, Scenario, Seed};

use crate::progress::Progress;
use crate::run::{Run, stop_if_interrupted};

/// Futures of one scene, and what they cost.
pub(crate) struct Imagined {
    /// The futures.
    pub(crate) rollouts: Vec<Rollout>,
    /// Frames the world made, at its own rate, over all futures.
    pub(crate) frames: usize,
    /// Wall time the world took, opening included.
    pub(crate) elapsed: Duration,
    /// Transformer passes per step of the world, whatever their batch, without those over the
    /// history; 0 for worlds that follow rules.
    pub(crate) passes_per_frame: f64,
}

impl Imagined {
    /// Frames the world made per second of wall time.
    pub(crate) fn frames_per_second(&self) -> f64 {
        self.frames as f64 / self.elapsed.as_secs_f64().max(1e-9)
    }
}

/// Imagines `n_futures` of what comes after the present; the world drives the ego too, and is not
/// told its route, which comes from what is to be imagined.
///
/// Error: a map without lanes for a world that follows them, what the world reports, or Ctrl-C.
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
    anyhow::ensure!(
        !(world.follows_lanes() && scenario.map.lanes().is_empty()),
        "scenario {}: expected a map with lanes to drive on, found none",
        scenario.id
    );
    let (scene, seconds) = (scenario.present().unguided(), config.seconds);
    let start = Start {
        scene,
        n_futures,
        seed,
    };
    let steps = (seconds / scene.dt).round().max(1.0);
    let watched = Watched {
        world,
        // Advanced in units of the scene's step, since the world's own is not known yet.
        progress: run.progress("simulating", steps as u64 * n_futures as u64, "frames"),
        scene_dt: scene.dt,
        cost: Mutex::new(Cost::default()),
    };
    let rollouts =
        simulate(&watched, &[start], driver, config).map_err(|error| anyhow::anyhow!(error))?;
    let cost = watched.into_cost();
    let passes = world.passes().saturating_sub(cost.passes_before);
    Ok(Imagined {
        rollouts,
        frames: cost.frames,
        elapsed: cost.elapsed,
        passes_per_frame: passes as f64 / cost.steps.max(1) as f64,
    })
}

struct Watched<'a> {
    world: &'a World,
    progress: Progress,
    scene_dt: f64,
    cost: Mutex<Cost>,
}

#[derive(Default)]
struct Cost {
    frames: usize,
    steps: usize,
    elapsed: Duration,
    /// Passes of the world once its session was open.
    passes_before: u64,
}

impl Watched<'_> {
    fn add(&self, change: impl FnOnce(&mut Cost)) {
        // Adding numbers cannot leave them half added, so a poisoned lock still holds good ones.
        change(
            &mut self
                .cost
                .lock()
                .unwrap_or_else(std::sync::PoisonError::into_inner),
        );
    }

    fn into_cost(self) -> Cost {
        self.cost
            .into_inner()
            .unwrap_or_else(std::sync::PoisonError::into_inner)
    }
}

impl WorldModel for Watched<'_> {
    fn name(&self) -> &str {
        self.world.model().name()
    }

    fn open(&self, starts: &[Start<'_>]) -> Result<Box<dyn Session + '_>, BoxError> {
        let began = Instant::now();
        let session = self.world.model().open(starts)?;
        self.add(|cost| {
            cost.elapsed += began.elapsed();
            cost.passes_before = self.world.passes();
        });
        Ok(Box::new(WatchedSession {
            session,
            watched: self,
        }))
    }
}

struct WatchedSession<'a> {
    session: Box<dyn Session + 'a>,
    watched: &'a Watched<'a>,
}

impl Session for WatchedSession<'_> {
    fn dt(&self) -> f64 {
        self.session.dt()
    }

    fn step(&mut self, ego: Option<&[AgentState]>) -> Result<Vec<Frame>, BoxError> {
        stop_if_interrupted()?;
        let began = Instant::now();
        let frames = self.session.step(ego)?;
        let stride = (self.session.dt() / self.watched.scene_dt).round().max(1.0);
        self.watched
            .progress
            .advance((stride * frames.len() as f64) as u64);
        self.watched.add(|cost| {
            cost.elapsed += began.elapsed();
            cost.frames += frames.len();
            cost.steps += 1;
        });
        Ok(frames)
    }

    fn replace(&mut self, future: usize, start: Start<'_>) -> Result<(), BoxError> {
        self.session.replace(future, start)
    }
}
