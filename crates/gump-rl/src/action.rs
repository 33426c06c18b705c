//! What the ego can do in one step.

use gump_rollout::Command;

/// An acceleration and a curvature, held for one step of the world.
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub struct Action {
    /// Along the heading, metres per second squared.
    pub acceleration: f64,
    /// Turn per metre driven, radians per metre, positive to the left.
    pub curvature: f64,
}

/// What a vehicle can do at most; actions beyond are clipped and counted.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ActionLimits {
    /// Hardest braking, metres per second squared, < 0.
    pub min_acceleration: f64,
    /// Hardest acceleration, metres per second squared, > 0.
    pub max_acceleration: f64,
    /// Sharpest turn to either side, radians per metre, > 0.
    pub max_curvature: f64,
}

impl Default for ActionLimits {
    /// Accelerations within nuPlan's comfort bounds, -4.05 and 2.40 m/s². A turning radius of 5 m,
    /// the lower end of the turning circles of 10 to 12 m that makers state for passenger cars.
    fn default() -> Self {
        Self {
            min_acceleration: -4.05,
            max_acceleration: 2.40,
            max_curvature: 0.2,
        }
    }
}

impl Action {
    /// True if both numbers are finite.
    pub fn is_finite(self) -> bool {
        self.acceleration.is_finite() && self.curvature.is_finite()
    }

    /// The action as a command to the vehicle.
    pub fn command(self) -> Command {
        Command::Drive {
            acceleration: self.acceleration,
            curvature: self.curvature,
        }
    }
}

impl ActionLimits {
    /// The nearest action within the limits.
    pub fn clip(&self, action: Action) -> Action {
        Action {
            acceleration: action
                .acceleration
                .clamp(self.min_acceleration, self.max_acceleration),
            curvature: action
                .curvature
                .clamp(-self.max_curvature, self.max_curvature),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn actions_are_clipped_component_by_component() {
        let check = |given: (f64, f64), expected: (f64, f64)| {
            let clipped = ActionLimits::default().clip(Action {
                acceleration: given.0,
                curvature: given.1,
            });
            assert_eq!((clipped.acceleration, clipped.curvature), expected);
        };
        check((1.0, -0.1), (1.0, -0.1));
        check((9.0, 0.1), (2.4, 0.1));
        check((-9.0, -3.0), (-4.05, -0.2));
    }
}
