//! Auxiliary heads that predict a whole future at once from an agent's key and value.
//!
//! Shapes: `A` agents, `C` width. A pose is (Δx, Δy, sin θ, cos θ): displacement from the agent's
//! present position and absolute heading, both in the scene frame.

use candle_core::{Result, Tensor};
use gump_nn::layers::{LayerNorm, Linear};
use gump_nn::parameters::Scope;

use crate::ModelError;

// The released code's numbers: 3 s back, 8 s ahead, and the six modes of motion prediction.

/// Half-second steps of the past that a head predicts.
pub const PAST: usize = 6;
/// Half-second steps of the future that a head predicts.
pub const FUTURE: usize = 16;
/// Number of modes of the future.
pub const MODES: usize = 6;
/// Numbers per pose.
pub const POSE: usize = 4;

/// One head: a trunk of two layers, three outputs.
#[derive(Debug)]
pub struct TrajectoryHead {
    trunk: Vec<(Linear, LayerNorm)>,
    past: Linear,
    future: Linear,
    modes: Linear,
}

/// The output of a head.
#[derive(Debug)]
pub struct Trajectories {
    /// [A, PAST, POSE], the most recent first.
    pub past: Tensor,
    /// [A, MODES, FUTURE, POSE]
    pub future: Tensor,
    /// Logits of the modes, [A, MODES].
    pub modes: Tensor,
}

impl TrajectoryHead {
    pub(crate) fn new(mut scope: Scope<'_>, width: usize) -> std::result::Result<Self, ModelError> {
        let c = 2 * width;
        let mut trunk = Vec::with_capacity(2);
        for i in 0..2 {
            let linear = Linear::new(&mut scope, &format!("trunk{i}"), c, c)?;
            trunk.push((linear, LayerNorm::new(&mut scope, &format!("norm{i}"), c)?));
        }
        Ok(Self {
            trunk,
            past: Linear::new(&mut scope, "past", c, PAST * POSE)?,
            future: Linear::new(&mut scope, "future", c, MODES * FUTURE * POSE)?,
            modes: Linear::new(&mut scope, "modes", c, MODES)?,
        })
    }

    /// `features` [A, 2C]: the level's features at key and value, side by side.
    pub fn forward(&self, features: &Tensor) -> Result<Trajectories> {
        let a = features.dim(0)?;
        let x = self
            .trunk
            .iter()
            .try_fold(features.clone(), |x, (linear, norm)| {
                norm.forward(&linear.forward(&x)?)?.relu()
            })?;
        Ok(Trajectories {
            past: self.past.forward(&x)?.reshape((a, PAST, POSE))?,
            future: self.future.forward(&x)?.reshape((a, MODES, FUTURE, POSE))?,
            modes: self.modes.forward(&x)?,
        })
    }
}
