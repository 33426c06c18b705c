//! Futures of one scene, with their cost, and with a monitor that can stop the simulation.
//!
//! The engine in `gump-rollout` knows no clock, so the world is watched from outside.
#![allow(
    clippy::disallowed_methods,
    reason = "worlds are timed; layers 0-3 may not look at the clock"
)]

use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use gump_rollout::{
    BoxError, Policy, PredictiveSamples, ProbeConfig, Session, SessionStats, SimulateConfig, Start,
    WorldModel, simulate,
};
use gump_scene::{Agent, AgentId, AgentState, Frame, Light, Rollout, Scenario, Seed};

use crate::worlds::World;
use crate::{EvalError, LanePurpose, Monitor, RecordingError};

/// Futures of one scene, and their cost.
pub struct Imagined {
    /// The futures.
    pub rollouts: Vec<Rollout>,
    /// Simulated frames over all futures, in steps of the scene: a world whose own step is longer
    /// makes several at a time.
    pub frames: usize,
    /// Wall time that the world took, opening included.
    pub elapsed: Duration,
    /// Passes of the network per step of the world, whatever their batch, without those over the
    /// history; 0 for worlds that follow rules.
    pub passes_per_frame: f64,
    /// Requested predictive samples, of [`imagine_probed`].
    pub samples: Vec<PredictiveSamples>,
}

impl Imagined {
    /// Simulated frames, in steps of the scene (0.1 s), per second of wall time, all futures together.
    pub fn frames_per_second(&self) -> f64 {
        self.frames as f64 / self.elapsed.as_secs_f64().max(1e-9)
    }
}

/// Frames that the monitor of a simulation counts: in steps of the scene, over all futures.
pub fn frames(scenario: &Scenario, n_futures: usize, config: &SimulateConfig) -> u64 {
    let steps = (config.seconds / scenario.dt).round().max(1.0);
    steps as u64 * n_futures as u64
}

/// Simulates `n_futures` of what comes after the present; the world drives the ego too, and does
/// not get its route, which comes from what is to be imagined. The monitor counts [`frames`].
///
/// # Errors
/// A map without lanes for a world that follows them, an error of the world, or
/// [`EvalError::Stopped`].
pub fn imagine(
    world: &World,
    scenario: &Scenario,
    n_futures: usize,
    config: &SimulateConfig,
    seed: Seed,
    monitor: &dyn Monitor,
) -> Result<Imagined, EvalError> {
    imagine_around(world, scenario, n_futures, config, seed, None, monitor)
}

/// The same around an ego that `driver` drives, if there is one.
///
/// # Errors
/// As [`imagine`], and errors of the driver.
pub fn imagine_around(
    world: &World,
    scenario: &Scenario,
    n_futures: usize,
    config: &SimulateConfig,
    seed: Seed,
    driver: Option<&mut dyn Policy>,
    monitor: &dyn Monitor,
) -> Result<Imagined, EvalError> {
    let probe = ProbeConfig::default();
    simulate_watched(
        world, scenario, n_futures, config, seed, driver, probe, monitor,
    )
}

/// As [`imagine`], with predictive samples of the first futures, which stay the same; the time that
/// the samples take counts as the world's.
///
/// # Errors
/// As [`imagine`], and [`RecordingError::NoPredictiveSamples`] for a world that follows rules.
pub fn imagine_probed(
    world: &World,
    scenario: &Scenario,
    n_futures: usize,
    config: &SimulateConfig,
    seed: Seed,
    probe: ProbeConfig,
    monitor: &dyn Monitor,
) -> Result<Imagined, EvalError> {
    simulate_watched(
        world, scenario, n_futures, config, seed, None, probe, monitor,
    )
}

#[expect(
    clippy::too_many_arguments,
    reason = "the public functions leave out one of the last"
)]
fn simulate_watched(
    world: &World,
    scenario: &Scenario,
    n_futures: usize,
    config: &SimulateConfig,
    seed: Seed,
    driver: Option<&mut dyn Policy>,
    probe: ProbeConfig,
    monitor: &dyn Monitor,
) -> Result<Imagined, EvalError> {
    if world.follows_lanes() && scenario.map.lanes().is_empty() {
        return Err(RecordingError::NoLanes {
            scenario: scenario.id.clone(),
            purpose: LanePurpose::Drive,
        }
        .into());
    }
    let scene = scenario.present().unguided();
    let start = Start {
        scene,
        n_futures,
        seed,
    };
    let watched = Watched {
        world,
        monitor,
        scene_dt: scene.dt,
        probe,
        cost: Mutex::new(Cost::default()),
    };
    let rollouts =
        simulate(&watched, &[start], driver, config).map_err(EvalError::of_simulation)?;
    let cost = watched.cost.into_inner();
    let cost = cost.unwrap_or_else(PoisonError::into_inner);
    Ok(Imagined {
        rollouts,
        frames: cost.frames,
        elapsed: cost.elapsed,
        passes_per_frame: cost.passes as f64 / cost.steps.max(1) as f64,
        samples: cost.samples,
    })
}

struct Watched<'a> {
    world: &'a World,
    /// Counts in steps of the scene, since the world's own step is not known before it is open.
    monitor: &'a dyn Monitor,
    scene_dt: f64,
    probe: ProbeConfig,
    cost: Mutex<Cost>,
}

#[derive(Default)]
struct Cost {
    frames: usize,
    steps: usize,
    elapsed: Duration,
    /// Passes of the network since its session was open.
    passes: u64,
    samples: Vec<PredictiveSamples>,
}

impl Watched<'_> {
    fn add(&self, change: impl FnOnce(&mut Cost)) {
        // Adding numbers cannot leave them half added, so a poisoned lock still holds good ones.
        let cost = self.cost.lock();
        change(&mut cost.unwrap_or_else(PoisonError::into_inner));
    }
}

impl WorldModel for Watched<'_> {
    fn name(&self) -> &str {
        self.world.model().name()
    }

    fn open(&self, starts: &[Start<'_>]) -> Result<Box<dyn Session + '_>, BoxError> {
        let began = Instant::now();
        let mut session = self.world.model().open(starts)?;
        if self.probe.futures > 0 && !session.probe(self.probe) {
            return Err(EvalError::from(RecordingError::NoPredictiveSamples).into());
        }
        self.add(|cost| cost.elapsed += began.elapsed());
        Ok(Box::new(WatchedSession {
            passes: session.stats().passes,
            session,
            watched: self,
        }))
    }
}

struct WatchedSession<'a> {
    session: Box<dyn Session + 'a>,
    watched: &'a Watched<'a>,
    /// Passes of the session that are counted, or belong to its opening.
    passes: u64,
}

impl WatchedSession<'_> {
    /// Counts the passes made since the last call.
    fn count_passes(&mut self) {
        let passes = self.session.stats().passes;
        self.watched.add(|cost| cost.passes += passes - self.passes);
        self.passes = passes;
    }
}

impl Session for WatchedSession<'_> {
    fn dt(&self) -> f64 {
        self.session.dt()
    }

    fn step(&mut self, ego: Option<&[AgentState]>) -> Result<Vec<Frame>, BoxError> {
        self.watched.monitor.check()?;
        let began = Instant::now();
        let frames = self.session.step(ego)?;
        let stride = (self.session.dt() / self.watched.scene_dt).round().max(1.0);
        let n = stride as usize * frames.len();
        self.watched.monitor.advance(n as u64);
        let samples = self.session.take_predictive_samples();
        self.watched.add(|cost| {
            cost.elapsed += began.elapsed();
            cost.frames += n;
            cost.steps += 1;
            cost.samples.extend(samples);
        });
        self.count_passes();
        Ok(frames)
    }

    fn keep(&mut self, futures: &[usize]) -> bool {
        self.session.keep(futures)
    }

    fn show(&mut self, future: usize, lights: &[Light]) -> bool {
        self.session.show(future, lights)
    }

    fn exchange(&mut self, future: usize, leave: &[AgentId], come: &[Agent]) -> bool {
        self.session.exchange(future, leave, come)
    }

    fn take_for_made(&mut self) {
        self.session.take_for_made();
    }

    fn probe(&mut self, config: ProbeConfig) -> bool {
        self.session.probe(config)
    }

    fn stats(&self) -> SessionStats {
        self.session.stats()
    }

    fn replace(&mut self, future: usize, start: Start<'_>) -> Result<(), BoxError> {
        self.session.replace(future, start)?;
        self.count_passes();
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use gump_engine::SamplingConfig;
    use gump_model::Device;

    use super::*;
    use crate::worlds::WorldName;

    #[test]
    fn samples_are_of_the_same_futures_and_rules_have_none() {
        let scenario = gump_scene::fixture::scenario(
            "lane 1: -50,0 250,0\nego vehicle 0: 0,0 velocity 8,0\n\
             agent vehicle 1: 30,0 velocity 8,0\nhistory 1 future 1 dt 0.1",
        )
        .unwrap();
        let weights = concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/../../datasets/weights/gump-relative.safetensors"
        );
        let learned = WorldName::Model(weights.into());
        let (config, seed) = (
            SimulateConfig {
                seconds: 1.0,
                ..SimulateConfig::default()
            },
            Seed(1),
        );
        let probe = ProbeConfig {
            futures: 1,
            draws: 4,
        };
        let load = |name: &WorldName| {
            let sampling = SamplingConfig::default();
            World::without_log(&Device::Cpu, name, &sampling).unwrap()
        };
        let world = load(&learned);
        let plain = imagine(&world, &scenario, 2, &config, seed, &()).unwrap();
        let probed = imagine_probed(&world, &scenario, 2, &config, seed, probe, &()).unwrap();
        assert!(plain.samples.is_empty());
        // Two futures of ten steps of the scene, which the world makes in two of its own.
        assert_eq!(plain.frames, 20);
        let frames = |imagined: &Imagined| -> Vec<Vec<Frame>> {
            imagined
                .rollouts
                .iter()
                .map(|one| one.imagined().to_vec())
                .collect()
        };
        assert_eq!(frames(&plain), frames(&probed));
        // Two steps of two agents.
        assert_eq!(probed.samples.len(), 4);
        assert!(probed.samples.iter().all(|sample| sample.future == 0));
        let ruled = load(&WorldName::Idm);
        let error = imagine_probed(&ruled, &scenario, 2, &config, seed, probe, &());
        assert!(error.is_err_and(|error| error.to_string().contains("draws nothing")));
    }
}
