//! Speeds and accelerations, and the steps at which their differences are valid.

use super::config::Algorithm;
use super::input::State;

/// Seconds between steps.
const DT: f32 = 0.1;
/// Its square as the reference rounds it: in f64 first.
const DT_SQUARED: f32 = 0.01;

/// The neighbours that a difference is taken between.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Differences {
    /// This step less the one before: 2023.
    Backward,
    /// Half of the next less the one before: since 2024. Both ends are NaN, which counts.
    Central,
}

impl From<Algorithm> for Differences {
    fn from(algorithm: Algorithm) -> Self {
        if algorithm.is_2023() {
            Self::Backward
        } else {
            Self::Central
        }
    }
}

impl Differences {
    fn of(self, values: &[f32]) -> Vec<f32> {
        let n = values.len();
        (0..n)
            .map(|t| match self {
                Self::Backward if t > 0 => values[t] - values[t - 1],
                Self::Central if t > 0 && t + 1 < n => (values[t + 1] - values[t - 1]) / 2.0,
                _ => f32::NAN,
            })
            .collect()
    }

    /// Speed along the ground at one step, m/s; NaN at the ends.
    pub(crate) fn ground_speed(self, states: &[State], t: usize) -> f32 {
        let (a, b, divisor) = match self {
            Self::Backward if t > 0 => (t - 1, t, 1.0),
            Self::Central if t > 0 && t + 1 < states.len() => (t - 1, t + 1, 2.0),
            _ => return f32::NAN,
        };
        let step = |i: usize| (states[b].position[i] - states[a].position[i]) / divisor;
        let (x, y) = (step(0), step(1));
        (x * x + y * y).sqrt() / DT
    }
}

/// Motion of one agent, per step.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Kinematics {
    /// Speed in space, m/s.
    pub(crate) linear_speed: Vec<f32>,
    /// Change of that speed, m/s².
    pub(crate) linear_acceleration: Vec<f32>,
    /// rad/s.
    pub(crate) angular_speed: Vec<f32>,
    /// rad/s².
    pub(crate) angular_acceleration: Vec<f32>,
}

/// Speeds and accelerations of one agent from its states; NaN where a neighbour is missing.
///
/// Positions of invalid states are used unchanged, as in the reference.
pub(crate) fn kinematics(states: &[State], differences: Differences) -> Kinematics {
    let column = |f: &dyn Fn(&State) -> f32| states.iter().map(f).collect::<Vec<_>>();
    let [x, y, z] = [0, 1, 2].map(|i| differences.of(&column(&|s| s.position[i])));
    let norm = |t: usize| (x[t] * x[t] + y[t] * y[t] + z[t] * z[t]).sqrt();
    let linear_speed: Vec<f32> = (0..states.len()).map(|t| norm(t) / DT).collect();
    let acceleration = differences.of(&linear_speed).into_iter().map(|a| a / DT);
    let heading = differences.of(&column(&|s| s.heading));
    let (angular_speed, angular_acceleration) = match differences {
        Differences::Backward => {
            let speed: Vec<f32> = heading.into_iter().map(|a| wrap(a) / DT).collect();
            // The reference wraps a difference of rad/s here.
            let change = differences.of(&speed).into_iter().map(|a| wrap(a) / DT);
            let change = change.collect();
            (speed, change)
        }
        Differences::Central => {
            let step: Vec<f32> = heading.into_iter().map(|a| wrap(a * 2.0) / 2.0).collect();
            let change = differences.of(&step).into_iter();
            let change = change.map(|a| wrap(a * 2.0) / 2.0 / DT_SQUARED).collect();
            (step.into_iter().map(|a| a / DT).collect(), change)
        }
    };
    Kinematics {
        linear_acceleration: acceleration.collect(),
        linear_speed,
        angular_speed,
        angular_acceleration,
    }
}

/// The steps at which speeds, and at which accelerations, are computed from valid states only.
///
/// Source: as in the reference, a central difference does not require the step in its middle, and
/// the first step never counts.
pub(crate) fn validity(valid: &[bool], differences: Differences) -> (Vec<bool>, Vec<bool>) {
    let narrow = |valid: &[bool]| -> Vec<bool> {
        let n = valid.len();
        (0..n)
            .map(|k| match differences {
                Differences::Backward => k > 0 && valid[k] && valid[k - 1],
                Differences::Central => k > 0 && k + 1 < n && valid[k - 1] && valid[k + 1],
            })
            .collect()
    };
    let speed = narrow(valid);
    let acceleration = narrow(&speed);
    (speed, acceleration)
}

/// An angle in [-π, π), in f32 throughout.
fn wrap(angle: f32) -> f32 {
    const PI: f32 = std::f32::consts::PI;
    const TWO_PI: f32 = 2.0 * PI;
    let rest = (angle + PI) % TWO_PI;
    let floored = if rest < 0.0 { rest + TWO_PI } else { rest };
    floored - PI
}
