//! The interface of learners to environments: many episodes as flat arrays.

use gump_scene::Seed;

use crate::RlError;

/// A fixed number of parallel episodes.
///
/// The environment owns all buffers and lends them; they contain the results of the last reset or
/// step. An action is a point of the box [-1, 1] per dimension, whatever its meaning.
///
/// A row whose episode ended has a new one when the step returns (Gymnasium's *same step*
/// auto-reset): [`VectorEnv::observations`] is the input of the next action,
/// [`VectorEnv::final_observations`] the result of the step. A transition is therefore (observation
/// before, action, reward, final observation after, terminated), whether the episode ended or not.
pub trait VectorEnv {
    /// Number of parallel episodes, > 0.
    fn n_envs(&self) -> usize;

    /// Length of an observation, > 0.
    fn observation_len(&self) -> usize;

    /// Length of an action, > 0.
    fn action_len(&self) -> usize;

    /// Starts new episodes in all rows; the same seed gives the same episodes.
    ///
    /// # Errors
    /// Any reason for which the environment cannot start.
    fn reset(&mut self, seed: Seed) -> Result<(), RlError>;

    /// Applies one action per row.
    ///
    /// Shape: `[n_envs, action_len]`, row-major.
    ///
    /// # Errors
    /// [`RlError::Count`] for another number of actions and [`RlError::NotFinite`] for NaN or
    /// infinities leave all episodes as they are.
    fn step(&mut self, actions: &[f32]) -> Result<(), RlError>;

    /// The observations to act on next. Shape: `[n_envs, observation_len]`.
    fn observations(&self) -> &[f32];

    /// The rewards of the last step. Shape: `[n_envs]`; zeros after a reset.
    fn rewards(&self) -> &[f32];

    /// Rows whose episode terminated in the last step: the value after it is 0. Shape: `[n_envs]`.
    fn terminated(&self) -> &[bool];

    /// Rows whose episode was truncated in the last step, so that a value must be bootstrapped from
    /// the final observation. Never true where `terminated` is. Shape: `[n_envs]`.
    fn truncated(&self) -> &[bool];

    /// The result of the last step, in the same episode: differs from [`VectorEnv::observations`]
    /// only in rows that ended. Shape: `[n_envs, observation_len]`.
    fn final_observations(&self) -> &[f32];
}
