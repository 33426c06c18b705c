//! Controllers: from a plan to the ego's next state.

use std::fmt;
use std::str::FromStr;

use gump_scene::EgoState;
use serde::de::IntoDeserializer as _;
use serde::de::value::Error as NameError;
use serde::{Deserialize, Serialize};

use super::Recording;
use crate::tracking::{LqrTracker, Trajectory, propagate};
use gump_rollout::RolloutError;

/// A faster tracked speed means that the plan cannot be driven, metres per second.
///
/// Source: nuplan-devkit's perfect tracking.
const IMPOSSIBLE_SPEED: f64 = 50.0;

/// The way in which the ego follows its plan.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Tracking {
    /// As a car: the LQR tracker steers the kinematic bicycle.
    TwoStage,
    /// Perfect tracking.
    Perfect,
    /// The logged state, whatever the plan: open loop.
    Log,
}

impl Tracking {
    /// All of them, in the order of declaration.
    pub const ALL: [Self; 3] = [Self::TwoStage, Self::Perfect, Self::Log];
}

impl fmt::Display for Tracking {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

impl FromStr for Tracking {
    type Err = NameError;

    /// Finds a value by the name that it is stored and displayed under.
    ///
    /// # Errors
    /// A sentence with the unknown name and the known ones.
    fn from_str(name: &str) -> Result<Self, NameError> {
        Self::deserialize(name.into_deserializer())
    }
}

/// A controller with its state between steps.
#[derive(Clone, Debug)]
pub struct Controller {
    tracking: Tracking,
    lqr: LqrTracker,
}

impl Controller {
    /// A controller in its initial state.
    pub fn new(tracking: Tracking) -> Self {
        Self {
            tracking,
            lqr: LqrTracker::default(),
        }
    }

    /// The ego one iteration later.
    ///
    /// # Errors
    /// [`RolloutError::OutsideTrajectory`] for a plan that does not reach the next iteration,
    /// [`RolloutError::NotFinite`] if the motion diverges, [`RolloutError::Speed`] for a plan
    /// faster than 50 m/s.
    pub fn advance(
        &mut self,
        recording: &Recording,
        iteration: usize,
        ego: &EgoState,
        plan: &Trajectory,
    ) -> Result<EgoState, RolloutError> {
        let logged = recording.ego_at(iteration + 1);
        let next = match self.tracking {
            Tracking::Log => *logged,
            Tracking::Perfect => plan.at(logged.time_us)?,
            Tracking::TwoStage => {
                plan.pose_at(logged.time_us)?;
                let wheel_base = recording.vehicle().wheel_base;
                let controls = self.lqr.track(ego, plan, wheel_base)?;
                propagate(ego, &controls, wheel_base, logged.time_us)
            }
        };
        if !next.is_finite() {
            return Err(RolloutError::NotFinite { who: "the planner" });
        }
        if self.tracking == Tracking::Perfect && next.speed() >= IMPOSSIBLE_SPEED {
            return Err(RolloutError::Speed(next.speed()));
        }
        Ok(next)
    }
}
