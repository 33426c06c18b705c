//! Actions: the ego's possible motion in one step.
//!
//! An action is a point of the box [-1, 1]; a [`Dynamics`] defines its meaning. Limits apply here
//! rather than in a policy, so that every world sees the same vehicle.

use gump_geometry::{DVec2, Pose, angle_difference, dvec2};
use gump_rollout::dynamics::drive;
use gump_scene::AgentState;
use serde::{Deserialize, Serialize};

/// The meaning of an action.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case", deny_unknown_fields)]
#[non_exhaustive]
pub enum Dynamics {
    /// Two numbers, held for the step, of a kinematic bicycle: acceleration (-1 the hardest braking, 0
    /// none, 1 the hardest acceleration) and steering (the share of the sharpest turn possible at this
    /// speed, positive to the left). Braking ends at rest, for a vehicle that rolls backwards, too.
    Bicycle(BicycleLimits),
    /// Three numbers: the ego's pose after the step, in its own frame, tracked perfectly.
    NextPose(PoseLimits),
    /// 48 numbers: the poses after 1 to 16 steps, each in the present ego frame and as (x, y,
    /// heading); pose `k` has `k` times the range of the first. The first is tracked perfectly, the
    /// others state the intention.
    Trajectory(PoseLimits),
}

/// Limits of a vehicle.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BicycleLimits {
    /// Hardest braking, metres per second squared, < 0.
    pub min_acceleration: f64,
    /// Hardest acceleration, metres per second squared, > 0.
    pub max_acceleration: f64,
    /// Sharpest turn to either side, radians per metre, > 0.
    pub max_curvature: f64,
    /// Sharpest turn at speed: curvature times speed squared, metres per second squared, > 0.
    pub max_lateral_acceleration: f64,
    /// Highest speed, metres per second, > 0.
    pub max_speed: f64,
}

/// Limits of a pose relative to the one before.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PoseLimits {
    /// Minimum metres ahead.
    pub min_dx: f64,
    /// Maximum metres ahead.
    pub max_dx: f64,
    /// Maximum metres to either side, > 0.
    pub max_dy: f64,
    /// Maximum turn to either side, radians, > 0.
    pub max_turn: f64,
}

/// Poses of a [`Dynamics::Trajectory`]: 8 s at half a second, as in the paper's policy.
const N_POSES: usize = 16;

impl Default for BicycleLimits {
    /// Accelerations within nuPlan's comfort bounds, -4.05 and 2.40 m/s². A turning radius of 5 m,
    /// the lower end of the turning circles of 10 to 12 m that makers state for passenger cars.
    /// 6 m/s² across, well within dry-road grip; 30 m/s, above any limit of a city.
    fn default() -> Self {
        Self {
            min_acceleration: -4.05,
            max_acceleration: 2.40,
            max_curvature: 0.2,
            max_lateral_acceleration: 6.0,
            max_speed: 30.0,
        }
    }
}

impl Default for PoseLimits {
    /// For steps of half a second: up to 30 m/s ahead, a little back, half a radian of turn. Our
    /// choice: the paper states no bounds.
    fn default() -> Self {
        Self {
            min_dx: -1.0,
            max_dx: 15.0,
            max_dy: 2.0,
            max_turn: 0.5,
        }
    }
}

impl Default for Dynamics {
    fn default() -> Self {
        Self::Bicycle(BicycleLimits::default())
    }
}

impl Dynamics {
    /// Length of an action.
    pub fn action_len(&self) -> usize {
        match self {
            Self::Bicycle(_) => 2,
            Self::NextPose(_) => 3,
            Self::Trajectory(_) => 3 * N_POSES,
        }
    }

    /// The name of the first parameter that is out of range, with its value and what is expected.
    pub(crate) fn check(&self) -> Option<(&'static str, f64, &'static str)> {
        let expected = "a positive number";
        let parameters = match self {
            Self::Bicycle(limits) => vec![
                ("-min_acceleration", -limits.min_acceleration),
                ("max_acceleration", limits.max_acceleration),
                ("max_curvature", limits.max_curvature),
                ("max_lateral_acceleration", limits.max_lateral_acceleration),
                ("max_speed", limits.max_speed),
            ],
            Self::NextPose(limits) | Self::Trajectory(limits) => vec![
                ("max_dx - min_dx", limits.max_dx - limits.min_dx),
                ("max_dy", limits.max_dy),
                ("max_turn", limits.max_turn),
            ],
        };
        let mut wrong = parameters
            .into_iter()
            .filter(|(_, v)| !(*v > 0.0 && v.is_finite()));
        wrong.next().map(|(name, value)| (name, value, expected))
    }

    /// The ego `elapsed` seconds into a step of `dt` seconds that began at `now`.
    ///
    /// Shape: `action` is `[action_len]`, finite numbers in [-1, 1].
    pub fn advance(&self, now: &AgentState, action: &[f32], dt: f64, elapsed: f64) -> AgentState {
        match self {
            Self::Bicycle(limits) => {
                let acceleration = limits.acceleration(now, f64::from(action[0]), dt);
                let curvature = limits.sharpest(now) * f64::from(action[1]);
                drive(now, acceleration, curvature, elapsed)
            }
            Self::NextPose(limits) | Self::Trajectory(limits) => {
                let step = limits.pose(&action[..3], 1.0);
                let next = now.pose * step;
                AgentState {
                    pose: now.pose.interpolate(next, elapsed / dt),
                    velocity: (next.position - now.pose.position) / dt,
                }
            }
        }
    }

    /// All poses that an action of [`Dynamics::Trajectory`] intends, in the world frame; for other
    /// dynamics the result of the action.
    pub fn intended(&self, now: &AgentState, action: &[f32], dt: f64) -> Vec<Pose> {
        match self {
            Self::Trajectory(limits) => action
                .chunks_exact(3)
                .zip(1..)
                .map(|(pose, k)| now.pose * limits.pose(pose, f64::from(k)))
                .collect(),
            _ => vec![self.advance(now, action, dt, dt).pose],
        }
    }

    /// The action that comes nearest to `targets`, which lie `dt`, `2 * dt`, ... seconds ahead;
    /// past the last one the vehicle is assumed to keep its velocity.
    ///
    /// Shape: `action` is `[action_len]`. A bicycle steers for the first target and corrects half
    /// of its accumulated error per step, so that it neither drifts nor oscillates.
    pub fn towards(&self, now: &AgentState, targets: &[AgentState], dt: f64, action: &mut [f32]) {
        let coasting = AgentState {
            pose: Pose {
                position: now.pose.position + now.velocity * dt,
                ..now.pose
            },
            ..*now
        };
        let first = targets.first().unwrap_or(&coasting);
        match self {
            Self::Bicycle(limits) => limits.towards(now, first, dt, action),
            Self::NextPose(limits) => {
                action.copy_from_slice(&limits.action(now.pose.inverse() * first.pose, 1.0));
            }
            Self::Trajectory(limits) => {
                for (k, pose) in action.chunks_exact_mut(3).enumerate() {
                    let target = targets.get(k).copied().unwrap_or_else(|| {
                        let last = targets.last().unwrap_or(&coasting);
                        let late = (k + 1 - targets.len().max(1)) as f64 * dt;
                        let position = last.pose.position + last.velocity * late;
                        let pose = Pose {
                            position,
                            ..last.pose
                        };
                        AgentState { pose, ..*last }
                    });
                    let relative = now.pose.inverse() * target.pose;
                    pose.copy_from_slice(&limits.action(relative, (k + 1) as f64));
                }
            }
        }
    }
}

impl BicycleLimits {
    /// Metres per second squared, such that the speed stays within its limit.
    fn acceleration(&self, now: &AgentState, share: f64, dt: f64) -> f64 {
        let speed = now.velocity.dot(now.pose.direction());
        let wanted = if share >= 0.0 {
            share * self.max_acceleration
        } else if speed < 0.0 {
            // Logged egos roll backwards by rounding and noise: they would get ever faster.
            share * self.min_acceleration
        } else {
            -share * self.min_acceleration
        };
        wanted.min(((self.max_speed - speed) / dt).max(self.min_acceleration))
    }

    /// The sharpest turn at this speed, radians per metre.
    fn sharpest(&self, now: &AgentState) -> f64 {
        let speed_squared = now.velocity.length_squared();
        if speed_squared * self.max_curvature > self.max_lateral_acceleration {
            self.max_lateral_acceleration / speed_squared
        } else {
            self.max_curvature
        }
    }

    fn towards(&self, now: &AgentState, target: &AgentState, dt: f64, action: &mut [f32]) {
        let forward = now.pose.direction();
        let speed = now.velocity.dot(forward);
        let offset = now.pose.inverse() * target.pose.position;
        let turn = angle_difference(target.pose.heading, now.pose.heading);
        // The chord of an arc is shorter than the arc.
        let half = turn / 2.0;
        let stretch = if half.abs() < 1e-6 {
            1.0
        } else {
            half / half.sin()
        };
        let distance = offset.x.signum() * offset.length() * stretch;
        let matching_speed = (target.velocity.dot(target.pose.direction()) - speed) / dt;
        let reaching = 2.0 * (distance - speed * dt) / (dt * dt);
        let wanted = (matching_speed + reaching) / 2.0;
        // Backwards no action makes it faster.
        let acceleration = if speed < 0.0 { wanted.max(0.0) } else { wanted };
        let share = if acceleration < 0.0 {
            -acceleration / self.min_acceleration
        } else {
            acceleration / self.max_acceleration
        };
        // At a crawl the direction of the next pose is noise.
        let curvature = if distance.abs() < 0.2 {
            0.0
        } else {
            let matching_heading = turn / distance;
            let reaching = 2.0 * offset.y / offset.length_squared();
            (matching_heading + reaching) / 2.0
        };
        let steering = curvature / self.sharpest(now);
        action.copy_from_slice(&[share, steering].map(|v| v.clamp(-1.0, 1.0) as f32));
    }
}

impl PoseLimits {
    /// The pose, relative to the ego's, that three numbers in [-1, 1] encode.
    fn pose(&self, action: &[f32], k: f64) -> Pose {
        let [x, y, heading] = [0, 1, 2].map(|i| f64::from(action[i]));
        let (center, half) = self.ahead();
        Pose {
            position: dvec2(center + half * x, self.max_dy * y) * k,
            heading: gump_geometry::wrap_angle(self.max_turn * heading * k),
        }
    }

    fn action(&self, pose: Pose, k: f64) -> [f32; 3] {
        let (center, half) = self.ahead();
        let DVec2 { x, y } = pose.position / k;
        let turn = pose.heading / k;
        [(x - center) / half, y / self.max_dy, turn / self.max_turn]
            .map(|v| v.clamp(-1.0, 1.0) as f32)
    }

    fn ahead(&self) -> (f64, f64) {
        (
            (self.max_dx + self.min_dx) / 2.0,
            (self.max_dx - self.min_dx) / 2.0,
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;

    const DT: f64 = 0.5;

    fn at_speed(speed: f64) -> AgentState {
        let pose = Pose::new(100.0, -50.0, 0.7);
        AgentState {
            pose,
            velocity: pose.direction() * speed,
        }
    }

    #[test]
    fn a_bicycle_by_hand() {
        let bicycle = Dynamics::default();
        let speed_after = |speed: f64, action: f32| {
            let next = bicycle.advance(&at_speed(speed), &[action, 0.0], DT, DT);
            next.velocity.length()
        };
        assert_abs_diff_eq!(speed_after(10.0, 0.0), 10.0, epsilon = 1e-9);
        assert_abs_diff_eq!(speed_after(10.0, 1.0), 11.2, epsilon = 1e-9);
        assert_abs_diff_eq!(speed_after(10.0, -0.5), 10.0 - 4.05 / 4.0, epsilon = 1e-9);
        // The limit is kept, and a vehicle beyond it comes back to it.
        assert_abs_diff_eq!(speed_after(29.9, 1.0), 30.0, epsilon = 1e-9);
        assert_abs_diff_eq!(speed_after(31.0, 1.0), 30.0, epsilon = 1e-9);
        assert_eq!(speed_after(1.0, -1.0), 0.0);
        // 0.2 per metre at 2 m/s, 6 / 100 at 10 m/s.
        let turn_after = |speed: f64| {
            let next = bicycle.advance(&at_speed(speed), &[0.0, 1.0], DT, DT);
            angle_difference(next.pose.heading, 0.7)
        };
        assert_abs_diff_eq!(turn_after(2.0), 0.2, epsilon = 1e-9);
        assert_abs_diff_eq!(turn_after(10.0), 0.06 * 5.0, epsilon = 1e-9);
    }

    #[test]
    fn braking_backwards_ends_at_rest() {
        let bicycle = Dynamics::default();
        let mut now = at_speed(-0.4);
        let start = now.pose.position;
        for _ in 0..10 {
            now = bicycle.advance(&now, &[-0.5, 0.0], DT, DT);
        }
        assert_eq!(now.velocity.length(), 0.0);
        // By 2.025 m/s² from 0.4 m/s.
        assert_abs_diff_eq!(
            now.pose.position.distance(start),
            0.16 / 4.05,
            epsilon = 1e-9
        );
        // Who backs up faster and faster is followed as far as possible: at a constant speed.
        let mut action = [0.0; 2];
        bicycle.towards(&at_speed(-1.0), &[at_speed(-3.0)], DT, &mut action);
        assert_eq!(action[0], 0.0);
    }

    #[test]
    fn a_step_in_pieces_ends_where_the_whole_ends() {
        let now = at_speed(8.0);
        for dynamics in [
            Dynamics::default(),
            Dynamics::NextPose(PoseLimits::default()),
        ] {
            let action = [0.4, -0.3, 0.2];
            let action = &action[..dynamics.action_len()];
            let whole = dynamics.advance(&now, action, DT, DT);
            let almost = dynamics.advance(&now, action, DT, DT - 1e-9);
            assert!(whole.pose.position.distance(almost.pose.position) < 1e-6);
            assert!((whole.velocity - almost.velocity).length() < 1e-6);
        }
    }

    /// The action towards where another action leads is that action.
    #[test]
    fn actions_are_found_again() {
        let now = at_speed(8.0);
        let check = |dynamics: Dynamics, action: &[f32], tolerance: f32| {
            let next = dynamics.advance(&now, action, DT, DT);
            let mut found = vec![0.0; dynamics.action_len()];
            dynamics.towards(&now, &[next], DT, &mut found);
            for (found, expected) in found.iter().zip(action) {
                assert!((found - expected).abs() < tolerance, "{dynamics:?}");
            }
        };
        check(Dynamics::default(), &[0.5, -0.2], 1e-3);
        check(Dynamics::default(), &[-0.5, 0.4], 1e-3);
        check(
            Dynamics::NextPose(PoseLimits::default()),
            &[0.2, -0.1, 0.3],
            1e-5,
        );
    }

    #[test]
    fn a_trajectory_is_driven_pose_by_pose() {
        let trajectory = Dynamics::Trajectory(PoseLimits::default());
        let now = at_speed(8.0);
        let target = |k: f64| AgentState {
            pose: now.pose * Pose::new(4.0 * k, 0.1 * k * k, 0.02 * k),
            velocity: now.velocity,
        };
        let targets: Vec<AgentState> = (1..=16).map(|k| target(f64::from(k))).collect();
        let mut action = vec![0.0; trajectory.action_len()];
        trajectory.towards(&now, &targets, DT, &mut action);
        let intended = trajectory.intended(&now, &action, DT);
        for (intended, target) in intended.iter().zip(&targets) {
            assert!(intended.position.distance(target.pose.position) < 1e-4);
            assert!(angle_difference(intended.heading, target.pose.heading).abs() < 1e-5);
        }
        let next = trajectory.advance(&now, &action, DT, DT);
        assert_eq!(next.pose, intended[0]);
        // Unknown targets continue straight on.
        trajectory.towards(&now, &targets[..2], DT, &mut action);
        let intended = trajectory.intended(&now, &action, DT);
        let expected = targets[1].pose.position + now.velocity * DT * 14.0;
        assert!(intended[15].position.distance(expected) < 1e-3);
    }
}
