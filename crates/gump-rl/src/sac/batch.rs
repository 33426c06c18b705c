//! Batches of normalized transitions, the input of a gradient step.

use super::replay_buffer::ReplayBuffer;
use crate::RlError;
use crate::networks::Normalizer;
use gump_scene::Rng;

/// Transitions as flat rows; expert transitions come last.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Batch {
    /// Shape: `[n, observation_len]`.
    pub observations: Vec<f32>,
    /// Shape: `[n, action_len]`, in [-1, 1].
    pub actions: Vec<f32>,
    /// Shape: `[n]`.
    pub rewards: Vec<f32>,
    /// Shape: `[n, observation_len]`.
    pub nexts: Vec<f32>,
    /// Whether the episode terminated. Shape: `[n]`.
    pub terminated: Vec<bool>,
    /// Number of expert transitions, which are the last rows.
    pub n_imitated: usize,
}

impl Batch {
    /// Number of transitions.
    pub fn len(&self) -> usize {
        self.rewards.len()
    }

    /// True if the batch is empty.
    pub fn is_empty(&self) -> bool {
        self.rewards.is_empty()
    }

    /// Number of the learner's own transitions.
    pub fn n_own(&self) -> usize {
        self.len() - self.n_imitated
    }

    /// Refills the batch with `n_own` transitions of `replay` and `n_imitated` of `expert`, each
    /// drawn uniformly.
    ///
    /// # Errors
    /// [`RlError::EmptyBuffer`] where a buffer is empty.
    pub fn draw(
        &mut self,
        (replay, n_own): (&ReplayBuffer, usize),
        (expert, n_imitated): (&ReplayBuffer, usize),
        normalizer: Option<&Normalizer>,
        rng: &mut Rng,
    ) -> Result<(), RlError> {
        self.observations.clear();
        self.actions.clear();
        self.rewards.clear();
        self.nexts.clear();
        self.terminated.clear();
        self.n_imitated = n_imitated;
        for (buffer, n) in [(replay, n_own), (expert, n_imitated)] {
            if n == 0 {
                continue;
            }
            for index in buffer.sample(n, rng)? {
                let transition = buffer.get(index);
                self.observations.extend_from_slice(&transition.observation);
                self.actions.extend_from_slice(transition.action);
                self.rewards.push(transition.reward);
                self.nexts.extend_from_slice(&transition.next);
                self.terminated.push(transition.terminated);
            }
        }
        if let Some(normalizer) = normalizer {
            normalizer.apply(&mut self.observations);
            normalizer.apply(&mut self.nexts);
        }
        Ok(())
    }
}
