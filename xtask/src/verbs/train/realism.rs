//! Realism during training: the current network simulates held-out scenes, which are scored as in
//! the Waymo Sim Agents Challenge of 2025.

use gump_rollout::{SimulateConfig, Start, WorldModel, simulate};
use gump_scene::{Scenario, Seed};
use gump_wosac::realism::{Config, Log, Reference, Rollouts, Scores, Year};

use crate::run::stop_if_interrupted;

/// Maximum number of simulated scenes: the evaluation between two steps has to be quick. Chosen by
/// hand.
const SCENES: usize = 8;
/// Seconds that the challenge requires.
const HORIZON_S: f64 = 8.0;

/// Held-out scenes that can be scored.
pub(super) struct Judge<'a> {
    scenes: Vec<(&'a Scenario, Log)>,
    config: Config,
    rollouts: usize,
    seed: Seed,
}

impl<'a> Judge<'a> {
    /// The first of the scenes on which the challenge is defined, with so many rollouts of each;
    /// `None` without such a scene or without rollouts.
    pub(super) fn new(scenes: &'a [Scenario], rollouts: usize, seed: Seed) -> Option<Self> {
        if rollouts == 0 {
            return None;
        }
        let config = Config::of(Year::Y2025);
        let scored = scenes.iter().filter_map(|scenario| {
            let log = Log::of(scenario).ok()?;
            let is_defined = Reference::new(&log, &config).is_ok();
            is_defined.then_some((scenario, log))
        });
        let scenes: Vec<_> = scored.take(SCENES).collect();
        (!scenes.is_empty()).then_some(Self {
            scenes,
            config,
            rollouts,
            seed,
        })
    }

    /// Number of scenes.
    pub(super) fn scenes(&self) -> usize {
        self.scenes.len()
    }

    /// Mean scores of a world over the scenes.
    ///
    /// Error: what the world reports, or Ctrl-C.
    pub(super) fn score(&self, world: &dyn WorldModel) -> anyhow::Result<Option<Scores>> {
        let mut all = Vec::with_capacity(self.scenes.len());
        for (i, (scenario, log)) in self.scenes.iter().enumerate() {
            stop_if_interrupted()?;
            let start = Start {
                scene: scenario.present().unguided(),
                n_futures: self.rollouts,
                seed: self.seed.fork(i as u64),
            };
            let config = SimulateConfig {
                seconds: HORIZON_S,
                ..SimulateConfig::default()
            };
            let imagined = simulate(world, &[start], None, &config)
                .map_err(|error| anyhow::anyhow!("{}: {error}", scenario.id))?;
            let rollouts = Rollouts::of(&scenario.id, &imagined, self.config.mode)?;
            all.push(
                Reference::new(log, &self.config)?
                    .evaluate(&rollouts)?
                    .scores,
            );
        }
        Ok(Scores::mean(&all))
    }
}
