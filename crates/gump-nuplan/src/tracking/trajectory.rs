//! A planned trajectory of the ego, as states of its rear axle over time.

use gump_geometry::Pose;
use gump_scene::EgoState;

use gump_rollout::RolloutError;

/// States of the rear axle at increasing times.
#[derive(Clone, Debug, PartialEq)]
pub struct Trajectory {
    states: Vec<EgoState>,
}

impl Trajectory {
    /// Checks that the states can be followed.
    ///
    /// # Errors
    /// [`RolloutError::TooFewStates`] for fewer than two states, [`RolloutError::NotFinite`] for
    /// values that are not numbers and [`RolloutError::TimeOrder`] for times that do not increase.
    pub fn new(states: Vec<EgoState>) -> Result<Self, RolloutError> {
        if states.len() < 2 {
            return Err(RolloutError::TooFewStates(states.len()));
        }
        if !states.iter().all(EgoState::is_finite) {
            return Err(RolloutError::NotFinite { who: "the planner" });
        }
        match states.windows(2).position(|p| p[1].time_us <= p[0].time_us) {
            Some(before) => Err(RolloutError::TimeOrder { state: before + 1 }),
            None => Ok(Self { states }),
        }
    }

    /// The states in order, at least two.
    pub fn states(&self) -> &[EgoState] {
        &self.states
    }

    /// Time of the first state, microseconds.
    pub fn start_us(&self) -> i64 {
        self.states[0].time_us
    }

    /// Time of the last state, microseconds.
    pub fn end_us(&self) -> i64 {
        self.states[self.states.len() - 1].time_us
    }

    /// The state at a time between the first and the last state.
    ///
    /// Pose, velocity, acceleration and steering are interpolated linearly, the heading in the
    /// shorter direction; rates of turning and steering are 0, as in nuPlan. At the time of a state
    /// that state is returned, with the same rates of 0.
    ///
    /// # Errors
    /// [`RolloutError::OutsideTrajectory`] for any other time.
    pub fn at(&self, time_us: i64) -> Result<EgoState, RolloutError> {
        let (i, t) = self.locate(time_us)?;
        let (a, b) = (&self.states[i], &self.states[i + 1]);
        Ok(EgoState {
            time_us,
            rear_axle: a.rear_axle.interpolate(b.rear_axle, t),
            velocity: a.velocity.lerp(b.velocity, t),
            acceleration: a.acceleration.lerp(b.acceleration, t),
            steering_angle: a.steering_angle + t * (b.steering_angle - a.steering_angle),
            steering_rate: 0.0,
            yaw_rate: 0.0,
            yaw_acceleration: 0.0,
        })
    }

    /// The rear-axle pose at a time between the first and the last state.
    ///
    /// # Errors
    /// As [`Trajectory::at`].
    pub fn pose_at(&self, time_us: i64) -> Result<Pose, RolloutError> {
        let (i, t) = self.locate(time_us)?;
        Ok(self.states[i]
            .rear_axle
            .interpolate(self.states[i + 1].rear_axle, t))
    }

    /// The segment that holds a time and the fraction along it.
    fn locate(&self, time_us: i64) -> Result<(usize, f64), RolloutError> {
        let (start_us, end_us) = (self.start_us(), self.end_us());
        if time_us < start_us || time_us > end_us {
            return Err(RolloutError::OutsideTrajectory {
                time_us,
                start_us,
                end_us,
            });
        }
        let after = self
            .states
            .partition_point(|state| state.time_us <= time_us);
        let i = (after - 1).min(self.states.len() - 2);
        let (a, b) = (self.states[i].time_us, self.states[i + 1].time_us);
        Ok((i, (time_us - a) as f64 / (b - a) as f64))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;
    use gump_geometry::dvec2;
    use std::f64::consts::PI;

    fn state(time_us: i64, x: f64, heading: f64) -> EgoState {
        EgoState {
            time_us,
            rear_axle: Pose::new(x, 0.0, heading),
            velocity: dvec2(x, 0.0),
            yaw_rate: 1.0,
            ..EgoState::default()
        }
    }

    #[test]
    fn states_are_interpolated_and_rates_dropped() {
        let states = vec![state(0, 0.0, PI - 0.1), state(100_000, 2.0, -PI + 0.1)];
        let trajectory = Trajectory::new(states).unwrap();
        let middle = trajectory.at(50_000).unwrap();
        assert_abs_diff_eq!(middle.rear_axle.position.x, 1.0);
        assert_abs_diff_eq!(middle.rear_axle.heading.cos(), -1.0, epsilon = 1e-12);
        assert_eq!((middle.velocity.x, middle.yaw_rate), (1.0, 0.0));
        assert_eq!(trajectory.at(100_000).unwrap().rear_axle.position.x, 2.0);
        assert!(matches!(
            trajectory.at(100_001),
            Err(RolloutError::OutsideTrajectory { .. })
        ));
    }

    #[test]
    fn what_cannot_be_followed_is_refused() {
        let check = |states, expected| assert_eq!(Trajectory::new(states), Err(expected));
        check(vec![state(0, 0.0, 0.0)], RolloutError::TooFewStates(1));
        let still = vec![state(0, 0.0, 0.0), state(5, 0.0, 0.0), state(5, 1.0, 0.0)];
        check(still, RolloutError::TimeOrder { state: 2 });
        let nan = vec![state(0, 0.0, 0.0), state(5, f64::NAN, 0.0)];
        check(nan, RolloutError::NotFinite { who: "the planner" });
    }
}
