//! Comfort of a whole drive: smoothed accelerations, jerks and turning, all within bounds.
//!
//! The bounds are those of [`gump_metrics::Discomfort`]. The difference is smoothing: a finished
//! drive can be smoothed, while a reward only has the past.

use gump_geometry::DVec2;
use gump_scene::{EgoState, VehicleParameters};

use super::savgol::SavitzkyGolay;
use super::statistics::{mean_step, round8};
use gump_metrics::{ComfortBounds, ComfortMeasurements};

/// The motion of a vehicle: one entry per sample in every list.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct Motion {
    /// Times, microseconds, increasing.
    pub times_us: Vec<i64>,
    /// Headings, radians.
    pub headings: Vec<f64>,
    /// Acceleration of the box centre in the vehicle's frame (x ahead, y left), metres per second
    /// squared.
    pub centre_accelerations: Vec<DVec2>,
    /// Magnitude of the acceleration of the rear axle, metres per second squared.
    pub accelerations: Vec<f64>,
}

impl Motion {
    /// The motion of a vehicle from its states.
    pub fn of(vehicle: &VehicleParameters, states: &[EgoState]) -> Self {
        let lever = vehicle.rear_axle_to_center();
        // Both terms of turning act along x, unlike those of a rigid body: as in the devkit.
        let at_centre = |s: &EgoState| {
            let swing = lever * (s.yaw_rate * s.yaw_rate + s.yaw_acceleration);
            s.acceleration + DVec2::new(swing, 0.0)
        };
        Self {
            times_us: states.iter().map(|s| s.time_us).collect(),
            headings: states.iter().map(|s| s.rear_axle.heading).collect(),
            centre_accelerations: states.iter().map(at_centre).collect(),
            accelerations: states.iter().map(|s| s.acceleration.length()).collect(),
        }
    }
}

/// The smoothed series that comfort is evaluated on, one value per sample.
///
/// Source: nuPlan's comfort metrics; values are rounded to 8 decimals after each filter, as in the
/// devkit.
#[derive(Clone, Debug, PartialEq)]
pub struct ComfortSeries {
    /// Along the heading, metres per second squared.
    pub longitudinal_acceleration: Vec<f64>,
    /// Across the heading, metres per second squared.
    pub lateral_acceleration: Vec<f64>,
    /// Magnitude at the rear axle, metres per second squared.
    pub acceleration: Vec<f64>,
    /// Derivative of `acceleration`, metres per second cubed. (Not the length of the jerk vector.)
    pub jerk: Vec<f64>,
    /// Derivative of `longitudinal_acceleration`, metres per second cubed.
    pub longitudinal_jerk: Vec<f64>,
    /// Derivative of `lateral_acceleration`, metres per second cubed.
    pub lateral_jerk: Vec<f64>,
    /// Radians per second.
    pub yaw_rate: Vec<f64>,
    /// Radians per second squared.
    pub yaw_acceleration: Vec<f64>,
}

/// Windows of the filters, samples.
///
/// Source: nuplan-devkit; its own window of 15 for yaw rates is never passed on, so the default of
/// 5 is in force.
const ACCELERATION_WINDOW: usize = 8;
const JERK_WINDOW: usize = 15;
const YAW_WINDOW: usize = 5;

impl ComfortSeries {
    /// Smooths a drive; `None` for fewer than four samples, which do not determine a cubic, or time
    /// stamps that do not increase.
    pub fn of(motion: &Motion) -> Option<Self> {
        let dt = mean_step(&motion.times_us);
        if dt <= 0.0 {
            return None;
        }
        let part = |axis: fn(&DVec2) -> f64| -> Vec<f64> {
            motion.centre_accelerations.iter().map(axis).collect()
        };
        let longitudinal_acceleration = smoothed(&part(|a| a.x))?;
        let lateral_acceleration = smoothed(&part(|a| a.y))?;
        let acceleration = smoothed(&motion.accelerations)?;
        let headings = unwrapped(&motion.headings);
        Some(Self {
            jerk: jerk(&acceleration, dt)?,
            longitudinal_jerk: jerk(&longitudinal_acceleration, dt)?,
            lateral_jerk: jerk(&lateral_acceleration, dt)?,
            yaw_rate: filtered(&headings, YAW_WINDOW, 2, 1, dt)?,
            yaw_acceleration: filtered(&headings, YAW_WINDOW, 3, 2, dt)?,
            longitudinal_acceleration,
            lateral_acceleration,
            acceleration,
        })
    }

    /// True if every value lies strictly inside its bounds.
    pub fn is_comfortable(&self, bounds: &ComfortBounds) -> bool {
        (0..self.acceleration.len()).all(|i| {
            bounds.allow(&ComfortMeasurements {
                longitudinal_acceleration: self.longitudinal_acceleration[i],
                lateral_acceleration: self.lateral_acceleration[i],
                yaw_rate: Some(self.yaw_rate[i]),
                yaw_acceleration: Some(self.yaw_acceleration[i]),
                longitudinal_jerk: Some(self.longitudinal_jerk[i]),
                jerk: Some(self.jerk[i]),
            })
        })
    }
}

fn smoothed(values: &[f64]) -> Option<Vec<f64>> {
    filtered(values, ACCELERATION_WINDOW, 2, 0, 1.0)
}

fn jerk(acceleration: &[f64], dt: f64) -> Option<Vec<f64>> {
    filtered(acceleration, JERK_WINDOW, 2, 1, dt)
}

fn filtered(
    values: &[f64],
    window: usize,
    polynomial: usize,
    derivative: usize,
    delta: f64,
) -> Option<Vec<f64>> {
    let filter = SavitzkyGolay {
        window: window.min(values.len()),
        polynomial,
        derivative,
        delta,
    };
    let filtered = filter.filter(values)?;
    Some(filtered.into_iter().map(round8).collect())
}

/// Headings without jumps of full turns.
fn unwrapped(headings: &[f64]) -> Vec<f64> {
    let turn = std::f64::consts::TAU;
    let mut turns = 0.0;
    let mut last = headings.first().copied().unwrap_or_default();
    headings
        .iter()
        .map(|&heading| {
            turns += ((heading - last) / turn).round_ties_even();
            last = heading;
            heading - turn * turns
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_geometry::dvec2;

    fn drive(n: usize, acceleration: f64, yaw_rate: f64) -> Motion {
        let times_us: Vec<i64> = (0..n as i64).map(|i| i * 100_000).collect();
        Motion {
            headings: (0..n)
                .map(|i| gump_geometry::wrap_angle(3.0 + 0.1 * i as f64 * yaw_rate))
                .collect(),
            centre_accelerations: vec![dvec2(acceleration, 0.0); n],
            accelerations: vec![acceleration.abs(); n],
            times_us,
        }
    }

    #[test]
    fn bounds_are_excluded() {
        let check = |acceleration, yaw_rate, expected| {
            let series = ComfortSeries::of(&drive(30, acceleration, yaw_rate)).unwrap();
            assert_eq!(series.is_comfortable(&ComfortBounds::NUPLAN), expected);
        };
        check(2.39, 0.94, true);
        check(2.40, 0.0, false);
        check(-4.04, 0.0, true);
        check(-4.05, 0.0, false);
        check(0.0, -0.96, false);
    }

    #[test]
    fn four_samples_are_needed() {
        assert!(ComfortSeries::of(&drive(3, 0.0, 0.0)).is_none());
        assert!(ComfortSeries::of(&drive(4, 0.0, 0.0)).is_some());
        assert!(ComfortSeries::of(&Motion::default()).is_none());
    }
}
