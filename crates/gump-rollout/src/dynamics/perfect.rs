//! Perfect tracking: the vehicle follows its trajectory exactly.

use gump_scene::AgentState;

use crate::RolloutError;

/// The state `elapsed` seconds along a trajectory that leaves `now`.
///
/// `states[i]` lies `(i + 1) * spacing` seconds ahead. Between states, position and velocity are
/// interpolated linearly and the heading in the shorter direction; past the last one the vehicle
/// keeps its velocity.
///
/// # Errors
/// [`RolloutError::Trajectory`] if there is no state or `spacing` is not positive.
pub fn track(
    now: &AgentState,
    states: &[AgentState],
    spacing: f64,
    elapsed: f64,
) -> Result<AgentState, RolloutError> {
    let n = states.len();
    let last = match states.last() {
        Some(last) if spacing > 0.0 && spacing.is_finite() => last,
        _ => return Err(RolloutError::Trajectory { n, dt: spacing }),
    };
    // A session step is a sum of trajectory steps up to rounding; snap so that it hits the state.
    let exact = elapsed / spacing;
    let position = if (exact - exact.round()).abs() < 1e-9 {
        exact.round()
    } else {
        exact
    };
    let before = position.floor() as usize;
    if before >= n {
        let mut state = *last;
        state.pose.position += state.velocity * (elapsed - n as f64 * spacing);
        return Ok(state);
    }
    let from = if before == 0 {
        now
    } else {
        &states[before - 1]
    };
    let t = position - before as f64;
    let to = &states[before];
    Ok(AgentState {
        pose: from.pose.interpolate(to.pose, t),
        velocity: from.velocity.lerp(to.velocity, t),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;
    use gump_geometry::{Pose, dvec2};
    use std::f64::consts::PI;

    fn state(x: f64, heading: f64, speed: f64) -> AgentState {
        AgentState {
            pose: Pose::new(x, 0.0, heading),
            velocity: dvec2(speed, 0.0),
        }
    }

    fn check(elapsed: f64, x: f64, speed: f64) {
        let states = [
            state(1.0, 0.0, 10.0),
            state(2.0, 0.0, 10.0),
            state(4.0, 0.0, 20.0),
        ];
        let reached = track(&state(0.0, 0.0, 10.0), &states, 0.1, elapsed).unwrap();
        assert_abs_diff_eq!(reached.pose.position.x, x, epsilon = 1e-9);
        assert_abs_diff_eq!(reached.velocity.x, speed, epsilon = 1e-9);
    }

    #[test]
    fn the_vehicle_is_where_the_trajectory_says() {
        check(0.1, 1.0, 10.0);
        check(0.05, 0.5, 10.0);
        check(0.1 + 0.1 + 0.1, 4.0, 20.0);
        check(0.25, 3.0, 15.0);
    }

    #[test]
    fn past_the_end_it_keeps_its_velocity() {
        check(0.5, 8.0, 20.0);
    }

    #[test]
    fn the_heading_turns_the_short_way() {
        let to = state(0.0, -PI + 0.1, 0.0);
        let half = track(&state(0.0, PI - 0.1, 0.0), &[to], 0.2, 0.1).unwrap();
        assert_abs_diff_eq!(half.pose.heading.cos(), -1.0, epsilon = 1e-9);
    }

    #[test]
    fn an_empty_trajectory_is_an_error() {
        let error = RolloutError::Trajectory { n: 0, dt: 0.1 };
        assert_eq!(track(&state(0.0, 0.0, 0.0), &[], 0.1, 0.1), Err(error));
    }
}
