//! The replay buffer.

use std::borrow::Cow;

use gump_scene::Rng;
use rand::Rng as _;

use crate::observation::pack;
use crate::{ObservationForm, RlError, expand};

/// One step of one episode.
#[derive(Clone, Debug, PartialEq)]
pub struct Transition<'a> {
    /// The observation.
    pub observation: Cow<'a, [f32]>,
    /// The action, in [-1, 1].
    pub action: &'a [f32],
    /// The reward.
    pub reward: f32,
    /// The next observation, in the same episode also where that ended.
    pub next: Cow<'a, [f32]>,
    /// Whether the episode terminated; truncation does not count.
    pub terminated: bool,
}

/// Keeps the latest transitions, replacing the oldest, and samples them at random.
///
/// Flat arrays that grow up to the capacity: two observations, an action and five bytes each. Image
/// observations take a bit per pixel: 4 kB for eight layers of 64 x 64.
#[derive(Clone, Debug, PartialEq)]
pub struct ReplayBuffer {
    pub(crate) form: ObservationForm,
    pub(crate) action_len: usize,
    pub(crate) capacity: usize,
    /// Index that the next transition overwrites once the buffer is full.
    pub(crate) head: usize,
    pub(crate) observations: Store,
    pub(crate) actions: Vec<f32>,
    pub(crate) rewards: Vec<f32>,
    pub(crate) nexts: Store,
    pub(crate) terminated: Vec<bool>,
}

/// Observations one after another, packed as tightly as their form allows.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Store {
    Numbers(Vec<f32>),
    /// Whole bytes per observation.
    Bits(Vec<u8>),
}

impl Store {
    fn new(form: ObservationForm) -> Self {
        match form {
            ObservationForm::Numbers(_) => Self::Numbers(Vec::new()),
            ObservationForm::Bits(_) => Self::Bits(Vec::new()),
        }
    }

    /// Puts an observation in place `index`, at most one behind the last.
    fn put(&mut self, index: usize, observation: &[f32]) {
        match self {
            Self::Numbers(numbers) => {
                room(numbers, index, observation.len()).copy_from_slice(observation);
            }
            Self::Bits(bytes) => {
                let n_bytes = observation.len().div_ceil(8);
                pack(observation, room(bytes, index, n_bytes));
            }
        }
    }

    /// The observation of `len` numbers in place `index`.
    fn get(&self, index: usize, len: usize) -> Cow<'_, [f32]> {
        match self {
            Self::Numbers(numbers) => numbers[index * len..][..len].into(),
            Self::Bits(bytes) => {
                let n_bytes = len.div_ceil(8);
                let mut numbers = vec![0.0; len];
                expand(&bytes[index * n_bytes..][..n_bytes], &mut numbers);
                numbers.into()
            }
        }
    }
}

/// Slot `index` of values of `len` each, created if it is one past the last.
fn room<T: Clone + Default>(values: &mut Vec<T>, index: usize, len: usize) -> &mut [T] {
    if values.len() == index * len {
        values.resize(values.len() + len, T::default());
    }
    &mut values[index * len..][..len]
}

impl ReplayBuffer {
    /// An empty buffer for `capacity` transitions.
    ///
    /// # Errors
    /// [`RlError::Parameter`] for a capacity of 0.
    pub fn new(
        capacity: usize,
        form: impl Into<ObservationForm>,
        action_len: usize,
    ) -> Result<Self, RlError> {
        if capacity == 0 {
            return Err(RlError::Parameter {
                name: "capacity",
                value: 0.0,
                expected: "at least one transition",
            });
        }
        let form = form.into();
        Ok(Self {
            form,
            action_len,
            capacity,
            head: 0,
            observations: Store::new(form),
            actions: Vec::new(),
            rewards: Vec::new(),
            nexts: Store::new(form),
            terminated: Vec::new(),
        })
    }

    /// Adds a transition, replacing the oldest if the buffer is full. In image observations,
    /// positive numbers are stored as 1 and others as 0.
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
        let expected = [self.form.len(), self.action_len, self.form.len()];
        assert_eq!(lengths, expected, "lengths of observation, action, next");
        let index = if self.len() < self.capacity {
            self.len()
        } else {
            let oldest = self.head;
            self.head = (oldest + 1) % self.capacity;
            oldest
        };
        self.observations.put(index, &observation);
        self.nexts.put(index, &next);
        room(&mut self.actions, index, self.action_len).copy_from_slice(action);
        room(&mut self.rewards, index, 1)[0] = reward;
        room(&mut self.terminated, index, 1)[0] = terminated;
    }

    /// Draws the indices of `n` transitions, each uniformly and with replacement.
    ///
    /// # Errors
    /// [`RlError::EmptyBuffer`] if the buffer is empty.
    pub fn sample(&self, n: usize, rng: &mut Rng) -> Result<Vec<usize>, RlError> {
        if self.is_empty() {
            return Err(RlError::EmptyBuffer { requested: n });
        }
        Ok((0..n).map(|_| rng.random_range(0..self.len())).collect())
    }

    /// The transition at an index below [`ReplayBuffer::len`].
    ///
    /// # Panics
    /// At any other index.
    pub fn get(&self, index: usize) -> Transition<'_> {
        let (o, a) = (self.form.len(), self.action_len);
        Transition {
            observation: self.observations.get(index, o),
            action: &self.actions[index * a..][..a],
            reward: self.rewards[index],
            next: self.nexts.get(index, o),
            terminated: self.terminated[index],
        }
    }

    /// The transitions, oldest first.
    pub fn iter(&self) -> impl Iterator<Item = Transition<'_>> {
        let newest_last = (self.head..self.len()).chain(0..self.head);
        newest_last.map(|index| self.get(index))
    }

    /// All observations, in no guaranteed order; none for images. Shape: `[len, observation_len]`.
    pub fn numbers(&self) -> &[f32] {
        match &self.observations {
            Store::Numbers(numbers) => numbers,
            Store::Bits(_) => &[],
        }
    }

    /// The form of observations.
    pub fn form(&self) -> ObservationForm {
        self.form
    }

    /// Number of transitions.
    pub fn len(&self) -> usize {
        self.rewards.len()
    }

    /// True if the buffer is empty.
    pub fn is_empty(&self) -> bool {
        self.rewards.is_empty()
    }

    /// Capacity.
    pub fn capacity(&self) -> usize {
        self.capacity
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::networks::Picture;
    use gump_scene::Seed;

    /// Transition `i` of a stream: every part of it encodes `i`.
    fn filled(capacity: usize, n: usize) -> ReplayBuffer {
        let mut buffer = ReplayBuffer::new(capacity, 2, 1).unwrap();
        for i in 0..n {
            let x = i as f32;
            buffer.push(Transition {
                observation: (&[x, -x]).into(),
                action: &[x / 10.0],
                reward: x,
                next: (&[x + 1.0, -x - 1.0]).into(),
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
            assert_eq!(*t.observation, [x, -x]);
            assert_eq!(t.action, [x / 10.0]);
            assert_eq!(*t.next, [x + 1.0, -x - 1.0]);
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
    fn pictures_take_a_bit_per_pixel() {
        let picture = Picture { layers: 1, side: 3 };
        let mut buffer = ReplayBuffer::new(2, picture, 1).unwrap();
        let pixels = |i: u16| (0..9).map(|k| f32::from((i >> k) & 1)).collect::<Vec<_>>();
        for i in [7, 300, 511] {
            buffer.push(Transition {
                observation: pixels(i).into(),
                action: &[0.0],
                reward: f32::from(i),
                next: pixels(i / 2).into(),
                terminated: false,
            });
        }
        let held: Vec<_> = buffer.iter().collect();
        for (t, i) in held.iter().zip([300, 511]) {
            assert_eq!(t.reward, f32::from(i));
            assert_eq!((&*t.observation, &*t.next), (&*pixels(i), &*pixels(i / 2)));
        }
        assert!(matches!(&buffer.nexts, Store::Bits(bytes) if bytes.len() == 2 * 2));
        assert_eq!(buffer.numbers(), [0.0; 0]);
    }

    #[test]
    fn empty_buffers_are_refused() {
        let buffer = filled(3, 0);
        let error = buffer.sample(4, &mut Seed(0).rng()).unwrap_err();
        assert!(matches!(error, RlError::EmptyBuffer { requested: 4 }));
        assert!(ReplayBuffer::new(0, 2, 1).is_err());
    }
}
