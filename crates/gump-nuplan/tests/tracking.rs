//! The tracker and the vehicle against nuPlan's, step by step.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use approx::assert_abs_diff_eq;
use gump_geometry::{Pose, angle_difference, dvec2, wrap_angle};
use gump_nuplan::tracking::{LqrTracker, Trajectory, propagate};
use gump_scene::EgoState;
use serde_json::Value;

const WHEEL_BASE: f64 = 3.089;

fn numbers(value: &Value) -> Vec<f64> {
    let list = value.as_array().unwrap().iter();
    list.map(|v| v.as_f64().unwrap()).collect()
}

fn reference(run: &Value) -> Trajectory {
    let rows = run["reference"].as_array().unwrap().iter().map(numbers);
    let states = rows.map(|row| EgoState {
        time_us: row[0].round() as i64,
        rear_axle: Pose::new(row[1], row[2], wrap_angle(row[3])),
        ..EgoState::default()
    });
    Trajectory::new(states.collect()).unwrap()
}

fn initial(run: &Value, trajectory: &Trajectory) -> EgoState {
    let first = trajectory.states()[0];
    let offsets = numbers(&run["initial"]["offsets"]);
    let mut pose = first.rear_axle;
    pose.position += dvec2(offsets[0], offsets[1]);
    pose.heading += offsets[2];
    EgoState {
        time_us: first.time_us,
        rear_axle: pose,
        velocity: dvec2(offsets[3], 0.0),
        acceleration: dvec2(run["initial"]["accel_x"].as_f64().unwrap(), 0.0),
        steering_angle: offsets[4],
        ..EgoState::default()
    }
}

fn check_profile(found: &[f64], values: &Value, rates: &Value) {
    let (values, rates) = (numbers(values), numbers(rates));
    assert_eq!(found.len(), values.len());
    for (found, expected) in found.iter().zip(&values) {
        assert_abs_diff_eq!(found, expected, epsilon = 1e-7);
    }
    for (pair, expected) in found.windows(2).zip(&rates) {
        assert_abs_diff_eq!((pair[1] - pair[0]) / 0.1, *expected, epsilon = 1e-6);
    }
}

#[test]
fn the_tracked_vehicle_agrees_step_by_step() {
    let golden: Value = serde_json::from_str(include_str!("data/lqr_bicycle.json")).unwrap();
    let mut n_steps = 0;
    for run in golden["runs"].as_array().unwrap() {
        let trajectory = reference(run);
        let mut ego = initial(run, &trajectory);
        let mut tracker = LqrTracker::default();
        for (i, step) in run["steps"].as_array().unwrap().iter().enumerate() {
            let controls = tracker.track(&ego, &trajectory, WHEEL_BASE).unwrap();
            let expected = |key: &str| step[key].as_f64().unwrap();
            assert_abs_diff_eq!(controls.acceleration, expected("accel_cmd"), epsilon = 1e-7);
            assert_abs_diff_eq!(
                controls.steering_rate,
                expected("steer_rate_cmd"),
                epsilon = 1e-7
            );
            let state = numbers(&step["state"]);
            ego = propagate(&ego, &controls, WHEEL_BASE, state[0] as i64);
            let found = [
                ego.rear_axle.position.x,
                ego.rear_axle.position.y,
                state[3] + angle_difference(ego.rear_axle.heading, state[3]),
                ego.velocity.x,
                ego.velocity.y,
                ego.acceleration.x,
                ego.acceleration.y,
                ego.steering_angle,
                ego.yaw_rate,
                ego.yaw_acceleration,
                ego.steering_rate,
            ];
            for (field, (found, expected)) in found.iter().zip(&state[1..]).enumerate() {
                let off = (found - expected).abs();
                assert!(
                    off < 1e-7,
                    "{} step {i} field {field}: off by {off}",
                    run["kind"]
                );
            }
            n_steps += 1;
        }
        let profile = tracker.profile();
        check_profile(
            &profile.speeds,
            &run["velocity_profile"],
            &run["acceleration_profile"],
        );
        check_profile(
            &profile.curvatures,
            &run["curvature_profile"],
            &run["curvature_rate_profile"],
        );
    }
    assert!(n_steps >= 250);
}
