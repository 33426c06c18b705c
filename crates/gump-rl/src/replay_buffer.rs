//! What happened lately, to learn from again.

use gump_scene::Rng;
use rand::Rng as _;

use crate::{Action, End, Observation, RlError};

/// One step of one episode.
#[derive(Clone, Debug, PartialEq)]
pub struct Transition {
    /// What was seen.
    pub observation: Observation,
    /// What was done, as applied: within the limits.
    pub action: Action,
    /// What it earned.
    pub reward: f64,
    /// What was seen next, in the same episode also where that ended.
    pub next: Observation,
    /// How the episode ended, if this was its last step.
    pub end: Option<End>,
}

/// Keeps the latest transitions, the oldest giving way, and draws from them at random.
#[derive(Clone, Debug)]
pub struct ReplayBuffer {
    transitions: Vec<Transition>,
    capacity: usize,
    /// Where the next transition goes once the buffer is full.
    head: usize,
}

impl Transition {
    /// True if there is a value after this step: always but after a failure.
    pub fn bootstraps(&self) -> bool {
        !matches!(self.end, Some(End::Terminated(_)))
    }
}

impl ReplayBuffer {
    /// An empty buffer for `capacity` transitions.
    ///
    /// # Errors
    /// [`RlError::Parameter`] for a capacity of 0.
    pub fn new(capacity: usize) -> Result<Self, RlError> {
        if capacity == 0 {
            return Err(RlError::Parameter {
                name: "capacity",
                value: 0.0,
                expected: "at least one transition",
            });
        }
        Ok(Self {
            transitions: Vec::new(),
            capacity,
            head: 0,
        })
    }

    /// Adds a transition, replacing the oldest if the buffer is full.
    pub fn push(&mut self, transition: Transition) {
        if self.transitions.len() < self.capacity {
            self.transitions.push(transition);
        } else {
            self.transitions[self.head] = transition;
            self.head = (self.head + 1) % self.capacity;
        }
    }

    /// Draws `n` transitions, each uniformly and with replacement.
    ///
    /// # Errors
    /// [`RlError::EmptyBuffer`] if there is nothing to draw from.
    pub fn sample(&self, n: usize, rng: &mut Rng) -> Result<Vec<&Transition>, RlError> {
        if self.is_empty() {
            return Err(RlError::EmptyBuffer { asked: n });
        }
        let draw = |_| &self.transitions[rng.random_range(0..self.transitions.len())];
        Ok((0..n).map(draw).collect())
    }

    /// The transitions held, oldest first.
    pub fn iter(&self) -> impl Iterator<Item = &Transition> {
        let (newer, older) = self.transitions.split_at(self.head);
        older.iter().chain(newer)
    }

    /// Number of transitions held.
    pub fn len(&self) -> usize {
        self.transitions.len()
    }

    /// True if nothing is held.
    pub fn is_empty(&self) -> bool {
        self.transitions.is_empty()
    }

    /// Most transitions it can hold.
    pub fn capacity(&self) -> usize {
        self.capacity
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Failure, ObservationSpec, observe};
    use gump_scene::{Seed, fixture};

    fn transition(reward: f64, end: Option<End>) -> Transition {
        let scenario = fixture::scenario("ego vehicle 0: 0,0").unwrap();
        let observation = observe(&ObservationSpec::default(), &scenario.present());
        Transition {
            next: observation.clone(),
            observation,
            action: Action::default(),
            reward,
            end,
        }
    }

    fn filled(capacity: usize, n: usize) -> ReplayBuffer {
        let mut buffer = ReplayBuffer::new(capacity).unwrap();
        for i in 0..n {
            buffer.push(transition(i as f64, None));
        }
        buffer
    }

    #[test]
    fn the_oldest_gives_way() {
        let check = |n: usize, expected: &[f64]| {
            let buffer = filled(3, n);
            let held: Vec<f64> = buffer.iter().map(|t| t.reward).collect();
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
    fn only_a_failure_has_no_value_after_it() {
        let check = |end, expected| assert_eq!(transition(0.0, end).bootstraps(), expected);
        check(None, true);
        check(Some(End::Truncated), true);
        check(Some(End::Terminated(Failure::Collision)), false);
        check(Some(End::Terminated(Failure::OffRoad)), false);
    }

    #[test]
    fn samples_are_uniform_and_repeat_with_their_seed() {
        let buffer = filled(10, 25);
        let draw = |seed| {
            let sample = buffer.sample(5000, &mut Seed(seed).rng()).unwrap();
            sample.iter().map(|t| t.reward).collect::<Vec<_>>()
        };
        assert_eq!(draw(1), draw(1));
        assert_ne!(draw(1), draw(2));
        // Chi-square with 9 degrees of freedom: 27.9 is exceeded once in a thousand.
        let drawn = draw(3);
        let counts = (15..25).map(|i| drawn.iter().filter(|&&r| r == f64::from(i)).count());
        let chi_square: f64 = counts.map(|n| (n as f64 - 500.0).powi(2) / 500.0).sum();
        assert!(chi_square < 27.9, "{chi_square}");
    }

    #[test]
    fn empty_buffers_are_refused() {
        let buffer = filled(3, 0);
        let error = buffer.sample(4, &mut Seed(0).rng()).unwrap_err();
        assert!(matches!(error, RlError::EmptyBuffer { asked: 4 }));
        assert!(ReplayBuffer::new(0).is_err());
    }
}
