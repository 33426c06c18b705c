//! The kinematic bicycle about the box centre.

use gump_geometry::{Pose, wrap_angle};
use gump_scene::AgentState;

/// The state `dt` seconds after `state` at constant acceleration and curvature.
///
/// The box centre is treated as the point that moves along the heading, as a rear axle would: no
/// side slip. Curvature is the turn per metre driven by *this point*, so there is no wheel base.
/// Braking ends at standstill; a positive acceleration brakes a vehicle that rolls backwards.
///
/// Units: metres per second squared, radians per metre (positive to the left), seconds.
/// Source: closed-form integration of x' = v cos h, y' = v sin h, h' = v * curvature, v' = a.
pub fn drive(state: &AgentState, acceleration: f64, curvature: f64, dt: f64) -> AgentState {
    let forward = state.pose.direction();
    let speed = state.velocity.dot(forward);
    let mut end_speed = speed + acceleration * dt;
    let mut distance = (speed + end_speed) / 2.0 * dt;
    if speed * end_speed < 0.0 {
        // It comes to rest within the step and stays there.
        distance = -speed * speed / (2.0 * acceleration);
        end_speed = 0.0;
    }
    if speed == 0.0 && acceleration < 0.0 {
        (distance, end_speed) = (0.0, 0.0);
    }
    let turn = curvature * distance;
    // The chord of a circular arc: length d * sinc(turn / 2), direction half the turn.
    let half = turn / 2.0;
    let chord = if half.abs() < 1e-9 {
        distance
    } else {
        distance * half.sin() / half
    };
    let middle = Pose {
        heading: state.pose.heading + half,
        ..state.pose
    };
    let pose = Pose {
        position: state.pose.position + middle.direction() * chord,
        heading: wrap_angle(state.pose.heading + turn),
    };
    AgentState {
        pose,
        velocity: pose.direction() * end_speed,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;
    use gump_geometry::dvec2;
    use std::f64::consts::{FRAC_PI_2, PI};

    fn at_speed(speed: f64) -> AgentState {
        AgentState {
            pose: Pose::IDENTITY,
            velocity: dvec2(speed, 0.0),
        }
    }

    #[test]
    fn straight_driving_is_uniform_acceleration() {
        let end = drive(&at_speed(10.0), 2.0, 0.0, 0.5);
        assert_abs_diff_eq!(end.pose.position.x, 5.25, epsilon = 1e-12);
        assert_abs_diff_eq!(end.velocity.x, 11.0, epsilon = 1e-12);
    }

    #[test]
    fn a_quarter_circle_ends_where_geometry_says() {
        let radius = 10.0;
        let dt = radius * FRAC_PI_2 / 5.0;
        let end = drive(&at_speed(5.0), 0.0, 1.0 / radius, dt);
        assert_abs_diff_eq!(end.pose.position.x, radius, epsilon = 1e-9);
        assert_abs_diff_eq!(end.pose.position.y, radius, epsilon = 1e-9);
        assert_abs_diff_eq!(end.pose.heading, FRAC_PI_2, epsilon = 1e-12);
        assert_abs_diff_eq!(end.velocity.y, 5.0, epsilon = 1e-9);
    }

    #[test]
    fn many_small_steps_equal_one_large_step() {
        let mut state = at_speed(3.0);
        for _ in 0..100 {
            state = drive(&state, 1.0, -0.05, 0.02);
        }
        let once = drive(&at_speed(3.0), 1.0, -0.05, 2.0);
        assert_abs_diff_eq!(state.pose.position.x, once.pose.position.x, epsilon = 1e-9);
        assert_abs_diff_eq!(state.pose.position.y, once.pose.position.y, epsilon = 1e-9);
        assert_abs_diff_eq!(state.pose.heading, once.pose.heading, epsilon = 1e-9);
    }

    #[test]
    fn braking_ends_at_standstill() {
        let end = drive(&at_speed(2.0), -4.0, 0.1, 1.0);
        assert_eq!(end.velocity.length(), 0.0);
        assert_abs_diff_eq!(end.pose.heading, 0.05, epsilon = 1e-12);
        let rest = drive(&at_speed(0.0), -4.0, PI, 1.0);
        assert_eq!(rest.pose, Pose::IDENTITY);
    }
}
