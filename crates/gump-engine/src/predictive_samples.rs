//! Predictive samples: the distributions of agents' next states, represented by draws.
//!
//! A state is decoded field by field, each given those before, so its distribution has no closed
//! form; many draws represent it, including truncation and temporal averaging. They come from
//! separate random streams, so simulated futures do not change.

#[cfg(feature = "tensors")]
use gump_model::decoder::Bins;
use gump_model::steps::TOKEN_DT;
use gump_scene::{AgentId, AgentState};

#[cfg(feature = "tensors")]
use crate::request::Request;

/// Which predictive samples a session records; none by default.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ProbeConfig {
    /// Number of futures of a session to record, the first ones.
    pub futures: usize,
    /// Draws per agent and step.
    pub draws: usize,
}

/// The possible states of one agent half a second later.
///
/// Draws that overlap other agents are included; the world itself redraws those
/// ([`SamplingConfig::redraws`](crate::SamplingConfig::redraws)).
#[derive(Clone, Debug, PartialEq)]
pub struct PredictiveSamples {
    /// Index of the future in the session.
    pub future: usize,
    /// Number of steps of the session before it: 0 is sampled from the start.
    pub step: usize,
    /// The agent.
    pub agent: AgentId,
    /// States, world frame, all equally likely.
    pub draws: Vec<AgentState>,
}

impl PredictiveSamples {
    /// Time from the frame it is sampled from to the draws, seconds.
    pub const AHEAD_S: f64 = TOKEN_DT;

    /// Time of the frame it is sampled from, seconds after the start.
    pub fn from_s(&self) -> f64 {
        self.step as f64 * TOKEN_DT
    }
}

/// Draws of an object: its window, its index there, and a chunk of bins each.
#[derive(Debug)]
#[cfg(feature = "tensors")]
pub(crate) struct Seen {
    pub(crate) window: usize,
    pub(crate) place: usize,
    pub(crate) bins: Vec<Bins>,
}

/// Separates the streams of predictive samples from those of fields and redraws.
#[cfg(feature = "tensors")]
const WATCH: u64 = 1 << 40;

#[cfg(feature = "tensors")]
impl ProbeConfig {
    /// The same request many times, each with its own random stream.
    pub(crate) fn requests(self, request: &Request) -> impl Iterator<Item = Request> {
        (0..self.draws as u64).map(|i| Request {
            stream: request.stream.fork(WATCH + i),
            ..request.clone()
        })
    }
}

#[cfg(test)]
#[cfg(feature = "tensors")]
mod tests {
    use gump_model::testing::{network, scenario};
    use gump_rollout::{Start, WorldModel};
    use gump_scene::{Frame, Seed};

    use super::*;
    use crate::sampling::{Mode, SamplingConfig};
    use crate::world::TransformerWorld;

    const STEPS: usize = 3;

    fn world(sampling: SamplingConfig, watch: ProbeConfig) -> TransformerWorld {
        TransformerWorld::new(network(), sampling).watching(watch)
    }

    /// Frames of two futures, step by step.
    fn imagined(world: &TransformerWorld) -> Vec<Vec<Frame>> {
        let scenario = scenario();
        let start = Start {
            scene: scenario.present(),
            n_futures: 2,
            seed: Seed(5),
        };
        let mut session = world.open(&[start]).unwrap();
        (0..STEPS).map(|_| session.step(None).unwrap()).collect()
    }

    #[test]
    fn whoever_looks_changes_nothing() {
        for mode in [Mode::PartialAr, Mode::FullAr] {
            let sampling = SamplingConfig {
                mode,
                temperature: Some(1.0),
                ..SamplingConfig::default()
            };
            let watch = ProbeConfig {
                futures: 1,
                draws: 20,
            };
            let watched = world(sampling.clone(), watch);
            let frames = imagined(&watched);
            assert_eq!(frames, imagined(&world(sampling, ProbeConfig::default())));
            let outlooks = watched.take_predictive_samples();
            assert!(watched.take_predictive_samples().is_empty());
            // One future of two, every step, all five agents, none forgotten.
            let told: Vec<_> = outlooks.iter().map(|o| (o.future, o.step)).collect();
            let expected = (0..STEPS).flat_map(|step| [(0, step); 5]);
            assert_eq!(told, expected.collect::<Vec<_>>(), "{mode:?}");
            let mut ids: Vec<i64> = outlooks[..5].iter().map(|o| o.agent.0).collect();
            ids.sort_unstable();
            assert_eq!(ids, [0, 1, 2, 4, 7]);
            // The network is random, so its draws are apart.
            for outlook in &outlooks {
                let first = outlook.draws[0];
                assert_eq!(outlook.draws.len(), 20);
                assert!(outlook.draws.iter().any(|draw| *draw != first));
            }
        }
    }

    #[test]
    fn where_there_is_one_choice_all_draws_are_what_is_imagined() {
        for mode in [Mode::PartialAr, Mode::FullAr] {
            let sampling = SamplingConfig {
                mode,
                top_k: 1,
                redraws: 0,
                ..SamplingConfig::default()
            };
            let watch = ProbeConfig {
                futures: 2,
                draws: 4,
            };
            let world = world(sampling, watch);
            let frames = imagined(&world);
            let outlooks = world.take_predictive_samples();
            assert_eq!(outlooks.len(), 2 * 5 * STEPS);
            for outlook in outlooks {
                let state = frames[outlook.step][outlook.future]
                    .agent(outlook.agent)
                    .unwrap()
                    .state;
                assert_eq!(outlook.draws, [state; 4], "{mode:?}");
            }
        }
    }
}
