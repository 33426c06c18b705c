//! A critic, its target copy, and their training targets.

use gump_scene::Seed;

use crate::networks::{Adam, Mlp, Pass, clip};

/// The estimated value of an action in a state.
#[derive(Clone, Debug)]
pub struct Critic {
    observation_len: usize,
    pub(crate) online: Mlp,
    pub(crate) target: Mlp,
    pub(crate) optimizer: Adam,
    gradient: Vec<f32>,
    taken: Pass,
    future: Pass,
    judged: Pass,
}

/// The target of a transition: the reward, and unless it terminated the discounted value of what
/// follows. Truncation is not termination.
pub fn soft_target(reward: f64, terminated: bool, discount: f64, soft_value: f64) -> f64 {
    if terminated {
        reward
    } else {
        reward + discount * soft_value
    }
}

/// Loss of an error and its derivative: squared, and linear beyond `huber`.
pub fn critic_loss(error: f64, huber: Option<f64>) -> (f64, f64) {
    match huber {
        Some(limit) if error.abs() > limit => (
            limit * (2.0 * error.abs() - limit),
            2.0 * limit * error.signum(),
        ),
        _ => (error * error, 2.0 * error),
    }
}

impl Critic {
    /// An untrained critic over rows of an observation and an action.
    pub(crate) fn new(
        hidden: &[usize],
        observation_len: usize,
        action_len: usize,
        seed: Seed,
    ) -> Self {
        let mut sizes = vec![observation_len + action_len];
        sizes.extend(hidden);
        sizes.push(1);
        let online = Mlp::new(&sizes, 1.0, &mut seed.rng());
        Self {
            observation_len,
            target: online.clone(),
            optimizer: Adam::new(online.parameters().len()),
            gradient: vec![0.0; online.parameters().len()],
            online,
            taken: Pass::default(),
            future: Pass::default(),
            judged: Pass::default(),
        }
    }

    /// Values of rows of a normalized observation and an action.
    ///
    /// Shape: `[rows, observation_len]` and `[rows, action_len]` to `[rows]`.
    ///
    /// # Panics
    /// If the lengths do not fit.
    pub fn values(&self, observations: &[f32], actions: &[f32]) -> Vec<f32> {
        let mut pass = Pass::default();
        let input = self.join(observations, actions);
        self.online.forward(&input, &mut pass);
        pass.output().to_vec()
    }

    /// Computes the values of the taken actions, and by the target critics those of the next
    /// actions; each pair holds observations and actions.
    pub(super) fn run(&mut self, taken: (&[f32], &[f32]), next: (&[f32], &[f32])) {
        let taken = self.join(taken.0, taken.1);
        self.online.forward(&taken, &mut self.taken);
        let next = self.join(next.0, next.1);
        self.target.forward(&next, &mut self.future);
    }

    /// Computes the values of the policy's actions.
    pub(super) fn judge(&mut self, observations: &[f32], actions: &[f32]) {
        let input = self.join(observations, actions);
        self.online.forward(&input, &mut self.judged);
    }

    pub(super) fn value(&self) -> &[f32] {
        self.taken.output()
    }

    pub(super) fn future(&self) -> &[f32] {
        self.future.output()
    }

    pub(super) fn judged(&self) -> &[f32] {
        self.judged.output()
    }

    /// Takes the gradient of the mean of `loss(row, value)`, also by the input if `through`;
    /// returns that mean.
    pub(super) fn learn(&mut self, through: bool, loss: impl Fn(usize, f32) -> (f64, f64)) -> f64 {
        let rows = self.taken.rows() as f64;
        let values = self.taken.output().iter().enumerate();
        let losses: Vec<_> = values.map(|(i, &q)| loss(i, q)).collect();
        let output_gradient: Vec<f32> = losses.iter().map(|l| (l.1 / rows) as f32).collect();
        self.gradient.fill(0.0);
        let (pass, gradient) = (&mut self.taken, &mut self.gradient);
        if through {
            self.online
                .backward_through(&output_gradient, pass, gradient);
        } else {
            self.online.backward(&output_gradient, pass, gradient);
        }
        losses.iter().map(|l| l.0).sum::<f64>() / rows
    }

    /// Takes the gradient of the judged values by their input, 0 for rows that do not `count`.
    pub(super) fn gradient_of_judged(&mut self, counts: impl Fn(usize) -> bool) {
        let rows = 0..self.judged.rows();
        let output_gradient: Vec<f32> = rows.map(|i| f32::from(u8::from(counts(i)))).collect();
        self.online
            .backward_to_input(&output_gradient, &mut self.judged);
    }

    /// The part of a gradient [`Critic::learn`] took that is by the observations, row after row.
    pub(super) fn taken_by_observation(&self) -> impl Iterator<Item = f32> {
        let rows = self.taken.input_gradient();
        let rows = rows.chunks_exact(self.online.sizes()[0]);
        rows.flat_map(|row| row[..self.observation_len].iter().copied())
    }

    /// The part of the judged values' gradient that is by the actions, row after row.
    pub(super) fn judged_by_action(&self) -> impl Iterator<Item = f32> {
        let rows = self.judged.input_gradient();
        let rows = rows.chunks_exact(self.online.sizes()[0]);
        rows.flat_map(|row| row[self.observation_len..].iter().copied())
    }

    /// Rows of an observation and an action as one row each.
    fn join(&self, observations: &[f32], actions: &[f32]) -> Vec<f32> {
        let action_len = self.online.sizes()[0] - self.observation_len;
        let rows = observations.chunks_exact(self.observation_len);
        let rows = rows.zip(actions.chunks_exact(action_len));
        rows.flat_map(|(o, a)| o.iter().chain(a)).copied().collect()
    }

    /// The gradient of the last step.
    #[cfg(test)]
    pub(super) fn gradient_taken(&self) -> &[f32] {
        &self.gradient
    }

    pub(super) fn step(&mut self, learning_rate: f64, limit: Option<f64>) {
        clip(&mut self.gradient, limit);
        self.optimizer
            .step(self.online.parameters_mut(), &self.gradient, learning_rate);
    }

    pub(super) fn move_target(&mut self, tau: f32) {
        self.target.follow(&self.online, tau);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn targets_by_hand() {
        // min(3, 2) - 0.5 * (-1.2) = 2.6, discounted by 0.9; a failure has no future.
        let soft_value = 2.0 - 0.5 * -1.2;
        assert_eq!(soft_target(-5.0, true, 0.9, soft_value), -5.0);
        assert!((soft_target(1.0, false, 0.9, soft_value) - 3.34).abs() < 1e-12);
    }

    #[test]
    fn losses_by_hand() {
        assert_eq!(critic_loss(-3.0, None), (9.0, -6.0));
        assert_eq!(critic_loss(0.5, Some(1.0)), (0.25, 1.0));
        assert_eq!(critic_loss(-3.0, Some(1.0)), (5.0, -2.0));
    }
}
