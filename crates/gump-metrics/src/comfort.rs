//! Comfort of the motion.

use gump_scene::{Agent, SceneState};

use crate::{Metric, Reduce, kinematics};

/// 1 if any comfort bound is broken now, else 0.
///
/// Bounds that cannot be computed yet do not count; `None` if not even an acceleration is known.
/// Differences are taken frame by frame, so noisy tracks may exceed bounds that the smoothed drive
/// keeps; `ComfortSeries` of `gump-nuplan` smooths finished drives.
///
/// Source: the bounds of nuPlan's comfort metric, see [`ComfortBounds`].
#[derive(Clone, Copy, Debug)]
pub struct Discomfort;

/// Bounds of comfort; absolute values except for the longitudinal acceleration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ComfortBounds {
    /// Lowest acceleration along the heading, metres per second squared.
    pub min_acceleration: f64,
    /// Highest acceleration along the heading, metres per second squared.
    pub max_acceleration: f64,
    /// Acceleration across the heading, metres per second squared.
    pub lateral_acceleration: f64,
    /// Radians per second.
    pub yaw_rate: f64,
    /// Radians per second squared.
    pub yaw_acceleration: f64,
    /// Jerk along the heading, metres per second cubed.
    pub longitudinal_jerk: f64,
    /// Change of the magnitude of the acceleration, metres per second cubed.
    pub jerk: f64,
}

/// Accelerations, rates and jerks at one instant; `None` where unknown.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ComfortMeasurements {
    /// Along the heading, metres per second squared.
    pub longitudinal_acceleration: f64,
    /// Across the heading, metres per second squared.
    pub lateral_acceleration: f64,
    /// Radians per second.
    pub yaw_rate: Option<f64>,
    /// Radians per second squared.
    pub yaw_acceleration: Option<f64>,
    /// Along the heading, metres per second cubed.
    pub longitudinal_jerk: Option<f64>,
    /// Change of the magnitude of the acceleration, metres per second cubed.
    pub jerk: Option<f64>,
}

impl ComfortBounds {
    /// True if every known value lies strictly inside its bounds.
    pub fn allow(&self, felt: &ComfortMeasurements) -> bool {
        let within = |value: Option<f64>, bound: f64| value.is_none_or(|v| v.abs() < bound);
        let along = felt.longitudinal_acceleration;
        self.min_acceleration < along
            && along < self.max_acceleration
            && within(Some(felt.lateral_acceleration), self.lateral_acceleration)
            && within(felt.yaw_rate, self.yaw_rate)
            && within(felt.yaw_acceleration, self.yaw_acceleration)
            && within(felt.longitudinal_jerk, self.longitudinal_jerk)
            && within(felt.jerk, self.jerk)
    }

    /// The values of nuPlan's comfort metric.
    pub const NUPLAN: Self = Self {
        min_acceleration: -4.05,
        max_acceleration: 2.40,
        lateral_acceleration: 4.89,
        yaw_rate: 0.95,
        yaw_acceleration: 1.93,
        longitudinal_jerk: 4.13,
        jerk: 8.37,
    };
}

impl Metric for Discomfort {
    fn name(&self) -> &'static str {
        "discomfort"
    }

    fn at(&self, scene: &SceneState<'_>, agent: &Agent) -> Option<f64> {
        let forward = agent.state.pose.direction();
        let acceleration = kinematics::acceleration(scene, agent.id)?;
        let felt = ComfortMeasurements {
            longitudinal_acceleration: acceleration.dot(forward),
            lateral_acceleration: acceleration.dot(forward.perp()),
            yaw_rate: kinematics::yaw_rate(scene, agent.id),
            yaw_acceleration: kinematics::yaw_acceleration(scene, agent.id),
            longitudinal_jerk: kinematics::jerk(scene, agent.id).map(|jerk| jerk.dot(forward)),
            jerk: kinematics::acceleration_change(scene, agent.id),
        };
        Some(f64::from(!ComfortBounds::NUPLAN.allow(&felt)))
    }

    fn reduce(&self) -> Reduce {
        Reduce::Any
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_geometry::{Pose, dvec2};
    use gump_scene::{AgentState, Frame, fixture};

    /// The ego in three frames `dt` apart, given as (heading, vx, vy).
    fn check(dt: f64, states: [(f64, f64, f64); 3], expected: f64) {
        let history = 2.0 * dt;
        let text = format!("ego vehicle 0: 0,0\nhistory {history} future 0 dt {dt}");
        let mut scenario = fixture::scenario(&text).unwrap();
        for (frame, (heading, vx, vy)) in scenario.log.iter_mut().zip(states) {
            let state = AgentState {
                pose: Pose::new(0.0, 0.0, heading),
                velocity: dvec2(vx, vy),
            };
            *frame = Frame::new(vec![frame.agents()[0].with_state(state)], vec![]);
        }
        let scene = scenario.present();
        let found = Discomfort.at(&scene, scene.ego_now());
        assert_eq!(found, Some(expected), "{states:?}");
    }

    #[test]
    fn accelerations_are_bounded() {
        check(1.0, [(0.0, 5.0, 0.0); 3], 0.0);
        check(
            1.0,
            [(0.0, 5.0, 0.0), (0.0, 7.3, 0.0), (0.0, 9.6, 0.0)],
            0.0,
        );
        check(
            1.0,
            [(0.0, 5.0, 0.0), (0.0, 7.5, 0.0), (0.0, 10.0, 0.0)],
            1.0,
        );
        check(
            1.0,
            [(0.0, 9.0, 0.0), (0.0, 5.0, 0.0), (0.0, 1.0, 0.0)],
            0.0,
        );
        check(
            1.0,
            [(0.0, 9.0, 0.0), (0.0, 4.9, 0.0), (0.0, 0.8, 0.0)],
            1.0,
        );
        check(
            1.0,
            [(0.0, 0.0, 0.0), (0.0, 0.0, 4.8), (0.0, 0.0, 9.6)],
            0.0,
        );
        check(
            1.0,
            [(0.0, 0.0, 0.0), (0.0, 0.0, 5.0), (0.0, 0.0, 10.0)],
            1.0,
        );
    }

    #[test]
    fn jerk_is_bounded() {
        // Along the heading 2.0 + 2.0 and 2.4 + 1.9; magnitude, across the heading, 8.2 and 8.4.
        check(
            1.0,
            [(0.0, 5.0, 0.0), (0.0, 3.0, 0.0), (0.0, 5.0, 0.0)],
            0.0,
        );
        check(
            1.0,
            [(0.0, 5.0, 0.0), (0.0, 2.6, 0.0), (0.0, 4.5, 0.0)],
            1.0,
        );
        check(
            0.5,
            [(0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 2.05)],
            0.0,
        );
        check(
            0.5,
            [(0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 2.1)],
            1.0,
        );
    }

    #[test]
    fn turning_is_bounded() {
        check(
            1.0,
            [(0.0, 5.0, 0.0), (0.9, 5.0, 0.0), (1.8, 5.0, 0.0)],
            0.0,
        );
        check(
            1.0,
            [(0.0, 5.0, 0.0), (1.0, 5.0, 0.0), (2.0, 5.0, 0.0)],
            1.0,
        );
        check(
            0.5,
            [(0.2, 5.0, 0.0), (0.0, 5.0, 0.0), (0.2, 5.0, 0.0)],
            0.0,
        );
        check(
            0.5,
            [(0.3, 5.0, 0.0), (0.0, 5.0, 0.0), (0.3, 5.0, 0.0)],
            1.0,
        );
    }
}
