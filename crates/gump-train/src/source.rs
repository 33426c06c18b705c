//! The source of samples, drawn ahead of the step that uses them.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, channel};

use gump_model::steps::TOKEN_DT;
use gump_scene::{Scenario, Seed};
use rand::Rng as _;

use crate::TrainError;
use crate::closed_loop_samples::{ClosedLoopConfig, DrivenScenario};
use crate::sample::{Driven, Reader, Sample, SampleConfig, draw};
use crate::scenes::ScenarioSource;

/// The source of samples, shared with the threads that draw them.
pub(super) struct SampleSource {
    pub(super) scenarios: Box<dyn ScenarioSource>,
    /// Scenes as driven by the network.
    pub(super) drives: Vec<DrivenScenario>,
    pub(super) closed_loop: ClosedLoopConfig,
    pub(super) reader: Reader,
    pub(super) config: SampleConfig,
    pub(super) seed: Seed,
}

impl SampleSource {
    /// The samples of a step with these numbers. A scenario too short for a sample is replaced by
    /// another draw.
    pub(super) fn samples(
        &self,
        step: usize,
        numbers: &[usize],
    ) -> Result<Vec<Sample>, TrainError> {
        // More mean that hardly any scenario is long enough.
        const ATTEMPTS: u64 = 64;
        let seed = self.seed.fork(step as u64);
        let mut samples = Vec::with_capacity(numbers.len());
        for &i in numbers {
            let seed = seed.fork(i as u64);
            for attempt in 0..ATTEMPTS {
                if let Some(sample) = self.sample(step, seed.fork(attempt))? {
                    samples.push(sample);
                    break;
                }
            }
        }
        Ok(samples)
    }

    /// One draw; `None` if the scenario drawn is too short.
    fn sample(&self, step: usize, seed: Seed) -> Result<Option<Sample>, TrainError> {
        let pick = |n: usize| (seed.fork(0).0 % n as u64) as usize;
        let is_driven =
            !self.drives.is_empty() && seed.fork(2).rng().random_bool(self.closed_loop.share);
        let driven = is_driven.then(|| Driven {
            drive: &self.drives[pick(self.drives.len())],
            slack: self.closed_loop.slack,
        });
        let scenario = match driven {
            Some(driven) => driven.drive.scenario,
            None => self.scenarios.pick(step, seed.fork(0).0),
        };
        let scenario = self.scenarios.get(scenario)?;
        check_rate(&scenario)?;
        Ok(draw(
            &scenario,
            driven,
            &self.reader,
            &self.config,
            seed.fork(1),
        ))
    }
}

/// Frames must be available every half second; time steps may differ between scenarios.
///
/// Error: [`TrainError::TimeStep`].
pub(super) fn check_rate(scenario: &Scenario) -> Result<(), TrainError> {
    let frames = TOKEN_DT / scenario.dt;
    if (frames - frames.round()).abs() < 1e-3 && frames.round() >= 1.0 {
        return Ok(());
    }
    Err(TrainError::TimeStep {
        id: scenario.id.clone(),
        dt: scenario.dt,
        expected: TOKEN_DT,
    })
}

/// The samples of a step, or the error of drawing them.
pub(super) type SampleReceiver = Receiver<Result<Vec<Sample>, TrainError>>;

/// Draws the samples of a step in the background, while the present step is computed.
///
/// On its own thread: a job of the thread pool could wait for ever behind the step that waits for
/// it.
pub(super) fn prefetch(
    source: &Arc<SampleSource>,
    step: usize,
    numbers: Vec<usize>,
) -> SampleReceiver {
    let (sender, receiver) = channel();
    let source = Arc::clone(source);
    // A receiver that is gone belongs to a trainer that is gone.
    std::thread::spawn(move || drop(sender.send(source.samples(step, &numbers))));
    receiver
}
