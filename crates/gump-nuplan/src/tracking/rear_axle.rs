//! The kinematic bicycle about the rear axle, with actuator lag.
//!
//! The bicycle model of `gump-rollout` moves box centres by commands; this one is the vehicle that
//! nuPlan's controllers steer, step by step.

use std::f64::consts::FRAC_PI_3;

use gump_geometry::{DVec2, Pose, dvec2, wrap_angle};
use gump_scene::EgoState;

// Lags and the largest angle are defaults of nuPlan's kinematic bicycle model.
/// Time constant of the engine and brakes, seconds.
const ACCELERATION_LAG: f64 = 0.2;
/// Time constant of the steering, seconds.
const STEERING_LAG: f64 = 0.05;
/// Largest steering angle to either side, radians.
const MAX_STEERING: f64 = FRAC_PI_3;

/// The inputs of a vehicle from its controller.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Controls {
    /// Along the heading, metres per second squared.
    pub acceleration: f64,
    /// Change of the steering angle, radians per second.
    pub steering_rate: f64,
}

/// The state at `time_us`, after `state` and with `controls` held in between.
///
/// One Euler step of the kinematic bicycle; acceleration and steering follow the controls with
/// first-order lags. The speed may fall below zero.
///
/// Source: nuPlan's kinematic bicycle model (agrees with its goldens to rounding).
pub fn propagate(state: &EgoState, controls: &Controls, wheel_base: f64, time_us: i64) -> EgoState {
    let dt = (time_us - state.time_us) as f64 * 1e-6;
    propagate_by(state, controls, wheel_base, dt, time_us)
}

/// [`propagate`] over exactly `dt` seconds, whatever the timestamps.
pub fn propagate_by(
    state: &EgoState,
    controls: &Controls,
    wheel_base: f64,
    dt: f64,
    time_us: i64,
) -> EgoState {
    let speed = state.velocity.x;
    let pose = state.rear_axle;
    let acceleration = state.acceleration.x
        + dt / (dt + ACCELERATION_LAG) * (controls.acceleration - state.acceleration.x);
    let steering_rate = controls.steering_rate * dt / (dt + STEERING_LAG);
    let heading = wrap_angle(pose.heading + speed * state.steering_angle.tan() / wheel_base * dt);
    let next_speed = speed + acceleration * dt;
    let steering = (state.steering_angle + steering_rate * dt).clamp(-MAX_STEERING, MAX_STEERING);
    let yaw_rate = next_speed * steering.tan() / wheel_base;
    EgoState {
        time_us,
        rear_axle: Pose {
            position: pose.position + pose.direction() * (speed * dt),
            heading,
        },
        velocity: dvec2(next_speed, 0.0),
        acceleration: DVec2::new(acceleration, 0.0),
        steering_angle: steering,
        steering_rate,
        yaw_rate,
        yaw_acceleration: (yaw_rate - state.yaw_rate) / dt,
    }
}
