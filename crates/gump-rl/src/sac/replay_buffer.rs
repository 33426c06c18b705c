//! What happened lately, to learn from again.

use gump_scene::Rng;
use rand::Rng as _;

use crate::RlError;

/// One step of one episode.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Transition<'a> {
    /// What was seen.
    pub observation: &'a [f32],
    /// What was done, in [-1, 1].
    pub action: &'a [f32],
    /// What it earned.
    pub reward: f32,
    /// What was seen next, in the same episode also where that ended.
    pub next: &'a [f32],
    /// Whether it ended for good, so that no value comes after; being cut off is no such end.
    pub terminated: bool,
}

/// Keeps the latest transitions, the oldest giving way, and draws from them at random.
///
/// Flat arrays that grow up to the capacity: two observations, an action and five bytes each.
#[derive(Clone, Debug, PartialEq)]
pub struct ReplayBuffer {
    pub(crate) observation_len: usize,
    pub(crate) action_len: usize,
    pub(crate) capacity: usize,
    /// Where the next transition goes once the buffer is full.
    pub(crate) head: usize,
    pub(crate) observations: Vec<f32>,
    pub(crate) actions: Vec<f32>,
    pub(crate) rewards: Vec<f32>,
    pub(crate) nexts: Vec<f32>,
    pub(crate) terminated: Vec<bool>,
}

impl ReplayBuffer {
    /// An empty buffer for `capacity` transitions.
    ///
    /// # Errors
    /// [`RlError::Parameter`] for a capacity of 0.
    pub fn new(
        capacity: usize,
        observation_len: usize,
        action_len: usize,
    ) -> Result<Self, RlError> {
        if capacity == 0 {
            return Err(RlError::Parameter {
                name: "capacity",
                value: 0.0,
                expected: "at least one transition",
            });
        }
        Ok(Self {
            observation_len,
            action_len,
            capacity,
            head: 0,
            observations: Vec::new(),
            actions: Vec::new(),
            rewards: Vec::new(),
            nexts: Vec::new(),
            terminated: Vec::new(),
        })
    }

    /// Adds a transition, replacing the oldest if the buffer is full.
    ///
    /// # Panics
    /// If observations or action have another length than the buffer's.
    pub fn push(&mut self, transition: Transition<'_>) {
        let Transition {
            observation,
            action,
            reward,
            next,
            terminated,
        } = transition;
        let lengths = [observation.len(), action.len(), next.len()];
        let expected = [self.observation_len, self.action_len, self.observation_len];
        assert_eq!(lengths, expected, "lengths of observation, action, next");
        if self.len() < self.capacity {
            self.observations.extend_from_slice(observation);
            self.actions.extend_from_slice(action);
            self.rewards.push(reward);
            self.nexts.extend_from_slice(next);
            self.terminated.push(terminated);
            return;
        }
        let i = self.head;
        let (o, a) = (self.observation_len, self.action_len);
        self.observations[i * o..][..o].copy_from_slice(observation);
        self.actions[i * a..][..a].copy_from_slice(action);
        self.rewards[i] = reward;
        self.nexts[i * o..][..o].copy_from_slice(next);
        self.terminated[i] = terminated;
        self.head = (i + 1) % self.capacity;
    }

    /// Draws the indices of `n` transitions, each uniformly and with replacement.
    ///
    /// # Errors
    /// [`RlError::EmptyBuffer`] if there is nothing to draw from.
    pub fn sample(&self, n: usize, rng: &mut Rng) -> Result<Vec<usize>, RlError> {
        if self.is_empty() {
            return Err(RlError::EmptyBuffer { asked: n });
        }
        Ok((0..n).map(|_| rng.random_range(0..self.len())).collect())
    }

    /// The transition at an index below [`ReplayBuffer::len`].
    ///
    /// # Panics
    /// At any other index.
    pub fn get(&self, index: usize) -> Transition<'_> {
        let (o, a) = (self.observation_len, self.action_len);
        Transition {
            observation: &self.observations[index * o..][..o],
            action: &self.actions[index * a..][..a],
            reward: self.rewards[index],
            next: &self.nexts[index * o..][..o],
            terminated: self.terminated[index],
        }
    }

    /// The transitions held, oldest first.
    pub fn iter(&self) -> impl Iterator<Item = Transition<'_>> {
        let newest_last = (self.head..self.len()).chain(0..self.head);
        newest_last.map(|index| self.get(index))
    }

    /// All observations held, in no promised order. Shape: `[len, observation_len]`.
    pub fn observations(&self) -> &[f32] {
        &self.observations
    }

    /// Number of transitions held.
    pub fn len(&self) -> usize {
        self.rewards.len()
    }

    /// True if nothing is held.
    pub fn is_empty(&self) -> bool {
        self.rewards.is_empty()
    }

    /// Most transitions it can hold.
    pub fn capacity(&self) -> usize {
        self.capacity
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_scene::Seed;

    /// Transition `i` of a stream: every part of it tells `i`.
    fn filled(capacity: usize, n: usize) -> ReplayBuffer {
        let mut buffer = ReplayBuffer::new(capacity, 2, 1).unwrap();
        for i in 0..n {
            let x = i as f32;
            buffer.push(Transition {
                observation: &[x, -x],
                action: &[x / 10.0],
                reward: x,
                next: &[x + 1.0, -x - 1.0],
                terminated: i.is_multiple_of(3),
            });
        }
        buffer
    }

    #[test]
    fn the_oldest_gives_way() {
        let check = |n: usize, expected: &[f32]| {
            let buffer = filled(3, n);
            let held: Vec<f32> = buffer.iter().map(|t| t.reward).collect();
            assert_eq!(held, expected);
            assert_eq!(buffer.len(), expected.len());
        };
        check(0, &[]);
        check(2, &[0.0, 1.0]);
        check(3, &[0.0, 1.0, 2.0]);
        check(4, &[1.0, 2.0, 3.0]);
        check(8, &[5.0, 6.0, 7.0]);
    }

    #[test]
    fn the_parts_of_a_transition_stay_together() {
        // Written over twice and a half: no part may come from across the write head.
        let buffer = filled(10, 25);
        for t in buffer.iter() {
            let x = t.reward;
            assert_eq!(t.observation, [x, -x]);
            assert_eq!(t.action, [x / 10.0]);
            assert_eq!(t.next, [x + 1.0, -x - 1.0]);
            assert_eq!(t.terminated, (x as usize).is_multiple_of(3));
        }
        assert_eq!(buffer.iter().count(), 10);
    }

    #[test]
    fn samples_are_uniform_and_repeat_with_their_seed() {
        let buffer = filled(10, 25);
        let draw = |seed| buffer.sample(5000, &mut Seed(seed).rng()).unwrap();
        assert_eq!(draw(1), draw(1));
        assert_ne!(draw(1), draw(2));
        // Chi-square with 9 degrees of freedom: 27.9 is exceeded once in a thousand.
        let drawn = draw(3);
        let counts = (0..10).map(|i| drawn.iter().filter(|&&index| index == i).count());
        let chi_square: f64 = counts.map(|n| (n as f64 - 500.0).powi(2) / 500.0).sum();
        assert!(chi_square < 27.9, "{chi_square}");
    }

    #[test]
    fn empty_buffers_are_refused() {
        let buffer = filled(3, 0);
        let error = buffer.sample(4, &mut Seed(0).rng()).unwrap_err();
        assert!(matches!(error, RlError::EmptyBuffer { asked: 4 }));
        assert!(ReplayBuffer::new(0, 2, 1).is_err());
    }
}
