//! The data of a step of the relative network, drawn ahead of it: samples, and rollouts with their
//! rewards.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, channel};

use gump_model::relative::RelativeNetwork;
use gump_model::relative::sample::{Sample, SampleConfig, draw};
use gump_scene::Seed;
use rand::Rng as _;

use crate::TrainError;
use crate::relative::drives::NetworkDriver;
use crate::relative::rewards::{Group, Judged};
use crate::relative::train::RelativeTrainConfig;
use crate::scenes::ScenarioSource;

/// Maximum number of scenes tried for a sample: more mean that hardly any is long enough.
const ATTEMPTS: u64 = 64;
/// Maximum number of scenes drawn to find one with lights, which may be rare.
const PICKS: u64 = 4096;
/// Separates the scenes to roll out from those of the samples.
const GROUP: u64 = 1 << 40;
/// Separates from these whether the scene has to have lights.
const LIT: u64 = 1 << 41;

/// The data of a step, or the error of drawing it.
pub(super) type BatchReceiver = Receiver<Result<Batch, TrainError>>;

/// The data of a step.
pub(super) struct Batch {
    pub(super) samples: Vec<Sample>,
    pub(super) group: Option<Group>,
}

impl Batch {
    /// The rewarded samples that have moves.
    pub(super) fn judged(&self) -> Vec<&Sample> {
        let group = self.group.iter().flat_map(|group| &group.samples);
        group.filter(|sample| !sample.targets.is_empty()).collect()
    }

    /// Agent-frames of all samples.
    pub(super) fn n_nodes(&self) -> usize {
        let group = self.group.iter().flat_map(|group| &group.samples);
        self.samples.iter().chain(group).map(Sample::n_nodes).sum()
    }

    /// A channel that holds it.
    pub(super) fn again(self) -> BatchReceiver {
        let (sender, receiver) = channel();
        sender.send(Ok(self)).expect("the receiver is there");
        receiver
    }
}

/// The driving network, for drives and for rewards.
#[derive(Default)]
pub(super) struct Drivers {
    driver: Option<NetworkDriver>,
    judged: Option<Judged>,
}

impl Drivers {
    /// Those that the settings ask for, if a network drives.
    pub(super) fn new(
        driving: Option<&RelativeNetwork>,
        config: &RelativeTrainConfig,
    ) -> Result<Self, TrainError> {
        let driver = driving.zip(config.closed_loop.as_ref());
        let driver = driver.map(|(network, drives)| NetworkDriver::new(network, drives));
        let judged = driving.zip(config.realism.as_ref());
        let judged = judged.map(|(network, rewards)| Judged::new(network, rewards));
        Ok(Self {
            driver: driver.transpose()?,
            judged: judged.transpose()?,
        })
    }
}

/// Scenarios, and how to draw from them.
pub(super) struct BatchSource {
    pub(super) scenarios: Box<dyn ScenarioSource>,
    pub(super) config: SampleConfig,
    pub(super) seed: Seed,
    pub(super) batch: usize,
}

impl BatchSource {
    fn batch(&self, step: usize, drivers: &Drivers) -> Result<Batch, TrainError> {
        let group = drivers.judged.as_ref();
        let group = group.map(|judged| self.group(step, judged));
        Ok(Batch {
            samples: self.samples(step, drivers.driver.as_ref())?,
            group: group.transpose()?,
        })
    }

    fn group(&self, step: usize, judged: &Judged) -> Result<Group, TrainError> {
        let seed = self.seed.fork(step as u64).fork(GROUP);
        let lit = seed.fork(LIT).rng().random_bool(judged.lit());
        let mut excluded = 0;
        for pick in 0..PICKS {
            let seed = seed.fork(pick);
            let scenario = self.scenarios.pick(step, seed.fork(0).0);
            let scenario = self.scenarios.get(scenario)?;
            if lit && scenario.log[scenario.now].lights().is_empty() {
                continue;
            }
            if let Some(mut group) = judged.group(&scenario, seed.fork(1))? {
                group.excluded.scenes = excluded;
                return Ok(group);
            }
            excluded += 1;
            if excluded == ATTEMPTS as usize {
                break;
            }
        }
        Err(TrainError::NoComparableScene)
    }

    fn samples(
        &self,
        step: usize,
        driver: Option<&NetworkDriver>,
    ) -> Result<Vec<Sample>, TrainError> {
        let seed = self.seed.fork(step as u64);
        let drawn = (0..self.batch).map(|i| {
            let seed = seed.fork(i as u64);
            for attempt in 0..ATTEMPTS {
                let seed = seed.fork(attempt);
                let scenario = self.scenarios.pick(step, seed.fork(0).0);
                let scenario = self.scenarios.get(scenario)?;
                let sample = draw(
                    &scenario,
                    &self.config,
                    driver.map(|d| d as _),
                    seed.fork(1),
                );
                if let Some(sample) = sample.filter(|sample| !sample.targets.is_empty()) {
                    return Ok(sample);
                }
            }
            Err(TrainError::NoData { frames: 3 })
        });
        drawn.collect()
    }
}

/// Draws the data of a step in the background.
pub(super) fn prefetch(source: &Arc<BatchSource>, step: usize, drivers: Drivers) -> BatchReceiver {
    let (sender, receiver) = channel();
    let source = Arc::clone(source);
    // A receiver that is gone belongs to a trainer that is gone.
    std::thread::spawn(move || drop(sender.send(source.batch(step, &drivers))));
    receiver
}
