//! Counters of the work of a session.

use std::cell::Cell;
use std::rc::Rc;

use gump_model::decoder::Bins;
use gump_rollout::SessionStats;

use crate::cpu::{Engine, Job, Successor};
use crate::request::Request;
use crate::sampling::SamplingConfig;

/// The work of a session so far, which its parts share.
#[derive(Clone, Debug, Default)]
pub(crate) struct Counters(Rc<Cell<SessionStats>>);

impl Counters {
    /// The work so far.
    pub(crate) fn stats(&self) -> SessionStats {
        self.0.get()
    }

    /// Adds passes of the network.
    pub(crate) fn count_passes(&self, n: u64) {
        self.change(|stats| stats.passes += n);
    }

    /// Adds multiplications, each with an addition.
    fn count_products(&self, n: u64) {
        self.change(|stats| stats.operations += 2 * n);
    }

    /// Notes how many bytes of keys and values are held.
    pub(crate) fn note_cache_bytes(&self, bytes: usize) {
        self.change(|stats| stats.cache_bytes = stats.cache_bytes.max(bytes));
    }

    fn change(&self, change: impl FnOnce(&mut SessionStats)) {
        let mut stats = self.0.get();
        change(&mut stats);
        self.0.set(stats);
    }
}

/// The engine as one session uses it: what it computes is counted.
#[derive(Clone, Debug)]
pub(crate) struct CountedEngine<'a> {
    pub(crate) engine: &'a Engine,
    pub(crate) counters: Counters,
}

impl CountedEngine<'_> {
    /// As [`Engine::run`]; one pass, unless there are no jobs.
    pub(crate) fn run(&self, jobs: &mut [Job<'_>]) -> Vec<f32> {
        let mut products = 0;
        self.counters.count_passes(u64::from(!jobs.is_empty()));
        let hidden = self.engine.run_counted(jobs, &mut products);
        self.counters.count_products(products);
        hidden
    }

    /// As [`Engine::sample`].
    pub(crate) fn sample(
        &self,
        hidden: &[f32],
        requests: &[&Request],
        config: &SamplingConfig,
    ) -> Vec<Bins> {
        let products = self.engine.products_of_samples(requests.len());
        self.counters.count_products(products);
        self.engine.sample(hidden, requests, config)
    }

    /// As [`Engine::successors`].
    pub(crate) fn successors(&self, hidden: &[f32]) -> Vec<Successor> {
        let rows = hidden.len() / self.width();
        let products = self.engine.products_of_successors(rows);
        self.counters.count_products(products);
        self.engine.successors(hidden)
    }

    /// Numbers of a hidden vector.
    pub(crate) fn width(&self) -> usize {
        self.engine.width()
    }
}
