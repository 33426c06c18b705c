//! Generated scenes beside recorded ones: their likeness, the prompts they satisfy, and half a minute
//! of traffic.
//!
//! Likeness is the maximum mean discrepancy in TrafficGen's protocol, as in the GUMP paper: vehicles
//! within 50 m of the recorded ego, which every [`SceneSource`] gets with as many vehicles as were
//! recorded. [`recorded_scenarios`] and [`ComparedScene::of`] choose what is compared with,
//! [`SceneMakers`] makes scenes and [`GenerationTally`] scores them. [`prompt_satisfaction`] and
//! [`observe_world`] have scenes of their own.

mod long;
mod prompts;
mod sources;

use gump_data::ReadOptions;
use gump_generate::baseline::{overlapping_vehicles, wrong_way};
use gump_generate::check::off_road;

use gump_metrics::mmd::{MmdMean, MmdProtocol, SceneMmd, scene_mmd};
use gump_metrics::{Interval, intervals};
use gump_scene::{Frame, Scenario, Seed};
use rayon::prelude::*;

use crate::benchmarks::ScenarioSet;
use crate::{EvalError, Monitor};

pub use long::{
    LongObservation, LongSummary, long_scenes, observe_logs, observe_world, summarize_long,
};
pub use prompts::{PromptConfig, PromptMeans, PromptRow, PromptSatisfaction, prompt_satisfaction};
pub use sources::{ComparedScene, SceneMakers, SceneSource};

/// Draws of recordings for an interval; its ends move by a few percent of its width with the seed.
const DRAWS: usize = 1000;

/// The attributes in which scenes are compared.
pub const ATTRIBUTES: [&str; 6] = ["position", "heading", "speed", "size", "gap", "per_lane"];

/// The first `limit` scenarios of a set that the protocol admits.
///
/// # Errors
/// The first record that cannot be read, or [`EvalError::Stopped`].
pub fn recorded_scenarios(
    set: &ScenarioSet,
    limit: Option<usize>,
    protocol: &MmdProtocol,
    monitor: &dyn Monitor,
) -> Result<Vec<Scenario>, EvalError> {
    let mut scenarios = Vec::new();
    for record in set.open(ReadOptions::ALL)? {
        monitor.check()?;
        let scenario = record?.scenario;
        let present = scenario.present();
        if scene_mmd(&present, present.now(), protocol).is_some() {
            scenarios.push(scenario);
        }
        if limit.is_some_and(|limit| scenarios.len() >= limit) {
            break;
        }
    }
    Ok(scenarios)
}

/// Scores of the scenes that one source made.
#[derive(Clone, Debug, Default)]
pub struct GenerationTally {
    /// The discrepancy of each scene, with the index of its recording.
    pub mmd: Vec<(usize, SceneMmd)>,
    /// Number of scenes that could not be made.
    pub failed: usize,
    /// Number of vehicles.
    pub vehicles: usize,
    /// Number of vehicles that overlap another.
    pub overlapping: usize,
    /// Number of vehicles off the road.
    pub off_road: usize,
    /// Number of vehicles that move on a lane.
    pub moving: usize,
    /// Number of them that move against it.
    pub wrong_way: usize,
}

impl GenerationTally {
    /// Makes a scene in place of every recorded one and scores it; the seed of a scene is forked from
    /// `seed` by its position.
    pub fn of(makers: &SceneMakers<'_>, source: SceneSource, seed: Seed) -> Self {
        let frames: Vec<Option<Frame>> = (0..makers.cases.len())
            .into_par_iter()
            .map(|i| makers.make(source, i, seed.fork(i as u64)))
            .collect();
        let mut tally = Self::default();
        for (case, frame) in makers.cases.iter().zip(frames) {
            match frame {
                Some(frame) => tally.add(case, frame, &makers.protocol),
                None => tally.failed += 1,
            }
        }
        tally
    }

    fn add(&mut self, case: &ComparedScene, frame: Frame, protocol: &MmdProtocol) {
        let recorded = &case.recorded;
        if let Some(mmd) = scene_mmd(&recorded.present(), &frame, protocol) {
            self.mmd.push((case.recording, mmd));
        }
        let (overlapping, vehicles) = overlapping_vehicles(&frame);
        let (wrong, moving) = wrong_way(&recorded.map, &frame);
        self.overlapping += overlapping;
        self.vehicles += vehicles;
        self.wrong_way += wrong;
        self.moving += moving;
        self.off_road += off_road(&alone(recorded, frame));
    }

    /// Means over scenes.
    pub fn mean(&self) -> SceneMmd {
        let mut mean = MmdMean::default();
        self.mmd.iter().for_each(|(_, mmd)| mean.add(mmd));
        mean.mean()
    }

    /// 95 % intervals of the means of [`ATTRIBUTES`], for which recordings are drawn with all their
    /// scenes.
    pub fn intervals(&self, n_recordings: usize, seed: Seed) -> Vec<Option<Interval>> {
        intervals(n_recordings, DRAWS, seed, |drawn| {
            let mut mean = MmdMean::default();
            for recording in drawn {
                let own = self.mmd.iter().filter(|(of, _)| of == recording);
                own.for_each(|(_, mmd)| mean.add(mmd));
            }
            mean.mean().values().to_vec()
        })
    }
}

/// The frame as the only one of a scenario.
fn alone(scenario: &Scenario, frame: Frame) -> Scenario {
    Scenario {
        log: vec![frame],
        now: 0,
        ..scenario.clone()
    }
}

#[cfg(test)]
mod tests {
    use gump_engine::{SamplingConfig, TransformerWorld};
    use gump_model::{Device, ModelConfig, Network};

    use super::*;

    #[test]
    fn the_log_is_like_itself() {
        let scenario = gump_scene::fixture::scenario(
            "lane 1: -50,0 99,0\nego vehicle 0: 0,0\nagent vehicle 1: 10,0 velocity 5,0\n\
             agent vehicle 2: 20,0",
        )
        .unwrap();
        let protocol = MmdProtocol {
            min_vehicles: 2,
            ..MmdProtocol::gump()
        };
        let cases = ComparedScene::of(0, scenario, 0, &protocol, Seed(0));
        let network = Network::random(ModelConfig::tiny(), Seed(0), &Device::Cpu).unwrap();
        let world = TransformerWorld::new(network, SamplingConfig::default());
        let makers = SceneMakers {
            world: &world,
            cases: &cases,
            bank: &[],
            protocol,
        };
        let tally = GenerationTally::of(&makers, SceneSource::Log, Seed(0));
        assert_eq!((tally.mmd.len(), tally.failed, tally.vehicles), (1, 0, 3));
        assert_eq!((tally.overlapping, tally.wrong_way), (0, 0));
        assert!(
            tally
                .mean()
                .values()
                .iter()
                .flatten()
                .all(|mmd| mmd.abs() < 1e-6)
        );
        let none = GenerationTally::of(&makers, SceneSource::Retrieval, Seed(0));
        assert_eq!(none.failed, 1);
    }
}
