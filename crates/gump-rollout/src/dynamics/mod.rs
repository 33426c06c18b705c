//! Vehicle dynamics: the next state of a vehicle under a command.
//!
//! [`advance`] works on box-centre states, and commands take effect at once. nuPlan's ego vehicle,
//! with a rear axle and actuator lag, is in `gump-nuplan`. Commands come from a [`crate::Policy`].

mod bicycle;
mod perfect;

pub use bicycle::drive;
pub use perfect::track;

use gump_scene::AgentState;

use crate::{Command, RolloutError};

/// The state `dt` seconds after `state` under `command`.
///
/// A trajectory is tracked perfectly; an acceleration and a curvature move a kinematic bicycle.
///
/// # Errors
/// [`RolloutError::Trajectory`] for a trajectory without states or time step,
/// [`RolloutError::NotFinite`] for commands that are not numbers.
pub fn advance(state: &AgentState, command: &Command, dt: f64) -> Result<AgentState, RolloutError> {
    let next = match command {
        Command::Follow {
            dt: spacing,
            states,
        } => track(state, states, *spacing, dt)?,
        Command::Drive {
            acceleration,
            curvature,
        } => drive(state, *acceleration, *curvature, dt),
    };
    if next.is_finite() {
        Ok(next)
    } else {
        Err(RolloutError::NotFinite { who: "the policy" })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_geometry::{Pose, dvec2};

    #[test]
    fn commands_that_are_not_numbers_are_refused() {
        let state = AgentState::default();
        let drive = Command::Drive {
            acceleration: f64::NAN,
            curvature: 0.0,
        };
        let who = "the policy";
        assert_eq!(
            advance(&state, &drive, 0.1),
            Err(RolloutError::NotFinite { who })
        );
        let nowhere = AgentState {
            pose: Pose::new(f64::INFINITY, 0.0, 0.0),
            velocity: dvec2(1.0, 0.0),
        };
        let follow = Command::Follow {
            dt: 0.1,
            states: vec![nowhere],
        };
        assert_eq!(
            advance(&state, &follow, 0.1),
            Err(RolloutError::NotFinite { who })
        );
    }
}
