//! Small problems with known optimal answers.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::f64::consts::PI;

use gump_scene::{Rng, Seed};
use rand::Rng as _;

use crate::networks::Picture;
use crate::{ObservationForm, RlError, VectorEnv};

/// A problem of one environment; states are a few numbers, the last of them may count steps.
pub(crate) trait Problem {
    const OBSERVATION: usize;
    const ACTION: usize;
    /// Steps until an episode is cut off.
    const HORIZON: usize;

    fn form() -> ObservationForm {
        Self::OBSERVATION.into()
    }

    fn start(&self, rng: &mut Rng) -> Vec<f64>;
    fn observe(&self, state: &[f64]) -> Vec<f32>;
    /// The reward, and whether the episode is over for good.
    fn step(&self, state: &mut Vec<f64>, action: &[f32]) -> (f64, bool);
}

/// A problem many times side by side.
pub(crate) struct Toy<P> {
    problem: P,
    rng: Rng,
    states: Vec<(Vec<f64>, usize)>,
    observations: Vec<f32>,
    finals: Vec<f32>,
    rewards: Vec<f32>,
    terminated: Vec<bool>,
    truncated: Vec<bool>,
}

impl<P: Problem> Toy<P> {
    pub(crate) fn new(problem: P, n: usize) -> Self {
        let mut toy = Self {
            problem,
            rng: Seed(0).rng(),
            states: vec![(Vec::new(), 0); n],
            observations: Vec::new(),
            finals: Vec::new(),
            rewards: vec![0.0; n],
            terminated: vec![false; n],
            truncated: vec![false; n],
        };
        toy.reset(Seed(0)).expect("a toy accepts every action");
        toy
    }

    fn observe(&self) -> Vec<f32> {
        let states = self.states.iter();
        states
            .flat_map(|(state, _)| self.problem.observe(state))
            .collect()
    }

    /// Mean over environments of the total reward of one episode each, by the policy's modes.
    pub(crate) fn play(&mut self, seed: Seed, policy: impl Fn(&[f32]) -> Vec<f32>) -> f64 {
        self.reset(seed).expect("a toy accepts every action");
        let mut total = 0.0;
        for _ in 0..P::HORIZON {
            let actions = policy(&self.observations);
            self.step(&actions).expect("a toy accepts every action");
            total += self.rewards.iter().map(|&r| f64::from(r)).sum::<f64>();
        }
        total / self.states.len() as f64
    }
}

impl<P: Problem> VectorEnv for Toy<P> {
    fn n_envs(&self) -> usize {
        self.states.len()
    }

    fn observation_len(&self) -> usize {
        P::OBSERVATION
    }

    fn action_len(&self) -> usize {
        P::ACTION
    }

    fn reset(&mut self, seed: Seed) -> Result<(), RlError> {
        self.rng = seed.rng();
        for state in &mut self.states {
            *state = (self.problem.start(&mut self.rng), 0);
        }
        self.observations = self.observe();
        self.finals = self.observations.clone();
        Ok(())
    }

    fn step(&mut self, actions: &[f32]) -> Result<(), RlError> {
        for (i, action) in actions.chunks_exact(P::ACTION).enumerate() {
            let (state, steps) = &mut self.states[i];
            *steps += 1;
            let (reward, terminated) = self.problem.step(state, action);
            self.rewards[i] = reward as f32;
            self.terminated[i] = terminated;
            self.truncated[i] = !terminated && *steps == P::HORIZON;
        }
        self.finals = self.observe();
        for i in 0..self.states.len() {
            if self.terminated[i] || self.truncated[i] {
                self.states[i] = (self.problem.start(&mut self.rng), 0);
            }
        }
        self.observations = self.observe();
        Ok(())
    }

    fn observations(&self) -> &[f32] {
        &self.observations
    }

    fn rewards(&self) -> &[f32] {
        &self.rewards
    }

    fn terminated(&self) -> &[bool] {
        &self.terminated
    }

    fn truncated(&self) -> &[bool] {
        &self.truncated
    }

    fn final_observations(&self) -> &[f32] {
        &self.finals
    }
}

/// Do what you see, once.
pub(crate) struct Identity;

impl Problem for Identity {
    const OBSERVATION: usize = 1;
    const ACTION: usize = 1;
    const HORIZON: usize = 1;

    fn start(&self, rng: &mut Rng) -> Vec<f64> {
        vec![rng.random_range(-0.9..0.9)]
    }

    fn observe(&self, state: &[f64]) -> Vec<f32> {
        vec![state[0] as f32]
    }

    fn step(&self, state: &mut Vec<f64>, action: &[f32]) -> (f64, bool) {
        (-(f64::from(action[0]) - state[0]).powi(2), true)
    }
}

/// Go to the origin of the plane; a step is at most 0.2 along each axis.
pub(crate) struct Reach;

impl Problem for Reach {
    const OBSERVATION: usize = 2;
    const ACTION: usize = 2;
    const HORIZON: usize = 20;

    fn start(&self, rng: &mut Rng) -> Vec<f64> {
        (0..2).map(|_| rng.random_range(-1.0..1.0)).collect()
    }

    fn observe(&self, state: &[f64]) -> Vec<f32> {
        state.iter().map(|&x| x as f32).collect()
    }

    fn step(&self, state: &mut Vec<f64>, action: &[f32]) -> (f64, bool) {
        for (x, &a) in state.iter_mut().zip(action) {
            *x += 0.2 * f64::from(a);
        }
        (-state[0].hypot(state[1]), false)
    }
}

/// [`Reach`], seen from above: a square of four pixels, and nothing else.
pub(crate) struct SeenReach;

impl SeenReach {
    /// Pixels of 0.2.
    const PICTURE: Picture = Picture {
        layers: 1,
        side: 16,
    };
}

impl Problem for SeenReach {
    const OBSERVATION: usize = 16 * 16;
    const ACTION: usize = 2;
    const HORIZON: usize = 20;

    fn form() -> ObservationForm {
        Self::PICTURE.into()
    }

    fn start(&self, rng: &mut Rng) -> Vec<f64> {
        Reach.start(rng)
    }

    fn observe(&self, state: &[f64]) -> Vec<f32> {
        let side = Self::PICTURE.side;
        let corner = |x: f64| (x / 0.2 + 7.0).round().clamp(0.0, 14.0) as usize;
        let mut pixels = vec![0.0; side * side];
        for (x, y) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
            pixels[(corner(state[1]) + y) * side + corner(state[0]) + x] = 1.0;
        }
        pixels
    }

    fn step(&self, state: &mut Vec<f64>, action: &[f32]) -> (f64, bool) {
        Reach.step(state, action)
    }
}

/// The reward is `-(a - 0.3)^2`, once.
pub(crate) struct Bandit;

impl Problem for Bandit {
    const OBSERVATION: usize = 1;
    const ACTION: usize = 1;
    const HORIZON: usize = 1;

    fn start(&self, _: &mut Rng) -> Vec<f64> {
        vec![1.0]
    }

    fn observe(&self, _: &[f64]) -> Vec<f32> {
        vec![1.0]
    }

    fn step(&self, _: &mut Vec<f64>, action: &[f32]) -> (f64, bool) {
        (-(f64::from(action[0]) - 0.3).powi(2), true)
    }
}

/// A constant reward for five steps; then the episode is over for good, or cut off.
pub(crate) struct Clock {
    pub(crate) reward: f64,
    pub(crate) terminates: bool,
}

impl Problem for Clock {
    const OBSERVATION: usize = 1;
    const ACTION: usize = 1;
    const HORIZON: usize = 5;

    fn start(&self, _: &mut Rng) -> Vec<f64> {
        vec![0.0]
    }

    /// The time is observed only in the problem where it matters.
    fn observe(&self, state: &[f64]) -> Vec<f32> {
        vec![if self.terminates {
            state[0] as f32 / 5.0
        } else {
            1.0
        }]
    }

    fn step(&self, state: &mut Vec<f64>, _: &[f32]) -> (f64, bool) {
        state[0] += 1.0;
        (self.reward, self.terminates && state[0] == 5.0)
    }
}

/// `s' = s + a`, reward `-(s^2 + 0.1 a^2)`.
pub(crate) struct Regulator;

impl Problem for Regulator {
    const OBSERVATION: usize = 1;
    const ACTION: usize = 1;
    const HORIZON: usize = 5;

    fn start(&self, rng: &mut Rng) -> Vec<f64> {
        vec![rng.random_range(-0.5..0.5)]
    }

    fn observe(&self, state: &[f64]) -> Vec<f32> {
        vec![state[0] as f32]
    }

    fn step(&self, state: &mut Vec<f64>, action: &[f32]) -> (f64, bool) {
        let a = f64::from(action[0]);
        let reward = -(state[0].powi(2) + 0.1 * a * a);
        state[0] += a;
        (reward, false)
    }
}

/// Swing a rod up and hold it there.
///
/// Source: Gymnasium's Pendulum-v1: gravity 10, mass and length 1, steps of 0.05 s, torque within
/// ±2, speed within ±8, 200 steps.
pub(crate) struct Pendulum;

impl Problem for Pendulum {
    const OBSERVATION: usize = 3;
    const ACTION: usize = 1;
    const HORIZON: usize = 200;

    /// Angle from upright, and speed.
    fn start(&self, rng: &mut Rng) -> Vec<f64> {
        vec![rng.random_range(-PI..PI), rng.random_range(-1.0..1.0)]
    }

    fn observe(&self, state: &[f64]) -> Vec<f32> {
        [state[0].cos(), state[0].sin(), state[1]]
            .map(|x| x as f32)
            .to_vec()
    }

    fn step(&self, state: &mut Vec<f64>, action: &[f32]) -> (f64, bool) {
        let torque = 2.0 * f64::from(action[0]).clamp(-1.0, 1.0);
        let angle = (state[0] + PI).rem_euclid(2.0 * PI) - PI;
        let cost = angle * angle + 0.1 * state[1] * state[1] + 0.001 * torque * torque;
        let speed = state[1] + (15.0 * state[0].sin() + 3.0 * torque) * 0.05;
        state[1] = speed.clamp(-8.0, 8.0);
        state[0] += state[1] * 0.05;
        (-cost, false)
    }
}
