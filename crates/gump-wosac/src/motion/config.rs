//! Settings of the challenge: times, thresholds, number of modes, shapes.

use std::fmt;
use std::str::FromStr;

use serde::de::IntoDeserializer as _;
use serde::de::value::Error as NameError;
use serde::{Deserialize, Serialize};

/// The settings of a motion-prediction benchmark.
#[derive(Clone, Debug, PartialEq)]
pub struct MotionConfig {
    /// Seconds between the positions of a path; the first one is this long after the present.
    pub step_seconds: f64,
    /// Positions in a path.
    pub n_steps: usize,
    /// Number of modes that count, the first ones in the order of the predictor; others are
    /// ignored.
    pub max_modes: usize,
    /// The horizons of measurement, in ascending order.
    pub horizons: Vec<Horizon>,
    /// Scale of the miss thresholds for slow agents.
    pub speed_scale: SpeedScale,
    /// Rules that classify recorded paths by shape.
    pub shapes: ShapeRules,
}

/// One horizon.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Horizon {
    /// Index into a path, from 0; averages and overlaps include all positions up to it.
    pub step: usize,
    /// Largest error across the recorded heading that is a match, metres.
    pub lateral: f64,
    /// Largest error along the recorded heading that is a match, metres.
    pub longitudinal: f64,
}

/// Scale of the miss thresholds, by the recorded speed at the present.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SpeedScale {
    /// Below this speed [`slow`](Self::slow) holds, metres per second.
    pub lower_speed: f64,
    /// Above this speed [`fast`](Self::fast) holds, metres per second; linear in between.
    pub upper_speed: f64,
    /// Factor of slow agents.
    pub slow: f64,
    /// Factor of fast agents.
    pub fast: f64,
}

/// The definition of the shapes of recorded paths.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ShapeRules {
    /// Since March 2024.
    Current,
    /// Leaderboards of 2021 to 2023: coarser limits, and turns from headings that are not wrapped.
    #[serde(rename = "until-2023")]
    Until2023,
}

impl ShapeRules {
    /// All of them, in the order of declaration.
    pub const ALL: [Self; 2] = [Self::Current, Self::Until2023];
}

impl fmt::Display for ShapeRules {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

impl FromStr for ShapeRules {
    type Err = NameError;

    /// Finds a value by the name that it is stored and displayed under.
    ///
    /// # Errors
    /// A sentence with the unknown name and the known ones.
    fn from_str(name: &str) -> Result<Self, NameError> {
        Self::deserialize(name.into_deserializer())
    }
}

impl MotionConfig {
    /// The Waymo motion prediction challenge: 16 positions at 2 Hz, 6 modes, 3, 5 and 8 s.
    ///
    /// Source: the published challenge configuration; its numbers are f32.
    pub fn challenge() -> Self {
        let horizon = |step, lateral: f32, longitudinal: f32| Horizon {
            step,
            lateral: lateral.into(),
            longitudinal: longitudinal.into(),
        };
        Self {
            step_seconds: 0.5,
            n_steps: 16,
            max_modes: 6,
            horizons: vec![
                horizon(5, 1.0, 2.0),
                horizon(9, 1.8, 3.6),
                horizon(15, 3.0, 6.0),
            ],
            speed_scale: SpeedScale {
                lower_speed: f64::from(1.4_f32),
                upper_speed: 11.0,
                slow: 0.5,
                fast: 1.0,
            },
            shapes: ShapeRules::Current,
        }
    }

    /// Seconds from the present to a horizon.
    pub fn seconds(&self, horizon: &Horizon) -> f64 {
        (horizon.step + 1) as f64 * self.step_seconds
    }
}

impl SpeedScale {
    /// The factor for a speed in metres per second.
    pub fn at(&self, speed: f64) -> f64 {
        if speed < self.lower_speed {
            return self.slow;
        }
        if speed > self.upper_speed {
            return self.fast;
        }
        let share = (speed - self.lower_speed) / (self.upper_speed - self.lower_speed);
        self.slow + share * (self.fast - self.slow)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;

    #[test]
    fn thresholds_shrink_for_slow_agents() {
        let scale = MotionConfig::challenge().speed_scale;
        let check = |speed, expected| {
            assert_abs_diff_eq!(scale.at(speed), expected, epsilon = 1e-7);
        };
        check(0.0, 0.5);
        check(1.4, 0.5);
        check(6.2, 0.75);
        check(11.0, 1.0);
        check(30.0, 1.0);
    }

    #[test]
    fn horizons_are_at_three_five_and_eight_seconds() {
        let config = MotionConfig::challenge();
        let seconds: Vec<f64> = config.horizons.iter().map(|h| config.seconds(h)).collect();
        assert_eq!(seconds, [3.0, 5.0, 8.0]);
    }
}
