//! What a learner needs of an environment: many episodes, flat numbers.

use gump_scene::Seed;

use crate::RlError;

/// A fixed number of episodes side by side.
///
/// The environment owns all buffers and lends them; they hold what the last reset or step left. An
/// action is a point of the box [-1, 1] per dimension, whatever it stands for.
///
/// A row whose episode ended has a new one when the step returns (Gymnasium's *same step*
/// auto-reset): [`VectorEnv::observations`] is what to act on next,
/// [`VectorEnv::final_observations`] what the step led to. So a transition is (observation before,
/// action, reward, final observation after, terminated), whether the episode ended or not.
pub trait VectorEnv {
    /// Episodes side by side, > 0.
    fn n_envs(&self) -> usize;

    /// Numbers in an observation, > 0.
    fn observation_len(&self) -> usize;

    /// Numbers in an action, > 0.
    fn action_len(&self) -> usize;

    /// Starts fresh episodes in all rows; the same seed gives the same episodes.
    ///
    /// # Errors
    /// Whatever keeps the environment from starting.
    fn reset(&mut self, seed: Seed) -> Result<(), RlError>;

    /// Applies one action per row.
    ///
    /// Shape: `[n_envs, action_len]`, row-major.
    ///
    /// # Errors
    /// [`RlError::Count`] for another number of actions and [`RlError::NotFinite`] for NaN or
    /// infinities leave all episodes as they are.
    fn step(&mut self, actions: &[f32]) -> Result<(), RlError>;

    /// What to act on next. Shape: `[n_envs, observation_len]`.
    fn observations(&self) -> &[f32];

    /// What the last step earned. Shape: `[n_envs]`; zeros after a reset.
    fn rewards(&self) -> &[f32];

    /// Rows whose episode ended for good in the last step: no value comes after. Shape: `[n_envs]`.
    fn terminated(&self) -> &[bool];

    /// Rows whose episode was cut off in the last step: more would have come, so a value must be
    /// bootstrapped from the final observation. Never true where `terminated` is. Shape: `[n_envs]`.
    fn truncated(&self) -> &[bool];

    /// What the last step led to, in the same episode: differs from [`VectorEnv::observations`] in
    /// rows that ended only. Shape: `[n_envs, observation_len]`.
    fn final_observations(&self) -> &[f32];
}
