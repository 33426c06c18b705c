//! Predictive samples of the sequence network.
//!
//! A state is decoded field by field, each given those before, so its distribution has no closed
//! form; many draws represent it, including truncation and temporal averaging. They come from
//! separate random streams, so simulated futures do not change.

use gump_model::decoder::Bins;
use gump_rollout::ProbeConfig;

use crate::request::Request;

/// Draws of an object: its window, its index there, and a chunk of bins each.
#[derive(Debug)]
pub(crate) struct ObjectDraws {
    pub(crate) window: usize,
    pub(crate) place: usize,
    pub(crate) bins: Vec<Bins>,
}

/// Separates the streams of predictive samples from those of fields and redraws (from 2^20 on).
const SAMPLE_STREAMS: u64 = 1 << 40;

/// The same request many times, each with its own random stream.
pub(crate) fn requests(probe: ProbeConfig, request: &Request) -> impl Iterator<Item = Request> {
    (0..probe.draws as u64).map(|i| Request {
        stream: request.stream.fork(SAMPLE_STREAMS + i),
        ..request.clone()
    })
}

#[cfg(test)]
mod tests {
    use gump_model::testing::{network, scenario};
    use gump_rollout::{PredictiveSamples, Start, WorldModel};
    use gump_scene::{Frame, Seed};

    use super::*;
    use crate::sampling::{Mode, SamplingConfig};
    use crate::world::TransformerWorld;

    const STEPS: usize = 3;

    /// Frames of two futures, step by step, and what was recorded of them.
    fn imagined(
        sampling: &SamplingConfig,
        probe: ProbeConfig,
    ) -> (Vec<Vec<Frame>>, Vec<PredictiveSamples>) {
        let world = TransformerWorld::new(network(), sampling.clone());
        let scenario = scenario();
        let start = Start {
            scene: scenario.present(),
            n_futures: 2,
            seed: Seed(5),
        };
        let mut session = world.open(&[start]).unwrap();
        assert!(session.probe(probe));
        let frames = (0..STEPS).map(|_| session.step(None).unwrap()).collect();
        let samples = session.take_predictive_samples();
        assert!(session.take_predictive_samples().is_empty());
        (frames, samples)
    }

    #[test]
    fn whoever_looks_changes_nothing() {
        for mode in [Mode::PartialAr, Mode::FullAr] {
            let sampling = SamplingConfig {
                mode,
                temperature: Some(1.0),
                ..SamplingConfig::default()
            };
            let probe = ProbeConfig {
                futures: 1,
                draws: 20,
            };
            let (frames, samples) = imagined(&sampling, probe);
            assert_eq!(frames, imagined(&sampling, ProbeConfig::default()).0);
            // One future of two, every step, all five agents, none forgotten.
            let found: Vec<_> = samples.iter().map(|o| (o.future, o.step)).collect();
            let expected = (0..STEPS).flat_map(|step| [(0, step); 5]);
            assert_eq!(found, expected.collect::<Vec<_>>(), "{mode:?}");
            let mut ids: Vec<i64> = samples[..5].iter().map(|o| o.agent.0).collect();
            ids.sort_unstable();
            assert_eq!(ids, [0, 1, 2, 4, 7]);
            // The network is random, so its draws are apart.
            for sample in &samples {
                let first = sample.draws[0];
                assert_eq!(sample.draws.len(), 20);
                assert!(sample.draws.iter().any(|draw| *draw != first));
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
            let probe = ProbeConfig {
                futures: 2,
                draws: 4,
            };
            let (frames, samples) = imagined(&sampling, probe);
            assert_eq!(samples.len(), 2 * 5 * STEPS);
            for sample in samples {
                let state = frames[sample.step][sample.future]
                    .agent(sample.agent)
                    .unwrap()
                    .state;
                assert_eq!(sample.draws, [state; 4], "{mode:?}");
            }
        }
    }
}
