//! A session: futures of several starts in progress, step by step.

use std::sync::Arc;

use gump_model::decoder::Bins;
use gump_model::mct::VisualMemory;
use gump_model::steps::TOKEN_DT;
use gump_rollout::{BoxError, PredictiveSamples, ProbeConfig, Session, SessionStats, Start};
use gump_scene::{AgentState, Frame};
use rayon::prelude::*;

use crate::EngineError;
use crate::counters::Counters;
use crate::cpu::SceneMemory;
use crate::partial_ar::{Step, Window, present_all};
use crate::predictive_samples::ObjectDraws;
use crate::reference::{Passes, decode};
use crate::rollout_state::RolloutState;
use crate::scene::SceneContext;
use crate::world::TransformerWorld;

/// An ego farther than this from the origin of its scene gets a new scene around it, metres. Less
/// than the 85 m that training covers; a new scene costs a pass of the visual encoder (decision 5).
const RECENTRE_M: f64 = 60.0;
/// The same with spawning: agents enter and leave at the border of the window (100 m), which must
/// not come near; with 60 m it did (result 12).
const RECENTRE_ALIVE_M: f64 = 20.0;

pub(crate) struct TransformerSession<'a> {
    pub(crate) world: &'a TransformerWorld,
    pub(crate) scenes: Vec<SceneContext>,
    pub(crate) futures: Vec<RolloutState>,
    /// Settings of predictive samples, and those recorded.
    pub(crate) probe: ProbeConfig,
    pub(crate) samples: Vec<PredictiveSamples>,
    pub(crate) counters: Counters,
}

impl Session for TransformerSession<'_> {
    fn dt(&self) -> f64 {
        TOKEN_DT
    }

    fn step(&mut self, ego: Option<&[AgentState]>) -> Result<Vec<Frame>, BoxError> {
        if let Some(states) = ego
            && states.len() != self.futures.len()
        {
            let wrong = EngineError::EgoStates {
                found: states.len(),
                futures: self.futures.len(),
            };
            return Err(wrong.into());
        }
        self.recentre()?;
        let sampling = self.world.sampling();
        let mut windows: Vec<Window> = self
            .futures
            .iter()
            .enumerate()
            .map(|(i, future)| {
                let scene = &self.scenes[future.scene];
                future.window(scene, self.world, ego.map(|states| states[i]))
            })
            .collect();
        if sampling.spawn {
            self.before_decoding(&mut windows)?;
        }
        let decoded = self.decode(&windows)?;
        let mut frames = Vec::with_capacity(self.futures.len());
        for (i, (window, bins)) in windows.into_iter().zip(decoded).enumerate() {
            let scene = &self.scenes[self.futures[i].scene];
            let ego = ego.map(|states| states[i]);
            frames.push(self.futures[i].commit(window, &bins, scene, self.world, ego));
        }
        if sampling.spawn {
            self.after_decoding(&mut frames)?;
        }
        Ok(frames)
    }

    fn keep(&mut self, futures: &[usize]) -> bool {
        let mut index = 0..;
        self.futures
            .retain(|_| index.next().is_some_and(|i| futures.contains(&i)));
        self.forget_unused_scenes();
        true
    }

    /// Only the engine records them: on devices other than a CPU there are none.
    fn probe(&mut self, config: ProbeConfig) -> bool {
        self.probe = config;
        self.world.engine().is_some()
    }

    fn take_predictive_samples(&mut self) -> Vec<PredictiveSamples> {
        std::mem::take(&mut self.samples)
    }

    fn stats(&self) -> SessionStats {
        self.counters.stats()
    }

    fn replace(&mut self, future: usize, start: Start<'_>) -> Result<(), BoxError> {
        let index = self.scenes.len();
        let mut scene = SceneContext::new(self.world, start.scene)?;
        let counters = &self.counters;
        let mut fresh = self
            .world
            .futures(index, &mut scene, 1, start.seed, counters)?;
        self.scenes.push(scene);
        self.futures[future] = fresh.pop().expect("one future was asked for");
        self.forget_unused_scenes();
        Ok(())
    }
}

impl TransformerSession<'_> {
    /// Clears the engine's caches, so that the next step computes everything anew.
    #[cfg(test)]
    pub(crate) fn forget(&mut self) {
        for future in &mut self.futures {
            future.kv_cache = crate::cpu::KvCache::default();
        }
    }

    /// Gives every future whose ego nears the edge of its window a new scene around the ego's
    /// present, with map and tokens; such a future no longer shares its visual memory with others.
    fn recentre(&mut self) -> Result<(), EngineError> {
        let reach = match self.world.sampling().spawn {
            true => RECENTRE_ALIVE_M,
            false => RECENTRE_M,
        };
        let far: Vec<usize> = (0..self.futures.len())
            .filter(|i| self.futures[*i].ego_reach() >= reach)
            .collect();
        let history = self.world.sampling().history.max(1);
        let around = |i: &usize| {
            let future = &self.futures[*i];
            let from = &self.scenes[future.scene];
            SceneContext::of_window(
                self.world,
                Arc::clone(&from.map),
                from.route.clone(),
                future.recent[future.recent.len().saturating_sub(history)..].to_vec(),
                from.ego,
                future.identities.clone(),
            )
        };
        let scenes: Vec<SceneContext> = far.par_iter().map(around).collect::<Result<_, _>>()?;
        for (i, to) in far.into_iter().zip(scenes) {
            let index = self.scenes.len();
            let future = &mut self.futures[i];
            future.enter(index, &self.scenes[future.scene], &to);
            self.scenes.push(to);
        }
        self.forget_unused_scenes();
        Ok(())
    }

    /// One chunk of bins per tracked agent of every window.
    fn decode(&mut self, windows: &[Window]) -> Result<Vec<Vec<Bins>>, EngineError> {
        let (network, sampling) = (self.world.network(), self.world.sampling());
        let placed = present_all(windows, network.config().block_size)?;
        let Some(engine) = self.world.counted_engine(&self.counters) else {
            let memories = self
                .scenes
                .iter()
                .filter_map(|scene| scene.memory.reference());
            let memories: Vec<&VisualMemory> = memories.collect();
            let passes = Passes::new(network, sampling, &memories);
            let decoded = decode(&passes, windows, &placed);
            self.counters.count_passes(passes.count());
            return decoded;
        };
        let memories = self.scenes.iter().filter_map(|scene| scene.memory.packed());
        let memories: Vec<&SceneMemory> = memories.collect();
        let mut kv_caches: Vec<_> = self.futures.iter_mut().map(|f| &mut f.kv_cache).collect();
        let step = Step {
            engine: &engine,
            sampling,
            memories: &memories,
            windows,
            placed,
            probe: self.probe,
        };
        let decoded = step.decode(&mut kv_caches);
        let kept = kv_caches.iter().map(|kv_cache| kv_cache.bytes()).sum();
        self.counters.note_cache_bytes(kept);
        let seen = decoded.seen.iter();
        let samples: Vec<_> = seen
            .filter_map(|seen| self.samples_of(seen, windows))
            .collect();
        self.samples.extend(samples);
        Ok(decoded.bins)
    }

    /// Draws of an object in the world frame.
    fn samples_of(&self, seen: &ObjectDraws, windows: &[Window]) -> Option<PredictiveSamples> {
        let future = &self.futures[seen.window];
        let scene = &self.scenes[future.scene];
        let window = &windows[seen.window];
        let (object, request) = (
            &window.next.tracked[seen.place],
            &window.requests[seen.place],
        );
        let draws = seen.bins.iter().map(|bins| {
            let settled = request.resolve(bins, self.world.sampling());
            AgentState {
                pose: scene.world_from_scene * settled.pose,
                velocity: scene.world_from_scene.rotate(settled.velocity),
            }
        });
        Some(PredictiveSamples {
            future: seen.window,
            step: future.index - future.begun,
            step_s: TOKEN_DT,
            agent: future.identities.agent(object.key.id)?,
            draws: draws.collect(),
        })
    }

    /// Drops scenes that no future is in.
    fn forget_unused_scenes(&mut self) {
        let used = |scene: usize| self.futures.iter().any(|future| future.scene == scene);
        let mut places = Vec::with_capacity(self.scenes.len());
        let mut n = 0;
        for scene in 0..self.scenes.len() {
            places.push(used(scene).then_some(n));
            n += usize::from(used(scene));
        }
        let mut kept = places.iter().map(Option::is_some);
        self.scenes.retain(|_| kept.next().unwrap_or(false));
        for future in &mut self.futures {
            future.scene = places[future.scene].expect("the scene of a future is in use");
        }
    }
}
